"""Fused CUDA kernel: refraction at the exit, transfer to the screen and splat.

The functions of `kernels.fused`, with their notation: the per-ray functions and their derivatives come from there, from
`axial_refraction` and from `oblique_refraction`, a row of one ray at a time.  A kernel is made for each filter, so that its loops
over pixels have a known length.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache
from typing import NamedTuple

import torch
from numba import cuda, float64, int64
from torch import Tensor
from torch.autograd.function import once_differentiable

from caustic_cli.optics.kernels import axial_refraction, filter_weights, fused, pixels
from caustic_cli.optics.kernels import oblique_refraction as oblique
from caustic_cli.optics.kernels.arguments import Exit, ScreenFrame, Splat
from caustic_cli.optics.kernels.axial_refraction import (
    BY_GX,
    BY_GY,
    BY_POWER,
    BY_PX,
    BY_PY,
    BY_SAG,
    FLUX,
    GX,
    GY,
    OVER_X,
    OVER_Y,
    POWER,
    PX,
    PY,
    SAG,
    X,
    Y,
)
from caustic_cli.optics.kernels.cuda import sums
from caustic_cli.optics.kernels.cuda.launch import device, start
from caustic_cli.optics.kernels.cuda.scatter import scatter, units
from caustic_cli.optics.kernels.fused import COLUMNS, FRESNEL, LEAVING, MISSED, OFF_SCREEN, REFLECTED
from caustic_cli.optics.kernels.oblique_refraction import MISSED_POWER
from caustic_cli.optics.reconstruction import Filter, padding
from caustic_cli.scene import Screen

limits, share, gather = device(pixels.limits), device(fused.share), device(fused.gather)
carry, pull_axial = device(fused.carry), device(axial_refraction.pull)
aim_batch, pull_batch = device(oblique._aim), device(oblique._pull)
VECTORS = axial_refraction.VECTORS + axial_refraction.SCRATCH


class ImageArguments(NamedTuple):
    """Scalar arguments of a kernel: index and kind of Fresnel losses, as of an `Exit`, a `ScreenFrame`, and alpha of the filter."""

    index: float  # type: ignore[assignment]  # shadows `tuple.index`, which is not used
    fresnel: int
    frame: ScreenFrame
    alpha_x: float
    alpha_y: float


@dataclass(frozen=True, eq=False)
class LitRays:
    """Rays below the exit, (N,) each on the device: origins, mm, transverse direction components, and powers.

    oblique: whether they have individual directions; otherwise all are parallel to z, and `along` is empty.
    """

    x: Tensor
    y: Tensor
    along: tuple[Tensor, Tensor]
    power: Tensor
    oblique: bool

    @property
    def rays(self) -> tuple[Tensor, ...]:
        """Components in the order of the kernels' arguments."""
        return (self.x, self.y, *self.along, self.power)


@device
def bend_axial(v, w, k, hits, rays, exit_, frame):
    """Power and landing point of ray k, of rays along z, into the rows v."""
    (sag, gx, gy), (x, y, _, _, power) = hits, rays
    v[SAG, 0], v[GX, 0], v[GY, 0], v[X, 0], v[Y, 0], v[FLUX, 0] = sag[k], gx[k], gy[k], x[k], y[k], power[k]
    carry(v, exit_, frame)


@device
def bend_oblique(v, w, k, hits, rays, exit_, frame):
    """The same of rays of any direction, by rows w of their own."""
    (t, gx, gy), (x, y, dx, dy, power) = hits, rays
    w[oblique.REACH, 0], w[oblique.GX, 0], w[oblique.GY, 0] = t[k], gx[k], gy[k]
    w[oblique.DX, 0], w[oblique.DY, 0], w[oblique.PART, 0] = dx[k], dy[k], power[k]
    w[oblique.X, 0], w[oblique.Y, 0] = x[k], y[k]
    aim_batch(w, 1, exit_, frame)
    v[SAG, 0], v[POWER, 0], v[FLUX, 0] = w[oblique.OUT_SAG, 0], w[oblique.OUT_POWER, 0], power[k]
    v[PX, 0], v[PY, 0] = w[oblique.OUT_PX, 0], w[oblique.OUT_PY, 0]


@device
def unbend_axial(v, w, exit_):
    """Derivatives by the surface in BY_SAG, BY_GX, BY_GY."""
    pull_axial(v, exit_)


