"""Ray aiming: rays through the points of a given grid on the reference plane, by Newton's method on the pupil."""

from __future__ import annotations

import torch
from torch import Tensor

#: Largest number of iterations, and least number at the edges of dark regions; fraction of the distance to the centre of the light
#: by which rays that have always been blocked move in each iteration.
TRIES, AT_EDGES, INWARDS = 16, 10, 0.02


def aimed_rays(optics, seen, at: tuple[Tensor, Tensor], shape: tuple[int, int], step: tuple[float, float], left: float) -> tuple:
    """Rays with intercepts at given points of the reference plane.

    Args:
        optics, seen: the `Optics`, and its `Survey`.
        at: x, y (N,) of the points, mm.
        shape, step: of the grid that they form, mm.
        left: tolerance of the path error, mm, see `_left`.

    Returns:
        `Intercepts` of the rays; their points of the pupil u, v; and whether a ray was blocked at some iteration, (N,).

    Rays that leave the pupil are clamped to its edge.  The intercepts of rays that are blocked behind the pupil are undefined: such
    a ray moves back towards its last unblocked position, or else towards the centre of the light.
    """
    x, y = at
    u, v = ((c - seen.offset[k]) / seen.scale[k] for k, c in enumerate(at))
    middle = [(0.5 * (seen.light[0][k] + seen.light[1][k]) - seen.offset[k]) / seen.scale[k] for k in (0, 1)]
    found = behind = torch.zeros_like(x, dtype=torch.bool)
    held = u.clamp(0.0, 1.0), v.clamp(0.0, 1.0)
    for k in range(TRIES):
        hu, hv = u.clamp(0.0, 1.0), v.clamp(0.0, 1.0)
        f = optics.intercepts(hu, hv)
        lit = f.power > 0
        found, behind = found | lit, behind | ~lit
        held_u, held_v = (torch.where(lit | ~found, h, before) for h, before in zip((hu, hv), held, strict=True))
        held = held_u, held_v
        settled = _left(f, x, y, shape, step, u, v, behind) <= left
        if settled and (k + 1 >= AT_EDGES or not bool(behind.any())):
            break
        ahead = (hu + (x - f.x) / seen.scale[0], hv + (y - f.y) / seen.scale[1])
        u, v = (
            torch.where(lit, a, torch.where(found, 0.5 * (h + b), h + INWARDS * (m - h)))
            for a, h, b, m in zip(ahead, (hu, hv), held, middle, strict=True)
        )
    if bool(behind.any()):
        f = optics.intercepts(*held)
    return f, held, behind


def _left(
    f, x: Tensor, y: Tensor, shape: tuple[int, int], step: tuple[float, float], u: Tensor, v: Tensor, behind: Tensor
) -> float:
    """Bound of the error of the optical path due to a displacement e from the grid points: e^2 / 2 times the wavefront's curvature,
    mm."""
    inside = ~behind & (u >= 0) & (u <= 1) & (v >= 0) & (v <= 1)
    if not bool(inside.any()):
        return 0.0
    e2 = (x - f.x).square() + (y - f.y).square()
    curvature = sum(g.abs() for c in (f.qx, f.qy) for g in torch.gradient(c.view(shape), spacing=step, dim=(0, 1)))
    return float((0.5 * e2.view(shape) * curvature)[inside.view(shape)].max())
