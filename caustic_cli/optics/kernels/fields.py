"""CPU kernels of the wave image: a field from its phase, its power on pixels, and the adjoint of both.

The functions of `waves.propagation.Exposure`, the reference.  Every kernel passes over memory once, which is what its time consists
of.  Cosine and sine are polynomials: with k = round(x / pi) and r = x - k pi,

    sin x = (-1)^k sin r,    cos x = (-1)^k cos r,    |r| <= pi / 2,

which the compiler can vectorise, with an error below 2e-7 for phases of a few hundred radians.

Complex numbers are pairs of float32 in arrays of twice the length: loops over those are vectorised.  Pixels lie between edges,
in samples, see `pixel_edges`.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import torch
from torch import Tensor

from caustic_cli.optics.kernels import blocks
from caustic_cli.optics.kernels.jit import FAST, njit
from caustic_cli.optics.kernels.refraction import interact
from caustic_cli.optics.kernels.spline import place
from caustic_cli.optics.kernels.surface import FusedSurface
from caustic_cli.optics.kernels.threads import ALL, on_threads
from caustic_cli.optics.surfaces import HeightField
from caustic_cli.optics.waves.propagation import Exposure
from caustic_cli.optics.waves.wavefront import LastSurface, PathChange
from caustic_cli.scene import Lens

_ONE = np.float32(1.0)
# pi as a sum, whose first term has few enough digits for its multiples to be exact.
_PI, _PI_REST, _OVER = np.float32(3.140625), np.float32(np.pi - 3.140625), np.float32(1.0 / np.pi)
# Minimax polynomials of sin r / r and cos r in r^2.
_SINE = (9.9999997906e-01, -1.6666648664e-01, 8.3329129069e-03, -1.9801545764e-04, 2.5915867883e-06)
_COSINE = (9.9999999899e-01, -4.9999998084e-01, 4.1666604079e-02, -1.3888058426e-03, 2.4748173102e-05, -2.5883402666e-07)
_S1, _S2, _S3, _S4, _S5 = map(np.float32, _SINE)
_C1, _C2, _C3, _C4, _C5, _C6 = map(np.float32, _COSINE)


@njit(inline="always", **FAST)
def _turn(x):
    """cos x and sin x, float32."""
    k = np.floor(x * _OVER + np.float32(0.5))
    r = (x - k * _PI) - k * _PI_REST
    sign = _ONE - np.float32(2.0) * (k - np.float32(2.0) * np.floor(np.float32(0.5) * k))
    q = r * r
    sine = r * (_S1 + q * (_S2 + q * (_S3 + q * (_S4 + q * _S5))))
    cosine = _C1 + q * (_C2 + q * (_C3 + q * (_C4 + q * (_C5 + q * _C6))))
    return sign * cosine, sign * sine


@njit(entry=True, **FAST)
def make_field(block, phase, factor, moved, amplitude, out, blocks):
    """amplitude exp(i (phase + factor moved)), (n, m) -> out (N, 2 M), whose other rows and columns are left as they are."""
    if on_threads(block, blocks, (phase, factor, moved, amplitude, out, blocks)):
        return
    n, m = phase.shape
    for k in range(block * n // blocks, (block + 1) * n // blocks):
        at, by, high, row = phase[k], moved[k], amplitude[k], out[k]
        for j in range(m):
            c, s = _turn(at[j] + factor * by[j])
            row[2 * j] = high[j] * c
            row[2 * j + 1] = high[j] * s


@njit(entry=True, **FAST)
def make_pull(block, back, phase, factor, moved, amplitude, out, blocks):
    """Add the derivative by `moved` to out (n, m): 2 factor amplitude Im(back exp(-i (phase + factor moved))), back (N, 2 M)."""
    if on_threads(block, blocks, (back, phase, factor, moved, amplitude, out, blocks)):
        return
    n, m = phase.shape
    twice = np.float32(2.0) * factor
    for k in range(block * n // blocks, (block + 1) * n // blocks):
        at, by, high, row, total = phase[k], moved[k], amplitude[k], back[k], out[k]
        for j in range(m):
            c, s = _turn(at[j] + factor * by[j])
            total[j] += twice * high[j] * (row[2 * j + 1] * c - row[2 * j] * s)


@njit(inline="always", **FAST)
def _overlap(sample, edges, pixel):
    """Fraction of a sample inside a pixel."""
    return max(0.0, min(sample + 1.0, edges[pixel + 1]) - max(float(sample), edges[pixel]))


@njit(entry=True, **FAST)
def on_pixels(block, field, rows, columns, out, blocks):
    """Power |field|^2 of samples (N, 2 M) on pixels, out (a, b) float64; rows (a + 1,), columns (b + 1,): their edges."""
    if on_threads(block, blocks, (field, rows, columns, out, blocks)):
        return
    a, b, wide = len(rows) - 1, len(columns) - 1, field.shape[1]
    squares = np.empty(wide, np.float32)
    for p in range(block * a // blocks, (block + 1) * a // blocks):
        squares[:] = 0.0
        for r in range(int(rows[p]), int(np.ceil(rows[p + 1]))):
            share, row = np.float32(_overlap(r, rows, p)), field[r]
            for j in range(wide):
                squares[j] += share * row[j] * row[j]
        for q in range(b):
            total = 0.0
            for s in range(int(columns[q]), int(np.ceil(columns[q + 1]))):
                total += _overlap(s, columns, q) * (squares[2 * s] + squares[2 * s + 1])
            out[p, q] = total


@njit(entry=True, **FAST)
def widen(block, by_pixel, columns, out, blocks):
    """Derivatives by pixels (a, b) -> by the squares of samples along y, out (a, 2 M), overwritten."""
    if on_threads(block, blocks, (by_pixel, columns, out, blocks)):
        return
    a, b = by_pixel.shape
    for p in range(block * a // blocks, (block + 1) * a // blocks):
        out[p] = 0.0
        for q in range(b):
            for s in range(int(columns[q]), int(np.ceil(columns[q + 1]))):
                value = np.float32(_overlap(s, columns, q) * by_pixel[p, q])
                out[p, 2 * s] += value
                out[p, 2 * s + 1] += value


@njit(entry=True, **FAST)
def weigh(block, field, widened, rows, blocks):
    """Multiply samples (N, 2 M) by derivatives of pixels (a, 2 M), see `widen`."""
    if on_threads(block, blocks, (field, widened, rows, blocks)):
        return
    n, wide = field.shape
    mixed = np.empty(wide, np.float32)
    for r in range(block * n // blocks, (block + 1) * n // blocks):
        first = max(0, np.searchsorted(rows, r, "right") - 1)
        last = min(len(rows) - 1, np.searchsorted(rows, r + 1, "left"))
        row = field[r]
        mixed[:] = 0.0
        for p in range(first, last):
            share, value = np.float32(_overlap(r, rows, p)), widened[p]
            for j in range(wide):
                mixed[j] += share * value[j]
        for j in range(wide):
            row[j] *= mixed[j]


@njit(entry=True, **FAST)
def displace(block, u, v, c, pu, pv, pieces, weight, out, blocks):
    """A weight times a height field at points (u, v) of [0, 1]^2, (n, m) -> out (n, m).

    c: coefficients as of `spline`, (I, J, (p + 1) (q + 1)); pu, pv: tuples of p + 1 and q + 1 numbers, of known lengths.
    """
    if on_threads(block, blocks, (u, v, c, pu, pv, pieces, weight, out, blocks)):
        return
    n, m = u.shape
    for k in range(block * n // blocks, (block + 1) * n // blocks):
        for s in range(m):
            i, j, xi, eta = place(u[k, s], v[k, s], pieces)
            local, z = c[i, j], 0.0
            for a in range(len(pu) - 1, -1, -1):
                row = 0.0
                for b in range(len(pv) - 1, -1, -1):
                    row = row * eta + local[a * len(pv) + b]
                z = z * xi + row
            out[k, s] = weight[k, s] * z


@njit(entry=True, **FAST)
def pull_displacement(block, u, v, by, pu, pv, pieces, weight, grads):
    """Adjoint of `displace`: derivatives by the coefficients into grads (blocks, I, J, (p + 1) (q + 1)), overwritten."""
    if on_threads(block, len(grads), (u, v, by, pu, pv, pieces, weight, grads)):
        return
    (n, m), blocks, grad = u.shape, len(grads), grads[block]
    grad[:] = 0.0
    for k in range(block * n // blocks, (block + 1) * n // blocks):
        for s in range(m):
            i, j, xi, eta = place(u[k, s], v[k, s], pieces)
            local, along = grad[i, j], by[k, s] * weight[k, s]
            for a in range(len(pu)):
                term = along
                for b in range(len(pv)):
                    local[a * len(pv) + b] += term
                    term *= eta
                along *= xi


class FusedExposure(Exposure):
    """`waves.propagation.Exposure` by these kernels, in float32; the field of all exposures of one shape is the same memory."""

    def __init__(self, phase: Tensor, amplitude: Tensor, factor: float, shape: tuple[int, int], edges: tuple[Tensor, Tensor]):
        super().__init__(phase, amplitude, factor, shape, edges)
        self.limits = tuple(e.numpy() for e in edges)
        self.spectrum: Tensor | None = None

    def image(self, change: Tensor, keep: bool = False) -> Tensor:
        """As the reference."""
        out, spectrum = torch.empty(self.resolution, dtype=torch.float64), self._spectrum(change)
        on_pixels(ALL, _pairs(spectrum), *self.limits, out.numpy(), blocks())
        self.spectrum = spectrum if keep else None
        return out

    def pull(self, by_pixel: Tensor, change: Tensor, out: Tensor) -> None:
        """As the reference."""
        spectrum, self.spectrum = self._spectrum(change) if self.spectrum is None else self.spectrum, None
        widened = np.empty((self.resolution[0], 2 * self.shape[1]), np.float32)
        widen(ALL, by_pixel.contiguous().numpy(), self.limits[1], widened, blocks())
        weigh(ALL, _pairs(spectrum), widened, self.limits[0], blocks())
        back = torch.fft.ifft2(spectrum, norm="ortho")
        make_pull(ALL, _pairs(back), *self._field(change), out.numpy(), blocks())

    def _spectrum(self, change: Tensor) -> Tensor:
        field = _buffer(self.shape, tuple(self.phase.shape))
        make_field(ALL, *self._field(change), _pairs(field), blocks())
        return torch.fft.fft2(field, norm="ortho")

    def _field(self, change: Tensor) -> tuple:
        return self.phase.numpy(), np.float32(self.factor), change.numpy(), self.amplitude.numpy()


@lru_cache(maxsize=1)
def _buffer(shape: tuple[int, int], inside: tuple[int, int]) -> Tensor:
    """A field (N, M) that is 0 outside its first (n, m) samples."""
    return torch.zeros(shape, dtype=torch.complex64)


def _pairs(field: Tensor) -> np.ndarray:
    """(N, M) complex64 as (N, 2 M) float32."""
    return field.numpy().view(np.float32)


class FusedPathChange(PathChange):
    """`waves.wavefront.PathChange` by these kernels, in float32."""

    def __init__(self, surface: HeightField, last: LastSurface, dtype: torch.dtype):
        super().__init__(surface, last, dtype)
        self.spline = FusedSurface(surface.spaces, surface.half_size)
        at = ((0.5 * (c / r + 1.0)).float().numpy() for c, r in zip((last.x, last.y), surface.half_size, strict=True))
        self.orders = tuple((0,) * (s.degree + 1) for s in surface.spaces)
        self.points, self.weight = tuple(at), last.sensitivity.float().numpy()

    def of(self, heights: Tensor) -> Tensor:
        """As the reference."""
        out, c = torch.empty(self.weight.shape, dtype=torch.float32), self._flat(self.spline.coefficients(heights))
        displace(ALL, *self.points, c, *self.orders, self.spline.pieces, self.weight, out.numpy(), blocks())
        return out

    def pull(self, by: Tensor) -> Tensor:
        """As the reference."""
        grads = self.spline.workspace()
        pull_displacement(ALL, *self.points, by.numpy(), *self.orders, self.spline.pieces, self.weight, self._flat(grads))
        return torch.from_numpy(self.spline.pull(grads))

    @staticmethod
    def _flat(c: np.ndarray) -> np.ndarray:
        return c.reshape(*c.shape[:-2], -1)


def compile_kernels() -> None:
    """Load all of them from the cache, or compile them, by calling them on the least of fields; and before them refraction of the
    rays that are traced for it."""
    ray = torch.ones(1, dtype=torch.float64)
    interact((0.0, 0.0, 1.0), (0.0 * ray, 0.0 * ray), ray, eta=1.5, fresnel="exact")
    surface, one = HeightField.of(Lens((2.0, 2.0), control=(4, 4))), torch.ones(1, 1)
    edges = torch.linspace(0.0, 2.0, 2, dtype=torch.float64)
    light = FusedExposure(one, one, 1.0, (2, 2), (edges, edges))
    paths = FusedPathChange(surface, LastSurface(one.double(), one.double(), one.double()), torch.float32)
    out = torch.zeros(1, 1)
    light.pull(light.image(paths.of(torch.zeros(4, 4, dtype=torch.float64))), one, out)
    paths.pull(out)
