"""From one surface to the next through a medium of varying index.

Notation, beside that of `integrator`
    f(q)    height of a point above the next surface, in that surface's frame: z - Z(x, y);  f' = grad f . p along a ray
    T       tau of the straight way to the surface's mean height, in `steps` steps: as good a guess as bending is weak
    delta   what is then missing to the surface, one more step: found by Newton's method, f(q(T + delta)) = 0

T follows differentiably from the ray; a guess that misses by more than a step is moved by what it missed, and halved where the ray
has turned away from the surface by then, which changes the steps and not the ray.  delta is differentiated at the root,
d delta = -df / f'.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from caustic_cli.optics.gradient.fields import IndexField
from caustic_cli.optics.gradient.integrator import ORDER, Flow, steps_for
from caustic_cli.optics.surfaces.base import Surface
from caustic_cli.optics.tolerances import PARALLEL

#: Part of the way that rays may be off, and angle, rad: a thousandth of a pixel on any screen that a picture of 1000 pixels is on.
TOLERANCE = 1e-7
#: A point is on the surface where it is so near, in parts of the way; most steps of Newton's iteration, most guesses of T.
ON_SURFACE, NEWTON, GUESSES = 1e-12, 12, 12


class Transfer(NamedTuple):
    """Rays at the next surface.

    point, direction: in the medium's frame, three (N,) each, mm and unit; n: there; path, length: optical and geometric, mm;
    slopes: of the surface, two (N,) or the number 0; found: whether the surface is met; steps: that were taken.
    """

    point: tuple
    direction: tuple
    n: Tensor
    path: Tensor
    length: Tensor
    slopes: tuple
    found: Tensor
    steps: int


def index_at(march, field: IndexField, coefficients: Tensor | None, point) -> Tensor:
    """n at points: the length that a ray at rest gains in one kick."""
    zero, one = torch.zeros_like(point[0]), torch.ones_like(point[0])
    return march(field, coefficients, point, (zero, zero, zero), one, 1, 2).length


def transfer(
    march: Callable[..., Flow],
    field: IndexField,
    coefficients: Tensor | None,
    point,
    direction,
    surface: Surface,
    heights: Tensor | None,
    seen: Callable,
    side: float,
    steps: int | None = None,
    order: int = ORDER,
) -> Transfer:
    """Rays to a surface through a field.

    Args:
        march: `flow` of a backend.
        point, direction: three (N,) float64 each, in the medium's frame.
        surface, heights: what they run to.
        seen: (points, vectors) of the medium's frame -> the same in the surface's.
        side: from which the surface is met.
        steps: None for as many as TOLERANCE asks for.
    """
    n = index_at(march, field, coefficients, point)
    p = tuple(n * d for d in direction)
    o, v = seen(point, p)
    middle = 0.5 * sum(surface.hull(None if heights is None else heights.detach()))
    ahead = side * v[2] > PARALLEL
    time = torch.where(ahead, (middle - o[2]) / torch.where(ahead, v[2], torch.ones_like(v[2])), torch.zeros_like(v[2]))
    if steps is None:
        steps = steps_for(march, field, coefficients, point, p, time, TOLERANCE, order)
    near = ON_SURFACE * max(float(time.detach().abs().max()) * float(n.detach().mean()), 1e-3)

    def above(at: Flow):
        """f, f' and the slopes; beyond its aperture a surface goes on level."""
        (x, y, z), (px, py, pz) = seen(at.point, at.momentum)
        if surface.flat:
            return z, pz, (0.0, 0.0), torch.ones_like(z, dtype=torch.bool)
        (rx, ry) = surface.half_size
        within = (x.abs() <= rx) & (y.abs() <= ry)
        x, y = x.clamp(-rx, rx), y.clamp(-ry, ry)
        height, gx, gy = (surface.at if torch.is_grad_enabled() and x.requires_grad else surface.evaluate)(heights, x, y)
        return z - height, pz - gx * px - gy * py, (gx, gy), within

    def missing(begin: Flow) -> tuple[Tensor, Tensor]:
        """delta of rays from here, and whether they come to the surface."""
        f, rate, _, _ = above(begin)
        delta = torch.zeros_like(f)
        ok = side * rate > PARALLEL
        for _ in range(NEWTON):
            delta = delta - torch.where(ok, f / torch.where(ok, rate, torch.ones_like(rate)), torch.zeros_like(f))
            f, rate, _, _ = above(march(field, coefficients, begin.point, begin.momentum, delta, 1, order))
            ok = ok & (side * rate > PARALLEL) & f.isfinite()
            if bool(((f.abs() <= near) | ~ok).all()):
                break
        return torch.where(ok, delta, torch.zeros_like(delta)), ok & (f.abs() <= 10.0 * near)

    moved = torch.zeros_like(time)
    for guess in range(GUESSES):
        arrived = march(field, coefficients, point, p, time + moved, steps, order)
        with torch.no_grad():
            delta, found = missing(arrived)
            step = (time + moved).abs() / steps
            far, astray = found & (delta.abs() > step), ahead & ~found
            if guess == GUESSES - 1 or not bool((far | astray).any()):
                break
            moved = moved + torch.where(far, delta, torch.zeros_like(delta)) - torch.where(astray, 0.5 * (time + moved), 0.0 * time)
    if (torch.is_grad_enabled() and any(t.requires_grad for t in (*arrived.point, *arrived.momentum))) or (
        heights is not None and heights.requires_grad
    ):
        f, rate, _, _ = above(march(field, coefficients, arrived.point, arrived.momentum, delta, 1, order))
        rate = torch.where(found, rate.detach(), torch.ones_like(rate))
        delta = delta - torch.where(found, (f - f.detach()) / rate, torch.zeros_like(f))
    end = march(field, coefficients, arrived.point, arrived.momentum, delta, 1, order)
    _, _, slopes, within = above(end)
    norm = (end.momentum[0] ** 2 + end.momentum[1] ** 2 + end.momentum[2] ** 2).sqrt()
    return Transfer(
        end.point,
        tuple(c / norm for c in end.momentum),
        norm,
        arrived.path + end.path,
        arrived.length + end.length,
        slopes,
        found & within,
        steps,
    )