@device
def unbend_oblique(v, w, exit_):
    """Derivatives by distance and slopes in BY_SAG, BY_GX, BY_GY."""
    w[oblique.OUT_SAG, 0], w[oblique.OUT_POWER, 0] = v[POWER, 0], v[BY_POWER, 0]
    w[oblique.OUT_PX, 0], w[oblique.OUT_PY, 0] = v[BY_PX, 0], v[BY_PY, 0]
    pull_batch(w, 1, exit_)
    v[BY_SAG, 0], v[BY_GX, 0], v[BY_GY, 0] = w[oblique.BY_REACH, 0], w[oblique.BY_GX, 0], w[oblique.BY_GY, 0]


@device
def lands(v, frame, height, vx, vy):
    """Whether a ray that leaves the lens reaches into the frame, and the first of its pixels; False for NaN too."""
    rx, ry, low_x, low_y, high_x, high_y = limits(frame.pixels_x, frame.pixels_y, vx, vy)
    x, y = v[PX, 0], v[PY, 0]
    inside = x >= low_x and x < high_x and y >= low_y and y < high_y and height > v[SAG, 0]
    return (True, math.floor(x) + rx, math.floor(y) + ry) if inside else (False, 0, 0)


@cache
def _kernels(slanted: bool, kind: int, vx: int, vy: int):
    """Forward and adjoint for rays along z or of any direction, and a filter."""
    bend, unbend = (bend_oblique, unbend_oblique) if slanted else (bend_axial, unbend_axial)
    ray_rows, room = oblique.ROWS if slanted else 1, vy + -vy % 4

    @cuda.jit
    def forward(hits, rays, setting, place, unit, image, ledger):
        """Adds to `image` and `ledger`, both in units; place: start and height of an `Exit`."""
        v, w = cuda.local.array((VECTORS, 1), float64), cuda.local.array((ray_rows, 1), float64)
        sx, sy, none = (cuda.local.array((vx, 1), float64), cuda.local.array((vy, 1), float64), cuda.local.array((1, 1), float64))
        own, block = cuda.local.array(COLUMNS, int64), cuda.shared.array(COLUMNS, int64)
        exit_, frame = Exit(setting.index, setting.fresnel, place[0], place[1]), setting.frame
        splat, scale = Splat(kind, vx, vy, setting.alpha_x, setting.alpha_y), unit[0]
        for c in range(COLUMNS):
            own[c] = 0
        for c in range(cuda.threadIdx.x, COLUMNS, cuda.blockDim.x):
            block[c] = 0
        cuda.syncthreads()
        for k in range(cuda.grid(1), len(rays[4]), cuda.gridsize(1)):
            bend(v, w, k, hits, rays, exit_, frame)
            emitted, weight = v[FLUX, 0], v[POWER, 0]
            if weight < 0.0:
                own[MISSED if weight == MISSED_POWER else REFLECTED] += units(emitted, scale)
                continue
            own[FRESNEL] += units(emitted - weight, scale)
            own[LEAVING] += units(weight, scale)
            inside, i, j = lands(v, frame, exit_.height, vx, vy)
            if not inside:
                own[OFF_SCREEN] += units(weight, scale)
                continue
            share(v, splat, sx, sy, none[:0], none[:0])
            scatter(image, i, j, weight * v[OVER_X, 0] * v[OVER_Y, 0], sx, sy, scale)
        for c in range(COLUMNS):
            cuda.atomic.add(block, c, own[c])
        cuda.syncthreads()
        for c in range(cuda.threadIdx.x, COLUMNS, cuda.blockDim.x):
            cuda.atomic.add(ledger, c, block[c])

    @cuda.jit
    def adjoint(hits, rays, setting, place, grad, by_leaving, out):
        """Derivatives by distance (or sag) and slopes into `out`, from those by the padded image and the leaving power."""
        v, w = cuda.local.array((VECTORS, 1), float64), cuda.local.array((ray_rows, 1), float64)
        sx, dx = cuda.local.array((vx, 1), float64), cuda.local.array((vx, 1), float64)
        sy, dy = cuda.local.array((vy, 1), float64), cuda.local.array((vy, 1), float64)
        column, tilt = cuda.local.array(room, float64), cuda.local.array(room, float64)
        exit_, frame = Exit(setting.index, setting.fresnel, place[0], place[1]), setting.frame
        splat, (by_t, by_gx, by_gy) = Splat(kind, vx, vy, setting.alpha_x, setting.alpha_y), out
        for b in range(room):
            column[b], tilt[b] = 0.0, 0.0
        for k in range(cuda.grid(1), len(rays[4]), cuda.gridsize(1)):
            bend(v, w, k, hits, rays, exit_, frame)
            share(v, splat, sx, sy, dx, dy)
            gather(v, exit_, frame, splat, sx, sy, dx, dy, grad, by_leaving[0], column, tilt)
            unbend(v, w, exit_)
            by_t[k], by_gx[k], by_gy[k] = v[BY_SAG, 0], v[BY_GX, 0], v[BY_GY, 0]

    return forward, adjoint


