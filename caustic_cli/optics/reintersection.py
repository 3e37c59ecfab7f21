"""Where light meets the free-form surface that has met it before, with derivatives by the ray as well as by the heights.

Such a ray starts wherever the surface sent it, so o and d depend on the heights.  Differentiated at a root t of
f = o_z + t d_z - Z(o_x + t d_x, o_y + t d_y), everything that moves the ray moves the hit.
"""

from __future__ import annotations

import torch
from torch import Tensor

from caustic_cli.optics.backends import backend_for
from caustic_cli.optics.intersection import attach
from caustic_cli.optics.surfaces import HeightField

#: Least steps of the search over a knot span: a dip under the surface narrower than that is not seen.  It carries little light, at
#: grazing incidence.
STEPS_PER_SPAN = 128
#: Most steps of one search: a ray that crept along the whole diagonal of the largest net would need more.
MOST_STEPS = 1 << 18
#: Halvings of a step: it is then shorter than a rounding of the lens' size.
HALVINGS = 50


@torch.no_grad()
def next_intersection(field: HeightField, heights: Tensor, o, d, below: bool, round: bool = False) -> tuple[Tensor, Tensor]:
    """Next intersection with the surface of rays that start on it, by steps and bisection.

    The slopes bound how fast a ray can come nearer, so its distance from the surface is a step that cannot miss it.

    Args:
        heights: (n, m) mm.
        o: (x, y, z) of the start, (N,) float64 each, mm; d: unit directions.
        below: whether the rays run under the surface, or above it.
        round: the surface ends at the circle inscribed in its aperture.

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
    """The same distances in plain torch, from float64; `step` mm is the least one."""
    side, (rx, ry), (lowest, highest) = -1.0 if below else 1.0, field.half_size, (float(h.min()), float(h.max()))
    gx, gy = field.slope_bounds(h)
    t_found, reached = torch.zeros_like(o[0]), torch.zeros_like(o[0])
    rise = side * d[2] - gx * d[0].abs() - gy * d[1].abs()  # where it is positive, no slope of the surface catches the ray
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
    """The hit at distance t (N,), not differentiated, of rays o, d that may depend on the heights.

    Returns:
        (x, y, z) mm, slopes (z_x, z_y), and the distance, (N,) each, with their first derivatives.
    """
    t, gx, gy = attach(field, heights, o, d, t, torch.ones_like(t, dtype=torch.bool))
    return tuple(c + t * v for c, v in zip(o, d, strict=True)), (gx, gy), t
