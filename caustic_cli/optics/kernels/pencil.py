"""Fused CPU kernel for the rays of a source point through a tensor product of points of the exit: see `optics.pencil`, whose
notation this is, and which is its plain-torch reference.

A row of rays shares x.  Height and slopes come from `rows`, direction and flux in front of the exit from one-dimensional Newton
steps; refraction, transfer and splat are those of `oblique_refraction` and `fused`, with directions D = (k X, k Y, 1) of length L
instead of unit vectors, so that nothing has to be normalised:

    M = D . N = 1 - k (X z_x + Y z_y),    S = sqrt(n^2 M^2 - (n^2 - 1) |N|^2 L^2),    Gamma = (1 - n^2) L^2 / (S + n M),

and the ray leaves along n D + Gamma N, here with n the ratio of the indices at the exit.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from caustic_cli.optics.kernels import filter_weights, fused, pixels
from caustic_cli.optics.kernels.arguments import Exit, ScreenFrame, Splat
from caustic_cli.optics.kernels.axial_refraction import (
    BY_GX,
    BY_GY,
    BY_POWER,
    BY_PX,
    BY_PY,
    BY_SAG,
    FLUX,
    FRESNEL,
    GX,
    GY,
    POWER,
    PX,
    PY,
    SAG,
    X,
    load,
)
from caustic_cli.optics.kernels.banded import AlongV
from caustic_cli.optics.kernels.fused import COLUMNS, _cut, _scatter, gather, share
from caustic_cli.optics.kernels.fused_functions import _images, _strided, _Workspace
from caustic_cli.optics.kernels.jit import FAST, njit
from caustic_cli.optics.kernels.oblique_refraction import REFLECTED_POWER, _copy, _put, _reflected
from caustic_cli.optics.kernels.rows import combine, spread
from caustic_cli.optics.kernels.stage import BATCH
from caustic_cli.optics.kernels.threads import ALL, on_threads
from caustic_cli.optics.reconstruction import Filter, padding
from caustic_cli.optics.tolerances import CRITICAL, PARALLEL
from caustic_cli.scene import Screen

# Rows of a batch's scratch: the surface, cell areas, Y, u, the emission J and its derivative by s, outputs and derivatives by them.
Z, ZX, ZY, AREA, Y, U, AT, J, J_S, OUT_FLUX, OUT_POWER, OUT_PX, OUT_PY, OUT_Z, OUT_ZX, OUT_ZY, ROWS = range(17)


class Point(NamedTuple):
    """The source point behind the flat entrance.

    x, y: mm; distance: h, mm; index: n of the entrance; steps: of Newton's iteration; scale: 2 / largest s, see `optics.pencil`.
    """

    x: float
    y: float
    distance: float
    index: float  # type: ignore[assignment]  # shadows `tuple.index`, which is not used
    steps: int
    scale: float


@njit(inline="always", **FAST)
def _slope(q, z, u, h, n):
    """c and h + z n^2 c^3, the derivative of u (h + z c) by u."""
    c = 1.0 / math.sqrt(n * n + (n - 1.0) * (n + 1.0) * q * u * u)
    return c, h + z * n * n * c * c * c


@njit(inline="always", **FAST)
def _cross(w, count, x, depth, point):
    """u of a batch, by Newton steps from the paraxial value, from which they increase to the root."""
    h, n = point.distance, point.index
    for j in range(count):
        w[U, j] = n / (n * h + depth + w[Z, j])
    for _ in range(point.steps):
        for j in range(count):
            q, z, u = x * x + w[Y, j] * w[Y, j], depth + w[Z, j], w[U, j]
            c, by_u = _slope(q, z, u, h, n)
            w[U, j] = u - (u * (h + z * c) - 1.0) / by_u


@njit(inline="always", **FAST)
def _emit(w, count, x, point, emission):
    """J of a batch and its derivative by s, by Horner's scheme in 2 s / s_max - 1."""
    for j in range(count):
        t = (x * x + w[Y, j] * w[Y, j]) * w[U, j] * w[U, j]
        w[AT, j], w[J, j], w[J_S, j] = point.scale * t / (1.0 + t) - 1.0, emission[0], 0.0
    for k in range(1, len(emission)):
        one = emission[k]
        for j in range(count):
            w[J_S, j] = w[J_S, j] * w[AT, j] + w[J, j]
            w[J, j] = w[J, j] * w[AT, j] + one
    for j in range(count):
        w[J_S, j] *= point.scale


