"""Apertures: the clear area of a surface, and the pupil that sources illuminate."""

from __future__ import annotations

import math
from dataclasses import dataclass

from caustic_cli.errors import InputError


@dataclass(frozen=True)
class Aperture:
    """The clear aperture of a surface: a rectangle or a circle centred on the element's axis; infinite for an unbounded surface.

    Args:
        half_size: half widths of the rectangle, mm; for a circle its radius, given twice.
        round: whether it is a circle.
    """

    half_size: tuple[float, float] = (math.inf, math.inf)
    round: bool = False

    def __post_init__(self):
        if self.round and self.half_size[0] != self.half_size[1]:
            raise InputError(f"half_size of a circular aperture must be its radius, given twice, got {self.half_size}")

    @property
    def radius(self) -> float | None:
        """Radius of a circular aperture, mm; None for a rectangle."""
        return self.half_size[0] if self.round else None

    def contains(self, x, y):
        """Whether points x, y (mm) lie inside the aperture, borders included."""
        (rx, ry) = self.half_size
        if self.round:
            return x * x + y * y <= rx * rx
        return (x.abs() <= rx) & (y.abs() <= ry)


@dataclass(frozen=True)
class Pupil:
    """The aperture that sources illuminate: half widths, mm; z, mm; and whether it is a circle."""

    half_size: tuple[float, float]
    z: float
    round: bool = False

    @property
    def aperture(self) -> Aperture:
        """The aperture without its position."""
        return Aperture(self.half_size, self.round)
