"""Frames of elements: where they stand, and rays seen from there.

A vector is a tuple of three components, tensors (N,) or plain floats.  Points have z counted from `datum`, a height in the frame of
the system; in an element's own frame they are counted from its origin.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

from torch import Tensor

from caustic_cli.scene.screen import tilted

IDENTITY = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))

Axes = tuple[tuple[float, float, float], tuple[float, float, float], tuple[float, float, float]]


@dataclass(frozen=True)
class Pose:
    """Where an element stands: its origin, mm, and right-handed turns first about its x, then about its y axis, degrees; these in a
    frame that is turned already."""

    position: tuple[float, float, float] = (0.0, 0.0, 0.0)
    tilt: tuple[float, float] = (0.0, 0.0)
    frame: Axes = IDENTITY

    @cached_property
    def axes(self) -> Axes:
        """Unit vectors along its x, y and z."""
        if not any(self.tilt):
            return self.frame
        x, y, z = (rotate_to_global(Pose(frame=self.frame), axis) for axis in tilted(self.tilt))
        return x, y, z

    @property
    def upright(self) -> bool:
        """Whether nothing is tilted."""
        return not any(self.tilt) and self.frame == IDENTITY


@dataclass(frozen=True)
class AxisSegment:
    """A straight part of an axis that mirrors fold: where its z = 0 would be, mm, and its frame, whose z runs along it."""

    origin: tuple[float, float, float] = (0.0, 0.0, 0.0)
    frame: Axes = IDENTITY

    def at(self, x: float, y: float, z: float) -> tuple[float, float, float]:
        """A point of its own coordinates in those of the system, mm."""
        if self == AxisSegment():
            return x, y, z
        a, b, c = (o + x * u + y * v + z * w for o, u, v, w in zip(self.origin, *self.frame, strict=True))
        return a, b, c

    def pose(self, z: float, tilt: tuple[float, float] = (0.0, 0.0)) -> Pose:
        """Of an element at z, turned."""
        return Pose(self.at(0.0, 0.0, z), tilt, self.frame)

    def folded(self, z: float, tilt: tuple[float, float]) -> AxisSegment:
        """The next one, behind a mirror at z that is turned about x or about y.

        A mirror turned by t turns the axis by 2 t - 180 degrees, for t > 0, about the same line; the frame goes with it.
        """
        about_x, about_y = (2.0 * t - math.copysign(180.0, t) if t else 0.0 for t in tilt)
        frame, vertex = Pose(tilt=(about_x, about_y), frame=self.frame).axes, self.at(0.0, 0.0, z)
        x, y, w = (v - z * c for v, c in zip(vertex, frame[2], strict=True))
        return AxisSegment((x, y, w), frame)


def to_local(pose: Pose, origin, direction, datum: float) -> tuple[tuple, tuple]:
    """Origins and directions in an element's frame."""
    px, py, pz = pose.position
    moved = (_less(origin[0], px), _less(origin[1], py), _less(origin[2], pz - datum))
    return rotate_to_local(pose, moved), rotate_to_local(pose, direction)


def to_global(pose: Pose, point, datum: float) -> tuple:
    """Points of an element's frame in that of the system."""
    px, py, pz = pose.position
    x, y, z = rotate_to_global(pose, point)
    return _less(x, -px), _less(y, -py), _less(z, datum - pz)


def rotate_to_local(pose: Pose, vector) -> tuple:
    """A vector in an element's frame."""
    if pose.upright:
        return tuple(vector)
    return tuple(sum(c * a for c, a in zip(vector, axis, strict=True)) for axis in pose.axes)


def rotate_to_global(pose: Pose, vector) -> tuple:
    """A vector of an element's frame in that of the system."""
    if pose.upright:
        return tuple(vector)
    return tuple(sum(c * axis[k] for c, axis in zip(vector, pose.axes, strict=True)) for k in range(3))


def advance(origin, direction, t: Tensor) -> tuple:
    """o + t d; where d is a plain 0, o itself."""
    return tuple(
        o if isinstance(d, float) and d == 0.0 else o + (t if isinstance(d, float) and d == 1.0 else t * d)
        for o, d in zip(origin, direction, strict=True)
    )


def _less(value, shift: float):
    return value if shift == 0.0 else value - shift