@njit(inline="always", **FAST)
def _bend(w, j, x, depth, point, n):
    """Of ray j: q, z, c, dF/du, k, L^2, M, |N|^2, S, and whether it passes (S is 1 where it does not)."""
    y, zx, zy = w[Y, j], w[ZX, j], w[ZY, j]
    q, z = x * x + y * y, depth + w[Z, j]
    c, by_u = _slope(q, z, w[U, j], point.distance, point.index)
    k = w[U, j] * c
    long2, norm2 = 1.0 + k * k * q, 1.0 + zx * zx + zy * zy
    m = 1.0 - k * (x * zx + y * zy)
    radicand = n * n * m * m - (n - 1.0) * (n + 1.0) * norm2 * long2
    passes = radicand > CRITICAL * norm2 * long2
    return q, z, c, by_u, k, long2, m, norm2, math.sqrt(radicand if passes else 1.0), passes


@njit(inline="always", **FAST)
def _aim(w, count, x, point, exit_, frame):
    n, height, fresnel, depth = exit_.index, exit_.height, exit_.fresnel, -exit_.start
    over_x, over_y = 1.0 / frame.pixel_x, 1.0 / frame.pixel_y
    for j in range(count):
        _, _, _, by_u, k, long2, m, norm2, s, passes = _bend(w, j, x, depth, point, n)
        reflected, _, _, _ = _reflected(fresnel, m, s, norm2 * long2, n)
        flux = w[AREA, j] * w[J, j] * w[U, j] / by_u * max(m, 0.0)  # none arrives from above the surface
        gamma = (1.0 - n) * (1.0 + n) * long2 / (s + n * m)
        down = n + gamma
        path = (height - w[Z, j]) / down
        power = flux * (1.0 - reflected) if passes else REFLECTED_POWER
        w[OUT_FLUX, j] = flux
        w[OUT_POWER, j] = power if m > 0.0 else 0.0
        px = (point.x + x + path * (n * k * x - gamma * w[ZX, j]) - frame.low_x) * over_x
        w[OUT_PX, j] = px if down > PARALLEL else math.nan  # never arrives
        w[OUT_PY, j] = (point.y + w[Y, j] + path * (n * k * w[Y, j] - gamma * w[ZY, j]) - frame.low_y) * over_y


@njit(inline="always", **FAST)
def _take(w, v, start, count, y, area):
    """A batch of the surface, Y and cell areas."""
    _copy(v[SAG], start, count, w[Z])
    _copy(v[GX], start, count, w[ZX])
    _copy(v[GY], start, count, w[ZY])
    _copy(y, start, count, w[Y])
    load(area[start : start + count], w[AREA][:count])


@njit(**FAST)
def aim(v, x, y, area, point, emission, exit_, frame):
    """Flux in front of the exit, power behind it and landing points in pixels of a row of rays, from SAG, GX, GY; u into X."""
    w = np.empty((ROWS, BATCH))
    for start in range(0, len(y), BATCH):
        count = min(BATCH, len(y) - start)
        _take(w, v, start, count, y, area)
        _cross(w, count, x, -exit_.start, point)
        _emit(w, count, x, point, emission)
        _aim(w, count, x, point, exit_, frame)
        _put(w[U], start, count, v[X])
        _put(w[OUT_FLUX], start, count, v[FLUX])
        _put(w[OUT_POWER], start, count, v[POWER])
        _put(w[OUT_PX], start, count, v[PX])
        _put(w[OUT_PY], start, count, v[PY])


