"""Ray transfer to the next surface through a gradient-index medium.

Notation, in addition to that of `integrator`
    f(q)    height of a point above the next surface, in that surface's frame: z - Z(x, y);  f' = grad f . p along a ray
    T       tau of the straight path to the surface's mean height, integrated in `steps` steps: an estimate, good for weak gradients
    delta   remaining step to the surface, from Newton's method for f(q(T + delta)) = 0

T is a differentiable function of the ray.  If delta exceeds a step, T is increased by it; if the ray has turned away from the
surface, T is halved.  This changes the steps but not the ray.  delta is differentiated at the root, d delta = -df / f'.
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

#: Error tolerance of points relative to the path length, and of directions, rad: a thousandth of a pixel for a picture of 1000
#: pixels.
TOLERANCE = 1e-7
#: Tolerance of the distance to the surface relative to the path length; largest numbers of Newton iterations and of corrections of
#: T.
ON_SURFACE, NEWTON, GUESSES = 1e-12, 12, 12


class Transfer(NamedTuple):
    """Rays at the next surface.

    point, direction: in the medium's frame, three (N,) each, mm and unit vectors; n: index there; path, length: optical and
    geometric path length, mm; slopes: of the surface, two (N,) or the number 0; found: whether the surface is reached; steps:
    number of steps.
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
    """Refractive index at points, (N,): the length L of a ray with p = 0 after one kick of unit size."""
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
    """Trace rays to a surface through an index field.

    Args:
        march: `flow` of a backend.
        point, direction: three (N,) float64 each, in the medium's frame.
        surface, heights: the next surface.
        seen: transformation of (points, vectors) from the medium's frame to the surface's.
        side: from which the surface is reached.
        steps: number of steps; None for as many as TOLERANCE requires.
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
        """f, f', slopes, and whether the point is inside the aperture, beyond which the surface is continued at constant height."""
        (x, y, z), (px, py, pz) = seen(at.point, at.momentum)
        if surface.flat:
            return z, pz, (0.0, 0.0), torch.ones_like(z, dtype=torch.bool)
        (rx, ry) = surface.half_size
        within = (x.abs() <= rx) & (y.abs() <= ry)
        x, y = x.clamp(-rx, rx), y.clamp(-ry, ry)
        height, gx, gy = (surface.at if torch.is_grad_enabled() and x.requires_grad else surface.evaluate)(heights, x, y)
        return z - height, pz - gx * px - gy * py, (gx, gy), within

    def missing(begin: Flow) -> tuple[Tensor, Tensor]:
        """delta of rays from this point on, and whether they reach the surface."""
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
