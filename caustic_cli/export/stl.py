"""Writer of binary STL files of the closed solid (3D Systems, StereoLithography Interface Specification, 1989).

    80 bytes of header, uint32 count, then per triangle: float32 normal (3), float32 corners (3, 3), uint16 zero

all little-endian; lengths are mm in the scene's coordinates, since STL has no unit.  The solid is that of
`mesh`; corners run counter-clockwise seen from outside.

STL corners are float32, which resolve the sag to about 5e-7 mm at some mm of thickness: sufficient for printing, not for
tracing the caustic on a dense grid; the LightTools archive has float64.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from caustic_cli import __version__
from caustic_cli.errors import InputError
from caustic_cli.export import mesh
from caustic_cli.io.files import atomic_file

#: Must not begin with "solid", by which readers recognise the text variant.
HEADER = f"binary STL of a lens, millimetres, caustic {__version__}".encode().ljust(80)
TRIANGLE = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])  # 50 bytes
#: Triangles written at a time, which bounds the memory.
BLOCK = 1 << 20


def write_stl(path: str | Path, *lens: Any, **density: Any) -> None:
    """Write the solid atomically.  Arguments as in `closed_mesh`.

    Raises:
        InputError: as `closed_mesh`; points that coincide in float32; or the file cannot be written.
    """
    write_mesh(path, *mesh.closed_mesh(*lens, **density))


def write_mesh(path: str | Path, vertices: np.ndarray, faces: np.ndarray) -> None:
    """Write vertices (V, 3) mm and triangles (F, 3); errors as of `write_stl`."""
    vertices = vertices.astype("<f4")
    with atomic_file(path) as file:
        file.write(HEADER)
        file.write(np.array(len(faces), "<u4").tobytes())
        for start in range(0, len(faces), BLOCK):
            file.write(_records(vertices[faces[start : start + BLOCK]]).tobytes())


#: Densities of files of at most `limit` bytes, the smallest first; and the surface as read from the mesh, in float32.
choices = partial(mesh.choices, a_point=2 * TRIANGLE.itemsize)
readings = partial(mesh.readings, rounded=lambda points: points.astype(np.float32).astype(np.float64))


def _records(corners: np.ndarray) -> np.ndarray:
    """STL records of triangles with `corners` (F, 3, 3) float32: (F,) of TRIANGLE.

    Raises:
        InputError: a triangle has no area in float32.
    """
    exact = corners.astype(np.float64)
    normal = np.cross(exact[:, 1] - exact[:, 0], exact[:, 2] - exact[:, 0])
    length = np.linalg.norm(normal, axis=1, keepdims=True)  # twice the area
    if not (length > 0).all():
        raise InputError(
            "an STL file holds float32 numbers, in which neighbouring points of this lens coincide;"
            " give fewer ⟨samples⟩, or take another format"
        )
    records = np.zeros(len(corners), TRIANGLE)
    records["normal"], records["corners"] = normal / length, corners
    return records
