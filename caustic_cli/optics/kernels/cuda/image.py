"""Fused CUDA kernel: refraction at the exit, transfer to the screen and splat; and the splat alone.

The functions of `kernels.fused` and `kernels.splat`, with their notation: the per-ray functions and their derivatives come from
there, from `axial_refraction` and from `oblique_refraction`, a row of one ray at a time.  A kernel is made for each filter, so that
its loops over pixels have a known length.

Pixels are sums of atomic additions in fixed point (`sums`): filter weights are non-negative and sum to 1, so the power of all rays
bounds every one.
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

from caustic_cli.optics.kernels import axial_refraction, pixels, splat
from caustic_cli.optics.kernels import oblique_refraction as oblique
from caustic_cli.optics.kernels import rows as row
from caustic_cli.optics.kernels.arguments import Exit, ScreenFrame, Splat
from caustic_cli.optics.kernels.cuda import sums
from caustic_cli.optics.kernels.cuda.launch import device, start
from caustic_cli.optics.kernels.fresnel import FRESNEL
from caustic_cli.optics.kernels.fused import COLUMNS, LEAVING, LOST_BY_FRESNEL, MISSED, OFF_SCREEN, REFLECTED
from caustic_cli.optics.kernels.splat import trimmed
from caustic_cli.optics.reconstruction import Filter
from caustic_cli.scene import Screen

limits, share, gather, units = device(pixels.limits), device(splat.share), device(splat.gather), device(sums.units)
aim_points, aim_axial, pull_axial = device(splat.aim), device(axial_refraction.aim), device(axial_refraction.pull)
aim_batch, pull_batch = device(oblique.aim_batch), device(oblique.pull_batch)
VECTORS, MISSED_POWER = row.VECTORS + row.SCRATCH, row.MISSED_POWER


class Setting(NamedTuple):
    """Scalar arguments of a kernel: index and kind of Fresnel losses, as of an `Exit`, a `ScreenFrame`, and alpha of the filter."""

    eta: float
    fresnel: int
    frame: ScreenFrame
    alpha_x: float
    alpha_y: float


# What comes before the splat, in three forms: from `given` and `rays` the power and landing point of ray k into the rows v, and
# derivatives by `given` into `out`; with scratch rows w.


@device
def bend_axial(v, w, k, given, rays, exit_, frame):
    """Rays along z; given: sag and slopes."""
    (sag, gx, gy), (x, y, _, _, power) = given, rays
    v[row.SAG, 0], v[row.GX, 0], v[row.GY, 0], v[row.X, 0], v[row.Y, 0], v[row.FLUX, 0] = sag[k], gx[k], gy[k], x[k], y[k], power[k]
    aim_axial(v, exit_, frame)


@device
def unbend_axial(v, w, k, exit_, out):
    """By sag and slopes."""
    pull_axial(v, exit_)
    out[0][k], out[1][k], out[2][k] = v[row.BY_SAG, 0], v[row.BY_GX, 0], v[row.BY_GY, 0]


@device
def bend_oblique(v, w, k, given, rays, exit_, frame):
    """Rays of any direction; given: distances and slopes."""
    (t, gx, gy), (x, y, dx, dy, power) = given, rays
    w[oblique.REACH, 0], w[oblique.GX, 0], w[oblique.GY, 0] = t[k], gx[k], gy[k]
    w[oblique.DX, 0], w[oblique.DY, 0], w[oblique.P, 0] = dx[k], dy[k], power[k]
    w[oblique.X, 0], w[oblique.Y, 0] = x[k], y[k]
    aim_batch(w, 1, exit_, frame)
    v[row.POWER, 0], v[row.FLUX, 0] = w[oblique.POWER, 0], power[k]
    v[row.PX, 0], v[row.PY, 0] = w[oblique.PX, 0], w[oblique.PY, 0]


@device
def unbend_oblique(v, w, k, exit_, out):
    """By distance and slopes."""
    w[oblique.POWER, 0], w[oblique.PX, 0], w[oblique.PY, 0] = v[row.BY_POWER, 0], v[row.BY_PX, 0], v[row.BY_PY, 0]
    pull_batch(w, 1, exit_)
    out[0][k], out[1][k], out[2][k] = w[oblique.BY_REACH, 0], w[oblique.BY_GX, 0], w[oblique.BY_GY, 0]


@device
def bend_points(v, w, k, given, rays, exit_, frame):
    """Rays of which landing points and powers are given."""
    aim_points(given[0], given[1], given[2], k, 1, frame, v)


@device
def unbend_points(v, w, k, exit_, out):
    """By landing point and power."""
    out[0][k], out[1][k], out[2][k] = v[row.BY_PX, 0], v[row.BY_PY, 0], v[row.BY_POWER, 0]


#: By name, and how many rows w they use.
FORMS = {
    "axial": (bend_axial, unbend_axial, 1),
    "oblique": (bend_oblique, unbend_oblique, oblique.ROWS),
    "points": (bend_points, unbend_points, 1),
}


@device
def lands(v, frame, vx, vy):
    """Whether a ray reaches into the frame, and the first of its pixels; False for NaN too."""
    rx, ry, low_x, low_y, high_x, high_y = limits(frame.pixels_x, frame.pixels_y, vx, vy)
    x, y = v[row.PX, 0], v[row.PY, 0]
    inside = x >= low_x and x < high_x and y >= low_y and y < high_y
    return (True, math.floor(x) + rx, math.floor(y) + ry) if inside else (False, 0, 0)


@cache
def _kernels(form: str, kind: int, vx: int, vy: int):
    """Forward and adjoint of a form, and a filter."""
    bend, unbend, w_rows = FORMS[form]
    bent, room = form != "points", vy + -vy % 4

    @cuda.jit
    def forward(given, rays, setting, place, unit, image, ledger):
        """Adds to `image` and `ledger`, both in units; place: start and height of an `Exit`."""
        v, w = cuda.local.array((VECTORS, 1), float64), cuda.local.array((w_rows, 1), float64)
        sx, sy, none = cuda.local.array((vx, 1), float64), cuda.local.array((vy, 1), float64), cuda.local.array((1, 1), float64)
        own, block = cuda.local.array(COLUMNS, int64), cuda.shared.array(COLUMNS, int64)
        exit_, frame = Exit(setting.eta, setting.fresnel, place[0], place[1]), setting.frame
        splat, scale = Splat(kind, vx, vy, setting.alpha_x, setting.alpha_y), unit[0]
        for c in range(COLUMNS):
            own[c] = 0
        for c in range(cuda.threadIdx.x, COLUMNS, cuda.blockDim.x):
            block[c] = 0
        cuda.syncthreads()
        for k in range(cuda.grid(1), len(given[0]), cuda.gridsize(1)):
            bend(v, w, k, given, rays, exit_, frame)
            weight = v[row.POWER, 0]
            if bent:
                emitted = v[row.FLUX, 0]
                if weight < 0.0:
                    own[MISSED if weight == MISSED_POWER else REFLECTED] += units(emitted, scale)
                    continue
                own[LOST_BY_FRESNEL] += units(emitted - weight, scale)
                own[LEAVING] += units(weight, scale)
            inside, i, j = lands(v, frame, vx, vy)
            if not inside:
                own[OFF_SCREEN] += units(weight, scale)
                continue
            share(v, splat, sx, sy, none[:0], none[:0])
            weight *= v[row.OVER_X, 0] * v[row.OVER_Y, 0]
            for a in range(vx):
                for b in range(vy):
                    cuda.atomic.add(image, (i + a, j + b), units(weight * sx[a, 0] * sy[b, 0], scale))
        for c in range(COLUMNS):
            cuda.atomic.add(block, c, own[c])
        cuda.syncthreads()
        for c in range(cuda.threadIdx.x, COLUMNS, cuda.blockDim.x):
            cuda.atomic.add(ledger, c, block[c])

    @cuda.jit
    def adjoint(given, rays, setting, place, grad, by_inside, by_outside, out):
        """Derivatives by `given` into `out`, from those by the padded image, and by the power of all rays inside and outside it."""
        v, w = cuda.local.array((VECTORS, 1), float64), cuda.local.array((w_rows, 1), float64)
        sx, dx = cuda.local.array((vx, 1), float64), cuda.local.array((vx, 1), float64)
        sy, dy = cuda.local.array((vy, 1), float64), cuda.local.array((vy, 1), float64)
        column, tilt = cuda.local.array(room, float64), cuda.local.array(room, float64)
        exit_, frame = Exit(setting.eta, setting.fresnel, place[0], place[1]), setting.frame
        splat = Splat(kind, vx, vy, setting.alpha_x, setting.alpha_y)
        for b in range(room):
            column[b], tilt[b] = 0.0, 0.0
        for k in range(cuda.grid(1), len(given[0]), cuda.gridsize(1)):
            bend(v, w, k, given, rays, exit_, frame)
            if bent and v[row.POWER, 0] < 0.0:
                v[row.POWER, 0] = 0.0
            share(v, splat, sx, sy, dx, dy)
            gather(v, 1, frame, splat, sx, sy, dx, dy, grad, by_inside[0], by_outside[0], column, tilt)
            unbend(v, w, k, exit_, out)

    return forward, adjoint


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


class Splatting(NamedTuple):
    """All inputs except those that are differentiated by: rays, unit of the sums, start and height of the `Exit` (2,), kernels and
    their arguments; and the column of the ledger that is differentiable."""

    rays: tuple[Tensor, ...]
    unit: Tensor
    place: Tensor
    kernels: tuple
    setting: Setting
    shape: tuple[int, int]
    column: int

    @classmethod
    def of(
        cls, form: str, rays, unit: Tensor, place: Tensor, eta: float, fresnel: str, screen: Screen, filter: Filter, column: int
    ) -> Splatting:
        """Of a form of rays onto a screen."""
        frame, splat = ScreenFrame.of(screen), Splat.of(filter)
        kernels = _kernels(form, splat.kind, splat.size_x, splat.size_y)
        setting = Setting(float(eta), FRESNEL[fresnel], frame, splat.alpha_x, splat.alpha_y)
        return cls(rays, unit, place, kernels, setting, splat.padded(frame), column)


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
    form = "oblique" if light.oblique else "axial"
    padded, leaving, ledger = _Image.apply(
        *hits, Splatting.of(form, light.rays, unit, place, eta, fresnel, screen, filter, LEAVING)
    )
    image, beside = trimmed(padded, screen, filter)
    lost = {"missed_surface": ledger[MISSED]} if light.oblique else {}
    lost |= {"fresnel": ledger[LOST_BY_FRESNEL], "total_internal_reflection": ledger[REFLECTED]}
    return image, leaving, lost | {"off_screen": ledger[OFF_SCREEN] + beside.detach()}


def splat_rays(x: Tensor, y: Tensor, weight: Tensor, screen: Screen, filter: Filter) -> tuple[Tensor, Tensor]:
    """`kernels.splat.splat_rays` of tensors on the device."""
    unit, none = sums.unit_of(weight.detach().double().abs().sum()), weight.new_zeros(2, dtype=torch.float64)
    how = Splatting.of("points", (), unit, none, 1.0, "none", screen, filter, OFF_SCREEN)
    padded, outside, _ = _Image.apply(x, y, weight, how)
    image, beside = trimmed(padded, screen, filter)
    return image, outside + beside


class _Image(torch.autograd.Function):
    """Distance (or sag) and slopes, or landing points and powers -> padded image, one sum of powers (), ledger."""

    @staticmethod
    def forward(a: Tensor, b: Tensor, c: Tensor, how: Splatting):
        image = torch.zeros(how.shape, dtype=torch.int64, device=a.device)
        ledger = torch.zeros(COLUMNS, dtype=torch.int64, device=a.device)
        start(how.kernels[0], len(a), _whole((a, b, c)), how.rays, how.setting, how.place, how.unit, image, ledger)
        ledger = sums.value_of(ledger, how.unit)
        return sums.value_of(image, how.unit), ledger[how.column].clone(), ledger

    @staticmethod
    def setup_context(ctx, inputs, output):
        *given, ctx.how = inputs
        ctx.save_for_backward(*given)
        ctx.mark_non_differentiable(output[2])

    @staticmethod
    @once_differentiable
    def backward(ctx, by_image, by_sum, _):
        given, how, by = _whole(ctx.saved_tensors), ctx.how, by_sum.reshape(1)
        out = tuple(torch.empty_like(given[0]) for _ in range(3))
        by_inside = torch.zeros_like(by) if how.column == OFF_SCREEN else by
        start(how.kernels[1], len(out[0]), given, how.rays, how.setting, how.place, by_image.contiguous(), by_inside, by, out)
        wanted = zip(out, ctx.saved_tensors, ctx.needs_input_grad, strict=False)
        return *(o.to(t.dtype) if w else None for o, t, w in wanted), None


def _whole(values) -> tuple[Tensor, ...]:
    return tuple(v.detach().double().contiguous() for v in values)
