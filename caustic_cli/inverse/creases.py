"""What smooth creases of a surface take from the pixels at both sides of a gap, and masses of sites that make up for it.

Notation
    p, q         sites that share a border of their cells, pixels at both sides of a gap (`inverse.transport`)
    l            light per width of that border: the integral of the source along it
    h            cell of the grid on which phi is averaged and through which a cubic spline is laid
    s            where light near the border lands between its sites, 0 at p and 1 at q

The map of the sites jumps from p to q at the border; that of the averaged phi and its spline takes about two cells.  Light of
WIDTH h l lands along the line from p to q at POSITIONS, half of which each of the sites is short of: pixels at gaps are too dark by
some per cent, which was 0.6 of the square of a flame's error, and their neighbours too bright.  Between sites of one region
what a pixel loses it receives.  The masses compensate that to first order; the light in the gaps itself remains there.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

#: Light around a border that lands elsewhere than at its sites, as a strip of so many cells, and where its 16ths land: means over
#: the directions of a border, for phi averaged over triangles of a half width of 0.75 cells; a cubic spline overshoots.
WIDTH = 4.2
POSITIONS = (-0.0446, -0.0193, -0.0068, 0.0059, 0.0119, 0.0478, 0.1823, 0.3859)
POSITIONS += tuple(1.0 - s for s in reversed(POSITIONS))
#: Limits of the change of a mass: where a site is fainter than what its neighbours lose to it, the change is not small.
LEAST, MOST = 0.2, 5.0


class Spots(NamedTuple):
    """Point masses of a picture, of sum 1: where they are on it, (N,) each, mm, masses (N,), its pixels that are not black, (k, l)
    bool, and its half sizes, mm."""

    place: tuple[np.ndarray, np.ndarray]
    mass: np.ndarray
    lit: np.ndarray
    half: tuple[float, float]


def compensated(spots: Spots, ends: tuple[np.ndarray, np.ndarray], light: np.ndarray) -> np.ndarray:
    """Masses (N,) of sum 1, with which smooth creases send to each pixel what these spots give it.

    Args:
        ends: the sites of the borders, (k,) each; light: of a strip along each that is a cell wide, (k,), as a fraction of all.
    """
    place, mass, (n, m), half = *spots[:2], spots.lit.shape, spots.half
    outside = n * m

    def pixels(*at: np.ndarray) -> np.ndarray:
        i, j = (np.floor((c / h + 1.0) * (0.5 * count)) for c, count, h in zip(at, (n, m), half, strict=True))
        return np.where((i >= 0) & (i < n) & (j >= 0) & (j < m), i * m + j, outside).astype(np.int64)

    own = pixels(*place)
    power = np.bincount(own, mass, outside + 1)
    shared = np.append(spots.lit.ravel(), False) & (power == 0.0)  # what has its light from a site beside it, to which it belongs
    p, q = (e[own[ends[0]] != own[ends[1]]] for e in ends)
    each = light[own[ends[0]] != own[ends[1]]] * (WIDTH / len(POSITIONS))
    gained = np.zeros(outside + 1)
    for s in POSITIONS:
        at = pixels(*(c[p] + s * (c[q] - c[p]) for c in place))
        at = np.where(shared[at], own[p] if s < 0.5 else own[q], at)
        gained += np.bincount(at, each, outside + 1)
    for end in (p, q):
        gained -= np.bincount(own[end], 0.5 * len(POSITIONS) * each, outside + 1)
    mass = mass * (1.0 - gained[own] / power[own]).clip(LEAST, MOST)
    return mass / mass.sum()
