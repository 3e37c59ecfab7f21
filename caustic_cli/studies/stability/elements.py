"""Difficult cases of gradient indices and of curved screens."""

from __future__ import annotations

import math
from decimal import Decimal, localcontext

import torch

from caustic_cli.optics.backends import backend_for
from caustic_cli.optics.gradient.fields import Selfoc
from caustic_cli.optics.gradient.transfer import RayFlow
from caustic_cli.optics.screen_shape import shape_of
from caustic_cli.scene import Screen
from caustic_cli.studies.stability.case import Case


def flat_sphere(radius: float) -> tuple[float, float]:
    """A ray along the axis, 10 mm beside it, from the plane that touches the sphere: its way is the sag."""
    x = 10.0
    with localcontext() as context:
        context.prec = 60
        exact = float(Decimal(radius) - (Decimal(radius) ** 2 - Decimal(x) ** 2).sqrt())
    naive = radius - math.sqrt(radius * radius - x * x)
    at, zero, one = (torch.full((1,), c, dtype=torch.float64) for c in (x, 0.0, 1.0))
    surface = shape_of(Screen((40.0, 40.0), 100.0, radius=(radius, radius))).surface  # type: ignore[attr-defined]
    hit = surface.intersect(None, (at, zero, zero), (zero, zero, one), 1.0)
    ours = abs(float(hit.t[0]) / exact - 1.0) if bool(hit.valid[0]) else math.inf
    return abs(naive / exact - 1.0), ours


def long_rod(pitches: int) -> tuple[float, float]:
    """Rays in a SELFOC rod, on x = cos(w tau), after whole pitches and an eighth; naively by as many of Euler's steps."""
    rod = Selfoc(1.5, 0.2)
    w = rod.n0 * rod.g
    turns = 2.0 * math.pi * (pitches + 0.125)
    exact = (math.sqrt(0.5), -w * math.sqrt(0.5))
    one, zero, time = (torch.full((1,), c, dtype=torch.float64) for c in (1.0, 0.0, turns / w))
    point, momentum = (one, zero, zero), (zero, zero, torch.full_like(one, math.sqrt(rod.n0**2 - w**2)))
    rays = RayFlow(backend_for("cpu").flow, rod, None)
    steps = rays.steps_for(point, momentum, time)
    found = rays.on(point, momentum, time, steps)
    growth = math.log1p((turns / steps) ** 2) * 0.5 * steps  # of Euler's amplitude, exactly
    naive = math.expm1(growth) if growth < 700.0 else math.inf
    return naive, math.hypot(float(found.point[0][0]) - exact[0], (float(found.momentum[0][0]) - exact[1]) / w)


def oblique(tilt: float) -> tuple[float, float]:
    """Rays that nearly graze a tilted screen 1 km away, in mm on it; naively all in float32."""
    screen = Screen((40.0, 40.0), 1e6, tilt=(tilt, 10.0))
    axes, centre = screen.axes, screen.centre
    start = (2e5, 1e5, 5.0)
    way = [c + 0.3 * a - 0.2 * b - o for c, a, b, o in zip(centre, axes[0], axes[1], start, strict=True)]
    direction = [w / math.hypot(*way) for w in way]
    exact = _on_plane([Decimal(c) for c in start], [Decimal(c) for c in direction], centre, axes)

    def landed(dtype: torch.dtype) -> float:
        o, d = ([torch.full((1,), c, dtype=dtype) for c in v] for v in (start, direction))
        x, y, arrives = shape_of(screen).land(backend_for("cpu"), tuple(o), tuple(d), centre, axes, 1.0)
        return math.hypot(float(x[0]) - exact[0], float(y[0]) - exact[1]) if bool(arrives[0]) else math.inf

    return landed(torch.float32), landed(torch.float64)


def _on_plane(start: list[Decimal], direction: list[Decimal], centre, axes) -> tuple[float, float]:
    """Coordinates on a plane of the ray from a point, with 60 digits."""
    with localcontext() as context:
        context.prec = 60
        e1, e2, e3 = ([Decimal(c) for c in axis] for axis in axes)
        beside = [Decimal(c) - s for c, s in zip(centre, start, strict=True)]
        t = sum(a * b for a, b in zip(beside, e3, strict=True)) / sum(a * b for a, b in zip(direction, e3, strict=True))
        there = [t * d - b for d, b in zip(direction, beside, strict=True)]
        return tuple(float(sum(a * b for a, b in zip(there, e, strict=True))) for e in (e1, e2))  # type: ignore[return-value]


CASES = (
    # step doubling keeps 1e-7 of a path of 318 mm between two numbers of steps, and a fifteenth of it (2e-6 mm) to the truth
    Case(
        "SELFOC rods of 1 to 10 pitches",
        "place and slope, of the amplitude",
        "Euler's steps gain energy",
        1e-5,
        long_rod,
        (1, 10),
    ),
    # positive terms: a few roundings
    Case(
        "spherical screens of 1e6 to 1e9 mm",
        "way to the screen, relative",
        "R - sqrt(R² - x²) cancels",
        1e-12,
        flat_sphere,
        (1e6, 1e9),
    ),
    # roundings of 1e6 mm and of the direction (1e-10 mm), over cos(85 deg)^2
    Case(
        "screens 1 km away at 60 to 85°",
        "place on the screen, mm",
        "float32 has no digits left",
        1e-6,
        oblique,
        (60.0, 85.0),
    ),
)
