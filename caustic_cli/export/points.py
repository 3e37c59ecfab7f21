"""The exit surface as a list of points, x varying fastest, both ascending: `.csv` with a header, or plain `.xyz`.

    x_mm,y_mm,z_mm          # created by caustic ...
    -5,-5,5.1               -5 -5 5.1

The order (y-major) is what LightTools' point blocks and scripts expect; a comment has no place in a CSV.
"""

from __future__ import annotations

from pathlib import Path

from torch import Tensor

from caustic_cli.export.surface import default_samples, sample_grid
from caustic_cli.export.text import CREATED, rows
from caustic_cli.io.files import atomic_path
from caustic_cli.optics.surfaces.heightfield import HeightField
from caustic_cli.scene import Scene

#: Most points along an axis of the default cloud, which keep it under 20 MB; ⟨samples⟩ asks for more.
MOST = 577
HEADER = "x_mm,y_mm,z_mm\n"


def write_csv(path: str | Path, scene: Scene, field: HeightField, heights: Tensor, samples: tuple[int, int] | None = None) -> None:
    """Write the table whole or not at all.  Arguments and errors as of `sample_grid`; InputError also if it cannot be written."""
    _write(path, field, heights, samples, HEADER, "%.17g,%.17g,%.17g\n")


def write_xyz(path: str | Path, scene: Scene, field: HeightField, heights: Tensor, samples: tuple[int, int] | None = None) -> None:
    """Write the points whole or not at all, below a comment that begins with #; arguments and errors as of `write_csv`."""
    _write(path, field, heights, samples, f"# {CREATED}, millimetres\n", "%.17g %.17g %.17g\n")


def _write(path, field: HeightField, heights: Tensor, samples, head: str, form: str) -> None:
    counts = tuple(default_samples(s) for s in field.spaces)
    if samples is None and max(counts) > MOST:
        samples = (min(MOST, counts[0]), min(MOST, counts[1]))
    grid = sample_grid(field, heights, samples)
    points = grid.points.reshape(*grid.z.shape, 3).swapaxes(0, 1).reshape(-1, 3)
    with atomic_path(path) as temporary, open(temporary, "wb") as file:
        file.write(head.encode())
        file.writelines(rows(points, form))
