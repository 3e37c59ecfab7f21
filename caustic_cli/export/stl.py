"""The lens as a closed solid in a binary STL file (3D Systems, StereoLithography Interface Specification, 1989).

    80 bytes of header, uint32 count, then per triangle: float32 normal (3), float32 corners (3, 3), uint16 zero

all little-endian; lengths are mm in the scene's coordinates, since STL itself knows no unit.  The solid is the exit
surface, four walls along its border and the flat entrance at z_in; corners run counter-clockwise seen from outside.

STL corners are float32: beside some mm of thickness they resolve the sag to about 5e-7 mm.  That is fine for a printer
or a picture, not for tracing the caustic on a dense grid; the LightTools archive keeps float64.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from torch import Tensor

from caustic_cli import __version__
from caustic_cli.errors import InputError
from caustic_cli.export.surface import SurfaceGrid, sample_grid
from caustic_cli.files import atomic_path
from caustic_cli.optics.heightfield import HeightField
from caustic_cli.scene import Scene

#: Readers take a file that begins with "solid" for the text variant.
HEADER = f"binary STL of a lens, millimetres, caustic {__version__}".encode().ljust(80)
TRIANGLE = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])  # 50 bytes
#: Triangles written at a time, which bounds the memory.
BLOCK = 1 << 20


def write_stl(path: str | Path, scene: Scene, field: HeightField, heights: Tensor,
              samples: tuple[int, int] | None = None) -> None:
    """Write the solid whole or not at all.

    Args:
        heights: (n, m) control heights, mm.
        samples: (nx, ny) points on the exit surface, or None for a grid on the knots (`sample_grid`).

    Raises:
        InputError: the samples are too few, too many or closer than float32 can tell apart, the surface reaches the
            entrance, or the file cannot be written there.
    """
    vertices, faces = solid(sample_grid(field, heights, samples), scene.lens.z_in)
    vertices = vertices.astype("<f4")
    with atomic_path(path) as temporary, open(temporary, "wb") as file:
        file.write(HEADER)
        file.write(np.array(len(faces), "<u4").tobytes())
        for start in range(0, len(faces), BLOCK):
            file.write(_records(vertices[faces[start : start + BLOCK]]).tobytes())


def solid(grid: SurfaceGrid, z_in: float) -> tuple[np.ndarray, np.ndarray]:
    """Closed triangle mesh of the lens: vertices (V, 3) float64 mm, faces (F, 3) int64, outward counter-clockwise.

    Vertices are the nx ny grid points, one foot at z_in below each border point, and the entrance's centre.  Walls join
    border point to foot and the entrance is a fan from its centre, so every edge belongs to exactly two triangles.

    Raises:
        InputError: the surface reaches the entrance, so that there is no solid.
    """
    if not grid.z.min() > z_in:
        raise InputError(f"a solid needs its exit surface above the entrance at z_in = {z_in:g} mm everywhere,"
                         f" got a least height of {grid.z.min():.6g} mm; design with a larger min_thickness")
    nx, ny = grid.z.shape
    number = np.arange(nx * ny).reshape(nx, ny)
    a, b, c, d = number[:-1, :-1], number[1:, :-1], number[1:, 1:], number[:-1, 1:]  # corners of every cell, from +z
    top = np.stack([np.stack([a, b, c], -1), np.stack([a, c, d], -1)], 2).reshape(-1, 3)
    rim = np.concatenate([number[:-1, 0], number[-1, :-1], number[:0:-1, -1], number[0, :0:-1]])  # once around, from +z
    foot = nx * ny + np.arange(len(rim))
    centre = np.full_like(rim, nx * ny + len(rim))
    next_rim, next_foot = np.roll(rim, -1), np.roll(foot, -1)
    walls = [np.stack([foot, next_foot, next_rim], -1), np.stack([foot, next_rim, rim], -1)]
    entrance = np.stack([centre, next_foot, foot], -1)
    points = grid.points
    feet = points[rim]
    feet[:, 2] = z_in
    middle = np.array([[0.0, 0.0, z_in]])
    return np.concatenate([points, feet, middle]), np.concatenate([top, *walls, entrance])


def _records(corners: np.ndarray) -> np.ndarray:
    """STL records of triangles with `corners` (F, 3, 3) float32: (F,) of TRIANGLE.

    Raises:
        InputError: a triangle lost its area to float32.
    """
    exact = corners.astype(np.float64)
    normal = np.cross(exact[:, 1] - exact[:, 0], exact[:, 2] - exact[:, 0])
    length = np.linalg.norm(normal, axis=1, keepdims=True)  # twice the area
    if not (length > 0).all():
        raise InputError("an STL file holds float32 numbers, in which neighbouring points of this lens coincide;"
                         " give fewer --samples, or take another format")
    records = np.zeros(len(corners), TRIANGLE)
    records["normal"], records["corners"] = normal / length, corners
    return records
