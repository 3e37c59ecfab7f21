"""How a lens in a window stands in its room, and where it thereby sees directions of the outside world.

Notation
    F, S        azimuth to which the outer side of the pane looks, clockwise from north; its slope to the horizontal; degrees
    n           outer normal, (sin F sin S, cos F sin S, cos S) to the (east, north, up)
    x, y, z     axes of the lens: z = -n is into the room, the way of the light; y is up along the pane, x = y x z
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from operator import mul

from caustic_cli.scene.sun import Vector
from caustic_cli.schema.table import check_all, default


@dataclass(frozen=True)
class Room:
    """The orientation of a pane: of an upright window (slope 90), or of a skylight (slope 0), whose y is then the direction in
    which its upper edge would lie if it were raised to look at `faces`.

    Raises:
        InputError: an angle is out of range.
    """

    #: F and S, degrees.
    faces: float = default("room.faces")
    slope: float = default("room.slope")

    def __post_init__(self):
        check_all("room", self, "faces", "slope")

    @cached_property
    def axes(self) -> tuple[Vector, Vector, Vector]:
        """Unit vectors x, y, z of the lens, (east, north, up)."""
        (sf, cf), (ss, cs) = ((math.sin(a), math.cos(a)) for a in map(math.radians, (self.faces, self.slope)))
        return (cf, -sf, 0.0), (-sf * cs, -cf * cs, ss), (-sf * ss, -cf * ss, -cs)

    def to_lens(self, vector: Vector) -> Vector:
        """Components along the axes of the lens of a vector (east, north, up)."""
        x, y, z = (sum(map(mul, axis, vector)) for axis in self.axes)
        return x, y, z

    def to_room(self, vector: Vector) -> Vector:
        """East, north and up of a vector along the axes of the lens."""
        east, north, up = (sum(map(mul, parts, vector)) for parts in zip(*self.axes, strict=True))
        return east, north, up

    def tilt(self, direction: Vector) -> tuple[float, float]:
        """Rotations (A, B), degrees, that turn +z of the lens into a direction of light (east, north, up): see `tilt_of`."""
        return tilt_of(self.to_lens(direction))

    def incidence(self, direction: Vector) -> float:
        """Angle between light and the inner normal, degrees; beyond 90 it comes from the room."""
        x, y, z = self.to_lens(direction)
        return math.degrees(math.atan2(math.hypot(x, y), z))


def tilt_of(direction: Vector) -> tuple[float, float]:
    """Rotations (A, B), degrees, that turn +z into a direction along the axes of the lens, of any length: those of `screen.tilted`,
    whose z axis is (sin B cos A, -sin A, cos B cos A).  |B| > 90 of light that comes from the room."""
    x, y, z = direction
    return math.degrees(math.atan2(-y, math.hypot(x, z))), math.degrees(math.atan2(x, z))
