"""The lens as a closed solid in a PLY file (G. Turk, The PLY Polygon File Format, 1994), as text.

    ply, format, comments, properties; then per vertex x y z, float64 mm, 17 digits; then per triangle 3 and its corners

`write_surface` writes the exit surface alone with unit normals, for programs that shade.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from torch import Tensor

from caustic_cli.export.mesh import closed_mesh, triangles
from caustic_cli.export.surface import SurfaceGrid
from caustic_cli.export.text import CREATED, rows
from caustic_cli.files import atomic_path
from caustic_cli.optics.heightfield import HeightField
from caustic_cli.scene import Scene


def write_ply(path: str | Path, scene: Scene, field: HeightField, heights: Tensor,
              samples: tuple[int, int] | None = None, tolerance: float | None = None) -> None:
    """Write the solid whole or not at all.  Arguments and errors as of `closed_mesh`; InputError also if it cannot be written."""
    write_mesh(path, *closed_mesh(scene, field, heights, samples, tolerance))


def write_surface(path: str | Path, grid: SurfaceGrid) -> None:
    """Write the exit surface alone, with its unit normals towards +z."""
    write_mesh(path, grid.points, triangles(*grid.z.shape), grid.normals)


def write_mesh(path: str | Path, vertices: np.ndarray, faces: np.ndarray, normals: np.ndarray | None = None) -> None:
    """Write vertices (V, 3) mm, with unit normals (V, 3) if given, and triangles (F, 3)."""
    names = ("x", "y", "z") if normals is None else ("x", "y", "z", "nx", "ny", "nz")
    table = vertices if normals is None else np.concatenate([vertices, normals], 1)
    head = ["ply", "format ascii 1.0", f"comment {CREATED}", "comment millimetres", f"element vertex {len(vertices)}",
            *(f"property double {name}" for name in names), f"element face {len(faces)}",
            "property list uchar int vertex_indices", "end_header", ""]
    with atomic_path(path) as temporary, open(temporary, "wb") as file:
        file.write("\n".join(head).encode())
        file.writelines(rows(table, " ".join(["%.17g"] * len(names)) + "\n"))
        file.writelines(rows(faces, "3 %d %d %d\n"))
