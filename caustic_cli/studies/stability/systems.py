"""Difficult cases of several elements and of lenses with two free-form sides.

Planes z = z_k + g_k x, on which a ray of the plane y = 0 is followed by Snell's law in vector form, in 60 digits for the truth.
"""

from __future__ import annotations

from collections.abc import Callable
from decimal import Decimal, localcontext
from typing import Any

import numpy as np
import torch

from caustic_cli.optics.bspline import SplineSpace
from caustic_cli.optics.frames import Pose
from caustic_cli.optics.media import Medium
from caustic_cli.optics.rays import RayState
from caustic_cli.optics.surfaces import HeightField, Plane
from caustic_cli.optics.system import Element, System
from caustic_cli.optics.trace import Tracer
from caustic_cli.scene import Aperture, PlaneWave, Screen
from caustic_cli.studies.stability.case import Case

#: Index of the glass, exact in any precision, and half the width of every surface, mm.
INDEX, HALF = 1.5, 512.0
APERTURE = Aperture((HALF, HALF))
#: z_k in mm and slope g_k of a plane, and the index behind it.
Side = tuple[float, float, float]


def walk(number: Callable[[Any], Any], sides: list[Side], start: tuple[float, float], direction: tuple[float, float], z: float):
    """x where a ray through these sides reaches z, by the textbook's formulas in this kind of number."""
    one, before = number(1), number(1)
    (x, height), (dx, dz) = map(number, start), map(number, direction)
    for side in sides:
        at, slope, behind = map(number, side)
        t = (at + slope * x - height) / (dz - slope * dx)
        x, height = x + t * dx, height + t * dz
        square, c, eta = one + slope * slope, dz - slope * dx, before / behind
        root = square * (one - eta * eta) + eta * eta * c * c
        gamma = ((root.sqrt() if isinstance(root, Decimal) else np.sqrt(root)) - eta * c) / square
        dx, dz, before = eta * dx - gamma * slope, eta * dz + gamma, behind
    return x + (number(z) - height) / dz * dx


def compared(sides: list[Side], elements: list[Element], heights: dict, direction: tuple[float, float], z: float):
    """Errors of where a ray from x = 0, z = -1 mm lands, mm: in float32 by the textbook, and of the program."""
    zero, one = torch.zeros(1, dtype=torch.float64), torch.ones(1, dtype=torch.float64)
    rays = RayState((zero, zero, -1.0), (direction[0] * one, zero, direction[1] * one), one)
    screen = Screen((8.0 * HALF, 8.0 * HALF), z)
    (landed,) = Tracer(System((PlaneWave(),), tuple(elements), (screen,)), rays).land(heights, screen)
    with localcontext() as context:
        context.prec = 60
        exact = walk(Decimal, sides, (0.0, -1.0), direction, z)
        naive = walk(np.float32, sides, (0.0, -1.0), direction, z)
        return tuple(abs(float(Decimal(float(x)) - exact)) for x in (naive, landed.origin[0][0]))


def plates(count: int) -> tuple[float, float]:
    """So many plates of 1 mm, 1 mm apart, crossed at 53 degrees."""
    sides = [(float(k), 0.0, 1.0 if k % 2 else INDEX) for k in range(2 * count)]
    elements = [
        Element(f"{k}", Plane(), APERTURE, behind=Medium(n), pose=Pose((0.0, 0.0, z)), fresnel="none")
        for k, (z, _, n) in enumerate(sides)
    ]
    return compared(sides, elements, {}, (0.8, 0.6), 2.0 * count)


def two_sides(wedge: float) -> tuple[float, float]:
    """Both sides free and steep, and all but parallel: what they do cancels, up to this difference of slopes, 1 km behind."""
    field = HeightField((SplineSpace.uniform(2, 1), SplineSpace.uniform(2, 1)), (HALF, HALF))
    sides = [(0.0, 0.5, INDEX), (8.0, 0.5 + wedge, 1.0)]
    elements, heights = [], {}
    for name, (z, slope, n) in zip(("front", "back"), sides, strict=True):
        elements.append(Element(name, field, APERTURE, behind=Medium(n), pose=Pose((0.0, 0.0, z)), fresnel="none"))
        heights[name] = slope * HALF * torch.tensor([[-1.0, -1.0], [1.0, 1.0]], dtype=torch.float64)
    return compared(sides, elements, heights, (0.0, 1.0), 1e6)


CASES = (
    # a rounding of some 300 mm (3e-14) at each of up to 2,000 transfers
    Case("10 to 1,000 plates in a row", "place on the screen, mm", "float32 adds up its roundings", 1e-10, plates, (10, 1000)),
    # some ten roundings of either direction, 1e6 mm behind
    Case(
        "two free sides, parallel up to 2^-30 to 2^-20",
        "place on a screen 1 km away, mm",
        "deflections cancel in float32",
        1e-8,
        two_sides,
        (2.0**-30, 2.0**-20),
    ),
)
