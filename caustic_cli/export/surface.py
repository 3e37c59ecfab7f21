"""Sampling of the exit surface on a rectangular grid: exact values and derivatives of the B-spline, for the exported files.

Notation
    u_a, v_b     grid lines on [0, 1], both ends included;  x_a = (2 u_a - 1) r_x,  y_b = (2 v_b - 1) r_y, mm
    z            heights z[a, b] at (x_a, y_b), mm, in the scene's coordinates
    zx, zy, zxy  slopes dz/dx, dz/dy there, and d2z/dxdy, 1/mm
    h            step of a triangulated grid, mm;  M_xx, M_xy, M_yy  bounds of the second derivatives, 1/mm

A triangle with legs h along x and y leaves its surface by at most h^2 (M_xx + 2 M_xy + M_yy) / 8: by Taylor's formula the error
at p is half the mean of (v - p)^T D2z (v - p) over the corners v, weighted by p's barycentric coordinates, and that mean of
(v_x - p_x)^2 is at most h^2 / 4.

Other programs interpolate such a grid by a spline, which reproduces the designed surface only if every knot is a grid line: a
not-a-knot bicubic with 4 steps per span reproduces a cubic lens to rounding (1e-10 mm on a screen 300 mm away); on an arbitrary
grid of the same density the error is 1e-4 mm for a smooth relief and 0.1 mm for a rough one.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from caustic_cli.config import checks
from caustic_cli.errors import InputError
from caustic_cli.optics.bspline import SplineSpace
from caustic_cli.optics.surfaces.heightfield import HeightField

#: Equal steps per knot span of the default grid.  A not-a-knot bicubic is exact with 2; with 4 a natural spline, whose end
#: conditions are wrong, has an error of some micrometres on the screen.
STEPS_PER_SPAN = 4
#: Default limit of the file size, bytes.
USUAL_BYTES = 20_000_000
#: Most samples along one axis, and most points: 5e7 points are 2.8 GB of points, normals and heights.
MAX_SAMPLES = 20_000
MAX_POINTS = 50_000_000


@dataclass(frozen=True, eq=False)
class SurfaceGrid:
    """The surface on grid lines x (nx,), y (ny,) mm: z (nx, ny) mm, slopes zx, zy, twist zxy (nx, ny); all float64."""

    x: np.ndarray
    y: np.ndarray
    z: np.ndarray
    zx: np.ndarray
    zy: np.ndarray
    zxy: np.ndarray

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


def most_points(a_point: float, beside: float = 0.0) -> int:
    """Number of points in a file of `USUAL_BYTES` at `a_point` bytes each, with `beside` bytes of other contents."""
    return max(4, int((USUAL_BYTES - beside) / a_point))


def usual_steps(spaces: Sequence[SplineSpace], most: int) -> int:
    """Default steps per knot span: `STEPS_PER_SPAN`, or fewer for at most `most` points; 0 if one is too many."""
    spans = [len(s.breaks) - 1 for s in spaces]
    return next((k for k in range(STEPS_PER_SPAN, 0, -1) if math.prod(k * n + 1 for n in spans) <= most), 0)


def usual_counts(spaces: Sequence[SplineSpace], most: int, least: int = 2) -> tuple[int, int]:
    """Points along x and y: `usual_steps` per knot span, or about `most` points in the proportion of the spans; at least
    `least`."""
    steps, (nx, ny) = usual_steps(spaces, most), (len(s.breaks) - 1 for s in spaces)
    return (max(least, steps * nx + 1), max(least, steps * ny + 1)) if steps else even_counts(spaces, most, least)


def even_counts(spaces: Sequence[SplineSpace], most: int, least: int = 2) -> tuple[int, int]:
    """About `most` points along x and y, in the proportion of their spans."""
    nx, ny = (len(s.breaks) - 1 for s in spaces)
    across = math.sqrt(most * nx / ny)
    return max(least, math.floor(across)), max(least, math.floor(across * ny / nx))


def sample_grid(
    field: HeightField, heights: Tensor, samples: tuple[int, int] | None = None, most: int | None = None
) -> SurfaceGrid:
    """The surface and its slopes on a grid over the whole aperture, borders included.

    Args:
        heights: (n, m) control heights, mm.
        samples: (nx, ny) points of an equispaced grid, or None for `STEPS_PER_SPAN` equal steps in every knot span:
            STEPS_PER_SPAN (n - p) + 1 points along an axis with simple knots, every knot among them.
        most: default number of points: fewer steps per span, or an equispaced grid, if necessary (`usual_counts`).

    Raises:
        InputError: fewer than 2 or more than `MAX_SAMPLES` samples along an axis, more than `MAX_POINTS` points, or
            heights of another shape than the field.
    """
    steps = STEPS_PER_SPAN if most is None else usual_steps(field.spaces, most)
    if samples is None and steps:
        return on_lines(field, heights, [knot_lines(s, steps) for s in field.spaces])
    if samples is None and most is not None:
        samples = usual_counts(field.spaces, most)
    counts = checks.pair("⟨samples⟩", samples, lambda where, n: checks.whole(where, n, 2, MAX_SAMPLES))
    return on_lines(field, heights, [torch.linspace(0.0, 1.0, n, dtype=torch.float64) for n in counts])


def grid_within(field: HeightField, heights: Tensor, tolerance: float) -> SurfaceGrid:
    """The surface on equal steps per knot span, for a triangulation within `tolerance` mm everywhere.

    Raises:
        InputError: too many points.
    """
    h = step_within(field, heights, tolerance)
    lines = [
        knot_lines(s, (s.breaks.diff() * 2.0 * r / h).ceil().clamp(1, MAX_SAMPLES).long())
        for s, r in zip(field.spaces, field.half_size, strict=True)
    ]
    return on_lines(field, heights, lines, f"⟨tolerance⟩ {tolerance:g}")


def step_within(field: HeightField, heights: Tensor, tolerance: float) -> float:
    """Largest step h, mm, of a triangulated grid with knots on grid lines whose error is at most `tolerance` mm."""
    checks.number("⟨tolerance⟩", tolerance, 0.0, open_low=True)
    xx, xy, yy = second_derivative_bounds(field, heights)
    curvature = xx + 2.0 * xy + yy
    return math.sqrt(8.0 * tolerance / curvature) if curvature > 0 else math.inf


def second_derivative_bounds(field: HeightField, heights: Tensor) -> tuple[float, float, float]:
    """Upper bounds of |z_xx|, |z_xy|, |z_yy| between knots, 1/mm, from the derivatives' control nets."""
    (su, sv), (rx, ry), net = field.spaces, field.half_size, heights.detach().double().cpu()
    xx, yy = (float(s.differences(net, k, 2).abs().max()) if s.degree > 1 else 0.0 for k, s in enumerate(field.spaces))
    xy = float(sv.differences(su.differences(net), 1).abs().max())
    return xx / (4.0 * rx * rx), xy / (4.0 * rx * ry), yy / (4.0 * ry * ry)


