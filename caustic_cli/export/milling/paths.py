"""Tool paths: raster and spiral in the plane, and adaptive subdivision into linear moves within a tolerance of the height.

Paths are those over the aperture with an overrun on all sides, so that a ball reaches the contact points on sloped edges.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterator
from functools import singledispatch

import numpy as np

from caustic_cli.scene import Aperture, CircularAperture

#: Largest deviation of the polygon from a spiral, over the step-over.
OFF = 0.02
#: Most bisections of a move; initial moves processed at a time, which bounds the memory.
HALVINGS, AT_A_TIME = 14, 4096


def spacing(path: str, aperture: Aperture, step: float) -> float:
    """Step-over, at most `step` mm, for a whole number of passes over an aperture.  path: raster, raster-y or spiral."""
    if path == "spiral":
        return _turned(aperture, step)[0]
    across = 2.0 * aperture.half_size[1 if path == "raster" else 0]
    return across / math.ceil(across / step)


def raster(aperture: Aperture, step: float, along: int = 0) -> Iterator[np.ndarray]:
    """Zigzag passes over an aperture, at most `step` apart, each with the link to the next: points (k, 2) mm.  along: 0 or 1, for x
    or y.

    Each pass begins at the end point of the one before.
    """
    across = aperture.half_size[1 - along]
    count = max(1, math.ceil(2.0 * across / step))
    lines = np.linspace(-across, across, count + 1)
    chords = [(at, aperture.chord(at, along)) for at in lines]
    last = None
    for k, (at, reach) in enumerate([chord for chord in chords if chord[1] > 0] or chords[:1]):  # others only touch the edge
        ends = np.array([[-reach, at], [reach, at]])[:: 1 if k % 2 == 0 else -1, :: 1 if along == 0 else -1]
        yield ends if last is None else np.concatenate([last[None], ends])
        last = ends[-1]


def spiral(aperture: Aperture, step: float, turns: int = 8) -> Iterator[np.ndarray]:
    """Spiral from the centre outwards, yielded in pieces of several turns: Archimedean, r = step t / (2 pi), or rectangular.

    On a rectangle's diagonals passes are 1.17 times as far apart as elsewhere.
    """
    points = _turned(aperture, step)[1]()
    piece = max(2, len(points) * turns * step / max(aperture.half_size))
    edges = np.unique(np.linspace(0, len(points) - 1, math.ceil(len(points) / piece) + 1).astype(int))
    for first, last in itertools.pairwise(edges):
        yield points[first : last + 1]


@singledispatch
def _turned(aperture: Aperture, step: float) -> tuple[float, Callable[[], np.ndarray]]:
    """Step-over of a spiral, at most `step` mm, and its points (k, 2) mm with the distance `step` of its turns."""
    least = min(aperture.half_size)
    return least / math.ceil(least / step), lambda: _rectangular(list(aperture.half_size), step)


@_turned.register(CircularAperture)
def _(aperture: CircularAperture, step: float) -> tuple[float, Callable[[], np.ndarray]]:
    return step, lambda: _circular(aperture.radius, step)


def _circular(radius: float, step: float) -> np.ndarray:
    end, at, found = 2.0 * math.pi * radius / step, 0.0, []
    while at < end:
        found.append(at)
        r = max(step * at / (2.0 * math.pi), 0.25 * step)
        at += min(0.5 * math.pi / 2.0, math.sqrt(8.0 * OFF * step / r))
    angle = np.array([*found, *np.linspace(end, end + 2.0 * math.pi, math.ceil(2.0 * math.pi / (end - found[-2])) + 1)])
    r = np.minimum(step * angle / (2.0 * math.pi), radius)  # with a full circle at the end
    return np.stack([r * np.cos(angle), r * np.sin(angle)], -1)


def _rectangular(half: list[float], step: float) -> np.ndarray:
    """Rectangular spiral with sides `step` apart that ends at the outline."""
    turns = math.ceil(min(half) / step)
    longer = [h - min(half) for h in half]
    points = [(-longer[0], -longer[1])]
    for k in range(turns):
        a, b = (min(half) * (k + 1) / turns + extra for extra in longer)
        points += [(a, points[-1][1]), (a, b), (-a, b), (-a, -b)]
    return np.array([*points, (half[0], -half[1])])


def with_heights(
    line: np.ndarray,
    height: Callable[[np.ndarray, np.ndarray], np.ndarray],
    step: float,
    tolerance: float,
    probes: tuple[float, ...] = (),
) -> np.ndarray:
    """Points (m, 3), mm, along a polyline (k, 2) with heights from a function.

    Starts with moves of at most `step` and bisects each whose midpoint, or points at the parts `probes` of its length, deviate from
    the height by more than `tolerance`.  Points without a height (NaN) are omitted.
    """
    length = np.hypot(*np.diff(line, axis=0).T)
    parts = np.maximum(1, np.ceil(length / step)).astype(int)
    pieces = [
        a + np.linspace(0.0, 1.0, n, endpoint=False)[:, None] * (b - a) for a, b, n in zip(line, line[1:], parts, strict=False)
    ]
    xy = np.concatenate([*pieces, line[-1:]])
    z = height(*xy.T)
    place = np.arange(len(xy), dtype=float)
    begin, end = np.arange(len(xy) - 1), np.arange(1, len(xy))
    for _ in range(HALVINGS):
        middle = 0.5 * (xy[begin] + xy[end])
        found = height(*middle.T)
        with np.errstate(invalid="ignore"):
            off = np.abs(found - 0.5 * (z[begin] + z[end])) > tolerance
            for t in probes:
                there = height(*((1.0 - t) * xy[begin] + t * xy[end]).T)
                off |= np.abs(there - (1.0 - t) * z[begin] - t * z[end]) > tolerance
        if not off.any():
            break
        new = len(xy) + np.arange(off.sum())
        b, e = begin[off], end[off]
        xy, z = np.concatenate([xy, middle[off]]), np.concatenate([z, found[off]])
        place = np.concatenate([place, 0.5 * (place[b] + place[e])])
        begin, end = np.concatenate([b, new]), np.concatenate([new, e])
    order = np.argsort(place, kind="stable")
    points = np.column_stack([xy, z])[order]
    return points[np.isfinite(points[:, 2])]


def batches(passes: Iterator[np.ndarray], move: float) -> Iterator[np.ndarray]:
    """Concatenate consecutive passes into lines of about AT_A_TIME initial moves."""
    held, moves = [], 0.0
    for line in passes:
        held.append(line if not held else line[1:])
        moves += float(np.hypot(*np.diff(line, axis=0).T).sum()) / move
        if moves > AT_A_TIME:
            yield np.concatenate(held)
            held, moves = [line[-1:]], 0.0
    if sum(map(len, held)) > 1:
        yield np.concatenate(held)
