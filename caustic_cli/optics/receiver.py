"""The receiver of a system's light: a screen in space, with its frame, centre, shape and pixels.

Notation
    e1, e2, e3  unit vectors along a plane and normal to it, e3 in the direction of light
    Z           distance of the plane along e3 from the system's origin, mm
    X, Y        coordinates on it along e1, e2, mm
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property
from typing import cast

import torch
from torch import Tensor

from caustic_cli.optics.frames import IDENTITY, Axes
from caustic_cli.optics.rays import RayState
from caustic_cli.optics.screen_shape import PlaneScreen, shape_of
from caustic_cli.optics.system import PlacedScreen, System
from caustic_cli.scene import Screen
from caustic_cli.scene.screen import Window, passed_by

#: Cosine between a screen's normal and the axis from which on it counts as perpendicular to the axis.
ACROSS = 1.0 - 1e-12

Vector = tuple[float, float, float]


def dot(a: Vector, b: Vector) -> float:
    """Scalar product."""
    return sum(x * y for x, y in zip(a, b, strict=True))


@dataclass(frozen=True)
class NormalPlane:
    """A plane normal to the light: its frame (e1, e2, e3) and Z, mm, see the module; and the windows in front of it.  For the far
    field Z is the focal length F, and X, Y are F q, see `scene.screen`."""

    axes: Axes
    z: float
    windows: tuple[Window, ...] = ()
    far: bool = False


@dataclass(frozen=True)
class Receiver:
    """A screen in space; it collects what arrives along the system's axis."""

    #: The screen's size, pixels and shift.
    screen: Screen
    #: A point of its tangent plane, mm: its centre, or the axis' point of it.
    middle: Vector
    #: Unit vectors along its x, along its y, normal to it.
    axes: Axes
    #: Screen coordinates of that point, mm; lower edges of the pixels relative to it along both axes, mm.
    at: tuple[float, float]
    low: tuple[float, float]
    #: Direction of the system's axis in front of it.
    axis: Vector
    shape: PlaneScreen

    @classmethod
    def of(cls, system: System, screen: Screen | PlacedScreen) -> Receiver:
        """The receiver of one of a system's screens, or of another one at its place."""
        if isinstance(screen, Screen) and system.leg is not None:
            screen = system.placed(screen)
        if isinstance(screen, Screen):
            return cls.on_axis(screen, system.axis)
        inner, (axes, (x, y, z)) = screen.screen, (screen.pose.axes, screen.pose.position)
        if inner.curved or inner.far:  # its shape is that about its centre
            sx, sy = inner.shift
            x, y, z = (m + sx * a + sy * b for m, a, b in zip((x, y, z), *axes[:2], strict=True))
            return cls.centred(inner, (x, y, z), axes, system.axis)
        return cls(inner, (x, y, z), axes, (0.0, 0.0), inner.low, system.axis, shape_of(inner))

    @classmethod
    def on_axis(cls, screen: Screen, axis: Vector) -> Receiver:
        """That of a screen on a straight axis: it is tilted and curved about its own centre."""
        if screen.upright:
            return cls(screen, (0.0, 0.0, screen.z), IDENTITY, (0.0, 0.0), screen.low, axis, shape_of(screen))
        return cls.centred(screen, screen.centre, screen.axes, axis)

    @classmethod
    def centred(cls, screen: Screen, centre: Vector, axes: Axes, axis: Vector) -> Receiver:
        """That of a screen with a given centre."""
        rx, ry = screen.half_size
        return cls(screen, centre, axes, screen.shift, (-rx, -ry), axis, shape_of(screen))

    @property
    def pixel(self) -> tuple[float, float]:
        """Widths of a pixel, mm."""
        return self.screen.pixel

    @property
    def resolution(self) -> tuple[int, int]:
        """Pixels along x and y."""
        return self.screen.resolution

    @property
    def forward(self) -> float:
        """1 where light arrives along its normal, -1 where it does so from the other side."""
        return 1.0 if dot(self.axis, self.axes[2]) >= 0 else -1.0

    def land(self, backend, rays: RayState) -> tuple[RayState, Tensor]:
        """Ray transfer to it: the rays, expanded, with the screen's coordinates, mm, for x and y of their origins; and whether they
        arrive, (N,)."""
        rays = self._through_windows(rays.expanded())
        point = (self.middle[0], self.middle[1], self.middle[2] - rays.datum)
        x, y, arrives = self.shape.land(backend, rays.origin, rays.direction, point, self.axes, self.forward)
        if any(self.at):
            x, y = x + self.at[0], y + self.at[1]
        weight = torch.where(arrives, rays.power, torch.zeros_like(rays.power))
        on_it = replace(rays, origin=(x, y, 0.0), power=weight, lost=dict(rays.lost), leaving=rays.power.sum(dtype=torch.float64))
        on_it.lose("off_screen", (rays.power - weight).detach())
        return on_it, arrives

    def _through_windows(self, rays: RayState) -> RayState:
        """The rays with the power of those that pass the windows in front of it."""
        if not self.screen.windows:
            return rays
        passed = passed_by(self.screen.windows, (*rays.origin[:2], rays.origin[2] + rays.datum), rays.direction)
        through = replace(rays, power=torch.where(passed, rays.power, torch.zeros_like(rays.power)), lost=dict(rays.lost))
        through.lose("missed_surface", (rays.power - through.power).detach())
        return through

    @cached_property
    def plane(self) -> NormalPlane:
        """The plane through its centre normal to the axis, with e1 along the screen's x before a rotation about its normal; its own
        plane and axes if it is `across`."""
        (u, v, n), axis = self.axes, self.axis
        if self.screen.far:
            n = n if self.forward > 0 else (-n[0], -n[1], -n[2])
            return NormalPlane((u, v, n), abs(self.screen.z), self.screen.windows, far=True)
        if self.across:
            return NormalPlane(self.axes, dot(self.middle, n), self.screen.windows)
        turn = math.radians(sum(self.screen.tilt[2:]))
        u = cast(Vector, tuple(math.cos(turn) * a - math.sin(turn) * b for a, b in zip(u, v, strict=True)))
        x, y, z = (a - dot(u, axis) * b for a, b in zip(u, axis, strict=True))
        size = math.sqrt(dot((x, y, z), (x, y, z)))
        e1 = (x / size, y / size, z / size)
        e2 = (axis[1] * e1[2] - axis[2] * e1[1], axis[2] * e1[0] - axis[0] * e1[2], axis[0] * e1[1] - axis[1] * e1[0])
        return NormalPlane((e1, e2, axis), dot(self.middle, axis), self.screen.windows)

    @property
    def across(self) -> bool:
        """Whether it is plane, perpendicular to the axis, and not rotated about that, or the far field."""
        upright = abs(dot(self.axes[2], self.axis)) >= ACROSS and not any(self.screen.tilt[2:])
        return self.screen.far or (upright and not self.screen.curved)

    def corners(self) -> list[Vector]:
        """Its four corners in space, mm."""
        (u, v, _), corners = self.axes, []
        for a in (0, self.resolution[0]):
            for b in (0, self.resolution[1]):
                x, y = self.low[0] + a * self.pixel[0], self.low[1] + b * self.pixel[1]
                sx, sy, sz = (m + x * p + y * q for m, p, q in zip(self.middle, u, v, strict=True))
                corners.append((sx, sy, sz))
        return corners

    def extent(self) -> tuple[tuple[float, float], tuple[float, float]]:
        """Limits of its orthogonal projection onto `plane`: lower and upper X and Y, mm."""
        x, y = ([dot(c, e) for c in self.corners()] for e in self.plane.axes[:2])
        return (min(x), min(y)), (max(x), max(y))
