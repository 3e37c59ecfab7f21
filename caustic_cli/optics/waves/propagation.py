"""Fresnel propagation from the reference plane to the screen by a single Fourier transform, with its adjoint.

    U(X) = 1 / (i lambda L) exp(i k X^2 / 2 L)  integral  u(x) exp(i k x^2 / 2 L) exp(-i k x X / L) dx

Only |U|^2 is needed, so the factor in front of the integral is omitted; the rest is a discrete Fourier transform of samples dx
apart (`sampling`), unitary up to rounding: sum |U|^2 = sum |u|^2.  The phase is defined such that this integral, which is exact for
parabolic wavefronts, reproduces the landing point of every traced ray (`wavefront`).

Without derivatives, the transform is computed along y for blocks of rows and along x for blocks of columns, in bounded memory.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import cast

import numpy as np
import torch
from torch import Tensor

from caustic_cli.optics.pullback import pull_back
from caustic_cli.optics.waves.sampling import Sampling

TURN = 2.0 * math.pi
#: Rows or columns transformed at a time: those of 20,000 samples took 1.7 times as long with 256, whose blocks are mapped anew.
BLOCK = 64


def ramp(sampling: Sampling, wavelength: float, axis: int, device: torch.device) -> Tensor:
    """Phase (n,) rad of the Fresnel kernel along one axis, with the shift to the first screen sample `Sampling.first`; float64."""
    j = torch.arange(sampling.count[axis], dtype=torch.float64, device=device)
    x = sampling.low[axis] + (j + 0.5) * sampling.step[axis]
    k, x0 = TURN / wavelength, sampling.first(wavelength)[axis]
    return torch.remainder(k * (0.5 * x * x - x0 * x) / sampling.distance, TURN)


def phase_of(path: Tensor, sampling: Sampling, length: float, behind: float, part: slice = slice(None)) -> Tensor:
    """Phase, rad, less whole turns, of samples with these optical paths, mm, including the Fresnel kernel: rows `part`, (rows, m)
    float64.

    length, behind: wavelength in vacuum and in the image space, mm.
    """
    across, along = (ramp(sampling, behind, k, path.device) / TURN for k in (0, 1))
    turns = path * (1.0 / length)  # in place from here on: allocations cost more than the sums
    turns += across[part, None]
    turns += along
    return turns.frac_().mul_(TURN)


def pixel_edges(low: float, width: float, count: int, first: float, spacing: float, samples: int) -> Tensor:
    """Edges of the pixels along one axis, in samples of the screen, which are intervals of width `spacing`: (count + 1,) float64.

    low, width: of the first pixel; first: centre of the first sample; all mm.
    """
    edges = low + width * torch.arange(count + 1, dtype=torch.float64)
    return ((edges - first) / spacing + 0.5).clamp(0.0, float(samples))


def cells(edges: Tensor, samples: int) -> Tensor:
    """Fractions of the screen's samples inside each pixel along one axis, between edges (count + 1,): (count, N) float64."""
    start = torch.arange(samples, dtype=torch.float64, device=edges.device)
    reach = (edges[:, None] - start[None, :]).clamp(0.0, 1.0)  # fraction of each sample below each edge
    return reach[1:] - reach[:-1]


class _Illuminance(torch.autograd.Function):
    """Phase and amplitude of a field (n, m) -> power on pixels; see `power_on_pixels`."""

    @staticmethod
    def forward(ctx, phase: Tensor, amplitude: Tensor, shape: tuple[int, int], rows: Tensor, columns: Tensor) -> Tensor:
        u = torch.polar(amplitude, phase)
        big = torch.fft.fft2(u, s=shape, norm="ortho")
        ctx.save_for_backward(phase, amplitude, big, rows, columns)
        return rows @ (big.real.square() + big.imag.square()) @ columns.T

    @staticmethod
    def backward(ctx, by_pixel: Tensor):
        phase, amplitude, big, rows, columns = ctx.saved_tensors
        n, m = phase.shape
        back = torch.fft.ifft2(big * (rows.T @ by_pixel @ columns), norm="ortho")[:n, :m]
        unit = torch.polar(torch.ones_like(phase), phase)
        turned = back * unit.conj()
        return 2.0 * amplitude * turned.imag, 2.0 * turned.real, None, None, None


