"""Lenslets of an array: their apertures, and their cells by the names of packings.

Points are arrays of NumPy or of torch.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, ClassVar

from caustic_cli.scene.aperture import Aperture, larger, library
from caustic_cli.scene.cells import Cells, HexagonalCells, Point, area_of
from caustic_cli.scene.equal_cells import EqualCells


@dataclass(frozen=True)
class PartAperture(Aperture):
    """What is clear of an exit behind a rectangular pupil, whose half widths it has."""

    compiled: ClassVar[bool] = False

    @property
    def filled(self) -> float:
        """As of an aperture."""
        return self.area / math.prod(self.half_size)

    def covers(self, u, v, slack: float = 0.0):
        """As of an aperture."""
        return self.contains(u * self.half_size[0], v * self.half_size[1])


@dataclass(frozen=True)
class ConvexAperture(PartAperture):
    """A convex polygon within a rectangle.

    Args:
        vertices: (x, y) mm, counter-clockwise.
    """

    vertices: tuple[Point, ...] = ()

    name: ClassVar[str] = "polygon"

    @property
    def area(self) -> float:
        """As of an aperture."""
        return area_of(self.vertices)

    @property
    def _sides(self) -> list[tuple[Point, Point]]:
        """First and last point of each side."""
        return list(zip(self.vertices, self.vertices[1:] + self.vertices[:1], strict=True))

    def distances(self, x, y) -> tuple[tuple[Any, float], ...]:
        """As of an aperture: distances along the outer normal of each side."""
        found = []
        for (a, b), (c, d) in self._sides:
            long = math.hypot(c - a, d - b)
            nx, ny = (d - b) / long, (a - c) / long
            found.append((nx * x + ny * y, nx * a + ny * b))
        return tuple(found)

    def contains(self, x, y):
        """As of an aperture."""
        inside = [far <= most for far, most in self.distances(x, y)]
        return math.prod(inside[1:], start=inside[0])

    def scaled(self, factor: float) -> Aperture:
        """As of an aperture."""
        return type(self)(larger(self.half_size, factor), tuple(larger(at, factor) for at in self.vertices))


@dataclass(frozen=True)
class DiscAperture(PartAperture):
    """A circle anywhere within a rectangle.

    Args:
        middle: its centre, mm; span: its radius, mm.
    """

    middle: Point = (0.0, 0.0)
    span: float = 0.0

    name: ClassVar[str] = "disc"

    @property
    def area(self) -> float:
        """As of an aperture."""
        return math.pi * self.span**2

    def contains(self, x, y):
        """As of an aperture."""
        return (x - self.middle[0]) ** 2 + (y - self.middle[1]) ** 2 <= self.span**2

    def scaled(self, factor: float) -> Aperture:
        """As of an aperture."""
        return type(self)(larger(self.half_size, factor), larger(self.middle, factor), factor * self.span)


@dataclass(frozen=True)
class RoundLenslets(PartAperture):
    """The round lenslets of an array, between which it is opaque.

    Args:
        cells: of the array.
    """

    cells: Cells | None = None

    name: ClassVar[str] = "round lenslets"
    masks: ClassVar[bool] = True

    @property
    def area(self) -> float:
        """As of an aperture."""
        assert self.cells is not None
        return math.prod(self.cells.array) * math.pi * self.cells.radius**2

    def contains(self, x, y):
        """As of an aperture."""
        return self.margin(x, y) >= 0.0

    def margin(self, x, y):
        """Signed distances of points from the edges of the circles, mm, positive inside."""
        assert self.cells is not None
        a, b = self.cells.centre(*self.cells.index(x, y))
        return self.cells.radius - library(x).hypot(x - a, y - b)

    def scaled(self, factor: float) -> Aperture:
        """As of an aperture."""
        assert self.cells is not None
        size = larger(self.cells.size, factor)
        return type(self)(larger(self.half_size, factor), type(self.cells)(self.cells.array, size))


#: By the names of the settings.
PACKINGS: dict[str, type[Cells]] = {"square": Cells, "hexagonal": HexagonalCells}
#: The same of cells of equal area.
EQUAL: dict[str, type[Cells]] = {"square": Cells, "hexagonal": EqualCells}


def cells_of(packing: str, array: tuple[int, int], size: tuple[float, float], equal: bool = False) -> Cells:
    """The cells of an array, of equal area or of what is nearest to their centres.

    Raises:
        InputError: its lenslets do not fit.
    """
    n, m = array
    return (EQUAL if equal else PACKINGS)[packing]((n, m), (float(size[0]), float(size[1])))
