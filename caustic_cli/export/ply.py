"""Writer of PLY files of the closed solid (G. Turk, The PLY Polygon File Format, 1994), as text.

    ply, format, comments, properties; then per vertex x y z, float64 mm, 17 digits; then per triangle 3 and its vertices

`write_mesh` can also write normals, and little-endian binary.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from torch import Tensor

from caustic_cli.export.accuracy import Deviation, of_triangles
from caustic_cli.export.mesh import exit_and_solids
from caustic_cli.export.text import CREATED, rows
from caustic_cli.io.files import atomic_file
from caustic_cli.optics.surfaces.heightfield import HeightField
from caustic_cli.scene import Scene

#: Bytes of a point's three numbers and two triangles, as text, at most.
A_POINT = 3 * 21 + 2 * 23
FACE = np.dtype([("count", "u1"), ("corners", "<i4", 3)])


def write_ply(
    path: str | Path,
    scene: Scene,
    field: HeightField,
    heights: Tensor,
    samples: tuple[int, int] | None = None,
    tolerance: float | None = None,
) -> Deviation:
    """Write the solid atomically; returns the deviation of its triangles.

    Arguments and errors as in `closed_mesh`; InputError also if it cannot be written.
    """
    exit, vertices, faces = exit_and_solids(scene, field, heights, samples, tolerance, A_POINT)
    write_mesh(path, vertices, faces)
    return of_triangles(exit, field, heights)


def write_mesh(
    path: str | Path, vertices: np.ndarray, faces: np.ndarray, normals: np.ndarray | None = None, text: bool = True
) -> None:
    """Write vertices (V, 3) mm, with unit normals (V, 3) if given, and triangles (F, 3)."""
    names = ("x", "y", "z") if normals is None else ("x", "y", "z", "nx", "ny", "nz")
    table = vertices if normals is None else np.concatenate([vertices, normals], 1)
    head = [
        "ply",
        f"format {'ascii' if text else 'binary_little_endian'} 1.0",
        f"comment {CREATED}",
        "comment millimetres",
        f"element vertex {len(vertices)}",
        *(f"property double {name}" for name in names),
        f"element face {len(faces)}",
        "property list uchar int vertex_indices",
        "end_header",
        "",
    ]
    with atomic_file(path) as file:
        file.write("\n".join(head).encode())
        if text:
            file.writelines(rows(table, " ".join(["%.17g"] * len(names)) + "\n"))
            file.writelines(rows(faces, "3 %d %d %d\n"))
            return
        file.write(table.astype("<f8").tobytes())
        records = np.empty(len(faces), FACE)
        records["count"], records["corners"] = 3, faces
        file.write(records.tobytes())
