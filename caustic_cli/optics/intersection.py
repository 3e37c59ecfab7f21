"""Ray-surface intersection, differentiated by the implicit function theorem (thesis 4.3.2).

Notation, in the frame of the surface
    o, d    the ray's origin, mm, and unit direction
    side    +1 for rays that reach the surface from below, -1 from above
    f(t)    side (o_z + t d_z - Z(o_x + t d_x, o_y + t d_y)), negative before the crossing (eq. 4.3.3)
    c       d_z - Z_x d_x - Z_y d_y, f'(t) up to the sign `side`: at the intersection the cosine of incidence times |N|
    L       bound of |Z_x d_x| + |Z_y d_y|, for a spline from the control net of its derivative (convex hull property)

A ray with L < |d_z| intersects the surface once.  Newton's method is then safeguarded by a bracket from the convex hull and the
aperture, with bisection where a step leaves it.  For any other ray the first root is isolated beforehand.

`reference` is plain torch, for any surface and device; `kernels.batches`, by `kernels.intersect`, is its fused form for B-splines.
The thesis' triangle mesh is in `mesh`.  At the root, f(t; P, o, d) = 0 gives all derivatives of t (`attach`) whatever method found
it; no iteration is differentiated.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum
from importlib import import_module

import torch
from torch import Tensor

from caustic_cli.optics.backends import backend_for, primal
from caustic_cli.optics.surfaces.base import SECOND, Surface, SurfaceIntersection
from caustic_cli.optics.tolerances import FEW_ULP, FINEST, LEAST_COSINE, MOST_PROBES, MOST_STEPS
from caustic_cli.schema import checks

METHODS = ("newton", "mesh", "mesh+newton")


class Status(IntEnum):
    """Outcome of an intersection search."""

    HIT = 0
    MISSED = 1  # the ray leaves the aperture before it reaches the surface; the edge of the lens absorbs it
    UNRESOLVED = 2  # no convergence; counted as missed


@dataclass(frozen=True)
class Method:
    """Method of intersection with a B-spline."""

    #: newton, mesh, or mesh+newton, Newton's method started from the intersection with the mesh.
    name: str = "newton"
    #: (n_u, n_v), subdivisions of each knot span by the mesh.
    parts: tuple[int, int] = (4, 4)
    #: Find the mesh's knot span products by a quadtree, or by testing all of them.
    recursive: bool = True

    def __post_init__(self):
        checks.choice("intersection method", self.name, METHODS)

    def start(self, field, heights: Tensor, origin, direction, radius: float | None):
        """Distances to the intersections with the mesh (None if not requested), and (t, status) if the mesh is the whole method."""
        if self.name == "newton":
            return None, None
        mesh = import_module("caustic_cli.optics.mesh").TriangleMesh(field, heights, *self.parts)  # its search is compiled
        rays = _broadcast(*origin, *direction)
        start, missed, _ = mesh.intersect(*rays, self.recursive)
        if self.name == "mesh":
            t = torch.where(missed == 0, start, torch.zeros_like(start))
            return start, (t, within(missed.long(), start, origin, direction, radius))
        return start, None


def intersect_any(surface: Surface, heights: Tensor | None, origin, direction, side: float) -> SurfaceIntersection:
    """`Surface.intersect` for any surface, in plain torch."""
    t, status = reference(surface, heights, origin, direction, side)
    valid = status == Status.HIT
    t, gx, gy = attach(surface, heights, origin, direction, t, valid)
    return SurfaceIntersection(t, gx, gy, valid)


def attach(surface: Surface, heights: Tensor | None, origin, direction, t: Tensor, valid: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Make intersections differentiable: t (N,) mm and the slopes there, with first derivatives by heights and rays, in both modes.

    t: roots without derivatives; valid: where they are valid, 0 is returned elsewhere.  One Newton step from the root has the value
    0 and the derivative of the root.  Second derivatives are wrong.
    """
    sag, middle = surface.centred(heights)
    (ox, oy, oz), (dx, dy, dz) = origin, direction
    t = torch.where(valid, t, torch.zeros_like(t)).double()
    x, y, z_ray = ox + t * dx, oy + t * dy, (oz - middle) + t * dz
    at = tuple(primal(torch.as_tensor(c, dtype=torch.float64)).expand(t.shape) for c in (x, y))
    inside_x, inside_y = (c.clamp(-r, r) for c, r in zip(at, surface.half_size, strict=True))
    z, gx, gy = surface.evaluate(sag, inside_x, inside_y)
    if not torch.is_grad_enabled():
        return t, torch.where(valid, gx, torch.zeros_like(t)), torch.where(valid, gy, torch.zeros_like(t))
    with torch.no_grad():
        zxx, zxy, zyy = surface.at(sag if sag is None else sag.detach(), inside_x, inside_y, SECOND)
        sx, sy = primal(gx), primal(gy)
        fx, fy, fz = (primal(torch.as_tensor(c, dtype=torch.float64)) for c in direction)
        c = fz - sx * fx - sy * fy
        c = torch.where(c.abs() > LEAST_COSINE, c, torch.full_like(c, LEAST_COSINE))
    f = z_ray - z - sx * (x - at[0]) - sy * (y - at[1])
    move = torch.where(valid, -(f - primal(f)) / c, torch.zeros_like(t))
    ax, ay = (x - at[0]) + move * fx, (y - at[1]) + move * fy  # 0 in value, with the derivative of the point
    none = torch.zeros_like(t)
    return (t + move, torch.where(valid, gx + zxx * ax + zxy * ay, none), torch.where(valid, gy + zxy * ax + zyy * ay, none))


