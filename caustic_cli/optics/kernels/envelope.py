"""CPU kernel for the lower envelope of a ball along straight segments; notation of `optics.envelope`.

Segments are binned in square cells of side `side` by their midpoints and are no longer than a cell; cells are grouped in blocks of
COARSE x COARSE.  A ball whose centre is at a height of at least z0 and a distance of at least d is nowhere lower than
z0 - sqrt(R^2 - d^2) at the query point: cells and blocks that cannot contain the lowest ball are skipped.
"""

from __future__ import annotations

import math

import numpy as np

from caustic_cli.optics.kernels.jit import FAST, njit
from caustic_cli.optics.kernels.threads import on_threads

#: Cells along a side of a block.
COARSE = 8


@njit(inline="always", **FAST)
def _away(x, y, i, j, side, low_x, low_y):
    """Lower bound of the squared distance of a point to the segments of a cell, which extend up to half a cell beyond it."""
    dx = max(0.0, abs(x - (low_x + (i + 0.5) * side)) - side)
    dy = max(0.0, abs(y - (low_y + (j + 0.5) * side)) - side)
    return dx * dx + dy * dy


@njit(**FAST)
def _search(x, y, begin, end, radius, segments, best, at):
    """The lowest ball of a range of segments, if lower than `best`: its height, and its centre into at (2,)."""
    square = radius * radius
    for k in range(begin, end):
        ax, ay, az, ex, ey, length, rise = segments[k]
        dx, dy = x - ax, y - ay
        along, off = dx * ex + dy * ey, dx * ey - dy * ex
        rest = square - off * off
        if rest <= 0.0:
            continue
        w = min(max(along - rise * math.sqrt(rest / (1.0 + rise * rise)), 0.0), length)
        under = rest - (along - w) ** 2
        if under <= 0.0:  # the end next to the lowest place is too far away, and so is all of the segment
            continue
        z = az + rise * w - math.sqrt(under)
        if z < best:
            best = z
            at[0], at[1] = ax + w * ex, ay + w * ey
    return best


@njit(entry=True, **FAST)
def envelope(block, x, y, radius, top, segments, starts, least, least_of_blocks, side, low_x, low_y, z, cx, cy, blocks):
    """Heights z and centres cx, cy of the lowest ball at points x, y, (N,) each; z = top and the point itself where none is lower.

    segments: (S, 7) of first centre (3), direction (2), length and rise per length; starts: (I, J, 2), first segment of each cell
    and of the next; least: (I, J), lowest centre of each, inf where there is none; least_of_blocks: the same of COARSE x COARSE
    cells.
    """
    if on_threads(
        block, blocks, (x, y, radius, top, segments, starts, least, least_of_blocks, side, low_x, low_y, z, cx, cy, blocks)
    ):
        return
    count, cells_x, cells_y = len(x), least.shape[0], least.shape[1]
    square, wide = radius * radius, COARSE * side
    at, shift_x, shift_y = np.empty(2), 0.0, 0.0
    for n in range(block * count // blocks, (block + 1) * count // blocks):
        px, py, best = x[n], y[n], top
        at[0], at[1] = px, py
        i, j = math.floor((px + shift_x - low_x) / side), math.floor((py + shift_y - low_y) / side)
        if (
            0 <= i < cells_x and 0 <= j < cells_y
        ):  # as far from here as the ball of the point before: most cells are then passed over
            best = _search(px, py, starts[i, j, 0], starts[i, j, 1], radius, segments, best, at)
        first_x = max(0, math.floor((px - radius - side - low_x) / wide))
        first_y = max(0, math.floor((py - radius - side - low_y) / wide))
        last_x = min(least_of_blocks.shape[0] - 1, math.floor((px + radius + side - low_x) / wide))
        last_y = min(least_of_blocks.shape[1] - 1, math.floor((py + radius + side - low_y) / wide))
        for a in range(first_x, last_x + 1):
            for b in range(first_y, last_y + 1):
                if least_of_blocks[a, b] - radius >= best:
                    continue
                dx = max(0.0, abs(px - (low_x + (a + 0.5) * wide)) - 0.5 * (wide + side))
                dy = max(0.0, abs(py - (low_y + (b + 0.5) * wide)) - 0.5 * (wide + side))
                under = square - dx * dx - dy * dy
                if under <= 0.0 or least_of_blocks[a, b] - math.sqrt(under) >= best:
                    continue
                for i in range(a * COARSE, min(cells_x, (a + 1) * COARSE)):
                    for j in range(b * COARSE, min(cells_y, (b + 1) * COARSE)):
                        under = square - _away(px, py, i, j, side, low_x, low_y)
                        if under > 0.0 and least[i, j] - math.sqrt(under) < best:
                            best = _search(px, py, starts[i, j, 0], starts[i, j, 1], radius, segments, best, at)
        z[n], cx[n], cy[n] = best, at[0], at[1]
        if best < top:
            shift_x, shift_y = at[0] - px, at[1] - py
