"""The receiving plane of a wave image, with its frame, centre and pixels; and the plane through its centre normal to the axis.

Notation
    e1, e2, e3  unit vectors along the plane and normal to it, e3 in the direction of light
    Z           distance of the plane along e3 from the system's origin, mm
    X, Y        coordinates on it along e1, e2, mm
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from caustic_cli.errors import InputError
from caustic_cli.optics.frames import IDENTITY, Axes
from caustic_cli.optics.system import PlacedScreen, System
from caustic_cli.optics.waves.sampling import NoWaveImage
from caustic_cli.scene import Screen

#: Cosine between a screen's normal and the axis from which on it counts as perpendicular to the axis.
ACROSS = 1.0 - 1e-12
#: Least cosine between a screen's normal and the axis: near grazing incidence off-axis light is parallel to the screen.
LEAST_COSINE = 0.08

Vector = tuple[float, float, float]


def dot(a: Vector, b: Vector) -> float:
    """Scalar product."""
    return sum(x * y for x, y in zip(a, b, strict=True))


@dataclass(frozen=True)
class Plane:
    """A plane normal to the light: its frame (e1, e2, e3) and Z, mm; see the module."""

    axes: Axes
    z: float


@dataclass(frozen=True)
class Receiver:
    """A screen's pixels in space.

    middle: origin on its plane, mm; axes: along its x, along its y, normal to it; low: lower edges relative to the origin along
    both, mm; pixel: widths, mm; resolution: pixels along x and y.
    """

    middle: Vector
    axes: Axes
    low: tuple[float, float]
    pixel: tuple[float, float]
    resolution: tuple[int, int]

    @classmethod
    def of(cls, screen: Screen | PlacedScreen) -> Receiver:
        """The receiver of a scene's or a system's screen."""
        if isinstance(screen, PlacedScreen):
            inner = screen.screen
            return cls(screen.pose.position, screen.pose.axes, inner.low, inner.pixel, inner.resolution)
        if not any(screen.tilt):
            return cls((0.0, 0.0, screen.z), IDENTITY, screen.low, screen.pixel, screen.resolution)
        rx, ry = screen.half_size
        return cls((*screen.shift, screen.z), screen.axes, (-rx, -ry), screen.pixel, screen.resolution)

    def plane(self, axis: Vector) -> Plane:
        """The plane through its centre normal to the axis; its own plane if that is normal to the axis."""
        u, _, n = self.axes
        if abs(dot(n, axis)) >= ACROSS:
            return Plane(self.axes, dot(self.middle, n))
        x, y, z = (a - dot(u, axis) * b for a, b in zip(u, axis, strict=True))
        size = math.sqrt(dot((x, y, z), (x, y, z)))
        e1 = (x / size, y / size, z / size)
        e2 = (axis[1] * e1[2] - axis[2] * e1[1], axis[2] * e1[0] - axis[0] * e1[2], axis[0] * e1[1] - axis[1] * e1[0])
        return Plane((e1, e2, axis), dot(self.middle, axis))

    def across(self, axis: Vector) -> bool:
        """Whether it is perpendicular to the axis."""
        return abs(dot(self.axes[2], axis)) >= ACROSS

    def corners(self) -> list[Vector]:
        """Its four corners in space, mm."""
        (u, v, _), found = self.axes, []
        for a in (0, self.resolution[0]):
            for b in (0, self.resolution[1]):
                x, y = self.low[0] + a * self.pixel[0], self.low[1] + b * self.pixel[1]
                sx, sy, sz = (m + x * p + y * q for m, p, q in zip(self.middle, u, v, strict=True))
                found.append((sx, sy, sz))
        return found

    def extent(self, plane: Plane) -> tuple[tuple[float, float], tuple[float, float]]:
        """Limits of its orthogonal projection onto a plane: lower and upper X and Y, mm."""
        x, y = ([dot(c, e) for c in self.corners()] for e in plane.axes[:2])
        return (min(x), min(y)), (max(x), max(y))


def receiver_of(system: System, screen: Screen | PlacedScreen) -> Receiver:
    """The receiver of one of a system's screens.

    Raises:
        InputError: it is nearly parallel to the axis.
        NoWaveImage: it is curved.
    """
    if (screen if isinstance(screen, Screen) else screen.screen).curved:
        raise NoWaveImage("a curved screen has no wave image: the field is taken on planes")
    found = Receiver.of(screen)
    if abs(dot(found.axes[2], system.axis)) < LEAST_COSINE:
        raise InputError("⟨screen.tilt⟩ makes the screen nearly parallel to the light, where there is no wave image")
    return found
