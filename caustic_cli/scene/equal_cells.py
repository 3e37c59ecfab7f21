"""Hexagonal packing with cells of equal area: the power diagram of the lattice whose weights make them equal.

Notation
    c_k, w_k    centre of lenslet k, mm, and its weight, mm^2
    A           area of a cell, that of the array over the number of lenslets, mm^2
    l_kq        length of the border between the cells of k and q, mm

The cell of lenslet k is where |x - c_k|^2 - w_k is least (Aurenhammer, SIAM J. Comput. 16, 78, 1987): a convex polygon with
borders across the lines between centres.  Weights of given areas exist and are unique but for a constant, since they minimise a
convex function (Aurenhammer, Hoffmann and Aronov, Algorithmica 20, 61, 1998), and Newton's method finds them:

    d area_k / d w_q = -l_kq / (2 |c_k - c_q|),    d area_k / d w_k = minus the sum of these over q,

the Laplacian of the graph of the borders, whose equations conjugate gradients solve over the list of its edges.  A step is
shortened until no cell shrinks below LEFT of A or of the least before it (Kitagawa, Merigot and Thibert, J. Eur. Math. Soc. 21,
2603, 2019).
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
#: Relative residual of the linear equations of a step.
SOLVED = 1e-12
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


def _near(lattice: HexagonalCells, k: int) -> np.ndarray:
    """Numbers of the lenslets whose cells can touch that of lenslet k, in ascending order."""
    (n, m), (i, j), most = lattice.array, divmod(k, lattice.array[1]), math.ceil(NEIGHBOURS / math.sqrt(0.75))
    columns, rows = (np.arange(max(0, at - most), min(count, at + most + 1)) for at, count in ((i, n), (j, m)))
    return (columns[:, None] * m + rows).ravel()


def _diagram(lattice: HexagonalCells, weights: np.ndarray) -> _Diagram:
    """The power diagram of a lattice in its array.

    A border lies across the line between two centres at the distance (|c_k - c_q|^2 + w_k - w_q) / (2 |c_k - c_q|) from c_k: one
    that is farther away than the vertices of the cell does not touch it.
    """
    (a, b), centres, found = lattice.size, np.array(lattice.centres), _Diagram([], {})
    array = [(-a / 2, -b / 2), (a / 2, -b / 2), (a / 2, b / 2), (-a / 2, b / 2)]
    least = 1e-9 * lattice.pitch[0]
    for k, centre in enumerate(centres):
        near = _near(lattice, k)
        apart = np.hypot(*(centres[near] - centre).T)
        near, apart = (c[(apart > 0.0) & (apart < NEIGHBOURS * lattice.pitch[0])] for c in (near, apart))
        ends = 0.5 * (apart * apart + weights[k] - weights[near]) / apart
        cell, lines, middle = array, {}, tuple(centre.tolist())
        for at in np.argsort(ends, kind="stable").tolist():
            if not cell or ends[at] > max(math.dist(middle, p) for p in cell):
                break
            q = int(near[at])
            normal = (centres[q] - centre).tolist()
            lines[q] = normal, float(ends[at] * apart[at] + normal[0] * middle[0] + normal[1] * middle[1])
            cell = cut(cell, *lines[q])
        cell = [p for p, q in zip(cell, cell[1:] + cell[:1], strict=True) if math.dist(p, q) > least]
        found.cells.append(tuple(cell))
        for q, ((a, b), most) in lines.items():
            ends_of = [p for p in cell if abs(a * p[0] + b * p[1] - most) < least * math.hypot(a, b)]
            if len(ends_of) > 1:
                found.borders[k, q] = max(math.dist(ends_of[0], p) for p in ends_of)
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
        step = _laplace(found.borders, lattice.centres, goal - areas)
        for _ in range(HALVINGS):
            new = _diagram(lattice, weights + step)
            if new.areas.min() > LEFT * min(areas.min(), goal):
                break
            step *= 0.5
        weights, found = weights + step, new
    return weights


def _laplace(borders: dict[tuple[int, int], float], centres: list[Point], change: np.ndarray) -> np.ndarray:
    """The weights of the mean 0 that change the areas so, mm^2, to first order: by conjugate gradients with the diagonal."""
    k, q = np.array(list(borders)).T
    by = np.array([0.5 * length / math.dist(centres[i], centres[j]) for (i, j), length in borders.items()])
    count = len(centres)
    diagonal = np.bincount(k, by, count)
    step, left = np.zeros(count), change - change.mean()
    way, most = left / diagonal, SOLVED * np.linalg.norm(left)
    square = left @ way
    for _ in range(count):
        ahead = diagonal * way - np.bincount(k, by * way[q], count)
        length = square / (way @ ahead)
        step, left = step + length * way, left - length * ahead
        if np.linalg.norm(left) <= most:
            break
        new = left @ (left / diagonal)
        way, square = left / diagonal + new / square * way, new
    return step - step.mean()
