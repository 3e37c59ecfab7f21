"""Deviation of an exported surface, as interpolated by other programs, from the designed spline: measured by random sampling.

Notation
    dZ       height of the interpolated surface minus Z of the spline at the same x and y, mm
    dg       likewise the slope at which light is refracted: of a facet, or of interpolated normals
    shift    L (n - 1) |dg| over the width of a pixel, 2 L |dg| for a mirror: displacement of the light, to first order

Evaluated at `POINTS` uniformly distributed random points of the aperture: the largest height deviation and the RMS slope deviation.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from scipy.interpolate import RectBivariateSpline
from torch import Tensor

from caustic_cli.export.mesh import Patch, triangles
from caustic_cli.export.surface import SurfaceGrid, along
from caustic_cli.optics.surfaces.heightfield import HeightField
from caustic_cli.scene import Scene

#: Number of points: the statistical error of the RMS is below 1 %.
POINTS = 100_000
SEED = 0


@dataclass(frozen=True)
class Deviation:
    """read_as: interpolation of the samples; samples: (nx, ny); height: largest |dZ|, mm; slope: RMS |dg|; spline: deviation of a
    B-spline on fewer knots that is stored with the samples, if any."""

    read_as: str
    samples: tuple[int, int]
    height: float
    slope: float
    spline: Deviation | None = None

    def figures(self, scene: Scene) -> dict:
        """Figures for JSON: read_as, samples, height_error_mm, and shift_pixels in the scene of the lens; spline: its own."""
        lens, screen = scene.lens, scene.screen
        gain = abs(screen.z - lens.offset.thickness) * (2.0 if lens.mirror else lens.index - 1.0) / min(screen.pixel)
        return {
            "read_as": self.read_as,
            "samples": list(self.samples),
            "height_error_mm": self.height,
            "shift_pixels": gain * self.slope,
            **({} if self.spline is None else {"spline": self.spline.figures(scene)}),
        }


def of_spline(grid: SurfaceGrid, field: HeightField, heights: Tensor) -> Deviation:
    """Deviation of a bicubic not-a-knot spline through the heights, of lower degree for fewer than four along an axis;
    of the bilinear interpolation for fewer than three."""
    nx, ny = grid.z.shape
    if min(nx, ny) < 3:
        return of_bilinear(grid, field, heights)
    read = RectBivariateSpline(grid.x, grid.y, grid.z, kx=min(3, nx - 1), ky=min(3, ny - 1), s=0)
    x, y, (z, zx, zy) = _random_points(field, heights)
    slope = read.ev(x, y, dx=1) - zx, read.ev(x, y, dy=1) - zy
    return _deviation("a bicubic spline", (nx, ny), read.ev(x, y) - z, slope)


def of_bilinear(grid: SurfaceGrid, field: HeightField, heights: Tensor) -> Deviation:
    """Deviation of the bilinear interpolation of the heights."""
    x, y, (z, zx, zy) = _random_points(field, heights)
    (i, wx), (j, wy) = _cells(grid.x, x), _cells(grid.y, y)
    t, s = (x - grid.x[i]) / wx, (y - grid.y[j]) / wy
    low, high = ((1.0 - t) * grid.z[i, b] + t * grid.z[i + 1, b] for b in (j, j + 1))  # on the cell's two lines of y
    left, right = ((1.0 - s) * grid.z[a, j] + s * grid.z[a, j + 1] for a in (i, i + 1))
    slope = (right - left) / wx - zx, (high - low) / wy - zy
    return _deviation("a bilinear surface", grid.z.shape, (1.0 - s) * low + s * high - z, slope)


def of_patches(grid: SurfaceGrid, field: HeightField, heights: Tensor) -> Deviation:
    """Deviation of bicubic Hermite patches through heights, slopes and twists."""
    x, y, (z, zx, zy) = _random_points(field, heights)
    (i, wx), (j, wy) = _cells(grid.x, x), _cells(grid.y, y)
    (hx, dx), (hy, dy) = _hermite((x - grid.x[i]) / wx), _hermite((y - grid.y[j]) / wy)

    def read(across: np.ndarray, along: np.ndarray) -> np.ndarray:
        """Sum over a cell's corners; across, along: weights (2, 2, N) of values and slopes, at its lower and upper line."""
        total = np.zeros_like(x)
        for a in (0, 1):
            for b in (0, 1):
                at = i + a, j + b
                total += across[0, a] * (along[0, b] * grid.z[at] + wy * along[1, b] * grid.zy[at])
                total += wx * across[1, a] * (along[0, b] * grid.zx[at] + wy * along[1, b] * grid.zxy[at])
        return total

    slope = read(dx / wx, hy) - zx, read(hx, dy / wy) - zy
    return _deviation("bicubic patches", grid.z.shape, read(hx, hy) - z, slope)


