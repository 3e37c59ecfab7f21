"""The exit surface on a rectangular grid of points, exact from the B-spline: what the exported files are made of.

Notation
    u_a, v_b     grid lines on [0, 1], both ends included;  x_a = (2 u_a - 1) r_x,  y_b = (2 v_b - 1) r_y, mm
    z            heights z[a, b] at (x_a, y_b), mm, in the scene's coordinates
    zx, zy       slopes dz/dx, dz/dy there

Whoever reads such a grid lays a spline of their own through it.  That returns the designed surface only if every knot
is a grid line: a not-a-knot bicubic through 4 steps a span gives a cubic lens back to rounding (1e-10 mm on a screen
300 mm away); through an arbitrary grid as dense it is off by 1e-4 mm for a smooth relief and 0.1 mm for a rough one.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from caustic_cli.errors import InputError
from caustic_cli.optics.bspline import SplineSpace
from caustic_cli.optics.heightfield import HeightField
from caustic_cli.scene import checks

#: Equal steps per knot span of the default grid.  With 2 a not-a-knot bicubic is exact already; with 4 a natural one,
#: whose end conditions are wrong, is good to some micrometres on the screen too.
STEPS_PER_SPAN = 4
#: Most samples along one axis, and most points: 5e7 points are 2.8 GB of points, normals and heights.
MAX_SAMPLES = 20_000
MAX_POINTS = 50_000_000


@dataclass(frozen=True, eq=False)
class SurfaceGrid:
    """The surface on grid lines x (nx,), y (ny,) mm: z (nx, ny) mm, slopes zx, zy (nx, ny); all float64."""

    x: np.ndarray
    y: np.ndarray
    z: np.ndarray
    zx: np.ndarray
    zy: np.ndarray

    @property
    def points(self) -> np.ndarray:
        """(x, y, z) mm of every grid point, row-major, x varying slowest: (nx ny, 3)."""
        x, y = np.broadcast_arrays(self.x[:, None], self.y[None, :])
        return np.stack([x, y, self.z], -1).reshape(-1, 3)

    @property
    def normals(self) -> np.ndarray:
        """Unit normals towards +z in the order of `points`, (-z_x, -z_y, 1) / sqrt(1 + z_x^2 + z_y^2): (nx ny, 3)."""
        normal = np.stack([-self.zx, -self.zy, np.ones_like(self.z)], -1).reshape(-1, 3)
        return normal / np.linalg.norm(normal, axis=1, keepdims=True)


def sample_grid(field: HeightField, heights: Tensor, samples: tuple[int, int] | None = None) -> SurfaceGrid:
    """The surface and its slopes on a grid that spans the whole aperture, borders included.

    Args:
        heights: (n, m) control heights, mm.
        samples: (nx, ny) points of an equispaced grid, or None for `STEPS_PER_SPAN` equal steps in every knot span:
            STEPS_PER_SPAN (n - p) + 1 points along an axis with simple knots, every knot among them.

    Raises:
        InputError: fewer than 2 or more than `MAX_SAMPLES` samples along an axis, more than `MAX_POINTS` points, or
            heights that are not the field's.
    """
    if tuple(heights.shape) != field.shape:
        raise InputError(f"control heights must have shape {field.shape}, got {tuple(heights.shape)}")
    (su, sv), (rx, ry) = field.spaces, field.half_size
    if samples is None:
        u, v = _knot_lines(su), _knot_lines(sv)
    else:
        nx, ny = checks.pair("--samples", samples, lambda where, n: checks.whole(where, n, 2, MAX_SAMPLES))
        u, v = (torch.linspace(0.0, 1.0, n, dtype=torch.float64) for n in (nx, ny))
    if max(len(u), len(v)) > MAX_SAMPLES or len(u) * len(v) > MAX_POINTS:
        raise InputError(f"--samples must be at most {MAX_SAMPLES} along an axis and {MAX_POINTS:.0e} in all,"
                         f" got {len(u)} x {len(v)}")
    net = heights.detach().to("cpu", torch.float64)
    rows = _along(su, u, net)  # (nx, m)
    z = _along(sv, v, rows.T).T
    zx = _along(sv, v, _along(su, u, net, 1).T).T / (2.0 * rx)
    zy = _along(sv, v, rows.T, 1).T / (2.0 * ry)
    x, y = (2.0 * u - 1.0) * rx, (2.0 * v - 1.0) * ry
    return SurfaceGrid(*(t.contiguous().numpy() for t in (x, y, z, zx, zy)))


def _knot_lines(space: SplineSpace) -> Tensor:
    """Every distinct knot and the equal steps between them, ascending on [0, 1]: (steps (knots - 1) + 1,)."""
    start, width = space.breaks[:-1, None], space.breaks.diff()[:, None]
    step = torch.arange(STEPS_PER_SPAN, dtype=torch.float64) / STEPS_PER_SPAN
    return torch.cat([(start + width * step).reshape(-1), space.breaks[-1:]])


def _along(space: SplineSpace, at: Tensor, net: Tensor, derivative: int = 0) -> Tensor:
    """Splines with control values net (n, k) at the points `at` (m,), or their derivative: (m, k).

    Sums over the p + 1 basis functions that do not vanish: no dense (m, n) matrix for a fine grid on a fine net.
    """
    first, values = space.basis(at, derivative)
    return sum(values[:, a, None] * net[first + a] for a in range(space.degree + 1))