class Splatting(NamedTuple):
    """All inputs except the intersections: light, unit of its sums, start and height of the `Exit` (2,), kernels and their
    arguments."""

    light: LitRays
    unit: Tensor
    place: Tensor
    setting: ImageArguments
    kernels: tuple
    shape: tuple[int, int]


def expose(
    hits, light: LitRays, unit: Tensor, place: Tensor, eta: float, fresnel: str, screen: Screen, filter: Filter
) -> tuple[Tensor, Tensor, dict[str, Tensor]]:
    """The image of rays, from where they meet the exit.

    Args:
        hits: distances along the rays to their hits, mm, -1 for none, or for rays along z the sag; dz/dx and dz/dy there; (N,).
        unit: of sums of the light's powers, see `sums`.
        place: (2,) float64 on the device, the heights where oblique rays begin and of the screen, above the zero of the sag, mm.

    Returns:
        image (n_x, n_y) and the power behind the lens (), float64, differentiable; losses by name.
    """
    (nx, ny), (rx, ry) = screen.resolution, filter.reach
    vx, vy, kind = 2 * rx + 1, 2 * ry + 1, filter_weights.KINDS[filter.kind]
    frame = ScreenFrame(int(nx), int(ny), *map(float, screen.low), *map(float, screen.pixel))
    setting = ImageArguments(float(eta), axial_refraction.FRESNEL[fresnel], frame, *map(float, filter.alpha))
    shape = (nx + 4 * rx, ny + 4 * ry + -vy % 4)  # with room for the gather's steps of four pixels
    how = Splatting(light, unit, place, setting, _kernels(light.oblique, kind, vx, vy), shape)
    padded, leaving, ledger = _Image.apply(*hits, how)
    padded = padded[:, : ny + 4 * ry]
    lost = {"missed_surface": ledger[MISSED]} if light.oblique else {}
    lost |= {"fresnel": ledger[FRESNEL], "total_internal_reflection": ledger[REFLECTED]}
    lost["off_screen"] = ledger[OFF_SCREEN] + padding(padded.detach(), filter.reach)
    return padded[2 * rx : 2 * rx + nx, 2 * ry : 2 * ry + ny], leaving, lost


class _Image(torch.autograd.Function):
    """Distance (or sag) and slopes -> padded image, power behind the lens (), ledger."""

    @staticmethod
    def forward(t: Tensor, gx: Tensor, gy: Tensor, how: Splatting):
        image = torch.zeros(how.shape, dtype=torch.int64, device=t.device)
        ledger = torch.zeros(COLUMNS, dtype=torch.int64, device=t.device)
        hits = tuple(c.detach().contiguous() for c in (t, gx, gy))
        start(how.kernels[0], len(t), hits, how.light.rays, how.setting, how.place, how.unit, image, ledger)
        ledger = sums.value_of(ledger, how.unit)
        return sums.value_of(image, how.unit), ledger[LEAVING].clone(), ledger

    @staticmethod
    def setup_context(ctx, inputs, output):
        *hits, ctx.how = inputs
        ctx.save_for_backward(*hits)
        ctx.mark_non_differentiable(output[2])

    @staticmethod
    @once_differentiable
    def backward(ctx, by_image, by_leaving, _):
        hits, how = tuple(c.contiguous() for c in ctx.saved_tensors), ctx.how
        out = tuple(torch.empty_like(hits[0]) for _ in range(3))
        grad, by = by_image.contiguous(), by_leaving.reshape(1)
        start(how.kernels[1], len(hits[0]), hits, how.light.rays, how.setting, how.place, grad, by, out)
        return *out, None