def of_triangles(patch: Patch, field: HeightField, heights: Tensor, shaded: bool = False) -> Deviation:
    """Deviation of flat triangles between points; shaded: with interpolated vertex normals."""
    corners, random = triangles(patch.points), np.random.default_rng(SEED)
    chosen = corners[random.integers(len(corners), size=POINTS)]  # (N, 3)
    weights = random.dirichlet((1.0, 1.0, 1.0), POINTS)  # uniform over a triangle
    points, normals = (a.reshape(-1, 3)[chosen] for a in (patch.points, patch.normals))  # (N, 3 corners, 3)
    at = np.einsum("nc,nck->nk", weights, points)
    normal = (
        np.einsum("nc,nck->nk", weights, normals) if shaded else np.cross(points[:, 1] - points[:, 0], points[:, 2] - points[:, 0])
    )
    z, zx, zy = (a.numpy() for a in field.at(heights, *(torch.from_numpy(np.ascontiguousarray(at[:, k])) for k in (0, 1))))
    slope = tuple(-normal[:, k] / normal[:, 2] - own for k, own in ((0, zx), (1, zy)))
    read_as = "triangles with interpolated normals" if shaded else "flat triangles"
    return _deviation(read_as, patch.points.shape[:2], at[:, 2] - z, slope)


def of_poles(poles: np.ndarray, written: HeightField, field: HeightField, heights: Tensor) -> Deviation:
    """Deviation of a B-spline with poles (n, m, 3) mm on the knots of `written`; x and y of rounded poles are not exactly at the
    Greville abscissae."""
    random, (n, m) = np.random.default_rng(SEED), written.shape
    u, v = (torch.from_numpy(random.uniform(0.0, 1.0, POINTS)) for _ in range(2))
    (x, xu), (y, yv) = (
        [along(space, at, torch.from_numpy(ends.copy())[:, None], order)[:, 0] for order in (0, 1)]
        for space, at, ends in zip(written.spaces, (u, v), (poles[:, 0, 0], poles[0, :, 1]), strict=True)
    )
    unit = HeightField(written.spaces, (0.5, 0.5))
    z, zu, zv = unit.at(torch.from_numpy(poles[..., 2].copy()), u - 0.5, v - 0.5)
    own = field.at(heights, x, y)
    slope = (zu / xu - own[1]).numpy(), (zv / yv - own[2]).numpy()
    return _deviation("the B-spline of these poles", (n, m), (z - own[0]).numpy(), slope)


def combined(deviations: Sequence[Deviation]) -> Deviation:
    """Deviation of several surfaces: samples of the first, largest height, and root sum of squares of the slopes."""
    first = deviations[0]
    slope = float(np.sqrt(sum(d.slope**2 for d in deviations)))
    return Deviation(first.read_as, first.samples, max(d.height for d in deviations), slope)


def _deviation(read_as: str, samples: tuple[int, ...], height: np.ndarray, slope: tuple[np.ndarray, ...]) -> Deviation:
    return Deviation(read_as, samples[:2], float(np.abs(height).max()), float(np.sqrt(np.mean(slope[0] ** 2 + slope[1] ** 2))))


def _random_points(field: HeightField, heights: Tensor) -> tuple[np.ndarray, np.ndarray, list[np.ndarray]]:
    """Random points x, y (N,) mm of the rectangle, and Z, Z_x, Z_y of the spline there."""
    random = np.random.default_rng(SEED)
    x, y = (random.uniform(-r, r, POINTS) for r in field.half_size)
    return x, y, [a.numpy() for a in field.at(heights, torch.from_numpy(x), torch.from_numpy(y))]


def _cells(lines: np.ndarray, at: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Index of the grid cell of positions (N,), and its width."""
    cell = np.clip(np.searchsorted(lines, at, "right") - 1, 0, len(lines) - 2)
    return cell, lines[cell + 1] - lines[cell]


def _hermite(t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Cubic Hermite basis (2, 2, N), of values and slopes at the lower and upper end of a unit cell, at t (N,), and its
    derivatives."""
    h = np.array([[(1 + 2 * t) * (1 - t) ** 2, t * t * (3 - 2 * t)], [t * (1 - t) ** 2, t * t * (t - 1)]])
    d = np.array([[6 * t * (t - 1), 6 * t * (1 - t)], [(1 - t) * (1 - 3 * t), t * (3 * t - 2)]])
    return h, d
