"""Cells of the lenslets of an array: their centres, the cell of a point, and their outlines.

Notation
    N, M      lenslets along x and y, numbered i, j with j fastest;  W, H  size of the array, mm
    c_ij      centre of a lenslet, mm from the middle of the array
    w         pitch, the distance of neighbouring centres along x, mm

    square       c_ij = ((i + 1/2) W / N - W / 2, (j + 1/2) H / M - H / 2); cells of W / N by H / M
    hexagonal    w = W / (N + 1/2), or W / N for a single row;
                 c_ij = ((i + 1/2 + (j mod 2) / 2) w - W / 2, (j - (M - 1) / 2) w sqrt(3) / 2)

The cell of a hexagonally packed lenslet is the part of the array that is nearest to its centre (Voronoi cell): a regular hexagon of
width w inside, and at the rim what remains of the array, so that the cells fill it.  A round lenslet is the largest circle about
its centre within a whole cell.  Lenslets that fill the array have cells of equal area (`equal_cells`).

Points are arrays of NumPy or of torch.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

from caustic_cli.errors import InputError
from caustic_cli.scene.aperture import library

#: Distance, in pitches, within which the centres lie whose cells can touch; relative slack of a size that just fits.
NEIGHBOURS, SLACK = 2.1, 1e-9
Point = tuple[float, float]


@dataclass(frozen=True)
class Cells:
    """The cells of an array of N x M lenslets on W x H mm, in square packing."""

    array: tuple[int, int]
    size: tuple[float, float]

    @property
    def pieces(self) -> tuple[int, int]:
        """Pieces along x and y of a spline over the array that has its borders between lenslets on knots; 1 where no knots follow
        them."""
        return self.array

    @property
    def radius(self) -> float:
        """Radius of a round lenslet, mm."""
        return 0.5 * min(self.pitch)

    @property
    def pitch(self) -> tuple[float, float]:
        """Distances of neighbouring columns and rows, mm."""
        return self.size[0] / self.array[0], self.size[1] / self.array[1]

    def centre(self, i, j) -> tuple[Any, Any]:
        """Centre of lenslet i, j, mm."""
        w, h = self.pitch
        return (i + 0.5) * w - 0.5 * self.size[0], (j + 0.5) * h - 0.5 * self.size[1]

    @cached_property
    def centres(self) -> list[Point]:
        """Centres of all lenslets, j fastest, mm."""
        return [self.centre(i, j) for i in range(self.array[0]) for j in range(self.array[1])]

    def index(self, x, y) -> tuple[Any, Any]:
        """Numbers i, j, as floats, of the lenslets of points, mm."""
        xp, (w, h), (n, m) = library(x + y), self.pitch, self.array
        return (
            xp.clip(xp.floor((x + 0.5 * self.size[0]) / w), 0, n - 1),
            xp.clip(xp.floor((y + 0.5 * self.size[1]) / h), 0, m - 1),
        )

    def number(self, x, y):
        """Numbers of the lenslets of points, mm, in the order of `centres`, as floats."""
        i, j = self.index(x, y)
        return i * self.array[1] + j

    def outline(self, k: int) -> tuple[Point, ...]:
        """Vertices (x, y) mm of the cell of lenslet k, counter-clockwise."""
        (x, y), (w, h) = self.centres[k], self.pitch
        return tuple((x + a * w, y + b * h) for a, b in ((-0.5, -0.5), (0.5, -0.5), (0.5, 0.5), (-0.5, 0.5)))


@dataclass(frozen=True)
class HexagonalCells(Cells):
    """The same in hexagonal packing.

    Raises:
        InputError: the rows do not fit into the array.
    """

    def __post_init__(self):
        w, h = self.pitch
        most = 1 + math.floor((self.size[1] - w) / h + SLACK)
        if self.array[1] > max(1, most):
            raise InputError(
                f"⟨lens.array⟩ of {self.array[0]} lenslets along x has room for {max(1, most)} hexagonally packed rows on"
                f" {self.size[0]:g} x {self.size[1]:g} mm, got {self.array[1]}"
            )

    @property
    def pieces(self) -> tuple[int, int]:
        """As of cells: their slanted borders do not follow knots."""
        return (1, 1) if self.array[1] > 1 else self.array

    @property
    def radius(self) -> float:
        """As of cells."""
        return 0.5 * min(self.pitch[0], self.size[1])

    @property
    def pitch(self) -> tuple[float, float]:
        """As of cells."""
        w = self.size[0] / (self.array[0] + (0.5 if self.array[1] > 1 else 0.0))
        return w, w * math.sqrt(0.75)

    def centre(self, i, j) -> tuple[Any, Any]:
        """As of cells."""
        w, h = self.pitch
        return (i + 0.5 + 0.5 * (j % 2)) * w - 0.5 * self.size[0], (j - 0.5 * (self.array[1] - 1)) * h

    def index(self, x, y) -> tuple[Any, Any]:
        """As of cells: the nearest centre of the rows below and above a point."""
        xp, (w, h), (n, m) = library(x + y), self.pitch, self.array
        below = xp.floor(y / h + 0.5 * (m - 1))
        found = []
        for row in (xp.clip(below, 0, m - 1), xp.clip(below + 1, 0, m - 1)):
            i = xp.clip(xp.floor((x + 0.5 * self.size[0]) / w - 0.5 * (row % 2)), 0, n - 1)
            a, b = self.centre(i, row)
            found.append((i, row, (x - a) ** 2 + (y - b) ** 2))
        (i, j, here), (k, row, there) = found
        return xp.where(there < here, k, i), xp.where(there < here, row, j)

    def outline(self, k: int) -> tuple[Point, ...]:
        """As of cells: the array, cut by the bisectors between neighbours."""
        (x, y), (wide, high) = self.centres[k], self.size
        found: list[Point] = [(-wide / 2, -high / 2), (wide / 2, -high / 2), (wide / 2, high / 2), (-wide / 2, high / 2)]
        for a, b in self.centres:
            if 0.0 < math.hypot(a - x, b - y) < NEIGHBOURS * self.pitch[0]:
                found = cut(found, (a - x, b - y), 0.5 * (a * a + b * b - x * x - y * y))
        least = SLACK * self.pitch[0]
        return tuple(p for p, q in zip(found, found[1:] + found[:1], strict=True) if math.dist(p, q) > least)


def area_of(polygon: tuple[Point, ...]) -> float:
    """Area of a polygon, by the shoelace formula."""
    return 0.5 * math.fsum(a * d - b * c for (a, b), (c, d) in zip(polygon, polygon[1:] + polygon[:1], strict=True))


def cut(polygon: list[Point], normal: Sequence[float], most: float) -> list[Point]:
    """The part of a convex polygon in the half-plane normal . p <= most (Sutherland and Hodgman)."""
    kept: list[Point] = []
    over = [normal[0] * x + normal[1] * y - most for x, y in polygon]
    for k, (p, far) in enumerate(zip(polygon, over, strict=True)):
        q, beyond = polygon[k - 1], over[k - 1]
        if (far > 0.0) != (beyond > 0.0):
            t = beyond / (beyond - far)
            kept.append((q[0] + t * (p[0] - q[0]), q[1] + t * (p[1] - q[1])))
        if far <= 0.0:
            kept.append(p)
    return kept
