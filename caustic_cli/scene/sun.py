"""Where the sun stands, by J. Meeus, Astronomical Algorithms, 2nd ed. 1998: chapter 25 (longitude, to 0.01 degrees), 12 (sidereal
time), 22 (the leading terms of nutation), 40 (parallax), 16 (refraction, Saemundsson's formula) and 55 (semidiameter).

Notation
    d, T        days and Julian centuries since 2000 January 1, 12:00, of universal and of terrestrial time
    M           mean anomaly, degrees
    C           equation of the centre, degrees
    R           distance, astronomical units
    node        longitude of the moon's ascending node, degrees
    obliquity   of the ecliptic, degrees

Directions are unit vectors (east, north, up).
"""

from __future__ import annotations

import math
from datetime import UTC, datetime
from typing import NamedTuple

Vector = tuple[float, float, float]

#: Start of d and T.
EPOCH = datetime(2000, 1, 1, 12, tzinfo=UTC)
#: Terrestrial less universal time, s: 57 in 1990, 69 in 2020; the sun moves 0.001 degrees in 90 s.
DELTA_T = 65.0
#: Angular diameter at one astronomical unit, degrees: twice 959.63 arc seconds.
DIAMETER = 2.0 * 959.63 / 3600.0
#: Horizontal parallax at one astronomical unit, arc seconds.
PARALLAX = 8.794
#: Elevation below which refraction counts as constant, degrees: nothing is lit from there.
LOWEST = -1.0


class Sun(NamedTuple):
    """The sun as seen from a place, refracted by the air (10 degrees Celsius, 1010 hPa)."""

    #: Clockwise from north, 0 to 360; above the horizon, of its centre; angular diameter without refraction: degrees.
    azimuth: float
    elevation: float
    diameter: float

    @property
    def direction(self) -> Vector:
        """Unit vector towards its centre."""
        azimuth, elevation = math.radians(self.azimuth), math.radians(self.elevation)
        return math.sin(azimuth) * math.cos(elevation), math.cos(azimuth) * math.cos(elevation), math.sin(elevation)


def sun(latitude: float, longitude: float, time: datetime) -> Sun:
    """The sun at a time, which has an offset from universal time; latitude to the north and longitude to the east, degrees.

    Within 0.01 degrees from 1990 to 2060, where the air is as in `Sun`.
    """
    (x, y, z), distance, sidereal = _equatorial(time)
    phi, theta = math.radians(latitude), math.radians(sidereal + longitude)
    east = y * math.cos(theta) - x * math.sin(theta)
    outward = x * math.cos(theta) + y * math.sin(theta)
    north = z * math.cos(phi) - outward * math.sin(phi)
    up = z * math.sin(phi) + outward * math.cos(phi) - math.radians(PARALLAX / 3600.0) / distance
    true = math.degrees(math.atan2(up, math.hypot(east, north)))
    azimuth = math.degrees(math.atan2(east, north)) % 360.0
    return Sun(azimuth, true + refraction(true), DIAMETER / distance)


def refraction(elevation: float) -> float:
    """By how much the air lifts what stands at a true elevation, degrees."""
    h = max(elevation, LOWEST)
    return (1.02 / math.tan(math.radians(h + 10.3 / (h + 5.11))) + 0.0019279) / 60.0


def _equatorial(time: datetime) -> tuple[Vector, float, float]:
    """Apparent direction of the sun from the earth's centre, a unit vector along the equinox, 90 degrees east of it and north;
    R; and apparent sidereal time at Greenwich, degrees."""
    d = (time - EPOCH).total_seconds() / 86400.0
    T = (d + DELTA_T / 86400.0) / 36525.0
    M = math.radians(357.52911 + T * (35999.05029 - 0.0001537 * T))
    C = (1.914602 - T * (0.004817 + 0.000014 * T)) * math.sin(M)
    C += (0.019993 - 0.000101 * T) * math.sin(2.0 * M) + 0.000289 * math.sin(3.0 * M)
    eccentricity = 0.016708634 - T * (0.000042037 + 0.0000001267 * T)
    R = 1.000001018 * (1.0 - eccentricity**2) / (1.0 + eccentricity * math.cos(M + math.radians(C)))
    node = math.radians(125.04 - 1934.136 * T)
    nutation = -0.00478 * math.sin(node)
    longitude = math.radians(280.46646 + T * (36000.76983 + 0.0003032 * T) + C - 0.00569 + nutation)
    obliquity = math.radians(23.4392911 - 0.0130042 * T + 0.00256 * math.cos(node))
    sidereal = 280.46061837 + 360.98564736629 * d + 0.000387933 * T * T + nutation * math.cos(obliquity)
    along, across = math.cos(longitude), math.sin(longitude)
    return (along, across * math.cos(obliquity), across * math.sin(obliquity)), R, sidereal