@torch.no_grad()
def find(
    field, heights: Tensor, origin, direction, method: Method | None = None, radius: float | None = None
) -> tuple[Tensor, Tensor]:
    """First intersections of rays from below with a B-spline: t (N,) float64 mm, and `Status` (N,)."""
    return backend_for(heights.device).find(field, heights, origin, direction, method or Method(), radius)


def within(status: Tensor, t: Tensor, origin, direction, radius: float | None) -> Tensor:
    """`status` with intersections outside a circular aperture marked as missed."""
    if radius is None:
        return status
    beyond = (origin[0] + t * direction[0]) ** 2 + (origin[1] + t * direction[1]) ** 2 > radius**2
    return torch.where(beyond & (status == Status.HIT), int(Status.MISSED), status)


def _broadcast(*components: Tensor | float) -> Sequence[Tensor]:
    """Components of rays, which may be numbers, as float64 tensors of one shape on one device."""
    device = next((c.device for c in components if isinstance(c, Tensor)), None)
    return torch.broadcast_tensors(*(torch.as_tensor(c, dtype=torch.float64, device=device) for c in components))


def _above_aperture(origin, direction, half_size: tuple[float, float]) -> tuple[Tensor, Tensor]:
    """The interval of t in which rays are above an aperture, from 0 on; empty as (inf, ...)."""
    enter, leave = torch.zeros_like(direction[0]), torch.full_like(direction[0], torch.inf)
    for o, d, r in zip(origin, direction, half_size, strict=True):
        near = torch.where(d == 0, torch.where(o.abs() <= r, -torch.inf, torch.inf), (torch.where(d > 0, -r, r) - o) / d)
        far = torch.where(d == 0, torch.inf, (torch.where(d > 0, r, -r) - o) / d)
        near = torch.where(o.abs() <= r, torch.full_like(near, -torch.inf), near)
        enter, leave = torch.maximum(enter, near), torch.minimum(leave, far)
    return enter, leave


