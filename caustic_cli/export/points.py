"""Writer of the points of a surface, x varying fastest, both ascending: `.csv` with a header, or plain `.xyz`.

    x_mm,y_mm,z_mm          # created by caustic ...
    -5,-5,5.1               -5 -5 5.1

Lengths are rounded as far as light does not notice (`surface.decimals_for`).  The order (y-major) is what LightTools' point blocks
and scripts expect; a comment has no place in a CSV.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from torch import Tensor

from caustic_cli.export import reading
from caustic_cli.export.reading import Readings
from caustic_cli.export.surface import STEPS_PER_SPAN, Sampling, counts_of, decimals_for, sample_grid, samplings
from caustic_cli.export.text import CREATED, rows
from caustic_cli.io.files import atomic_file
from caustic_cli.optics.surfaces.heightfield import HeightField
from caustic_cli.scene import Scene

HEADER = "x_mm,y_mm,z_mm\n"


def write_csv(path: str | Path, scene: Scene, field: HeightField, heights: Tensor, samples: Sampling | None = None) -> None:
    """Write the table atomically.

    Arguments and errors as in `sample_grid`; InputError also if it cannot be written.
    """
    _write(path, field, heights, samples, HEADER, ",")


def write_xyz(path: str | Path, scene: Scene, field: HeightField, heights: Tensor, samples: Sampling | None = None) -> None:
    """Write the points atomically, after a comment line that begins with #; otherwise as `write_csv`."""
    _write(path, field, heights, samples, f"# {CREATED}, millimetres\n", " ")


def choices(scene: Scene, field: HeightField, heights: Tensor, limit: float) -> list[dict]:
    """Densities of files of at most `limit` bytes, the smallest first."""
    a_point = sum(len(f"{-w:.{_decimals(field, 1)}f},") for w in (*field.half_size, float(heights.abs().max())))
    return [{"samples": s} for s in samplings(field.spaces, limit / a_point)]


def readings(scene: Scene, field: HeightField, heights: Tensor, samples: Sampling | None = None) -> Readings:
    """The surface as read from the points."""
    x, y, z, _ = _rounded(field, heights, samples)
    return {"error": lambda: reading.of_points(x, y, z)}


def _decimals(field: HeightField, samples: Sampling | None) -> int:
    counts = counts_of(field.spaces, STEPS_PER_SPAN if samples is None else samples)
    return decimals_for(min(2.0 * r / n for r, n in zip(field.half_size, counts, strict=True)))


def _rounded(field: HeightField, heights: Tensor, samples) -> tuple[np.ndarray, np.ndarray, np.ndarray, int]:
    """x (nx,), y (ny,), z (nx, ny) mm as written, and their decimals."""
    grid, decimals = sample_grid(field, heights, samples), _decimals(field, samples)
    return grid.x.round(decimals) + 0.0, grid.y.round(decimals) + 0.0, grid.z.round(decimals) + 0.0, decimals


def _write(path, field: HeightField, heights: Tensor, samples, head: str, separator: str) -> None:
    x, y, z, decimals = _rounded(field, heights, samples)
    points = np.stack([*np.broadcast_arrays(x[:, None], y[None, :]), z], -1).swapaxes(0, 1).reshape(-1, 3)
    with atomic_file(path) as file:
        file.write(head.encode())
        file.writelines(rows(points, separator.join([f"%.{decimals}f"] * 3) + "\n"))
