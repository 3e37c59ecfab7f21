"""The part of a plane or of a surface that light may pass."""

from __future__ import annotations

import math
from dataclasses import dataclass

from caustic_cli.errors import InputError


@dataclass(frozen=True)
class Aperture:
    """The part of a surface that light may pass: a rectangle or a circle about the element's axis; infinite for all of it.

    Args:
        half_size: half widths of the rectangle, mm; radius twice of a circle.
        round: a circle.
    """

    half_size: tuple[float, float] = (math.inf, math.inf)
    round: bool = False

    def __post_init__(self):
        if self.round and self.half_size[0] != self.half_size[1]:
            raise InputError(f"half_size of a circular aperture must be its radius, twice the same, got {self.half_size}")

    @property
    def radius(self) -> float | None:
        """Of a circle, mm; None of a rectangle."""
        return self.half_size[0] if self.round else None

    def holds(self, x, y):
        """Whether points lie within it."""
        (rx, ry) = self.half_size
        if self.round:
            return x * x + y * y <= rx * rx
        return (x.abs() <= rx) & (y.abs() <= ry)


@dataclass(frozen=True)
class Pupil:
    """The aperture that sources light: half widths mm, z mm, and whether it is a circle."""

    half_size: tuple[float, float]
    z: float
    round: bool = False

    @property
    def aperture(self) -> Aperture:
        """Without its place."""
        return Aperture(self.half_size, self.round)