@torch.no_grad()
def reference(
    surface: Surface, heights: Tensor | None, origin, direction, side: float = 1.0, radius: float | None = None
) -> tuple[Tensor, Tensor]:
    """Distances t (N,) mm to the first intersections, and `Status` (N,), by safeguarded Newton iteration in plain torch."""
    h, middle = surface.centred(None if heights is None else heights.detach())
    ox, oy, oz, dx, dy, dz = (c.detach() for c in _broadcast(*origin, *direction))
    oz, dz = side * (oz - middle), side * dz
    low_z, high_z = sorted(side * z for z in surface.hull(h))
    rx, ry = surface.half_size
    ahead = dz > 0
    dz = torch.where(ahead, dz, torch.ones_like(dz))
    enter, leave = _above_aperture((ox, oy), (dx, dy), surface.half_size)
    low, top = torch.maximum((low_z - oz) / dz, enter), (high_z - oz) / dz
    high, closed = torch.minimum(leave, top), top < leave
    possible = ahead & (low <= high) & torch.isfinite(low)
    low = torch.where(possible, low, torch.zeros_like(low))
    high = torch.where(possible, high, torch.zeros_like(high))

    def f(t: Tensor, of: Tensor | slice) -> tuple[Tensor, Tensor]:
        if not len(t):
            return t, t
        x, y = ox[of] + t * dx[of], oy[of] + t * dy[of]
        if rx < torch.inf:
            x, y = x.clamp(-rx, rx), y.clamp(-ry, ry)
        z, zx, zy = surface.at(h, x, y)
        return oz[of] + t * dz[of] - side * z, dz[of] - side * (zx * dx[of] + zy * dy[of])

    status = torch.where(possible, int(Status.HIT), int(Status.MISSED))
    bound = surface.slope_bounds(h)
    slope = bound[0] * dx.abs() + bound[1] * dy.abs()
    within_box = (possible & ((low <= enter) | (slope >= dz))).nonzero()[:, 0]  # others begin below all of the surface
    f_low = torch.full_like(low, -torch.inf)
    f_low[within_box] = f(low[within_box], within_box)[0]
    at_once = f_low >= 0
    status = torch.where(at_once & (low <= enter) & (f_low > 0), int(Status.MISSED), status)
    unsafe = ((slope >= dz) & (status == Status.HIT) & ~at_once).nonzero()[:, 0]
    if len(unsafe):
        valid = _first_brackets(
            lambda t, of: f(t, unsafe[of])[0], low[unsafe], high[unsafe], f_low[unsafe], (dz + slope)[unsafe], (dz - slope)[unsafe]
        )
        low, high = low.index_copy(0, unsafe, valid[0]), high.index_copy(0, unsafe, valid[1])
        status = status.index_copy(0, unsafe, valid[2])
        closed = closed.index_fill(0, unsafe, True)
    size = torch.maximum(oz.abs(), torch.full_like(oz, max(abs(low_z), abs(high_z))))
    close, narrow = FEW_ULP * size, FEW_ULP * torch.maximum(high, size)
    t = torch.where(at_once, low, ((0.5 * (low_z + high_z) - oz) / dz).clamp(low, high))
    busy = (status == Status.HIT) & ~at_once
    doubtful = (busy & ~closed).nonzero()[:, 0]
    status[doubtful[f(high[doubtful], doubtful)[0] < 0]] = int(Status.MISSED)
    of = (busy & (status == Status.HIT)).nonzero()[:, 0]
    of = _converged(f, of, t, low, high, close, narrow)
    status[of] = int(Status.UNRESOLVED)
    return t, within(status, t, (ox, oy), (dx, dy), radius)


def _converged(f, of: Tensor, t: Tensor, low: Tensor, high: Tensor, close: Tensor, narrow: Tensor) -> Tensor:
    """Safeguarded Newton steps of the rays `of` to roots t in [low, high], all (N,), in place; the rays without one."""
    for _ in range(MOST_STEPS):
        if not len(of):
            break
        some = slice(None) if len(of) == len(t) else of  # of all rays nothing has to be looked up
        at = t[some]
        value, slope_f = f(at, some)
        a, b = torch.where(value < 0, at, low[some]), torch.where(value >= 0, at, high[some])
        step = value / slope_f
        done = ((value.abs() <= close[some]) & (step.abs() <= narrow[some])) | (b - a <= narrow[some])
        after = at - step
        after = torch.where((after > a) & (after < b), after, 0.5 * (a + b))
        low[some], high[some], t[some] = a, b, torch.where(done, at, after)
        of = of[~done]
    return of


def _first_brackets(f, low: Tensor, high: Tensor, f_low: Tensor, rise: Tensor, fall: Tensor):
    """Brackets a, b with f(a) < 0 <= f(b) of the first roots in [low, high], and a status each.

    By the Lipschitz bounds of f there is no root between a and b if the lines of slope `rise` from a and `fall` from b intersect
    below 0.
    """
    a, f_a, b, step = low.clone(), f_low.clone(), high.clone(), high - low
    least = FINEST * (high - low)
    status = torch.full(low.shape, int(Status.UNRESOLVED), device=low.device)
    for _ in range(MOST_PROBES):
        at = (status == Status.UNRESOLVED).nonzero()[:, 0]
        if not len(at):
            break
        end = torch.minimum(a[at] + step[at], high[at])
        f_b, width, small = f(end, at), end - a[at], step[at] <= least[at]
        across = (f_b - f_a[at] - fall[at] * width) / (rise[at] - fall[at])
        free = (f_b < 0) & (small | (f_a[at] + rise[at] * across < 0))
        through, here = free & (end >= high[at]), (f_b >= 0) & small
        status[at[through]], status[at[here]] = int(Status.MISSED), int(Status.HIT)
        b[at] = torch.where(here, end, b[at])
        on = free & ~through
        a[at], f_a[at] = torch.where(on, end, a[at]), torch.where(on, f_b, f_a[at])
        step[at] = torch.where(on, 2.0 * step[at], torch.maximum(0.5 * width, 0.999 * least[at]))
    return a, b, status
