"""Maps of the directions of a target in the far field onto a plane, in degrees.

    latitude        longitude about the y axis, atan2(x, z), and latitude, asin y: type A photometry
    gnomonic        tan gamma from the centre towards C: the picture as on a plane square to the axis
    stereographic   2 tan(gamma / 2): conformal
    polar           gamma: the picture is a polar diagram of type C photometry

gamma is the angle from the axis +z and C the half plane about it, from +x.  Of all but the first a direction (x, y, z) lies at
(x, y) s(gamma), s being the radius over sin gamma; the unit is that of degrees in the centre.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

_DEGREE = 180.0 / math.pi


class RadialMap(NamedTuple):
    """A map about the axis: its radius by gamma, gamma by the radius, and the radius' derivative, all in radians; and the widest
    target, a full angle in degrees."""

    radius: Callable[[np.ndarray], np.ndarray]
    gamma: Callable[[np.ndarray], np.ndarray]
    slope: Callable[[np.ndarray], np.ndarray]
    widest: float


RADIAL = {
    "gnomonic": RadialMap(np.tan, np.arctan, lambda g: 1.0 / np.cos(g) ** 2, 160.0),
    "stereographic": RadialMap(
        lambda g: 2.0 * np.tan(0.5 * g), lambda r: 2.0 * np.arctan(0.5 * r), lambda g: 1.0 / np.cos(0.5 * g) ** 2, 178.0
    ),
    "polar": RadialMap(lambda g: g, lambda r: r, np.ones_like, 178.0),
}
#: Their names, and widest target, degrees: a lamp emits into z > 0.
MAPS, WIDEST = ("latitude", *RADIAL), 178.0


def widest_of(name: str) -> float:
    """The widest target of a map, a full angle in degrees."""
    return RADIAL[name].widest if name in RADIAL else WIDEST


def extent_of(name: str, angle: float) -> float:
    """Width on the map of a target of this full angle about the axis, degrees."""
    return 2.0 * _DEGREE * float(RADIAL[name].radius(np.array(0.5 * angle / _DEGREE))) if name in RADIAL else angle


def angle_of(name: str, extent: float) -> float:
    """The full angle about the axis of a width on the map, degrees."""
    return 2.0 * _DEGREE * float(RADIAL[name].gamma(np.array(0.5 * extent / _DEGREE))) if name in RADIAL else extent


def directions_at(name: str, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Unit directions (N, 3) of points of the map, degrees, (N,) each."""
    x, y = x / _DEGREE, y / _DEGREE
    if name not in RADIAL:
        return np.stack([np.sin(x) * np.cos(y), np.sin(y), np.cos(x) * np.cos(y)], 1)
    radius = np.hypot(x, y)
    gamma = RADIAL[name].gamma(radius)
    scale = np.sin(gamma) / np.where(radius > 0, radius, 1.0)
    return np.stack([scale * x, scale * y, np.cos(gamma)], 1)


def solid_angles_at(name: str, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Solid angle per area of the map, sr per square degree, at points of it, degrees."""
    x, y = x / _DEGREE, y / _DEGREE
    if name not in RADIAL:
        return np.cos(y) / _DEGREE**2
    own, radius = RADIAL[name], np.hypot(x, y)
    gamma = own.gamma(radius)
    relative = np.where(radius > 0, np.sin(gamma) / np.where(radius > 0, radius, 1.0), 1.0)
    return relative / own.slope(gamma) / _DEGREE**2
