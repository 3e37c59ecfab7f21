"""Sunlight on a pane: its direction in the lens' frame at a time, and the hours at which it arrives."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass
from datetime import date, datetime, time, timedelta, tzinfo
from itertools import groupby

from caustic_cli.errors import InputError
from caustic_cli.scene.room import Room
from caustic_cli.scene.sources.plane import GRAZING
from caustic_cli.scene.sun import Sun, sun

Hours = list[tuple[datetime, datetime]]

#: Years in which the sun is where `sun` says to about 0.01 degrees.
YEARS = (1900, 2100)
#: The offset at the end of a time.
OFFSET = re.compile(r"(Z|[+-][0-9:]+)$")
MINUTES = 24 * 60


def moment(text: str, where: str = "⟨room.time⟩") -> datetime:
    """A time with its offset from universal time, from ISO 8601 text.

    Raises:
        InputError: naming `where`: it is none, or lacks the offset.
    """
    example = "like 2026-06-21T12:00+02:00"
    try:
        found = datetime.fromisoformat(text.strip())
    except ValueError:
        raise InputError(f"{where} must be a date and time with its offset from UTC, {example}, got {text!r}") from None
    if found.tzinfo is None:
        raise InputError(f"{where} must say its offset from UTC, {example} or with Z for UTC itself, got {text!r}")
    if not YEARS[0] <= found.year < YEARS[1]:
        raise InputError(f"{where} must be in the years {YEARS[0]} to {YEARS[1] - 1}, got {text!r}")
    return found


def instants(text: str, count: int) -> list[datetime]:
    """The time that a text gives; of an interval START/END, `count` of them at equal distances, both ends included.

    The end may be a time of the start's day, with its offset: 2026-06-21T10:00+02:00/16:00.

    Raises:
        InputError: as of `moment`, the interval is empty, or a single time of it is asked for.
    """
    first, slash, last = (part.strip() for part in text.partition("/"))
    start = moment(first)
    if not slash:
        return [start]
    zone = start.isoformat()[19:]
    end = moment(last if "T" in last or " " in last else f"{start.date()}T{last}{'' if OFFSET.search(last) else zone}")
    if count < 2:
        raise InputError(
            "⟨room.time⟩ as an interval is for a sundial, a lens for every hour: it needs ⟨+lens.array⟩ and ⟨+target.sheet⟩"
        )
    if end <= start:
        raise InputError(f"⟨room.time⟩ must end after it begins, got {text!r}")
    return [start + k * (end - start) / (count - 1) for k in range(count)]


@dataclass(frozen=True)
class Sunlight:
    """The light of the sun through a pane at a place.

    Raises:
        InputError: the latitude is beyond a pole.
    """

    room: Room
    #: Latitude to the north, longitude to the east, degrees.
    place: tuple[float, float]

    def __post_init__(self):
        if not -90.0 <= self.place[0] <= 90.0:
            raise InputError(f"⟨room.place⟩ must begin with a latitude of -90 to 90 degrees, got {self.place[0]:g}")

    def sun(self, time: datetime) -> Sun:
        """The sun at a time."""
        return sun(*self.place, time)

    def tilt(self, time: datetime) -> tuple[float, float]:
        """Rotations (A, B) of the light, degrees, see `Room.tilt`; whether or not there is any."""
        return self.room.tilt(_from(self.sun(time)))

    def shines(self, time: datetime) -> bool:
        """Whether the sun stands above the horizon and all of its light is within GRAZING of the pane's normal."""
        seen = self.sun(time)
        return seen.elevation > 0.0 and self.room.incidence(_from(seen)) + seen.diameter / 2.0 <= GRAZING

    def check(self, time: datetime) -> None:
        """Check that the sun shines through the pane.

        Raises:
            InputError: it is below the horizon, behind the pane or grazes it; with the hours at which it does shine.
        """
        seen, day, zone = self.sun(time), time.date(), time.tzinfo
        at = f"⟨room.time⟩ {time.isoformat(timespec='minutes')}: the sun"
        if seen.elevation <= 0.0:
            above = in_words(hours(lambda t: self.sun(t).elevation > 0.0, day, zone))
            raise InputError(f"{at} is {-seen.elevation:.1f} degrees below the horizon; it is above it {above} that day")
        angle = self.room.incidence(_from(seen))
        if not self.shines(time):
            how = "shines on the pane from behind" if angle >= 90.0 else f"grazes the pane, {angle:.1f} degrees from its normal"
            raise InputError(
                f"{at} at azimuth {seen.azimuth:.1f} and elevation {seen.elevation:.1f} degrees {how}, which faces"
                f" {self.room.faces:g} (⟨+room.faces⟩) at a slope of {self.room.slope:g} (⟨+room.slope⟩); within"
                f" {GRAZING:g} degrees of its normal the sun shines {in_words(hours(self.shines, day, zone))} that day"
            )


def _from(seen: Sun) -> tuple[float, float, float]:
    """The direction of its light."""
    east, north, up = seen.direction
    return -east, -north, -up


def hours(holds: Callable[[datetime], bool], day: date, zone: tzinfo | None) -> Hours:
    """First and last minute of each period of a day, in a time zone, during which something holds."""
    midnight = datetime.combine(day, time(), zone)
    minutes = [midnight + timedelta(minutes=k) for k in range(MINUTES)]
    found = [[*group] for true, group in groupby(minutes, holds) if true]
    return [(group[0], group[-1]) for group in found]


def in_words(periods: Hours) -> str:
    """Periods within a day, such as "from 08:12 to 17:40"."""
    said = [f"from {a:%H:%M} to {b:%H:%M}" for a, b in periods if b - a < timedelta(minutes=MINUTES - 1)]
    words = " and ".join(filter(None, (", ".join(said[:-1]), *said[-1:])))
    return words or ("all day" if periods else "at no time")
