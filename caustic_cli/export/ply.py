"""Writer of PLY files of the closed solid (G. Turk, The PLY Polygon File Format, 1994), little-endian binary.

    ply, format, comments, properties, as text; then per vertex x y z, float64 mm; then per triangle 3 and its vertices, int32

`write_mesh` can also write normals.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from caustic_cli.export import mesh
from caustic_cli.export.text import CREATED
from caustic_cli.io.files import atomic_file

FACE = np.dtype([("count", "u1"), ("corners", "<i4", 3)])
#: Bytes of a point's three numbers and two triangles.
A_POINT = 3 * 8 + 2 * FACE.itemsize


def write_ply(path: str | Path, *lens: Any, **density: Any) -> None:
    """Write the solid atomically.

    Arguments and errors as in `closed_mesh`; InputError also if it cannot be written.
    """
    write_mesh(path, *mesh.closed_mesh(*lens, **density))


#: Densities of files of at most `limit` bytes, the smallest first; and the surface as read from the mesh.
choices = partial(mesh.choices, a_point=A_POINT)
readings = mesh.readings


def write_mesh(path: str | Path, vertices: np.ndarray, faces: np.ndarray, normals: np.ndarray | None = None) -> None:
    """Write vertices (V, 3) mm, with unit normals (V, 3) if given, and triangles (F, 3)."""
    names = ("x", "y", "z") if normals is None else ("x", "y", "z", "nx", "ny", "nz")
    table = vertices if normals is None else np.concatenate([vertices, normals], 1)
    head = [
        "ply",
        "format binary_little_endian 1.0",
        f"comment {CREATED}",
        "comment millimetres",
        f"element vertex {len(vertices)}",
        *(f"property double {name}" for name in names),
        f"element face {len(faces)}",
        "property list uchar int vertex_indices",
        "end_header",
        "",
    ]
    records = np.empty(len(faces), FACE)
    records["count"], records["corners"] = 3, faces
    with atomic_file(path) as file:
        file.write("\n".join(head).encode())
        file.write(table.astype("<f8").tobytes())
        file.write(records.tobytes())
