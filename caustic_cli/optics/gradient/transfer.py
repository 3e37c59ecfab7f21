"""Ray transfer to the next surface through a gradient-index medium.

Notation, in addition to that of `integrator`
    f(q)    height of a point above the next surface, in that surface's frame: z - Z(x, y);  f' = grad f . p along a ray
    T       tau of the straight path to the surface's mean height, integrated in `steps` steps: an estimate, good for weak gradients
    delta   remaining step to the surface, from Newton's method for f(q(T + delta)) = 0

T is a differentiable function of the ray.  If delta exceeds a step, T is increased by it; if the ray has turned away from the
surface, T is halved.  This changes the steps but not the ray.  delta is differentiated at the root, d delta = -df / f', in both
modes.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from caustic_cli.optics.backends import differentiated, primal
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
    """Rays at the next surface."""

    #: In the medium's frame, three (N,) each, mm and unit vectors.
    point: tuple
    direction: tuple
    #: Index there.
    n: Tensor
    #: Optical and geometric path length, mm.
    path: Tensor
    length: Tensor
    #: Of the surface, two (N,) or the number 0.
    slopes: tuple
    #: Whether the surface is reached.
    found: Tensor
    #: Number of steps.
    steps: int


@dataclass(frozen=True)
class RayFlow:
    """Integration of rays in one medium: `flow` of a backend, the index field with its coefficients (None: its own), and the order
    of the method."""

    flow: Callable[..., Flow]
    field: IndexField
    coefficients: Tensor | None
    order: int = ORDER

    def on(self, point, momentum, time: Tensor, steps: int = 1) -> Flow:
        """Rays after `time` (N,) mm of tau."""
        return self.flow(self.field, self.coefficients, point, momentum, time, steps, self.order)

    def index_at(self, point) -> Tensor:
        """Refractive index at points, (N,): the length L of a ray with p = 0 after one kick of unit size."""
        zero, one = torch.zeros_like(point[0]), torch.ones_like(point[0])
        return self.flow(self.field, self.coefficients, point, (zero, zero, zero), one, 1, 2).length

    def steps_for(self, point, momentum, time: Tensor) -> int:
        """Number of steps that TOLERANCE requires."""
        return steps_for(self.flow, self.field, self.coefficients, point, momentum, time, TOLERANCE, self.order)


@dataclass(frozen=True)
class NextSurface:
    """The next surface, with its heights; the transformation of (points, vectors) from the medium's frame to the surface's; and the
    side from which it is reached."""

    surface: Surface
    heights: Tensor | None
    seen: Callable
    side: float

    def estimate(self, point, momentum) -> tuple[Tensor, Tensor]:
        """tau of the straight path to the surface's mean height, 0 for rays that do not go there, and which do, (N,)."""
        o, v = self.seen(point, momentum)
        middle = 0.5 * sum(self.surface.hull(None if self.heights is None else self.heights.detach()))
        ahead = self.side * v[2] > PARALLEL
        time = torch.where(ahead, (middle - o[2]) / torch.where(ahead, v[2], torch.ones_like(v[2])), torch.zeros_like(v[2]))
        return time, ahead

    def above(self, at: Flow):
        """f, f', slopes, and whether the point is inside the aperture, beyond which the surface is continued at constant height."""
        (x, y, z), (px, py, pz) = self.seen(at.point, at.momentum)
        surface = self.surface
        if surface.flat:
            return z, pz, (0.0, 0.0), torch.ones_like(z, dtype=torch.bool)
        (rx, ry) = surface.half_size
        within = (x.abs() <= rx) & (y.abs() <= ry)
        x, y = x.clamp(-rx, rx), y.clamp(-ry, ry)
        height, gx, gy = (surface.at if differentiated(x) else surface.evaluate)(self.heights, x, y)
        return z - height, pz - gx * px - gy * py, (gx, gy), within

    def missing(self, rays: RayFlow, begin: Flow, near: float) -> tuple[Tensor, Tensor]:
        """delta of rays from this point on, and whether they reach the surface, to within `near`, mm."""
        f, rate, _, _ = self.above(begin)
        delta = torch.zeros_like(f)
        ok = self.side * rate > PARALLEL
        for _ in range(NEWTON):
            delta = delta - torch.where(ok, f / torch.where(ok, rate, torch.ones_like(rate)), torch.zeros_like(f))
            f, rate, _, _ = self.above(rays.on(begin.point, begin.momentum, delta))
            ok = ok & (self.side * rate > PARALLEL) & f.isfinite()
            if bool(((f.abs() <= near) | ~ok).all()):
                break
        return primal(torch.where(ok, delta, torch.zeros_like(delta))), ok & (f.abs() <= 10.0 * near)

    def attached(self, rays: RayFlow, arrived: Flow, delta: Tensor, found: Tensor) -> Tensor:
        """delta, differentiated at the root where a derivative is wanted."""
        if not differentiated(*arrived.point, *arrived.momentum, *([] if self.heights is None else [self.heights])):
            return delta
        f, rate, _, _ = self.above(rays.on(arrived.point, arrived.momentum, delta))
        rate = torch.where(found, primal(rate), torch.ones_like(rate))
        return delta - torch.where(found, (f - primal(f)) / rate, torch.zeros_like(f))


def transfer(rays: RayFlow, point, direction, ahead: NextSurface, steps: int | None = None) -> Transfer:
    """Trace rays to a surface through an index field.

    Args:
        point, direction: three (N,) float64 each, in the medium's frame.
        steps: number of steps; None for as many as TOLERANCE requires.
    """
    n = rays.index_at(point)
    p = tuple(n * d for d in direction)
    time, towards = ahead.estimate(point, p)
    if steps is None:
        steps = rays.steps_for(point, p, time)
    near = ON_SURFACE * max(float(time.detach().abs().max()) * float(n.detach().mean()), 1e-3)
    moved = torch.zeros_like(time)
    for guess in range(GUESSES):
        arrived = rays.on(point, p, time + moved, steps)
        with torch.no_grad():
            delta, found = ahead.missing(rays, arrived, near)
            step = (time + moved).abs() / steps
            far, astray = found & (delta.abs() > step), towards & ~found
            if guess == GUESSES - 1 or not bool((far | astray).any()):
                break
            moved = moved + torch.where(far, delta, torch.zeros_like(delta)) - torch.where(astray, 0.5 * (time + moved), 0.0 * time)
    end = rays.on(arrived.point, arrived.momentum, ahead.attached(rays, arrived, delta, found))
    _, _, slopes, within = ahead.above(end)
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
