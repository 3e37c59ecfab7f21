"""Ray aiming: rays through the points of a given grid on the reference plane, by Newton's method on the pupil."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

#: Largest number of iterations, and least number at the edges of dark regions; fraction of the distance to the centre of the light
#: by which rays that have always been blocked move in each iteration; iterations after which the wavefront's curvature is known.
TRIES, AT_EDGES, INWARDS, SETTLING = 16, 10, 0.02, 2
#: Longest step from rays of a survey, in parts of the pupil: half the distance of its rays.
NEAR = 1.0 / 128.0


def aimed_rays(
    optics, seen, at: tuple[Tensor, Tensor], shape: tuple[int, int], step: tuple[float, float], left: float, sensitive: bool = False
) -> tuple:
    """Rays with intercepts at given points of the reference plane.

    Args:
        optics, seen: the `Optics`, and its `Survey`.
        at: x, y (N,) of the points, mm.
        shape, step: of the grid that they form, mm.
        left: tolerance of the path error, mm; from the second iteration on only rays beyond it are traced again.
        sensitive: as of `Optics.intercepts`.

    Returns:
        `Intercepts` of the rays; their points of the pupil u, v; and whether a ray was blocked at some iteration, (N,).

    Rays that leave the pupil are clamped to its edge.  The intercepts of rays that are blocked behind the pupil are undefined: such
    a ray moves back towards its last unblocked position, or else towards the centre of the light.
    """
    x, y = at
    u, v = seen.aim(x, y)
    toward = seen.toward if seen.places is None else _local(u, v, shape, step)
    middle = seen.toward(*(0.5 * (seen.light[0][k] + seen.light[1][k]) - seen.offset[k] for k in (0, 1)))
    found, behind = torch.zeros_like(x, dtype=torch.bool), torch.zeros_like(x, dtype=torch.bool)
    held = u.clamp(0.0, 1.0), v.clamp(0.0, 1.0)
    f: Any = None
    some: Tensor | slice = slice(None)
    curvature = torch.zeros_like(x)
    for k in range(TRIES):
        here = u[some].clamp(0.0, 1.0), v[some].clamp(0.0, 1.0)
        new = optics.intercepts(*here, sensitive)
        f = new if f is None else f.updated(some, new)
        lit = new.power > 0
        found[some] |= lit
        behind[some] |= ~lit
        ever = found[some]
        for kept, h in zip(held, here, strict=True):
            kept[some] = torch.where(lit | ~ever, h, kept[some])
        inside = ~behind & (u >= 0) & (u <= 1) & (v >= 0) & (v <= 1)
        if k < SETTLING:
            curvature = _curvature(f, shape, step)
        # a displacement e from its point of the grid is an error of the path of e^2 / 2 times the wavefront's curvature
        far = inside & (0.5 * ((x - f.x).square() + (y - f.y).square()) * curvature > left)
        if not bool(far.any()) and (k + 1 >= AT_EDGES or not bool(behind.any())):
            break
        ahead = [h + move for h, move in zip(here, toward(x[some] - new.x, y[some] - new.y, some), strict=True)]
        for c, a, h, kept, m in zip((u, v), ahead, here, held, middle, strict=True):
            c[some] = torch.where(lit, a, torch.where(ever, 0.5 * (h + kept[some]), h + INWARDS * (m - h)))
        some = (far | ~inside).nonzero()[:, 0]
    if bool(behind.any()):
        some = behind.nonzero()[:, 0]
        f = f.updated(some, optics.intercepts(*(h[some] for h in held), sensitive))
    return f, held, behind


def _local(u: Tensor, v: Tensor, shape: tuple[int, int], step: tuple[float, float]) -> Callable[..., tuple]:
    """As of `Survey.toward`, by the changes of u and v (N,) along the grid, and by NEAR at most: at the corners of the light, where
    these are uncertain, rays must not be thrown across the pupil."""
    by = [[g.reshape(-1) for g in torch.gradient(c.view(shape), spacing=step, dim=(0, 1))] for c in (u, v)]

    def toward(x: Tensor, y: Tensor, some: Tensor | slice) -> tuple[Tensor, Tensor]:
        a, b = ((gx[some] * x + gy[some] * y).clamp(-NEAR, NEAR) for gx, gy in by)
        return a, b

    return toward


def _curvature(f, shape: tuple[int, int], step: tuple[float, float]) -> Tensor:
    """Bound of the curvature of a wavefront at the rays of a grid, (N,) 1/mm."""
    slopes = [torch.gradient(c.view(shape), spacing=step, dim=(0, 1)) for c in (f.qx, f.qy)]
    bound = slopes[0][0].abs_()
    for g in (slopes[0][1], *slopes[1]):
        bound += g.abs_()
    return bound.view(-1)
