"""Conservative resampling between rectangular grids: exact area averages of piecewise constant functions."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy import sparse

#: Edges of cells along x and along y.
Edges = Sequence[np.ndarray]
#: Least number of cells along each axis of a displaced image: its own edges fall within them, and blur by less than their width.
FINE = 512


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


def displaced(image: np.ndarray, shift: tuple[float, float]) -> np.ndarray:
    """An image displaced by `shift`, in fractions of its width and height, over the same rectangle: averages over its own cells, or
    over FINE cells where it has fewer; beyond its edges it continues with the values there, which alone leaves a uniform image
    unchanged."""
    finer = [n * -(-FINE // n) if d else n for n, d in zip(image.shape, shift, strict=True)]
    within = [np.linspace(0.0, 1.0, n + 1) for n in image.shape]
    cells = [np.concatenate([[-1.0 - abs(d)], edges, [2.0 + abs(d)]]) for edges, d in zip(within, shift, strict=True)]
    pixels = [np.linspace(0.0, 1.0, n + 1) - d for n, d in zip(finer, shift, strict=True)]
    return area_average(np.pad(image, 1, mode="edge"), cells, pixels)
