"""Secondary intersections of rays that start on a free-form surface, with derivatives by rays and heights.

Origin o and direction d of such a ray depend on the heights.  The root t of f = o_z + t d_z - Z(o_x + t d_x, o_y + t d_y) is
therefore differentiated by both.
"""

from __future__ import annotations

import torch
from torch import Tensor

from caustic_cli.optics.backends import backend_for
from caustic_cli.optics.intersection import attach
from caustic_cli.optics.surfaces import HeightField

#: Least step of the search, in parts of a knot span: a narrower excursion below the surface is missed.  It carries little light, at
#: grazing incidence.
STEPS_PER_SPAN = 128
#: Largest number of steps of a search, less than a ray along the whole diagonal of the largest net would need.
MOST_STEPS = 1 << 18
#: Number of bisections of a step, after which it is below a rounding of the lens' size.
HALVINGS = 50


@torch.no_grad()
def next_intersection(field: HeightField, heights: Tensor, o, d, below: bool, round: bool = False) -> tuple[Tensor, Tensor]:
    """Next intersection of rays that start on the surface, by marching and bisection.

    The bound of the slopes bounds the rate of approach, so the step derived from the height above the surface cannot pass through
    it (sphere tracing).

    Args:
        heights: (n, m) mm.
        o: (x, y, z) of the origins, (N,) float64 each, mm; d: unit directions.
        below: whether the rays start below the surface, or above it.
        round: whether the surface ends at the circle inscribed in its aperture.

    Returns:
        t (N,) mm, 0 where there is none; found (N,) bool.
    """
    h = heights.detach().double()
    o, d = ([c.detach().double() for c in v] for v in (o, d))
    step = min(2.0 * r * float(torch.diff(s.breaks).min()) for s, r in zip(field.spaces, field.half_size, strict=True))
    step /= STEPS_PER_SPAN
    t = backend_for(h.device).next_intersections(field, h, o, d, below, round, step)
    return t, t > 0


@torch.no_grad()
def reference(field: HeightField, h: Tensor, o, d, below: bool, round: bool, step: float) -> Tensor:
    """Distances (N,) mm, 0 where there is none, in plain torch, from float64; step: least step, mm."""
    side, (rx, ry), (lowest, highest) = -1.0 if below else 1.0, field.half_size, (float(h.min()), float(h.max()))
    gx, gy = field.slope_bounds(h)
    t_found, reached = torch.zeros_like(o[0]), torch.zeros_like(o[0])
    rise = side * d[2] - gx * d[0].abs() - gy * d[1].abs()  # positive: the ray rises faster than the surface can
    at = (rise <= 0).nonzero()[:, 0]
    before = torch.full_like(t_found, 1e-3 * step)[at]

    def height(at: Tensor, t: Tensor) -> Tensor:
        x, y = (c[at] + t * v[at] for c, v in zip(o[:2], d[:2], strict=True))
        inside = (x * x + y * y <= rx * rx) if round else (x.abs() <= rx) & (y.abs() <= ry)
        z = field.at(h, x.clamp(-rx, rx), y.clamp(-ry, ry), ((0, 0),))[0]
        return torch.where(inside, side * (o[2][at] + t * d[2][at] - z), torch.full_like(t, torch.nan))

    f_before = height(at, before)
    clear = f_before > 0
    at, before, f_before = at[clear], before[clear], f_before[clear]
    for _ in range(MOST_STEPS):
        if not len(at):
            break
        after = before + torch.clamp_min(f_before / -rise[at], step)
        f, z = height(at, after), o[2][at] + after * d[2][at]
        through = f <= 0
        reached[at[through]], t_found[at[through]] = before[through], after[through]
        climbs = side * d[2][at] > 0
        gone = torch.isnan(f) | (climbs & ((z > highest) if side > 0 else (z < lowest)))
        on = ~through & ~gone
        at, before, f_before = at[on], after[on], f[on]
    here = t_found.nonzero()[:, 0]
    low, high = reached[here], t_found[here]
    for _ in range(HALVINGS if len(here) else 0):
        middle = 0.5 * (low + high)
        clear = height(here, middle) > 0
        low, high = torch.where(clear, middle, low), torch.where(clear, high, middle)
    t_found[here] = high
    return t_found


def hit_with_derivatives(field: HeightField, heights: Tensor, o, d, t: Tensor):
    """The points of intersection at distances t (N,) without derivatives, for rays o, d that may depend on the heights.

    Returns:
        (x, y, z) mm, slopes (z_x, z_y), and the distance, (N,) each, with their first derivatives.
    """
    t, gx, gy = attach(field, heights, o, d, t, torch.ones_like(t, dtype=torch.bool))
    return tuple(c + t * v for c, v in zip(o, d, strict=True)), (gx, gy), t
