"""Coordinate frames of elements: their poses, and transformations of rays between the global and a local frame.

A vector is a tuple of three components, tensors (N,) or plain floats.  Global points have z measured from `datum`, a height in the
frame of the system; local points are measured from the element's origin.
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
    """Position and orientation of an element: its origin, mm, and right-handed rotations relative to the axes `frame`,
    degrees, see `scene.screen.tilted`."""

    position: tuple[float, float, float] = (0.0, 0.0, 0.0)
    tilt: tuple[float, ...] = (0.0, 0.0)
    frame: Axes = IDENTITY

    @cached_property
    def axes(self) -> Axes:
        """Unit vectors along its x, y and z axes, in global components."""
        if not any(self.tilt):
            return self.frame
        x, y, z = (rotate_to_global(Pose(frame=self.frame), axis) for axis in tilted(self.tilt))
        return x, y, z

    @property
    def upright(self) -> bool:
        """Whether its axes are parallel to the global ones."""
        return not any(self.tilt) and self.frame == IDENTITY


@dataclass(frozen=True)
class AxisSegment:
    """A straight segment of an axis folded by mirrors: the global position of its z = 0, mm, and its frame, whose z is along it."""

    origin: tuple[float, float, float] = (0.0, 0.0, 0.0)
    frame: Axes = IDENTITY

    def at(self, x: float, y: float, z: float) -> tuple[float, float, float]:
        """Global coordinates of a point given in the segment's coordinates, mm."""
        if self == AxisSegment():
            return x, y, z
        a, b, c = (o + x * u + y * v + z * w for o, u, v, w in zip(self.origin, *self.frame, strict=True))
        return a, b, c

    def pose(self, z: float, tilt: tuple[float, float] = (0.0, 0.0)) -> Pose:
        """Pose of an element at z with a tilt, degrees."""
        return Pose(self.at(0.0, 0.0, z), tilt, self.frame)

    def folded(self, z: float, tilt: tuple[float, float]) -> AxisSegment:
        """The segment behind a mirror at z that is tilted about x or about y.

        A mirror tilted by t rotates the axis by 2 t - 180 degrees, for t > 0, about the same line, and the frame with it.
        """
        about_x, about_y = (2.0 * t - math.copysign(180.0, t) if t else 0.0 for t in tilt)
        frame, vertex = Pose(tilt=(about_x, about_y), frame=self.frame).axes, self.at(0.0, 0.0, z)
        x, y, w = (v - z * c for v, c in zip(vertex, frame[2], strict=True))
        return AxisSegment((x, y, w), frame)


def seen_from(held: Pose, pose: Pose) -> Pose:
    """A global pose in the frame `held`."""
    origin = tuple(p - h for p, h in zip(pose.position, held.position, strict=True))
    return _posed(rotate_to_local(held, origin), [rotate_to_local(held, axis) for axis in pose.axes])


def carried(held: Pose, pose: Pose) -> Pose:
    """The global pose of what has this pose in the frame `held`."""
    return _posed(to_global(held, pose.position, 0.0), [rotate_to_global(held, axis) for axis in pose.axes])


def _posed(position, axes) -> Pose:
    return Pose(tuple(position), frame=tuple(axes))  # type: ignore[arg-type]


def to_local(pose: Pose, origin, direction, datum: float) -> tuple[tuple, tuple]:
    """Ray origins and directions in an element's frame, from global ones."""
    px, py, pz = pose.position
    moved = (_less(origin[0], px), _less(origin[1], py), _less(origin[2], pz - datum))
    return rotate_to_local(pose, moved), rotate_to_local(pose, direction)


def to_global(pose: Pose, point, datum: float) -> tuple:
    """Global coordinates of points given in an element's frame."""
    px, py, pz = pose.position
    x, y, z = rotate_to_global(pose, point)
    return _less(x, -px), _less(y, -py), _less(z, datum - pz)


def rotate_to_local(pose: Pose, vector) -> tuple:
    """Components of a global vector in an element's frame."""
    if pose.upright:
        return tuple(vector)
    return tuple(sum(c * a for c, a in zip(vector, axis, strict=True)) for axis in pose.axes)


def rotate_to_global(pose: Pose, vector) -> tuple:
    """Global components of a vector given in an element's frame."""
    if pose.upright:
        return tuple(vector)
    return tuple(sum(c * axis[k] for c, axis in zip(vector, pose.axes, strict=True)) for k in range(3))


def turned_about(axis: tuple[float, float, float], x, y) -> tuple:
    """Components, up to a positive factor, of vectors with slopes x and y to an axis, by the rotation that takes +z to it without
    twist."""
    a, b, c = axis
    along = a * x + b * y
    return x + a * (1.0 - along / (1.0 + c)), y + b * (1.0 - along / (1.0 + c)), c - along


def advance(origin, direction, t: Tensor) -> tuple:
    """o + t d, where products with plain 0 and 1 are omitted."""
    return tuple(
        o if isinstance(d, float) and d == 0.0 else o + (t if isinstance(d, float) and d == 1.0 else t * d)
        for o, d in zip(origin, direction, strict=True)
    )


def _less(value, shift: float):
    return value if shift == 0.0 else value - shift
