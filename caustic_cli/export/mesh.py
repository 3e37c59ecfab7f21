"""The lens as a closed, oriented triangle mesh: exit surface, walls along its border, flat entrance at z_in.

Corners run counter-clockwise seen from outside.  What the mesh formats (STL, PLY, OBJ) are made of.
"""

from __future__ import annotations

import numpy as np
from torch import Tensor

from caustic_cli.errors import InputError
from caustic_cli.export.surface import SurfaceGrid, grid_within, sample_grid
from caustic_cli.optics.heightfield import HeightField
from caustic_cli.scene import Scene


def closed_mesh(scene: Scene, field: HeightField, heights: Tensor, samples: tuple[int, int] | None = None,
                tolerance: float | None = None) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (V, 3) float64 mm and faces (F, 3) int64 of the solid.

    Args:
        heights: (n, m) control heights, mm.
        samples: (nx, ny) points on the exit surface, or None for a grid on the knots (`sample_grid`).
        tolerance: mm, instead of samples: as many points as keep every triangle so close to the exit surface (chord error).

    Raises:
        InputError: samples and tolerance both; too few or too many points; or the surface reaches the entrance.
    """
    return solid(mesh_grid(field, heights, samples, tolerance), scene.lens.z_in)


def mesh_grid(field: HeightField, heights: Tensor, samples: tuple[int, int] | None, tolerance: float | None) -> SurfaceGrid:
    """The exit surface's grid by --samples or --tolerance.

    Raises:
        InputError: both were given, or they ask for too few or too many points.
    """
    if tolerance is None:
        return sample_grid(field, heights, samples)
    if samples is not None:
        raise InputError("--samples and --tolerance both say how fine the mesh is: give one of them")
    return grid_within(field, heights, tolerance)


def triangles(nx: int, ny: int) -> np.ndarray:
    """Two triangles for every cell of a grid of points, numbered row-major, counter-clockwise from +z: (2 (nx-1) (ny-1), 3)."""
    number = np.arange(nx * ny).reshape(nx, ny)
    a, b, c, d = number[:-1, :-1], number[1:, :-1], number[1:, 1:], number[:-1, 1:]  # corners of every cell, from +z
    return np.stack([np.stack([a, b, c], -1), np.stack([a, c, d], -1)], 2).reshape(-1, 3)


def rim_of(nx: int, ny: int) -> np.ndarray:
    """Numbers of the border points of that grid, once around, counter-clockwise from +z: (2 (nx + ny) - 4,)."""
    number = np.arange(nx * ny).reshape(nx, ny)
    return np.concatenate([number[:-1, 0], number[-1, :-1], number[:0:-1, -1], number[0, :0:-1]])


def solid(grid: SurfaceGrid, z_in: float) -> tuple[np.ndarray, np.ndarray]:
    """Closed triangle mesh of the lens: vertices (V, 3) float64 mm, faces (F, 3) int64, outward counter-clockwise.

    Vertices are the nx ny grid points, one foot at z_in below each border point, and the entrance's centre.  Walls join
    border point to foot and the entrance is a fan from its centre, so every edge belongs to exactly two triangles.

    Raises:
        InputError: the surface reaches the entrance, so that there is no solid.
    """
    refuse_open(float(grid.z.min()), z_in)
    nx, ny = grid.z.shape
    rim = rim_of(nx, ny)
    foot = nx * ny + np.arange(len(rim))
    centre = np.full_like(rim, nx * ny + len(rim))
    next_rim, next_foot = np.roll(rim, -1), np.roll(foot, -1)
    walls = [np.stack([foot, next_foot, next_rim], -1), np.stack([foot, next_rim, rim], -1)]
    entrance = np.stack([centre, next_foot, foot], -1)
    points = grid.points
    feet = points[rim]
    feet[:, 2] = z_in
    middle = np.array([[0.0, 0.0, z_in]])
    return np.concatenate([points, feet, middle]), np.concatenate([triangles(nx, ny), *walls, entrance])


def refuse_open(least: float, z_in: float) -> None:
    """Refuse a lens whose `least` height, mm, is not above the entrance.

    Raises:
        InputError: there is no solid.
    """
    if not least > z_in:
        raise InputError(f"a solid needs its exit surface above the entrance at z_in = {z_in:g} mm everywhere,"
                         f" got a least height of {least:.6g} mm; design with a larger min_thickness")
