"""Apertures: the outline of the clear area of a surface, and the pupil that sources illuminate.

Notation
    r_x, r_y    half widths of the aperture, mm; of a circle its radius, twice
    x, y        points, mm;  u, v = x / r_x, y / r_y, in [-1, 1] over the rectangle of the half widths

Points are arrays of NumPy or of torch.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from caustic_cli.errors import InputError


def library(array) -> Any:
    """NumPy or torch, of which an array is."""
    return sys.modules[type(array).__module__]


def larger(pair: tuple[float, float], factor: float) -> tuple[float, float]:
    """Two lengths, mm, larger by a factor."""
    return factor * pair[0], factor * pair[1]


@dataclass(frozen=True)
class Aperture:
    """The clear aperture of a surface: a rectangle centred on the element's axis; infinite for an unbounded surface."""

    #: Half widths, mm.
    half_size: tuple[float, float] = (math.inf, math.inf)

    #: Its name among the settings; whether it is a circle, an opaque mask with holes, and whether compiled loops, which take no
    #: objects, know it.
    name: ClassVar[str] = "rectangle"
    round: ClassVar[bool] = False
    masks: ClassVar[bool] = False
    compiled: ClassVar[bool] = True

    @property
    def filled(self) -> float:
        """Its area over the product of the half widths."""
        return 4.0

    @property
    def radius(self) -> float | None:
        """Radius of a circular aperture, mm; None for a rectangle."""
        return None

    @property
    def reach(self) -> float:
        """Semi-aperture: largest distance of the aperture from the axis, mm."""
        return math.hypot(*self.half_size)

    @property
    def on_edge(self) -> tuple[float, float]:
        """A point whose x^2 and y^2 are their means along the edge, mm^2; on two sides of a rectangle at a time, that is."""
        return self.half_size[0] * math.sqrt(2.0 / 3.0), self.half_size[1] * math.sqrt(2.0 / 3.0)

    @property
    def area(self) -> float:
        """Area, mm^2."""
        return math.prod(self.half_size) * self.filled

    def distances(self, x, y) -> tuple[tuple[Any, float], ...]:
        """Distances (N,) of points from the axis, mm, that are at most the half widths beside them where a point is inside."""
        return (abs(x), self.half_size[0]), (abs(y), self.half_size[1])

    def edges(self, x, y, half_size: tuple[float, float]) -> tuple[Any, Any | None]:
        """Signed distances of points from the edges along x and along y if the aperture is stretched to other half widths, positive
        inside; None for the second if one edge goes all around."""
        return half_size[0] - abs(x), half_size[1] - abs(y)

    def contains(self, x, y):
        """Whether points lie inside, borders included."""
        (rx, ry) = self.half_size
        return (abs(x) <= rx) & (abs(y) <= ry)

    def covers(self, u, v, slack: float = 0.0):
        """Whether points u, v in parts of the half widths lie inside, the border included, or beside it by the square `slack`."""
        return (u * u <= 1.0 + slack) & (v * v <= 1.0 + slack)

    def encloses(self, lows, highs):
        """Whether it contains the rectangles from `lows` to `highs`, x and y, mm."""
        inside = [(low >= -r) & (high <= r) for low, high, r in zip(lows, highs, self.half_size, strict=True)]
        return inside[0] & inside[1]

    def spread(self, u, v) -> tuple[Any, Any]:
        """Points x, y, uniform over the aperture for u, v that are uniform over [0, 1]."""
        (rx, ry) = self.half_size
        return rx * (2.0 * u - 1.0), ry * (2.0 * v - 1.0)

    def farthest(self, distance: Callable[[np.ndarray, np.ndarray], np.ndarray], x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """Largest distances (k,) mm of its points from figures about (x, y) in its plane, of which `distance` is the largest from
        the axis."""
        rx, ry = self.half_size
        return np.max([distance(x + a, y + b) for a in (-rx, rx) for b in (-ry, ry)], axis=0)

    def grown(self, by: float) -> Aperture:
        """The aperture with a border of a width, mm."""
        rx, ry = self.half_size
        return type(self)((rx + by, ry + by))

    def scaled(self, factor: float) -> Aperture:
        """The aperture larger by a factor."""
        return type(self)(larger(self.half_size, factor))

    def words(self, said: Callable[[tuple[float, ...]], str]) -> str:
        """Shape and size, of which `said` says the lengths, mm."""
        return said(larger(self.half_size, 2.0))

    def chord(self, at: float, along: int) -> float:
        """Half the length, mm, of the line across the aperture along x (0) or y (1) at this distance from the axis."""
        return self.half_size[along]


@dataclass(frozen=True)
class CircularAperture(Aperture):
    """A circle centred on the element's axis.

    Args:
        half_size: the radius, twice, mm.
    """

    name: ClassVar[str] = "circle"
    round: ClassVar[bool] = True

    @property
    def filled(self) -> float:
        """As of an aperture."""
        return math.pi

    def __post_init__(self):
        if self.half_size[0] != self.half_size[1]:
            raise InputError(f"half_size of a circular aperture must be its radius, given twice, got {self.half_size}")

    @property
    def radius(self) -> float:
        """Radius, mm."""
        return self.half_size[0]

    @property
    def reach(self) -> float:
        """The radius."""
        return self.half_size[0]

    @property
    def on_edge(self) -> tuple[float, float]:
        """As of an aperture."""
        return self.radius * math.sqrt(0.5), self.radius * math.sqrt(0.5)

    def distances(self, x, y) -> tuple[tuple[Any, float], ...]:
        """As of an aperture."""
        return ((library(x).hypot(x, y), self.radius),)

    def edges(self, x, y, half_size: tuple[float, float]) -> tuple[Any, Any | None]:
        """As of an aperture; distances from an ellipse as along x."""
        rx, ry = half_size
        return rx - library(x).hypot(x, y * (rx / ry)), None

    def contains(self, x, y):
        """As of an aperture."""
        return x * x + y * y <= self.radius * self.radius

    def covers(self, u, v, slack: float = 0.0):
        """As of an aperture."""
        return u * u + v * v <= 1.0 + slack

    def encloses(self, lows, highs):
        """As of an aperture: its farthest corner is inside."""
        most = library(lows[0]).maximum
        x, y = (most(-low, high) for low, high in zip(lows, highs, strict=True))
        return super().encloses(lows, highs) & (x**2 + y**2 <= self.radius * self.radius)

    def spread(self, u, v) -> tuple[Any, Any]:
        """As of an aperture."""
        xp, r = library(u), self.radius
        return r * xp.sqrt(u) * xp.cos(2.0 * math.pi * v), r * xp.sqrt(u) * xp.sin(2.0 * math.pi * v)

    def farthest(self, distance: Callable[[np.ndarray, np.ndarray], np.ndarray], x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """As of an aperture."""
        return distance(x, y) + self.radius

    def words(self, said: Callable[[tuple[float, ...]], str]) -> str:
        """As of an aperture."""
        return f"round, {said((2.0 * self.radius,))} across"

    def chord(self, at: float, along: int) -> float:
        """As of an aperture."""
        return math.sqrt(max(0.0, self.radius * self.radius - at * at))


#: The aperture of an unbounded surface.
UNBOUNDED = Aperture()
#: Apertures by their names among the settings.
APERTURES: dict[str, type[Aperture]] = {shape.name: shape for shape in (Aperture, CircularAperture)}


def aperture_of(shape: str, size: tuple[float, float], setting: str) -> Aperture:
    """The aperture of this shape and full size, mm, which a setting gives.

    Raises:
        InputError: the size is not that of a circle.
    """
    if APERTURES[shape].round and size[0] != size[1]:
        raise InputError(f"⟨{setting}⟩ of a circular aperture must be its diameter, given twice, got {size[0]:g} x {size[1]:g}")
    return APERTURES[shape]((size[0] / 2.0, size[1] / 2.0))


@dataclass(frozen=True)
class Pupil:
    """The aperture that sources illuminate, and its z, mm."""

    aperture: Aperture
    z: float

    @property
    def half_size(self) -> tuple[float, float]:
        """Half widths of the aperture, mm."""
        return self.aperture.half_size
