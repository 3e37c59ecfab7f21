"""Difficult cases of sources."""

from __future__ import annotations

import math

import torch

from caustic_cli.optics.emission import rays_of
from caustic_cli.optics.system import System
from caustic_cli.optics.trace import Tracer
from caustic_cli.scene import Lens, Points, Scene, Screen
from caustic_cli.studies.stability.case import Case

#: Half the size of the lens, mm.
HALF = (5.0, 4.0)


def arriving(distance: float, cone: float) -> float:
    """Part of the power of a cone (half angle in degrees) from `distance` mm before the lens that meets it."""
    lens = Lens(size=(2.0 * HALF[0], 2.0 * HALF[1]), fresnel="none")
    scene = Scene(Points(((0.0, 0.0, -distance),), cone=cone), lens, Screen((10.0, 10.0)))
    bundles = rays_of(scene, "stratified", 10_000, 1).chunks()
    return math.fsum(float(Tracer(System.of(scene), bundle).start.power.sum()) for bundle in bundles)


def solid_angle(h: float) -> float:
    """Of the lens from h mm before its middle, sr: a product of quotients without differences."""
    a, b = HALF
    return 4.0 * math.atan(a * b / (h * math.sqrt(a * a + b * b + h * h)))


def narrow_cone(cone: float) -> tuple[float, float]:
    """Its circle reaches 1.2 times as far as the lens' corner: the part is a ratio of solid angles."""
    theta = math.radians(cone)
    h = 1.2 * math.hypot(*HALF) / math.tan(theta)
    lens = solid_angle(h)
    exact = lens / (4.0 * math.pi * math.sin(0.5 * theta) ** 2)
    whole = 2.0 * math.pi * (1.0 - torch.cos(torch.tensor(theta, dtype=torch.float32)))
    return abs(float(torch.tensor(lens) / whole) / exact - 1.0), abs(arriving(h, cone) / exact - 1.0)


def near_source(distance: float) -> tuple[float, float]:
    """A hemisphere of uniform light; naively by 100 x 100 points spread evenly over the lens."""
    exact = solid_angle(distance) / (2.0 * math.pi)
    side = (torch.arange(100, dtype=torch.float64) + 0.5) / 100 - 0.5
    r2 = (2.0 * HALF[0] * side[:, None]) ** 2 + (2.0 * HALF[1] * side) ** 2 + distance**2
    naive = float((distance / r2**1.5).mean()) * 4.0 * HALF[0] * HALF[1] / (2.0 * math.pi)
    return abs(naive / exact - 1.0), abs(arriving(distance, 90.0) / exact - 1.0)


CASES = (
    # over such a cone the weights of rays vary by theta^2 = 3e-8
    Case(
        "cones of 1e-6 to 0.01°",
        "power that meets the lens, relative",
        "1 - cos leaves no digits",
        1e-7,
        narrow_cone,
        (1e-6, 1e-4, 1e-2),
    ),
    # 10,000 stratified rays know an area with an edge to N^(-3/4)
    Case(
        "source 1e-6 to 1e-3 mm before the lens",
        "power that meets the lens, relative",
        "even rays miss the foot",
        1e-3,
        near_source,
        (1e-6, 1e-3),
    ),
)
