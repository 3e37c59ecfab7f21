"""Writer of Wavefront OBJ files of the closed solid: `v x y z` in mm, `f a b c` counted from 1.

Lengths have DECIMALS decimals: at a distance of the points of 1 um, rounding changes slopes by less than 1e-6.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from caustic_cli.export import mesh
from caustic_cli.export.text import CREATED, rows
from caustic_cli.io.files import atomic_file

DECIMALS = 9
#: Bytes of a point's three numbers and two triangles, as text, about.
A_POINT = 3 * (DECIMALS + 4) + 2 * 25


def write_obj(path: str | Path, *lens: Any, **density: Any) -> None:
    """Write the solid atomically; arguments and errors as in `write_ply`."""
    write_mesh(path, *mesh.closed_mesh(*lens, **density))


def write_mesh(path: str | Path, vertices: np.ndarray, faces: np.ndarray) -> None:
    """Write vertices (V, 3) mm and triangles (F, 3)."""
    with atomic_file(path) as file:
        file.write(f"# {CREATED}\n# millimetres\no lens\n".encode())
        file.writelines(rows(vertices.round(DECIMALS) + 0.0, f"v %.{DECIMALS}f %.{DECIMALS}f %.{DECIMALS}f\n"))
        file.writelines(rows(faces + 1, "f %d %d %d\n"))


#: Densities of files of at most `limit` bytes, the smallest first; and the surface as read from the mesh, with rounded lengths.
choices = partial(mesh.choices, a_point=A_POINT)
readings = partial(mesh.readings, rounded=lambda points: points.round(DECIMALS))
