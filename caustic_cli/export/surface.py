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
grid of the same density the error is 1e-4 mm for a smooth relief and 0.1 mm for a rough one.  Which grid a lens needs for its
picture is therefore measured (`workflow.export`), from the densities of `samplings`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from torch import Tensor

from caustic_cli.errors import InputError
from caustic_cli.optics.bspline import SplineSpace
from caustic_cli.optics.surfaces.heightfield import HeightField
from caustic_cli.schema import checks

#: Equal steps per knot span of a grid unless another is given.  A not-a-knot bicubic is exact with 1 except beside the border,
#: and with 2 everywhere; with 4 a natural spline, whose end conditions are wrong, has an error of some micrometres on the screen.
STEPS_PER_SPAN = 4
#: Most samples along one axis, and most points: 5e7 points are 2.8 GB of points, normals and heights.
MAX_SAMPLES = 20_000
MAX_POINTS = 50_000_000
#: Points per knot span of the default grids to choose from, where they are fewer than one.
FRACTIONS = tuple(2.0 ** (-k / 2) for k in range(6, 0, -1))
#: Rounding of written lengths: unit of the last digit over the distance of the points, which changes slopes by less than 1e-6; and
#: at most, mm, which changes heights by half of that, 0.05 nm.
DIGIT, COARSEST = 1e-6, 1e-7

#: Density of a grid: points (nx, ny) equally spaced over the aperture, or a number of equal steps in every knot span.
Sampling = tuple[int, int] | int


@dataclass(frozen=True, eq=False)
class SurfaceGrid:
    """The surface with control heights `net` (n, m) mm float64 on grid lines u (nx,), v (ny,) on [0, 1].

    x (nx,), y (ny,) mm; z (nx, ny) mm, slopes zx, zy, twist zxy (nx, ny), all float64, each computed when it is first used.
    """

    field: HeightField
    net: Tensor
    u: Tensor
    v: Tensor

    @property
    def shape(self) -> tuple[int, int]:
        """Points (nx, ny)."""
        return len(self.u), len(self.v)

    @cached_property
    def x(self) -> np.ndarray:
        return ((2.0 * self.u - 1.0) * self.field.half_size[0]).numpy()

    @cached_property
    def y(self) -> np.ndarray:
        return ((2.0 * self.v - 1.0) * self.field.half_size[1]).numpy()

    @cached_property
    def _rows(self) -> tuple[Tensor, Tensor]:
        """The net evaluated along x, and its derivative: (nx, m)."""
        space, rx = self.field.spaces[0], self.field.half_size[0]
        return along(space, self.u, self.net), along(space, self.u, self.net, 1) / (2.0 * rx)

    def _across(self, rows: Tensor, derivative: int = 0) -> np.ndarray:
        scale = (2.0 * self.field.half_size[1]) ** derivative
        return (along(self.field.spaces[1], self.v, rows.T, derivative).T / scale).contiguous().numpy()

    @cached_property
    def z(self) -> np.ndarray:
        return self._across(self._rows[0])

    @cached_property
    def zx(self) -> np.ndarray:
        return self._across(self._rows[1])

    @cached_property
    def zy(self) -> np.ndarray:
        return self._across(self._rows[0], 1)

    @cached_property
    def zxy(self) -> np.ndarray:
        return self._across(self._rows[1], 1)

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


def control_points(field: HeightField, net: np.ndarray) -> np.ndarray:
    """Control points (n, m, 3) mm: heights (n, m) at the Greville abscissae."""
    x, y = (c.numpy() for c in field.control_xy())
    return np.stack([*np.broadcast_arrays(x[:, None], y[None, :]), net], -1)


def counts_of(spaces: Sequence[SplineSpace], sampling: Sampling) -> tuple[int, int]:
    """Points (nx, ny) of a grid of this density."""
    if isinstance(sampling, int):
        nx, ny = (sampling * (len(s.breaks) - 1) + 1 for s in spaces)
        return nx, ny
    return sampling


def samplings(spaces: Sequence[SplineSpace], most: float, least: int = 2) -> list[Sampling]:
    """Densities to choose from, fewest points first: equally spaced points at FRACTIONS of the knot spans, then up to
    `STEPS_PER_SPAN` equal steps in every span, with at most `most` points in all and at least `least` along an axis; and the finest
    equally spaced grid where one point per span is too many."""
    spans = [len(s.breaks) - 1 for s in spaces]
    found: list[Sampling] = []
    for fraction in FRACTIONS:
        nx, ny = (max(least, round(fraction * n) + 1) for n in spans)
        if (nx, ny) not in found and nx <= spans[0] and ny <= spans[1]:
            found.append((nx, ny))
    found += range(1, STEPS_PER_SPAN + 1)
    fits = [s for s in found if _allowed(counts_of(spaces, s), most, least)]
    if not fits or fits[-1] == found[-1] or isinstance(fits[-1], int):
        return fits or [even_counts(spaces, most, least)]
    finest = even_counts(spaces, most, least)
    return fits if finest == fits[-1] else [*fits, finest]


def _allowed(counts: tuple[int, int], most: float, least: int) -> bool:
    return math.prod(counts) <= min(most, MAX_POINTS) and min(counts) >= least and max(counts) <= MAX_SAMPLES


def even_counts(spaces: Sequence[SplineSpace], most: float, least: int = 2) -> tuple[int, int]:
    """About `most` points along x and y, in the proportion of their spans."""
    nx, ny = (len(s.breaks) - 1 for s in spaces)
    across = math.sqrt(min(most, MAX_POINTS) * nx / ny)
    a, b = (min(MAX_SAMPLES, max(least, math.floor(n))) for n in (across, across * ny / nx))
    return a, b


def decimals_for(distance: float, tolerance: float | None = None) -> int:
    """Decimals of lengths in mm between points at this distance, mm, for which rounding is negligible for the light (DIGIT,
    COARSEST) and below a tenth of a tolerance, mm."""
    return max(0, -math.floor(math.log10(min(DIGIT * distance, COARSEST, 0.1 * (tolerance or math.inf)))))


def sample_grid(field: HeightField, heights: Tensor, samples: Sampling | None = None) -> SurfaceGrid:
    """The surface on a grid over the whole aperture, borders included.

    Args:
        heights: (n, m) control heights, mm.
        samples: (nx, ny) points of an equispaced grid, or equal steps in every knot span, so that every knot is a grid line; None
            for `STEPS_PER_SPAN` of these.

    Raises:
        InputError: fewer than 2 or more than `MAX_SAMPLES` samples along an axis, more than `MAX_POINTS` points, or
            heights of another shape than the field.
    """
    if samples is None or isinstance(samples, int):
        return on_lines(field, heights, [knot_lines(s, STEPS_PER_SPAN if samples is None else samples) for s in field.spaces])
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
    u, v = lines
    if max(len(u), len(v)) > MAX_SAMPLES or len(u) * len(v) > MAX_POINTS:
        raise InputError(
            f"{asked} must give at most {MAX_SAMPLES} points along an axis and {MAX_POINTS:.0e} in all, got {len(u)} x {len(v)}"
        )
    return SurfaceGrid(field, heights.detach().to("cpu", torch.float64), u, v)


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
