"""Conservative resampling between rectangular grids: exact area averages of piecewise constant functions."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy import sparse

#: Edges of cells along x and along y.
Edges = Sequence[np.ndarray]


def overlap(cells: np.ndarray, pixels: np.ndarray) -> sparse.csr_array:
    """Fraction of each pixel's width covered by each cell: (len(pixels) - 1, len(cells) - 1), from ascending edges in mm."""
    edges = np.unique(np.concatenate([cells, pixels]))
    middle = 0.5 * (edges[:-1] + edges[1:])
    row, column = np.searchsorted(pixels, middle) - 1, np.searchsorted(cells, middle) - 1
    rows, columns = len(pixels) - 1, len(cells) - 1
    inside = (row >= 0) & (row < rows) & (column >= 0) & (column < columns)
    value = np.diff(edges)[inside] / np.diff(pixels)[row[inside]]
    return sparse.coo_array((value, (row[inside], column[inside])), shape=(rows, columns)).tocsr()


def area_average(image: np.ndarray, cells: Edges, pixels: Edges) -> np.ndarray:
    """Pixel averages (c, d) of a function constant on cells, (a, b), and 0 outside them; edges along each axis, ascending, mm."""
    across, along = (overlap(*edges) for edges in zip(cells, pixels, strict=True))
    return np.ascontiguousarray((along @ (across @ image).T).T)


def resampled(image: np.ndarray, resolution: tuple[int, int]) -> np.ndarray:
    """Averages over `resolution` equal cells of the rectangle that `image` covers with equal cells of its own."""
    return area_average(image, *([np.linspace(0.0, 1.0, n + 1) for n in shape] for shape in (image.shape, resolution)))
