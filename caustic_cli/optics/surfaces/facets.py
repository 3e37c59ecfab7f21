"""A triangulated surface: facets between the points of a lattice, with flat or interpolated normals, as readers of meshes see it.

Notation
    i, j      a cell of the lattice, corners A (i, j), B (i + 1, j), C (i + 1, j + 1), D (i, j + 1), counter-clockwise from +z
    w         barycentric coordinates of a point in the triangle of its cell

Each cell is split along its shorter diagonal, as by `export.mesh.triangles`.  The lattice is rectangular, or mapped to a disc by
the concentric map of `export.mesh`; over a disc a point beside a curved line of the lattice is evaluated on the plane of the facet
of its own cell, which deviates from that of the neighbour by second-order terms.
"""

from __future__ import annotations

from functools import cached_property

import numpy as np

from caustic_cli.optics.surfaces.base import MeasuredSurface

#: Points evaluated at a time, which bounds the memory.
BLOCK = 1 << 19


class FacetSurface(MeasuredSurface):
    """Facets between points (nx, ny, 3) mm, ascending along x and y.

    Args:
        points: float64; the lattice of a rectangle.
        normals: (nx, ny, 3) at the points, of any length, towards +z: interpolated over each facet for the slopes.  None for the
            slopes of the flat facets.
        turned: rotate it by 180 degrees about the x axis, (x, y, z) -> (x, -y, -z).
    """

    def __init__(self, points: np.ndarray, normals: np.ndarray | None = None, turned: bool = False):
        self.points, self.normals, self.up = points, normals, -1.0 if turned else 1.0
        self.half_size = (float(points[-1, points.shape[1] // 2, 0]), float(points[points.shape[0] // 2, -1, 1]))

    @cached_property
    def _lines(self) -> tuple[np.ndarray, np.ndarray]:
        """Coordinates x and y of the lattice lines."""
        return np.ascontiguousarray(self.points[:, 0, 0]), np.ascontiguousarray(self.points[0, :, 1])

    def _cells(self, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Indices i, j of the cells of points (N,)."""
        i, j = (
            np.clip(np.searchsorted(lines, at, "right") - 1, 0, len(lines) - 2)
            for lines, at in zip(self._lines, (x, y), strict=True)
        )
        return i, j

    def _evaluate(self, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Height and slopes at points (N,)."""
        (i, j), (nx, ny) = self._cells(x, y), self.points.shape[:2]
        flat = self.points.reshape(nx * ny, 3)
        a, b, c, d = (k.reshape(-1) for k in (i * ny + j, (i + 1) * ny + j, (i + 1) * ny + j + 1, i * ny + j + 1))
        up, down = (((flat[p, :2] - flat[q, :2]) ** 2).sum(-1) for p, q in ((c, a), (b, d)))
        falling = down < (1.0 - 1e-9) * up
        start, end = np.where(falling, b, a), np.where(falling, d, c)
        across = flat[end, :2] - flat[start, :2]
        left = across[:, 0] * (y - flat[start, 1]) - across[:, 1] * (x - flat[start, 0]) > 0
        # The third corner beside the diagonal: of A-C it is D on the left and B on the right, of B-D it is A and C.
        third = np.where(falling, np.where(left, a, c), np.where(left, d, b))
        p, q, r = flat[start], flat[end], flat[third]
        (ux, uy, uz), (vx, vy, vz) = (q - p).T, (r - p).T
        area = ux * vy - uy * vx
        px, py = x - p[:, 0], y - p[:, 1]
        s, t = (px * vy - py * vx) / area, (ux * py - uy * px) / area  # p + s u + t v
        z = p[:, 2] + s * uz + t * vz
        if self.normals is None:
            return z, (uz * vy - uy * vz) / area, (ux * vz - uz * vx) / area
        normals = self.normals.reshape(nx * ny, 3)
        n = (1.0 - s - t)[:, None] * normals[start] + s[:, None] * normals[end] + t[:, None] * normals[third]
        return z, -n[:, 0] / n[:, 2], -n[:, 1] / n[:, 2]

    def turned(self) -> FacetSurface:
        """The surface rotated by 180 degrees about the x axis: -Z(x, -y)."""
        return type(self)(self.points, self.normals, self.up > 0)

    def heights_and_slopes(self, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Of the facets at points (N,) mm, in blocks."""
        shape, (x, y) = x.shape, (x.reshape(-1), self.up * y.reshape(-1))
        parts = [self._evaluate(x[k : k + BLOCK], y[k : k + BLOCK]) for k in range(0, max(1, len(x)), BLOCK)]
        z, gx, gy = (np.concatenate([part[k] for part in parts]).reshape(shape) for k in range(3))
        return self.up * z, self.up * gx, gy

    def hull(self, heights: None) -> tuple[float, float]:
        """Of the points."""
        low, high = sorted((self.up * float(self.points[..., 2].min()), self.up * float(self.points[..., 2].max())))
        return low, high

    @cached_property
    def _steepest(self) -> tuple[float, float]:
        """Largest slopes of the facets, and of the normals where these are given."""
        nx, ny = self.points.shape[:2]
        at = (self.points[:-1, :-1, :2] + self.points[1:, :-1, :2] + self.points[:-1, 1:, :2] + self.points[1:, 1:, :2]) / 4.0
        aside = 0.01 * (self.points[1:, 1:, :2] - self.points[:-1, :-1, :2])  # on both sides of either diagonal
        inside = [(at + [[sx, sy]] * aside).reshape((nx - 1) * (ny - 1), 2) for sx, sy in ((1, 0), (-1, 0), (0, 1), (0, -1))]
        slopes_inside = [type(self)(self.points).heights_and_slopes(*p.T)[1:] for p in inside]
        most = [max(float(np.abs(slopes[k]).max()) for slopes in slopes_inside) for k in (0, 1)]
        if self.normals is not None:
            own = [float(np.abs(self.normals[..., k] / self.normals[..., 2]).max()) for k in (0, 1)]
            most = [max(a, b) for a, b in zip(most, own, strict=True)]
        return most[0], most[1]

    def slope_bounds(self, heights: None) -> tuple[float, float]:
        """Of all facets and normals."""
        return self._steepest


class DiscFacets(FacetSurface):
    """Facets between the points of a lattice that the concentric map takes to a disc."""

    @cached_property
    def _lines(self) -> tuple[np.ndarray, np.ndarray]:
        """Coordinates of the lattice lines in the square that is mapped to the disc."""
        nx, ny = self.points.shape[:2]
        return np.linspace(-1.0, 1.0, nx), np.linspace(-1.0, 1.0, ny)

    def _cells(self, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """As of facets."""
        r = np.hypot(x, y) / self.half_size[0]
        wide = np.abs(x) >= np.abs(y)
        near, far = np.where(wide, x, y), np.where(wide, y, x)
        along = np.copysign(r, near)
        across = along * (4.0 / np.pi) * np.arctan(far / np.where(near == 0.0, 1.0, near))
        return super()._cells(np.where(wide, along, across), np.where(wide, across, along))


def vertex_normals(points: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Normals (nx, ny, 3) at the points (nx, ny, 3) of a lattice: the sum of those of the adjoining triangles, faces (F, 3),
    weighted by their areas, as programs smooth a mesh without normals of its own."""
    flat = points.reshape(-1, 3)
    a, b, c = (flat[faces[:, k]] for k in range(3))
    normal = np.cross(b - a, c - a)  # (F, 3), its length twice the area
    total = np.stack(
        [np.bincount(faces.reshape(-1), np.repeat(normal[:, k], 3), minlength=len(flat)) for k in range(3)], -1
    )  # the order of a face's corners is immaterial
    return total.reshape(points.shape)
