"""Writer of Wavefront OBJ files of the closed solid: `v x y z` in mm with 17 digits, `f a b c` counted from 1."""

from __future__ import annotations

from pathlib import Path

from torch import Tensor

from caustic_cli.export.accuracy import Deviation, of_triangles
from caustic_cli.export.mesh import exit_and_solids
from caustic_cli.export.ply import A_POINT
from caustic_cli.export.text import CREATED, rows
from caustic_cli.io.files import atomic_file
from caustic_cli.optics.surfaces.heightfield import HeightField
from caustic_cli.scene import Scene


def write_obj(
    path: str | Path,
    scene: Scene,
    field: HeightField,
    heights: Tensor,
    samples: tuple[int, int] | None = None,
    tolerance: float | None = None,
) -> Deviation:
    """Write the solid atomically; arguments, errors and result as in `write_ply`."""
    exit, vertices, faces = exit_and_solids(scene, field, heights, samples, tolerance, A_POINT)
    with atomic_file(path) as file:
        file.write(f"# {CREATED}\n# millimetres\no lens\n".encode())
        file.writelines(rows(vertices, "v %.17g %.17g %.17g\n"))
        file.writelines(rows(faces + 1, "f %d %d %d\n"))
    return of_triangles(exit, field, heights)