@njit(inline="always", **FAST)
def _pull(w, count, x, point, exit_):
    n, height, fresnel, depth, ratio2 = exit_.index, exit_.height, exit_.fresnel, -exit_.start, point.index * point.index
    for j in range(count):
        y, zx, zy, u = w[Y, j], w[ZX, j], w[ZY, j], w[U, j]
        q, z, c, by_u, k, long2, m, norm2, s, passes = _bend(w, j, x, depth, point, n)
        reflected, r_m, r_s, r_norm2 = _reflected(fresnel, m, s, norm2 * long2, n)
        density = w[AREA, j] * w[J, j] * u / by_u
        by_power, by_x, by_y = w[OUT_POWER, j], w[OUT_PX, j], w[OUT_PY, j]
        # power = density M (1 - R)
        loss = -by_power * density * m
        by_density, by_m = by_power * m * (1.0 - reflected), by_power * density * (1.0 - reflected) + loss * r_m
        by_s, by_both = loss * r_s, loss * r_norm2  # by |N|^2 L^2
        # landing point = (x, y) + path (n D + Gamma N), path = (height - z) / (n + Gamma)
        under = 1.0 / (s + n * m)
        gamma = (1.0 - n) * (1.0 + n) * long2 * under
        down = n + gamma
        arrives = down > PARALLEL
        over = 1.0 / (down if arrives else 1.0)
        by_x, by_y = by_x if arrives else 0.0, by_y if arrives else 0.0
        path = (height - w[Z, j]) * over
        by_path = by_x * (n * k * x - gamma * zx) + by_y * (n * k * y - gamma * zy)
        by_gamma = -path * (zx * by_x + zy * by_y) - by_path * path * over
        by_k = path * n * (x * by_x + y * by_y)
        # Gamma and S
        by_s -= gamma * by_gamma * under
        by_m -= n * gamma * by_gamma * under
        by_s /= s
        by_m += by_s * n * n * m
        by_both += by_s * (1.0 - n) * (1.0 + n) * 0.5
        by_long2 = by_both * norm2 + by_gamma * (1.0 - n) * (1.0 + n) * under
        by_norm2 = by_both * long2
        # M, L^2, and the dependence of k and the density on z at fixed x and y
        by_k += 2.0 * k * q * by_long2 - (x * zx + y * zy) * by_m
        c3, t = ratio2 * c * c * c, 1.0 + q * u * u
        u_z = -k / by_u
        c_z, s_z = -c * c * c * (ratio2 - 1.0) * q * u * u_z, 2.0 * q * u * u_z / (t * t)
        shrinks = (c + c3 + 3.0 * z * ratio2 * c * c * c_z) / by_u
        density_z = w[AREA, j] * u / by_u * (w[J_S, j] * s_z - w[J, j] * shrinks)
        lit = passes and m > 0.0
        w[OUT_Z, j] = -by_path * over + by_k * u_z * c3 + by_density * density_z if lit else 0.0
        w[OUT_ZX, j] = 2.0 * zx * by_norm2 - gamma * path * by_x - k * x * by_m if lit else 0.0
        w[OUT_ZY, j] = 2.0 * zy * by_norm2 - gamma * path * by_y - k * y * by_m if lit else 0.0


@njit(**FAST)
def pull(v, x, y, area, point, emission, exit_):
    """Adjoint of `aim`: derivatives by height and slopes, in BY_SAG, BY_GX, BY_GY.  BY_PX, BY_PY: per mm."""
    w = np.empty((ROWS, BATCH))
    for start in range(0, len(y), BATCH):
        count = min(BATCH, len(y) - start)
        _take(w, v, start, count, y, area)
        _copy(v[X], start, count, w[U])
        _emit(w, count, x, point, emission)
        _copy(v[BY_POWER], start, count, w[OUT_POWER])
        _copy(v[BY_PX], start, count, w[OUT_PX])
        _copy(v[BY_PY], start, count, w[OUT_PY])
        _pull(w, count, x, point, exit_)
        _put(w[OUT_Z], start, count, v[BY_SAG])
        _put(w[OUT_ZX], start, count, v[BY_GX])
        _put(w[OUT_ZY], start, count, v[BY_GY])


