"""The lens as a closed solid in a Wavefront OBJ file: `v x y z` in mm with 17 digits, `f a b c` counted from 1."""

from __future__ import annotations

from pathlib import Path

from torch import Tensor

from caustic_cli.export.mesh import closed_mesh
from caustic_cli.export.text import CREATED, rows
from caustic_cli.io.files import atomic_path
from caustic_cli.optics.surfaces.heightfield import HeightField
from caustic_cli.scene import Scene


def write_obj(
    path: str | Path,
    scene: Scene,
    field: HeightField,
    heights: Tensor,
    samples: tuple[int, int] | None = None,
    tolerance: float | None = None,
) -> None:
    """Write the solid whole or not at all.  Arguments and errors as of `closed_mesh`; InputError also if it cannot be written."""
    vertices, faces = closed_mesh(scene, field, heights, samples, tolerance)
    with atomic_path(path) as temporary, open(temporary, "wb") as file:
        file.write(f"# {CREATED}\n# millimetres\no lens\n".encode())
        file.writelines(rows(vertices, "v %.17g %.17g %.17g\n"))
        file.writelines(rows(faces + 1, "f %d %d %d\n"))
