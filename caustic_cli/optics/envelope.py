"""The swept lower envelope of a ball along a tool path: the surface that a ball-nose tool leaves, exact to rounding.

Notation
    R           radius of the ball, mm
    A, e, l, m  a segment of the path: initial position of the centre, unit direction in the plane, projected length, rise per
    length
    q           a point of the plane;  a = (q - A) . e, its coordinate along the segment;  p its distance from the segment's line

The underside of the ball at q is Z(w) = A_z + m w - sqrt(R^2 - p^2 - (a - w)^2) with its centre at w in [0, l].  It is convex in w
with its minimum at w = a - m sqrt((R^2 - p^2) / (1 + m^2)), or at the nearer end.  The machined surface is the minimum over all
segments; between two passes it has an edge, the cusp of a scallop.  The slope at q is that of the lowest ball,
(q - c) / sqrt(R^2 - |q - c|^2), with its centre above c.

The dual problem gives collision-free positions: above a surface of points P the centre must be at least at the height
max(P_z + sqrt(R^2 - |q - P|^2)), which is minus the lower envelope of balls at the points with heights -P_z.
"""

from __future__ import annotations

import math

import numpy as np

from caustic_cli.errors import InputError
from caustic_cli.optics.kernels import blocks
from caustic_cli.optics.kernels.envelope import COARSE, envelope
from caustic_cli.optics.kernels.threads import ALL

#: Side of the cells that bin the segments, as a fraction of the radius; largest number of cells.
PART, MOST_CELLS = 1.0 / 16.0, 1 << 24


class Envelope:
    """The lower envelope of balls along segments.

    Args:
        radius: of the ball, mm.
        begins, ends: (S, 3) centres at the ends of each segment, mm; equal for a stationary ball.
        top: height of the stock, where no ball is lower, mm.

    Raises:
        InputError: there is no segment, or a coordinate is not finite.
    """

    def __init__(self, radius: float, begins: np.ndarray, ends: np.ndarray, top: float = math.inf):
        if not len(begins) or not (np.isfinite(begins).all() and np.isfinite(ends).all()):
            raise InputError("a tool's path needs segments between finite points")
        self.radius, self.top = float(radius), float(top)
        self.side = max(
            PART * self.radius, math.sqrt(np.prod(np.ptp(np.concatenate([begins, ends])[:, :2], 0) + radius) / MOST_CELLS)
        )
        self.segments, middle = _segments(begins, ends, self.side)
        self.low = middle.min(0)
        cell = ((middle - self.low) / self.side).astype(np.int64)
        count = cell.max(0) + 1
        number = cell[:, 0] * count[1] + cell[:, 1]
        order = np.argsort(number, kind="stable")
        self.segments = self.segments[order]
        first = np.searchsorted(number[order], np.arange(count.prod() + 1)).reshape(-1)
        self.starts = np.ascontiguousarray(np.stack([first[:-1], first[1:]], -1).reshape(*count, 2))
        s = self.segments
        least = np.full(count.prod(), np.inf)
        np.minimum.at(least, number[order], np.minimum(s[:, 2], s[:, 2] + s[:, 5] * s[:, 6]))
        self.least = least.reshape(count)
        padded = np.pad(self.least, [(0, -n % COARSE) for n in count], constant_values=np.inf)
        self.blocks = padded.reshape(padded.shape[0] // COARSE, COARSE, -1, COARSE).min((1, 3))

    def __call__(self, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Height and centre of the lowest ball at points (N,) mm: z, c_x, c_y (N,), mm; `top` and the point itself where there is
        none."""
        x, y = (np.ascontiguousarray(c, dtype=np.float64) for c in (x, y))
        z, cx, cy = (np.empty_like(x) for _ in range(3))
        low, n = self.low, blocks()
        envelope(
            ALL, x, y, self.radius, self.top, self.segments, self.starts, self.least, self.blocks, self.side, *low, z, cx, cy, n
        )
        return z, cx, cy

    def surface(self, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Heights, mm, and slopes along x and y at points (N,) mm."""
        z, cx, cy = self(x, y)
        return z, *self.slopes(x, y, cx, cy)

    def slopes(self, x: np.ndarray, y: np.ndarray, cx: np.ndarray, cy: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Slopes Z_x and Z_y at points, from the ball centres there."""
        dx, dy = x - cx, y - cy
        under = np.sqrt(np.maximum(self.radius**2 - dx * dx - dy * dy, 1e-300))
        return dx / under, dy / under


def _segments(begins: np.ndarray, ends: np.ndarray, most: float) -> tuple[np.ndarray, np.ndarray]:
    """Segments (S, 7) in the kernel's format, subdivided to at most `most` mm, and their midpoints (S, 2)."""
    step = ends - begins
    length = np.hypot(step[:, 0], step[:, 1])
    parts = np.maximum(1, np.ceil(length / most)).astype(np.int64)
    number = np.repeat(np.arange(len(parts)), parts)
    part = np.arange(len(number)) - np.repeat(np.cumsum(parts) - parts, parts)
    begin, step, length = begins[number], step[number] / parts[number, None], length[number] / parts[number]
    begin = begin + part[:, None] * step
    begin[length == 0, 2] = np.minimum(begins[number, 2], ends[number, 2])[length == 0]  # vertical moves
    moves = np.where(length > 0, length, 1.0)
    along = np.stack([np.where(length > 0, step[:, 0] / moves, 1.0), step[:, 1] / moves], -1)
    rise = np.where(length > 0, step[:, 2] / moves, 0.0)
    return np.column_stack([begin, along, length, rise]), begin[:, :2] + 0.5 * step[:, :2]
