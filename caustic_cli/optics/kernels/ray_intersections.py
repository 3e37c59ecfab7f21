"""Intersections of rays of any origin with a height field, differentiable by rays and heights.

The rays of `surface.RayIntersections` are fixed and start inside the aperture below the surface.  Behind another surface origin o
and direction d depend on that surface, and o may lie outside this surface's aperture.  Each ray is therefore first advanced to its
entry into the

    box    aperture x [a little below the least control height, infinity)

while t is still measured from o.  The search and the derivatives are those of `batches`.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from caustic_cli.optics.kernels import batches, blocks
from caustic_cli.optics.kernels.jit import FAST, njit
from caustic_cli.optics.kernels.surface import FusedSurface, _sag
from caustic_cli.optics.kernels.threads import ALL, on_threads

#: Depth of the box's floor below the least height, relative to the height of the hull and to the width of the aperture.
BELOW = 0.01, 1e-3


def hits_of_rays(
    surface: FusedSurface,
    heights: Tensor,
    origin: tuple[Tensor, Tensor, Tensor],
    direction: tuple[Tensor, Tensor, Tensor],
    *,
    side: float = 1.0,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """First intersections of rays, in the surface's frame.

    Args:
        heights: (n, m) mm.
        origin, direction: (N,) float64 each, mm, and unit vectors; side * d_z > 0, any other ray misses.
        side: 1 for rays from below, -1 for rays from above.

    Returns:
        t, mm, 0 where there is no hit; dz/dx, dz/dy there; found, bool.  (N,) each; t and slopes are differentiable once by
        heights, origin and direction.  A ray that starts on the surface or beyond it misses.
    """
    if side > 0:
        return _HitsOfRays.apply(heights, *origin, *direction, surface)[:4]
    (ox, oy, oz), (dx, dy, dz) = origin, direction
    t, gx, gy, found, *_ = _HitsOfRays.apply(-heights, ox, oy, -oz, dx, dy, -dz, surface)
    return t, -gx, -gy, found


@njit(inline="always", **FAST)
def _stretch(o, d, first, last):
    """The part of [first, last] in which o + t d lies in [0, 1]."""
    if d > 0.0:
        return max(first, -o / d), min(last, (1.0 - o) / d)
    if d < 0.0:
        return max(first, (1.0 - o) / d), min(last, -o / d)
    return (first, last) if o >= 0.0 and o <= 1.0 else (np.inf, -np.inf)


@njit(inline="always", **FAST)
def enter_alone(ray, floor):
    """o_u, o_v, o_z and the way of one ray, as of `enter`."""
    ou, ov, oz, du, dv, dz = ray
    first, last = _stretch(ou, du, 0.0, np.inf)
    first, last = _stretch(ov, dv, first, last)
    if not (first <= last and dz > 0.0):
        return -1.0, ov, oz, 0.0
    t = max(first, min((floor - oz) / dz, last))
    if t > 0.0:
        return min(max(ou + t * du, 0.0), 1.0), min(max(ov + t * dv, 0.0), 1.0), oz + t * dz, t
    return ou, ov, oz, 0.0


@njit(entry=True, **FAST)
def enter(block, ou, ov, oz, du, dv, dz, floor, way, blocks):
    """Advance rays (N,) to their entry into the box, overwriting ou, ov, oz; way (N,): the distance.

    floor: of the box, mm.  A ray that never enters is placed outside the aperture.
    """
    if block == ALL:
        on_threads(blocks, (ou, ov, oz, du, dv, dz, floor, way, blocks))
        return
    count = len(ou)
    for k in range(block * count // blocks, (block + 1) * count // blocks):
        ray = (ou[k], ov[k], oz[k], du[k], dv[k], dz[k])
        ou[k], ov[k], oz[k], way[k] = enter_alone(ray, floor)


def _rays(surface: FusedSurface, o, d) -> tuple[np.ndarray, ...]:
    """o, d mm -> o_u, o_v, o_z, d_u, d_v, d_z, float64."""
    (su, sv), (ox, oy, oz), (dx, dy, dz) = surface.scale, o, d
    return tuple(c.detach().double().contiguous().numpy() for c in (ox * su + 0.5, oy * sv + 0.5, oz, dx * su, dy * sv, dz))


class _HitsOfRays(torch.autograd.Function):
    @staticmethod
    def forward(
        heights: Tensor,
        ox: Tensor,
        oy: Tensor,
        oz: Tensor,
        dx: Tensor,
        dy: Tensor,
        dz: Tensor,
        surface: FusedSurface,
    ):
        h, middle = _sag(heights)
        low, high = float(h.min()), float(h.max())
        rays, way, n = _rays(surface, (ox, oy, oz - middle), (dx, dy, dz)), np.empty(len(ox)), blocks()
        floor = low - max(BELOW[0] * (high - low), BELOW[1] / min(surface.scale))
        enter(ALL, *rays, floor, way, n)
        order, used = batches.order(*rays[:2], surface.geometry[0], surface.geometry[3])
        status, *out = batches.found(len(way))
        top = high + 1e-6 * (high - low)  # above what touches the hull's top, by whatever rounding
        batches.first_hits(
            ALL,
            order,
            len(way) >= batches.CROWD * used,
            *rays,
            (low, top),
            surface.slope_bounds(h),
            np.inf,
            surface.coefficients(h),
            *surface.geometry,
            *surface.scale,
            status,
            *out,
            n,
        )
        reach, gx, gy, met, where = (torch.from_numpy(a) for a in out)
        t = torch.from_numpy(way) + reach
        found = torch.from_numpy(status == batches.HIT) & (t > 0.0)
        zero = torch.zeros((), dtype=torch.float64)
        where = torch.where(found[met], where, -1)
        return *(torch.where(found, c, zero) for c in (t, gx, gy)), found, met, where

    @staticmethod
    def setup_context(ctx, inputs, output):
        *tensors, ctx.surface = inputs
        ctx.save_for_backward(*tensors, *output)
        ctx.mark_non_differentiable(*output[3:])

    @staticmethod
    @once_differentiable
    def backward(ctx, *by):
        heights, ox, oy, oz, dx, dy, dz, t, gx, gy, _, met, where = ctx.saved_tensors
        surface, wanted = ctx.surface, ctx.needs_input_grad
        ou, ov, _, *directions = _rays(surface, (ox, oy, oz), (dx, dy, dz))
        c = surface.coefficients(_sag(heights)[0])
        grads = surface.workspace() if wanted[0] else np.empty((blocks(), 0, *c.shape[1:]))
        starts = [torch.empty(len(t) if any(wanted[1:7]) else 0, dtype=torch.float64) for _ in range(3)]
        batches.pull_back(
            ALL,
            met.numpy(),
            where.numpy(),
            *(b.double().contiguous().numpy() for b in by[:3]),
            ou,
            ov,
            *directions,
            *(a.detach().numpy() for a in (t, gx, gy)),
            c,
            *surface.geometry,
            *surface.scale,
            grads,
            *(a.numpy() for a in starts),
        )
        out = [surface.pull(grads).to(heights.dtype) if wanted[0] else None]
        out += [a if w else None for a, w in zip(starts, wanted[1:4], strict=True)]
        out += [t * a if w else None for a, w in zip(starts, wanted[4:7], strict=True)]
        return *out, None
