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


CASES = (
    Case(
        "SELFOC rods of 1 to 10 pitches",
        "place and slope, of the amplitude",
        "Euler's steps gain energy",
        1e-5,
        long_rod,
        (1, 10),
    ),
    Case(
        "spherical screens of 1e6 to 1e9 mm",
        "way to the screen, relative",
        "R - sqrt(R² - x²) cancels",
        1e-12,
        flat_sphere,
        (1e6, 1e9),
    ),
)