def power_on_pixels(phase: Tensor, amplitude: Tensor, shape: tuple[int, int], rows: Tensor, columns: Tensor) -> Tensor:
    """Power on the pixels of a screen, (a, b), from the field on the reference plane; differentiable by phase and amplitude.

    Args:
        phase, amplitude: (n, m), rad, including `ramp`, and the square root of the power of each sample.
        shape: (N, M) of the transform.
        rows, columns: (a, N) and (b, M), see `cells`.
    """
    return _Illuminance.apply(phase, amplitude, shape, rows, columns)


class Exposure:
    """The image of light of one wavelength as a function of a change of its optical paths, and its adjoint.

    Args:
        phase, amplitude: (n, m), as of `power_on_pixels`.
        factor: rad/mm, of the change of the path.
        shape: (N, M) of the transform.
        edges: of the pixels along both axes, see `pixel_edges`.
    """

    def __init__(self, phase: Tensor, amplitude: Tensor, factor: float, shape: tuple[int, int], edges: tuple[Tensor, Tensor]):
        self.phase, self.amplitude, self.factor, self.shape, self.edges = phase, amplitude, factor, shape, edges

    @property
    def resolution(self) -> tuple[int, int]:
        """Pixels along both axes."""
        return len(self.edges[0]) - 1, len(self.edges[1]) - 1

    def image(self, change: Tensor, keep: bool = False) -> Tensor:
        """Power on pixels (a, b) for a change (n, m) mm; keep: what takes time for the adjoint at the same change."""
        masks = (cells(e.to(self.phase.device), n).to(self.phase) for e, n in zip(self.edges, self.shape, strict=True))
        return power_on_pixels(self.phase + self.factor * change, self.amplitude, self.shape, *masks)

    def pull(self, by_pixel: Tensor, change: Tensor, out: Tensor) -> None:
        """Add the derivative by the change (n, m) to `out`, from that by the power on pixels (a, b)."""
        with torch.enable_grad():
            leaf = change.detach().requires_grad_()
            found = self.image(leaf)
        out += pull_back([found], [leaf], [by_pixel.to(found.dtype)])[0]


@torch.no_grad()
def power_by_blocks(
    field: Callable[[slice], Tensor], sampling: Sampling, pieces: int, rows: Tensor, columns: Tensor, block: int = BLOCK
) -> tuple[Tensor, float]:
    """`power_on_pixels` without derivatives, for a complex field that is provided in blocks of rows, (rows, m).

    The transform is computed in pieces of the screen's columns with bounded memory, (n, M / pieces) + (N, block).

    Returns:
        power on the pixels (a, b) float64, and the total power of the transform.
    """
    (n, _), (big, wide) = sampling.count, sampling.padded
    width = math.ceil(wide / pieces)
    image: Tensor | float = 0.0
    whole = 0.0
    half: Tensor | None = None
    for left in range(0, wide, width):
        right = min(wide, left + width)
        for start in range(0, n, block):
            u = field(slice(start, min(n, start + block)))
            half = u.new_empty(n, width) if half is None else half
            half[start : start + block, : right - left] = torch.fft.fft(u, n=wide, norm="ortho")[:, left:right]
        assert half is not None
        for start in range(0, right - left, block):
            u = torch.fft.fft(half[:, start : min(right - left, start + block)], n=big, dim=0, norm="ortho")
            power = u.real.square() + u.imag.square()
            whole += float(power.sum(dtype=torch.float64))
            at = slice(left + start, left + start + power.shape[1])
            image = image + ((rows @ power) @ columns[:, at].T).double()
    return cast(Tensor, image), whole


#: First and last pixels, the latter excluded, along each axis.
Box = tuple[tuple[int, int], tuple[int, int]]
#: Flops of a matrix product in the time of one of a Fourier transform.
PRODUCT = 8.0
#: Gauss points of a pixel: at least so many, and further ones for each Nyquist interval of the field in it.
POINTS, A_PERIOD = 2, 2.0
#: Nyquist intervals of the field for each point where these are as few as represent the light: its square varies twice as fast.
HALF = 0.55


