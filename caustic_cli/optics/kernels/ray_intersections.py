"""Intersections of rays with a height field as differentiable torch functions, by the CPU kernels of `batches`.

Rays that start inside the aperture below the surface, and do not change, are prepared once for any heights.  Behind another surface
origin o and direction d depend on that surface, and o may lie outside this surface's aperture.  Each such ray is therefore first
advanced to its entry into the

    box    aperture x [a little below the least control height, infinity)

while t is still measured from o.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from caustic_cli.optics.kernels import batches, blocks
from caustic_cli.optics.kernels.jit import FAST, njit
from caustic_cli.optics.kernels.stage import KernelStage
from caustic_cli.optics.kernels.surface import FusedSurface, sag_of, scaled
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
    (ox, oy, oz), (dx, dy, dz) = origin, direction
    if side < 0:
        heights, oz, dz = -heights, -oz, -dz
    t, gx, gy, *_ = _HITS((surface, None), heights, ox, oy, oz, dx, dy, dz)
    found = t.detach() >= 0.0
    t = torch.where(found, t, torch.zeros_like(t))
    return (t, -gx, -gy, found) if side < 0 else (t, gx, gy, found)


class RayIntersections:
    """Intersections of fixed rays from below with a height field: the fused form of `intersection.reference`.

    Args:
        origin, direction: (N,) float64 each, mm, inside the aperture, and unit vectors; z of the origins may be one number.
        radius: of a circular aperture, mm, or None.
        enter_first: distances are those from where rays enter the aperture, at `way` (N,) mm from an origin outside it.
    """

    def __init__(self, surface: FusedSurface, origin, direction, radius: float | None, enter_first: bool = False):
        self.surface, (x, y, self.z) = surface, origin
        if isinstance(self.z, Tensor):
            self.z = self.z.double().numpy()
        self.rays, self.way = scaled(surface, (x, y, torch.empty_like(x)), direction), np.zeros(len(x))
        if enter_first:
            enter(ALL, self.rays, -np.inf, self.way, blocks())
            self.z = self.z + self.way * self.rays[5]
        self.radius = np.inf if radius is None else radius
        self.order, used = batches.order(*self.rays[:2], surface.pieces.breaks_u, surface.pieces.breaks_v)
        self.batched = len(x) >= batches.CROWD * used
        if not self.batched:
            self.order = np.arange(len(x), dtype=np.int32)

    def __call__(self, heights: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Heights (n, m) mm -> distance along each ray to its hit (mm; -1 for none), dz/dx and dz/dy there, (N,) float64."""
        t, gx, gy, *_ = _HITS((self.surface, self), heights)
        return t, gx, gy

    def find(self, heights: Tensor, start: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
        """Distances (N,), mm, 0 for none, and status of every ray.  start: as of `search`."""
        _, hits = self.search(heights, start)
        return np.maximum(hits.reach, 0.0), hits.status

    def search(self, heights: Tensor, start: np.ndarray | None = None) -> tuple[np.ndarray, batches.Hits]:
        """Coefficients of the surface, counted from the heights' mean, and the first intersections.

        start: estimates of the distances (N,), infinite for none; None if unknown.
        """
        (h, middle), batched = sag_of(heights), self.batched and start is None
        self.rays[2][:] = self.z - middle
        return _first_hits(self.surface, h, _limits(h), self.rays, self.order, batched, self.radius, start)


def _limits(h: Tensor) -> tuple[float, float]:
    return float(h.min()), float(h.max())


def _first_hits(surface: FusedSurface, h: Tensor, limits, rays, order, batched: bool, radius: float, start=None):
    """Coefficients, and the first intersections."""
    c, hits = surface.coefficients(h), batches.Hits.of(len(order))
    slopes, begin = surface.slope_bounds(h), np.empty(0) if start is None else start
    batches.first_hits(ALL, order, batched, rays, begin, limits, slopes, float(radius), c, surface.pieces, hits, blocks())
    return c, hits


def _enter_and_hit(surface: FusedSurface, heights: Tensor, o, d) -> tuple[np.ndarray, batches.Hits]:
    """The same of rays from anywhere."""
    h, middle = sag_of(heights)
    low, high = _limits(h)
    rays, way = scaled(surface, (o[0], o[1], o[2] - middle), d), np.empty(len(o[0]))
    enter(ALL, rays, low - max(BELOW[0] * (high - low), BELOW[1] / min(surface.scale)), way, blocks())
    order, used = batches.order(*rays[:2], surface.pieces.breaks_u, surface.pieces.breaks_v)
    limits = low, high + 1e-6 * (high - low)  # above what touches the hull's top, by whatever rounding
    c, hits = _first_hits(surface, h, limits, rays, order, len(way) >= batches.CROWD * used, np.inf)
    found = (hits.status == batches.HIT) & (way + hits.reach > 0.0)
    t, gx, gy = np.where(found, way + hits.reach, -1.0), np.where(found, hits.gx, 0.0), np.where(found, hits.gy, 0.0)
    return c, hits._replace(reach=t, gx=gx, gy=gy, where=np.where(found[hits.met], hits.where, np.int32(-1)))


@njit(inline="always", **FAST)
def _stretch(o, d, first, last):
    """The part of [first, last] in which o + t d lies in [0, 1]."""
    if d > 0.0:
        return max(first, -o / d), min(last, (1.0 - o) / d)
    if d < 0.0:
        return max(first, (1.0 - o) / d), min(last, -o / d)
    return (first, last) if o >= 0.0 and o <= 1.0 else (np.inf, -np.inf)


@njit(entry=True, **FAST)
def enter(block, rays, floor, way, blocks):
    """Advance rays, (o_u, o_v, o_z, d_u, d_v, d_z), (N,) each, to their entry into the box, overwriting o; way (N,): the distance.

    floor: of the box, mm.  A ray that never enters is placed outside the aperture.
    """
    if on_threads(block, blocks, (rays, floor, way, blocks)):
        return
    ou, ov, oz, du, dv, dz = rays
    count = len(ou)
    for k in range(block * count // blocks, (block + 1) * count // blocks):
        first, last = _stretch(ou[k], du[k], 0.0, np.inf)
        first, last = _stretch(ov[k], dv[k], first, last)
        way[k] = 0.0
        if not (first <= last and dz[k] > 0.0):
            ou[k] = -1.0
            continue
        t = max(first, min((floor - oz[k]) / dz[k], last))
        if t > 0.0:
            ou[k], ov[k] = min(max(ou[k] + t * du[k], 0.0), 1.0), min(max(ov[k] + t * dv[k], 0.0), 1.0)
            oz[k], way[k] = oz[k] + t * dz[k], t


def _forward(parameters: tuple[FusedSurface, RayIntersections | None], heights, *ray):
    """Of fixed rays, or of the components of others: t (-1 for none), slopes; numbers and span products; coefficients."""
    (surface, fixed), heights = parameters, torch.from_numpy(heights)
    c, (_, *hits) = fixed.search(heights) if fixed else _enter_and_hit(surface, heights, ray[:3], ray[3:])
    return *hits, c


def _adjoint(parameters: tuple[FusedSurface, RayIntersections | None], inputs, kept, by, wanted):
    (surface, fixed), ray, (*found, met, where, c), (for_heights, *wanted) = parameters, inputs[1:], kept, wanted
    rays = fixed.rays if fixed else scaled(surface, ray[:3], ray[3:])
    grads = surface.workspace() if for_heights else np.empty((blocks(), 0, *c.shape[1:]))
    starts = tuple(np.empty(len(met) if any(wanted) else 0) for _ in range(3))
    batches.pull_back(ALL, met, where, tuple(by), rays, tuple(found), c, surface.pieces, grads, starts)
    along = [found[0] * a for a in starts] if any(wanted) else starts
    return surface.pull(grads) if for_heights else None, *[*starts, *along][: len(ray)]


_HITS = KernelStage(_forward, _adjoint, 3, keeps=True)
