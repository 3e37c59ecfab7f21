"""Hexagonal packing with cells of equal area: the power diagram of the lattice whose weights make them equal.

Notation
    c_k, w_k    centre of lenslet k, mm, and its weight, mm^2
    A           area of a cell, that of the array over the number of lenslets, mm^2
    l_kq        length of the border between the cells of k and q, mm

The cell of lenslet k is where |x - c_k|^2 - w_k is least (Aurenhammer, SIAM J. Comput. 16, 78, 1987): a convex polygon with
borders across the lines between centres.  Weights of given areas exist and are unique but for a constant, since they minimise a
convex function (Aurenhammer, Hoffmann and Aronov, Algorithmica 20, 61, 1998), and Newton's method finds them:

    d area_k / d w_q = -l_kq / (2 |c_k - c_q|),    d area_k / d w_k = minus the sum of these over q.

A step is shortened until no cell shrinks below LEFT of A or of the least before it (Kitagawa, Merigot and Thibert, J. Eur. Math.
Soc. 21, 2603, 2019).
"""

from __future__ import annotations

import math
from functools import cached_property, lru_cache
from typing import Any, NamedTuple

import numpy as np

from caustic_cli.scene.aperture import library
from caustic_cli.scene.cells import HexagonalCells, Point, area_of, cut

#: Relative error of the areas; most steps, and halvings of one; least part of an area that a step leaves.
EQUAL, STEPS, HALVINGS, LEFT = 1e-10, 50, 30, 0.3
#: Distance, in pitches, within which the centres lie whose cells can touch.
NEIGHBOURS = 4.1


class _Diagram(NamedTuple):
    """Cells: their vertices, counter-clockwise; and (k, q) -> length of the border between two, mm."""

    cells: list[tuple[Point, ...]]
    borders: dict[tuple[int, int], float]

    @property
    def areas(self) -> np.ndarray:
        """mm^2, 0 of empty cells."""
        return np.array([area_of(cell) for cell in self.cells])


class EqualCells(HexagonalCells):
    """The same with cells of equal area."""

    def index(self, x, y) -> tuple[Any, Any]:
        """As of cells: in each row the least by the borders between its cells alone, then the least of rows."""
        xp, weights, dtype, device = library(x + y), _weights(self), (x + y).dtype, (x + y).device
        best, column, row = xp.asarray(math.inf, dtype=dtype, device=device), 0.0, 0.0
        for j in range(self.array[1]):
            at = np.array([self.centre(i, j)[0] for i in range(self.array[0])])
            w, height = weights[j :: self.array[1]], self.centre(0, j)[1]
            ends, at, w = (xp.asarray(c, dtype=dtype, device=device) for c in (0.5 * np.diff(at * at - w) / np.diff(at), at, w))
            i = xp.searchsorted(ends, x)
            here = (x - at[i]) ** 2 - w[i] + (y - height) ** 2
            column, row = (xp.where(here < best, c, d) for c, d in ((i, column), (float(j), row)))
            best = xp.minimum(best, here)
        return column, row

    def outline(self, k: int) -> tuple[Point, ...]:
        """As of cells."""
        return self._diagram.cells[k]

    @cached_property
    def _diagram(self) -> _Diagram:
        return _diagram(self, _weights(self))


def _diagram(lattice: HexagonalCells, weights: np.ndarray) -> _Diagram:
    """The power diagram of a lattice in its array."""
    (a, b), centres, found = lattice.size, np.array(lattice.centres), _Diagram([], {})
    array = [(-a / 2, -b / 2), (a / 2, -b / 2), (a / 2, b / 2), (-a / 2, b / 2)]
    least = 1e-9 * lattice.pitch[0]
    for k, centre in enumerate(centres):
        cell, lines = array, {}
        for q in np.flatnonzero(np.hypot(*(centres - centre).T) < NEIGHBOURS * lattice.pitch[0]).tolist():
            if q != k:
                most = 0.5 * float((centres[q] ** 2 - centre**2).sum() + weights[k] - weights[q])
                lines[q] = (centres[q] - centre).tolist(), most
                cell = cut(cell, *lines[q])
        cell = [p for p, q in zip(cell, cell[1:] + cell[:1], strict=True) if math.dist(p, q) > least]
        found.cells.append(tuple(cell))
        for q, ((a, b), most) in lines.items():
            ends = [p for p in cell if abs(a * p[0] + b * p[1] - most) < least * math.hypot(a, b)]
            if len(ends) > 1:
                found.borders[k, q] = max(math.dist(ends[0], p) for p in ends)
    return found


@lru_cache(maxsize=64)
def _weights(lattice: HexagonalCells) -> np.ndarray:
    """w_k of cells of equal area, of the mean 0."""
    count = len(lattice.centres)
    weights, found, goal = np.zeros(count), _diagram(lattice, np.zeros(count)), math.prod(lattice.size) / count
    for _ in range(STEPS):
        areas = found.areas
        if np.abs(areas - goal).max() < EQUAL * goal:
            break
        slope = np.full((count, count), 1.0 / count)  # with a step of the mean 0 it is regular
        for (k, q), length in found.borders.items():
            by = 0.5 * length / math.dist(lattice.centres[k], lattice.centres[q])
            slope[k, k] += by
            slope[k, q] -= by
        step = np.linalg.solve(slope, goal - areas)
        for _ in range(HALVINGS):
            new = _diagram(lattice, weights + step)
            if new.areas.min() > LEFT * min(areas.min(), goal):
                break
            step *= 0.5
        weights, found = weights + step, new
    return weights
