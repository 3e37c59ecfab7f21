"""Screens that are part of a room: its floor, a wall, its ceiling, or any plane given by a point, a normal and an upward direction.

A picture is mapped onto such a plane as it is on paper: it looks right to a person on the side from which the light comes, for whom
the screen's y axis points upwards.  The screen's normal is towards this person, its x axis to their right.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from operator import mul
from typing import NamedTuple

from caustic_cli.errors import InputError
from caustic_cli.scene.room import Room
from caustic_cli.scene.screen import Vector, tilt_to

#: Accepted forms.
FORM = (
    "floor:DISTANCE, ceiling:DISTANCE or wall:DISTANCE with ,AZIMUTH of the top of the picture or of the wall, or"
    " point=X,Y,Z;normal=X,Y,Z;up=X,Y,Z with room; before it for east, north and up"
)
#: Least sine between two directions that are not parallel.
APART = 1e-6
#: Of the angles, degrees, and positions, mm, of a screen: below them is rounding.
DECIMALS = 9
NAMES = ("floor", "ceiling", "wall")


class RoomPlane(NamedTuple):
    """A plane in the lens' frame: a point of it, mm, its unit normal towards the viewer, and the upward direction, a unit vector in
    it; at: whether the point is the picture's centre, which otherwise is where the light meets the plane."""

    point: Vector
    normal: Vector
    up: Vector
    at: bool


class Placement(NamedTuple):
    """Where a screen is, as of `Screen`."""

    z: float
    tilt: tuple[float, ...]
    shift: tuple[float, float]


def placed(text: str, room: Room, light: Vector, side: int) -> Placement:
    """The place of a screen.

    Args:
        text: see FORM; distances in mm from the lens' origin, of a wall along the horizontal.
        room: in which the lens stands.
        light: unit direction, in the lens' frame, of the undeviated light that leaves the lens' origin.
        side: 1 behind a lens, -1 before a mirror.

    Raises:
        InputError: the text is none of these forms, or the light does not reach the plane's front.
    """
    plane = _named(text, room, side) if text.partition(":")[0] in NAMES else _explicit(text, room)
    facing = -_dot(light, plane.normal)
    if plane.at:
        centre = plane.point
    else:
        away = -_dot(plane.point, plane.normal)
        if facing <= APART or away / facing <= 0:
            rise = math.degrees(math.asin(max(-1.0, min(1.0, room.to_room(light)[2]))))
            way = "level" if abs(rise) < 0.05 else f"{abs(rise):.1f} degrees {'up' if rise > 0 else 'down'}"
            raise InputError(f"⟨screen_place⟩ {text} is not reached by the light, which leaves the lens' middle {way}")
        x, y, z = (away / facing * c for c in light)
        centre = x, y, z
    if facing <= APART:
        raise InputError(f"⟨screen_place⟩ {text} faces away from the light: its normal must point towards the lens")
    a, b, c = (round(angle, DECIMALS) + 0.0 for angle in tilt_to(_cross(plane.up, plane.normal), plane.normal))
    x, y, z = (round(position, DECIMALS) + 0.0 for position in centre)
    return Placement(z, (a, b, c) if c else (a, b), (x, y))


def _named(text: str, room: Room, side: int) -> RoomPlane:
    """A floor or ceiling whose picture has its top on the lens' side, so that one who faces the lens sees it upright; or a wall,
    opposite the pane unless its azimuth says otherwise."""
    name, _, rest = text.partition(":")
    distance, *given = _numbers(rest, (1, 2), text)
    if not distance > 0:
        raise InputError(f"⟨screen_place⟩ {text}: the distance must be greater than 0 mm")
    ahead = room.faces + (180.0 if side > 0 else 0.0)  # where the light goes
    azimuth = math.radians(given[0] if given else ahead + (0.0 if name == "wall" else 180.0))
    along = math.sin(azimuth), math.cos(azimuth), 0.0
    if name == "wall":
        return _in_lens(room, _times(distance, along), _times(-1.0, along), (0.0, 0.0, 1.0), False)
    upward = (0.0, 0.0, 1.0 if name == "floor" else -1.0)
    return _in_lens(room, _times(-distance, upward), upward, along, False)


def _explicit(text: str, room: Room) -> RoomPlane:
    """A plane with its point, normal and upward direction."""
    parts = [part.strip() for part in text.split(";")]
    in_room = parts[0] == "room"
    keys: Mapping[str, str] = dict(part.partition("=")[::2] for part in parts[in_room:])
    if {*keys} != {"point", "normal", "up"}:
        raise InputError(f"⟨screen_place⟩ must be {FORM}, got {text!r}")
    point, normal, up = (_vector(keys[key], text) for key in ("point", "normal", "up"))
    normal = _unit(normal, text)
    across = _times(-_dot(_unit(up, text), normal), normal)
    x, y, z = (a + b for a, b in zip(_unit(up, text), across, strict=True))
    if math.hypot(x, y, z) < APART:
        raise InputError(f"⟨screen_place⟩ {text}: up must not be along the normal")
    if in_room:
        return _in_lens(room, point, normal, _unit((x, y, z), text), True)
    return RoomPlane(point, normal, _unit((x, y, z), text), True)


def _in_lens(room: Room, point: Vector, normal: Vector, up: Vector, at: bool) -> RoomPlane:
    return RoomPlane(room.to_lens(point), room.to_lens(normal), room.to_lens(up), at)


def _vector(text: str, whole: str) -> Vector:
    x, y, z = _numbers(text, (3,), whole)
    return x, y, z


def _numbers(text: str, count: tuple[int, ...], whole: str) -> list[float]:
    try:
        values = [float(part) for part in text.split(",")]
    except ValueError:
        values = []
    if len(values) not in count or not all(map(math.isfinite, values)):
        raise InputError(f"⟨screen_place⟩ must be {FORM}, got {whole!r}")
    return values


def _unit(vector: Vector, whole: str) -> Vector:
    length = math.hypot(*vector)
    if not length > 0:
        raise InputError(f"⟨screen_place⟩ {whole}: a direction must not be 0,0,0")
    return _times(1.0 / length, vector)


def _times(factor: float, vector: Vector) -> Vector:
    x, y, z = (factor * c for c in vector)
    return x, y, z


def _dot(a: Vector, b: Vector) -> float:
    return sum(map(mul, a, b))


def _cross(a: Vector, b: Vector) -> Vector:
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]
