"""Where a ray meets the height field, and its derivatives by the implicit function theorem (thesis 4.3.2).

Notation
    o, d    the ray's start and unit direction inside the lens, mm
    f(t)    o_z + t d_z - Z(o_x + t d_x, o_y + t d_y), negative below the surface (eq. 4.3.3)
    c       f'(t) = d_z - Z_x d_x - Z_y d_y, at the hit the cosine of incidence times |N|
    L       bound of |Z_x d_x| + |Z_y d_y| from the derivative's control net, which holds the derivative in its convex hull

A ray with L < d_z meets the surface once.  Newton's iteration then runs inside a bracket, from the control net's hull and the
aperture, that bisection takes over where a step leaves it.  For any other ray the first root is isolated before that.

`reference` is plain torch, and the path for other devices; `kernels.hit` is its fused form.  The thesis' triangle mesh is in
`mesh`.  At the hit, f(t; P) = 0 gives dt/dP = N_i N_j / c, whatever found t: no iteration is ever differentiated.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum

import torch
from torch import Tensor

from caustic_cli.errors import InputError
from caustic_cli.optics.bundle import Bundle
from caustic_cli.optics.heightfield import HeightField
from caustic_cli.optics.kernels import fused
from caustic_cli.optics.mesh import TriangleMesh
from caustic_cli.optics.tolerances import FEW_ULP, FINEST, LEAST_COSINE, MOST_PROBES, MOST_STEPS
from caustic_cli.scene import checks

METHODS = ("newton", "mesh", "mesh+newton")


class Status(IntEnum):
    """What became of a ray inside the lens."""

    HIT = 0
    MISSED = 1  # it leaves the aperture below the surface: the lens' side absorbs it
    UNRESOLVED = 2  # the search gave up; counted as missed


@dataclass(frozen=True)
class Method:
    """How hits are found.

    Args:
        name: newton, mesh, or mesh+newton, which begins Newton's iteration at the mesh's hit.
        parts: (n_u, n_v), parts that the mesh cuts each knot span into.
        recursive: look for the mesh's span products four rectangles at a time, or through all of them.
    """

    name: str = "newton"
    parts: tuple[int, int] = (4, 4)
    recursive: bool = True

    def __post_init__(self):
        checks.choice("intersection method", self.name, METHODS)


def meet(field: HeightField, heights: Tensor, bundle: Bundle,
         method: Method | None = None) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """First hits of a bundle.

    Args:
        heights: (n, m) control heights, mm.
        method: None for Newton's, which decides ray by ray, from the surface's slopes, whether it has to isolate the root.

    Returns:
        t, distance to the hit (mm; -1 for none), dz/dx and dz/dy there, all (N,) float64, differentiable once in either mode by
        the heights; status (N,), a `Status` each.  Where a mesh found t, these are those of the surface above that point.
    """
    t, status = find(field, heights, bundle, method)
    hit = status == Status.HIT
    t = torch.where(hit, t, torch.zeros_like(t))
    x, y = bundle.x + t * bundle.dx, bundle.y + t * bundle.dy
    z, gx, gy = field.at(heights, x, y)
    with torch.no_grad():
        xx, xy, yy = field.at(heights, x, y, ((2, 0), (1, 1), (0, 2)))
        cosine = (bundle.dz - gx * bundle.dx - gy * bundle.dy).clamp_min(LEAST_COSINE)
    # f(t; P) = 0: one Newton step from the root, whose value is 0 and whose derivative is that of the root.
    move = torch.where(hit, (z - z.detach()) / cosine, torch.zeros_like(t))
    none = torch.zeros_like(t)
    gx = torch.where(hit, gx + (xx * bundle.dx + xy * bundle.dy) * move, none)
    gy = torch.where(hit, gy + (xy * bundle.dx + yy * bundle.dy) * move, none)
    return torch.where(hit, t + move, none - 1.0), gx, gy, status


@torch.no_grad()
def find(field: HeightField, heights: Tensor, bundle: Bundle, method: Method | None = None) -> tuple[Tensor, Tensor]:
    """t (N,) float64 of the first hit of every ray, and its status (N,); on a CPU by the kernels."""
    method, b = method or Method(), bundle
    start = None
    if method.name != "newton":
        mesh = TriangleMesh(field, heights, *method.parts)
        start, missed, _ = mesh.intersect(b.x, b.y, torch.full_like(b.x, b.z), b.dx, b.dy, b.dz, method.recursive)
        if method.name == "mesh":
            return torch.where(missed == 0, start, torch.zeros_like(start)), _within(missed.long(), start, b)
    if fused(b.x.device):
        from caustic_cli.optics.kernels.surface import FusedSurface, RayHits  # noqa: PLC0415

        hits = RayHits(FusedSurface(field.spaces, field.half_size), bundle)
        hits.find(heights, None if start is None else start.numpy())
        return torch.from_numpy(hits.t), torch.from_numpy(hits.status).long()
    if start is not None:
        raise InputError("mesh+newton intersection runs on the CPU; use newton")
    t, status = reference(field, heights, bundle)
    return t, _within(status, t, b)


def _within(status: Tensor, t: Tensor, b: Bundle) -> Tensor:
    """`status` with hits beyond a circular aperture as what they are, rays that left by the side."""
    if b.radius is None:
        return status
    beyond = (b.x + t * b.dx) ** 2 + (b.y + t * b.dy) ** 2 > b.radius**2
    return torch.where(beyond & (status == Status.HIT), int(Status.MISSED), status)


@torch.no_grad()
def reference(field: HeightField, heights: Tensor, bundle: Bundle) -> tuple[Tensor, Tensor]:
    """The same by Newton's method in plain torch."""
    h = heights.detach().double()
    lowest, highest = float(h.min()), float(h.max())
    (rx, ry), b = field.half_size, bundle
    inside = (b.x.abs() <= rx) & (b.y.abs() <= ry) & (b.dz > 0)
    dz = torch.where(inside, b.dz, torch.ones_like(b.dz))
    side = torch.minimum(*(torch.where(d == 0, torch.inf, torch.where(d > 0, r - o, r + o) / d.abs())
                           for o, d, r in ((b.x, b.dx, rx), (b.y, b.dy, ry))))
    low = ((lowest - b.z) / dz).clamp_min(0.0)
    top = (highest - b.z) / dz
    high, closed = torch.minimum(side, top), top < side

    def f(t: Tensor, of: Tensor | slice = slice(None)) -> tuple[Tensor, Tensor]:
        dx, dy, dz_ = b.dx[of], b.dy[of], dz[of]
        z, zx, zy = field.at(h, b.x[of] + t * dx, b.y[of] + t * dy)
        return b.z + t * dz_ - z, dz_ - zx * dx - zy * dy

    f_low = f(low)[0]
    status = torch.where(inside & (low <= high), int(Status.HIT), int(Status.MISSED))
    at_once = f_low >= 0
    status = torch.where(at_once & (low == 0) & (f_low > 0), int(Status.MISSED), status)
    bound = field.slope_bounds(h)
    slope = bound[0] * b.dx.abs() + bound[1] * b.dy.abs()
    unsafe = ((slope >= dz) & (status == Status.HIT) & ~at_once).nonzero()[:, 0]
    if len(unsafe):
        found = _first_brackets(lambda t, of: f(t, unsafe[of])[0], low[unsafe], high[unsafe], f_low[unsafe],
                                (dz + slope)[unsafe], (dz - slope)[unsafe])
        low, high = low.index_copy(0, unsafe, found[0]), high.index_copy(0, unsafe, found[1])
        status = status.index_copy(0, unsafe, found[2])
        closed = closed.index_fill(0, unsafe, True)
    size = max(abs(lowest), abs(highest), abs(b.z))
    close, narrow = FEW_ULP * size, FEW_ULP * high.clamp_min(size)
    t = torch.where(at_once, low, ((0.5 * (lowest + highest) - b.z) / dz).clamp(low, high))
    busy = (status == Status.HIT) & ~at_once
    reaches = closed | (f(torch.where(busy, high, low))[0] >= 0)
    status = torch.where(busy & ~reaches, int(Status.MISSED), status)
    busy &= reaches
    for _ in range(MOST_STEPS):
        if not bool(busy.any()):
            break
        value, slope_f = f(t)
        low, high = torch.where(busy & (value < 0), t, low), torch.where(busy & (value >= 0), t, high)
        step = value / slope_f
        busy &= ~(((value.abs() <= close) & (step.abs() <= narrow)) | (high - low <= narrow))
        after = t - step
        after = torch.where((after > low) & (after < high), after, 0.5 * (low + high))
        t = torch.where(busy, after, t)
    return t, torch.where(busy, int(Status.UNRESOLVED), status)


def _first_brackets(f, low: Tensor, high: Tensor, f_low: Tensor, rise: Tensor, fall: Tensor):
    """Brackets a, b with f(a) < 0 <= f(b) around the first roots in [low, high], and a status each.

    No root lies between a and b if the two lines that bound f, of slope `rise` from a and `fall` from b, stay below 0.
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