@njit(entry=True, **FAST)
def forward(block, images, ledgers, scratch, first, bu, du, net, net_y, x, y, area, point, emission, exit_, frame, splat):
    """As `fused.forward`, of points (x, y), mm from the source's projection, (a,) and (b,), each for an area (a, b), mm^2.

    emission: coefficients of J, the highest first; exit_: `start` is the height of the entrance.
    """
    if block == ALL:
        arguments = (images, ledgers, scratch, first, bu, du, net, net_y, x, y, area, point, emission, exit_, frame, splat)
        on_threads(len(images), arguments)
        return
    rows, blocks = len(x), len(images)
    images[block] = 0.0
    ledgers[block] = 0.0
    v, sx, sy, dx, dy = _cut(scratch[block], splat.size_x, splat.size_y)
    column = np.zeros(splat.size_y + -splat.size_y % 4)
    for i in range(block * rows // blocks, (block + 1) * rows // blocks):
        combine(i, first, bu, du, net, net, net_y, v[SAG], v[GX], v[GY])
        aim(v, x[i], y, area[i], point, emission, exit_, frame)
        share(v, splat, sx, sy, dx[:0], dy[:0])
        _scatter(v, exit_, frame, splat, sx, sy, images[block], ledgers[block], column)


@njit(entry=True, **FAST)
def backward(block, grad, grad_leaving, nets, scratch, first, bu, du, net, net_y, x, y, area, point, emission, exit_, frame, splat):
    """Adjoint of `forward`: derivatives by net and net_y in nets[0] and nets[2], as of `fused.backward`."""
    if block == ALL:
        arguments = (grad, grad_leaving, nets, scratch, first, bu, du, net, net_y, x, y, area, point, emission, exit_, frame, splat)
        on_threads(len(scratch), arguments)
        return
    rows, blocks = len(x), len(scratch)
    nets[:, block] = 0.0
    v, sx, sy, dx, dy = _cut(scratch[block], splat.size_x, splat.size_y)
    column, tilt = np.zeros(splat.size_y + -splat.size_y % 4), np.zeros(splat.size_y + -splat.size_y % 4)
    for i in range(block * rows // blocks, (block + 1) * rows // blocks):
        combine(i, first, bu, du, net, net, net_y, v[SAG], v[GX], v[GY])
        aim(v, x[i], y, area[i], point, emission, exit_, frame)
        share(v, splat, sx, sy, dx, dy)
        gather(v, exit_, frame, splat, sx, sy, dx, dy, grad, grad_leaving, column, tilt)
        pull(v, x[i], y, area[i], point, emission, exit_)
        spread(i, first, bu, du, v[BY_SAG], v[BY_GX], v[BY_GY], nets[:, block], False)


class PencilKernel:
    """The fused form of `optics.pencil`, `interface.interact`, landing and `reconstruction.splat`.

    Args:
        spaces, half_size: of the height field; half widths in mm.
        u, v: parameters of the points, which are all pairs of them; area: of the aperture for each, mm^2, scalar or (a, b).
        place: (x, y) of the source, mm; distance: of it from the entrance, which lies at z_in, mm; index: n of the entrance.
        emission: J, by `pencil.polynomial`, and the largest s.
        like: the kernel of another chunk, whose basis values along v serve again where v is the same tensor, with its workspace.
    """

    def __init__(
        self,
        spaces,
        half_size,
        u: Tensor,
        v: Tensor,
        area: Tensor,
        place: tuple[float, float],
        distance: float,
        z_in: float,
        index: float,
        emission: tuple[np.ndarray, float],
        like: PencilKernel | None = None,
    ):
        (su, sv), (rx, ry) = spaces, half_size
        first, bu = su.basis(u)
        self.rows = first.numpy(), bu.contiguous().numpy(), (su.basis(u, 1)[1] / (2.0 * rx)).contiguous().numpy()
        self.v = v
        self.along_v: AlongV = like.along_v if like is not None and like.v is v else AlongV(sv, v, 1.0 / (2.0 * ry))
        self.workspace: _Workspace = _Workspace() if like is None else like.workspace
        x, y = ((2.0 * c - 1.0) * r - p for c, r, p in zip((u, v), half_size, place, strict=True))
        areas = _strided(np.broadcast_to(area.double().numpy(), (len(u), len(v))))
        self.points = x.double().contiguous().numpy(), y.double().contiguous().numpy(), areas
        (self.coefficients, most), self.place, self.distance, self.z_in, self.index = emission, place, distance, z_in, index
        self.scale = 2.0 / most
        self.reach2 = float(np.abs(self.points[0]).max() ** 2 + np.abs(self.points[1]).max() ** 2)

    def steps(self, thickest: float) -> int:
        """Newton steps after which u is exact to rounding for any point at most `thickest` mm behind the entrance."""
        q, z = (c.ravel() for c in np.meshgrid(np.linspace(0.0, self.reach2, 65), np.linspace(0.0, max(thickest, 0.0), 9)))
        n, h = self.index, self.distance
        u, steps = n / (n * h + z), 0
        while True:
            c = 1.0 / np.sqrt(n * n + (n - 1.0) * (n + 1.0) * q * u * u)
            step = (u * (h + z * c) - 1.0) / (h + z * n * n * c**3)
            if steps == MOST_STEPS or np.abs(step / u).max() < EXACT:
                return steps
            u, steps = u - step, steps + 1

    def __call__(self, sag: Tensor, eta: float, fresnel: str, reference: float, screen: Screen, filter: Filter):
        """Control heights (n, m) float64 relative to `reference`, mm -> padded image, power behind the lens, ledger.

        Returns:
            image (n_x, n_y) and power (), float64, differentiable; ledger of `fused`.
        """
        thickest = float(sag.detach().max()) + reference - self.z_in
        (x, y), steps = self.place, self.steps(thickest)
        point = Point(float(x), float(y), self.distance, float(self.index), steps, self.scale)
        exit_ = Exit(float(eta), FRESNEL[fresnel], float(self.z_in - reference), float(screen.z - reference))
        frame = ScreenFrame(*map(int, screen.resolution), *map(float, screen.low), *map(float, screen.pixel))
        splat = Splat(filter_weights.KINDS[filter.kind], *(int(2 * r + 1) for r in filter.reach), *map(float, filter.alpha))
        arguments = (*self.points, point, self.coefficients, exit_, frame, splat)
        padded, leaving, ledger = _Image.apply(*self.along_v(sag), self.rows, arguments, self.workspace)
        (nx, ny), (rx, ry) = screen.resolution, filter.reach
        padded = padded[:, : ny + 4 * ry]
        ledger[fused.OFF_SCREEN] += padding(padded.detach(), filter.reach)
        return padded[2 * rx : 2 * rx + nx, 2 * ry : 2 * ry + ny], leaving, ledger


#: Largest number of Newton steps, and the relative size of a step that is not taken, since the next would be its square.
MOST_STEPS, EXACT = 30, 1e-13


class _Image(torch.autograd.Function):
    """The two nets (n, b) and the arguments of `forward` -> padded image, power behind the lens (), ledger."""

    @staticmethod
    def forward(net: Tensor, net_y: Tensor, rows: tuple, arguments: tuple, workspace: _Workspace):
        images, scratch = _blocks(arguments, workspace)
        ledgers = np.empty((len(images), COLUMNS))
        forward(ALL, images, ledgers, scratch, *rows, *(t.detach().contiguous().numpy() for t in (net, net_y)), *arguments)
        ledger = torch.from_numpy(ledgers.sum(0))
        return torch.from_numpy(pixels.total(images)), ledger[fused.LEAVING].clone(), ledger

    @staticmethod
    def setup_context(ctx, inputs, output):
        *nets, ctx.rows, ctx.arguments, ctx.workspace = inputs
        ctx.save_for_backward(*nets)
        ctx.mark_non_differentiable(output[2])

    @staticmethod
    @once_differentiable
    def backward(ctx, by_image, by_leaving, _):
        nets = [t.detach().contiguous().numpy() for t in ctx.saved_tensors]
        scratch = _blocks(ctx.arguments, ctx.workspace)[1]
        sums = ctx.workspace("nets", 3, len(scratch), *nets[0].shape)
        backward(ALL, by_image.contiguous().numpy(), float(by_leaving), sums, scratch, *ctx.rows, *nets, *ctx.arguments)
        return torch.from_numpy(pixels.total(sums[0])), torch.from_numpy(pixels.total(sums[2])), None, None, None


def _blocks(arguments: tuple, workspace: _Workspace) -> tuple[np.ndarray, np.ndarray]:
    """Images and scratch of all blocks, to be overwritten."""
    area, *_, frame, splat = arguments[2:]
    return _images((area, frame, splat, None), workspace)