class PrunedExposure(Exposure):
    """An `Exposure` of a rectangle of pixels alone; the others remain dark.  The field is taken at Gauss points j of its pixels by
    two matrix products,

        U = A_x u A_y^T,    A = exp(-2 pi i j m / N) / sqrt(N),    m = 0, 1, ...

    Args:
        box: the rectangle, None for all pixels; sparse: see `gauss_points`; all others as of an `Exposure`.
    """

    def __init__(
        self,
        phase: Tensor,
        amplitude: Tensor,
        factor: float,
        shape: tuple[int, int],
        edges: tuple[Tensor, Tensor],
        box: Box | None = None,
        sparse: bool = False,
    ):
        super().__init__(phase, amplitude, factor, shape, edges)
        box = box or _all(edges)
        self.box, self.kernels, self.weights, self.pixels = box, [], [], []
        for count, size, edge, ends in zip(phase.shape, shape, edges, box, strict=True):
            at, weight = gauss_points(edge.to(phase.device), ends, count / size, sparse)
            m = torch.arange(count, dtype=torch.float64, device=phase.device)
            turn = torch.remainder(at.reshape(-1, 1) * m / size, 1.0)
            self.kernels.append(torch.polar(torch.full_like(turn, size**-0.5), -TURN * turn).to(_complex(phase.dtype)))
            self.weights.append(weight.to(phase))
            self.pixels.append(slice(*ends))
        self._kept: Tensor | None = None

    def image(self, change: Tensor, keep: bool = False) -> Tensor:
        """As of an `Exposure`; not differentiable, but by `pull`."""
        field = self.field(change)
        self._kept = field if keep else None
        shape = [n for weight in self.weights for n in weight.shape]
        power = (field.real.square() + field.imag.square()).view(shape)
        image = power.new_zeros(self.resolution)
        image[tuple(self.pixels)] = torch.einsum("akbl,ak,bl->ab", power, *self.weights)
        return image

    def pull(self, by_pixel: Tensor, change: Tensor, out: Tensor) -> None:
        """As of an `Exposure`."""
        field = self.field(change) if self._kept is None else self._kept
        inner = by_pixel[tuple(self.pixels)].to(self.phase)
        field = field * torch.einsum("ab,ak,bl->akbl", inner, *self.weights).reshape(field.shape)
        back = (self.kernels[0].mH @ field) @ self.kernels[1].conj()
        unit = torch.polar(self.amplitude, self.phase + self.factor * change)
        out += (2.0 * self.factor) * (back * unit.conj()).imag
        self._kept = None

    def field(self, change: Tensor) -> Tensor:
        """U, for a change (n, m) mm of the optical paths."""
        return (self.kernels[0] @ torch.polar(self.amplitude, self.phase + self.factor * change)) @ self.kernels[1].T


def gauss_points(edge: Tensor, ends: tuple[int, int], part: float, sparse: bool = False) -> tuple[Tensor, Tensor]:
    """Gauss points of pixels, between edges (count + 1,) in samples, and their weights, in samples: (pixels, points) each.

    ends: first and last pixels, the latter excluded; part: samples of the field over those of its transform;
    sparse: as few points as represent the light, such as the middle of a pixel of half a Nyquist interval.
    """
    low, high = edge[ends[0] : ends[1]], edge[ends[0] + 1 : ends[1] + 1]
    width = part * float((high - low).max())
    points = max(1, math.ceil(width / HALF)) if sparse else POINTS + math.ceil(A_PERIOD * width - 1e-9)
    t, w = (torch.from_numpy(c).to(edge) for c in np.polynomial.legendre.leggauss(points))
    return 0.5 * (low + high)[:, None] + 0.5 * (high - low)[:, None] * t - 0.5, 0.5 * (high - low)[:, None] * w


def _all(edges: tuple[Tensor, Tensor]) -> Box:
    """The rectangle of all pixels."""
    rows, columns = ((0, len(edge) - 1) for edge in edges)
    return rows, columns


def pruning_pays(
    shape: tuple[int, int], count: tuple[int, int], edges: tuple[Tensor, Tensor], box: Box | None = None, sparse: bool = False
) -> bool:
    """Whether a `PrunedExposure` is faster than an `Exposure`."""
    of_each = zip(edges, box or _all(edges), count, shape, strict=True)
    a, b = (gauss_points(edge, ends, n / size, sparse)[0].numel() for edge, ends, n, size in of_each)
    (n, m), whole = count, shape[0] * shape[1]
    return a * m * (n + b) < PRODUCT * whole * math.log2(whole)


def _complex(dtype: torch.dtype) -> torch.dtype:
    return torch.complex64 if dtype == torch.float32 else torch.complex128
