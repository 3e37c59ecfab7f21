"""Writer of the points of the exit surface, x varying fastest, both ascending: `.csv` with a header, or plain `.xyz`.

    x_mm,y_mm,z_mm          # created by caustic ...
    -5,-5,5.1               -5 -5 5.1

The order (y-major) is what LightTools' point blocks and scripts expect; a comment has no place in a CSV.
"""

from __future__ import annotations

from pathlib import Path

from torch import Tensor

from caustic_cli.export.accuracy import Deviation, of_spline
from caustic_cli.export.surface import most_points, sample_grid
from caustic_cli.export.text import CREATED, rows
from caustic_cli.io.files import atomic_file
from caustic_cli.optics.surfaces.heightfield import HeightField
from caustic_cli.scene import Scene

#: Bytes of a point's three numbers, as text, at most.
A_POINT = 3 * 21
HEADER = "x_mm,y_mm,z_mm\n"


def write_csv(
    path: str | Path, scene: Scene, field: HeightField, heights: Tensor, samples: tuple[int, int] | None = None
) -> Deviation:
    """Write the table atomically; returns the deviation of a spline through its points.

    Arguments and errors as in `sample_grid`; InputError also if it cannot be written.
    """
    return _write(path, field, heights, samples, HEADER, "%.17g,%.17g,%.17g\n")


def write_xyz(
    path: str | Path, scene: Scene, field: HeightField, heights: Tensor, samples: tuple[int, int] | None = None
) -> Deviation:
    """Write the points atomically, after a comment line that begins with #; otherwise as `write_csv`."""
    return _write(path, field, heights, samples, f"# {CREATED}, millimetres\n", "%.17g %.17g %.17g\n")


def _write(path, field: HeightField, heights: Tensor, samples, head: str, form: str) -> Deviation:
    grid = sample_grid(field, heights, samples, most_points(A_POINT))
    points = grid.points.reshape(*grid.z.shape, 3).swapaxes(0, 1).reshape(-1, 3)
    with atomic_file(path) as file:
        file.write(head.encode())
        file.writelines(rows(points, form))
    return of_spline(grid, field, heights)