def on_lines(field: HeightField, heights: Tensor, lines: Sequence[Tensor], asked: str = "⟨samples⟩") -> SurfaceGrid:
    """The surface on grid lines u (nx,), v (ny,) on [0, 1]; `asked`: setting named in an error.

    Raises:
        InputError: too many points, or heights of another shape than the field.
    """
    if tuple(heights.shape) != field.shape:
        raise InputError(f"control heights must have shape {field.shape}, got {tuple(heights.shape)}")
    (su, sv), (rx, ry), (u, v) = field.spaces, field.half_size, lines
    if max(len(u), len(v)) > MAX_SAMPLES or len(u) * len(v) > MAX_POINTS:
        raise InputError(
            f"{asked} must give at most {MAX_SAMPLES} points along an axis and {MAX_POINTS:.0e} in all, got {len(u)} x {len(v)}"
        )
    net = heights.detach().to("cpu", torch.float64)
    rows, slopes = along(su, u, net), along(su, u, net, 1) / (2.0 * rx)  # (nx, m)
    z, zy = along(sv, v, rows.T).T, along(sv, v, rows.T, 1).T / (2.0 * ry)
    zx, zxy = along(sv, v, slopes.T).T, along(sv, v, slopes.T, 1).T / (2.0 * ry)
    x, y = (2.0 * u - 1.0) * rx, (2.0 * v - 1.0) * ry
    return SurfaceGrid(*(t.contiguous().numpy() for t in (x, y, z, zx, zy, zxy)))


def knot_lines(space: SplineSpace, steps: int | Tensor) -> Tensor:
    """Distinct knots and `steps` equal steps between them, a common number or one per span, ascending on [0, 1]."""
    breaks = space.breaks.tolist()
    counts = [steps] * (len(breaks) - 1) if isinstance(steps, int) else steps.tolist()
    inner = [torch.arange(k, dtype=torch.float64) / k * (b - a) + a for a, b, k in zip(breaks, breaks[1:], counts, strict=False)]
    return torch.cat([*inner, space.breaks[-1:]])


def along(space: SplineSpace, at: Tensor, net: Tensor, derivative: int = 0) -> Tensor:
    """Splines with control values net (n, k) at the points `at` (m,), or their derivative: (m, k).

    Sums over the p + 1 non-zero basis functions, without a dense (m, n) matrix.
    """
    first, values = space.basis(at, derivative)
    return sum(values[:, a, None] * net[first + a] for a in range(space.degree + 1))
