"""Height maps for milling programs: 16-bit grey PNG, or TIFF of 32-bit floats or, where these are sufficient, 16-bit numbers.

Pixels are points, borders included: column 0 is the edge at -x, the last one that at +x, row 0 the edge at +y, as seen from +z.
Height = z_of_zero + value * mm_per_count in both formats; a JSON file beside the picture holds these numbers, the orientation of
the part (`part`), and the control net of the spline, so that the surface can be read back as such.

Heights are rounded to the nearest count.  The deviation of the bilinear interpolation of the written values, which is how milling
programs read them, is measured; light is refracted by their bicubic interpolation (`readings`).
"""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from PIL import Image, PngImagePlugin, TiffImagePlugin

from caustic_cli.errors import InputError
from caustic_cli.export import reading
from caustic_cli.export.part import Part, surface_of
from caustic_cli.export.reading import Readings
from caustic_cli.export.surface import (
    MAX_SAMPLES,
    STEPS_PER_SPAN,
    Sampling,
    SurfaceGrid,
    counts_of,
    sample_grid,
    samplings,
    step_within,
)
from caustic_cli.export.text import CREATED
from caustic_cli.io.files import SOFTWARE, atomic_file, write_bytes
from caustic_cli.io.heightmaps import COUNTS, SUFFIXES, VERSION, beside

#: Points per knot span with which the spline can be recovered from a map, and their least number for a tolerance.
A_SPAN = 2
#: Bits per point of each suffix unless they are given.
BITS = {".png": 16, ".tif": 32, ".tiff": 32}


class Counts(NamedTuple):
    """The map as written: values (columns along x, rows along y) in counts, and the surface low + scale * values, mm.

    quantum: rounding of a height, mm."""

    grid: SurfaceGrid
    values: np.ndarray
    low: float
    high: float
    scale: float
    quantum: float

    @property
    def z(self) -> np.ndarray:
        """Heights (nx, ny) mm."""
        return self.low + self.scale * self.values.astype(np.float64)


def write_heightmap(
    path: str | Path, part: Part, samples: Sampling | None = None, tolerance: float | None = None, bits: int | None = None
) -> dict:
    """Write the picture and its JSON, each atomically.

    Args:
        samples: density of points; tolerance: of the bilinear interpolation, mm, instead; bits: 16, or of a TIFF 32, by default as
            many as the suffix allows.

    Returns:
        the contents of the JSON.

    Raises:
        InputError: another suffix, both samples and tolerance, too many points, or a file that cannot be written there.
    """
    path = Path(path)
    counts = _counts(part, _bits(path, bits), samples, tolerance)
    if path.suffix.lower() == ".png":
        info = PngImagePlugin.PngInfo()
        info.add_text("Software", SOFTWARE)
        more = {"format": "PNG", "pnginfo": info}
    else:
        tags = TiffImagePlugin.ImageFileDirectory_v2()
        tags[270] = CREATED
        more = {"format": "TIFF", "tiffinfo": tags}
    picture = np.ascontiguousarray(counts.values.T[::-1])  # rows from +y down
    with atomic_file(path) as file:
        Image.fromarray(picture).save(file, **more)
    said = _said(part, counts, path.name)
    said["height_error_mm"] = _bilinear_deviation(counts, part)
    write_bytes(beside(path), (json.dumps(said, indent=1, allow_nan=False) + "\n").encode())
    return said


def choices(part: Part, limit: float, path: Path) -> list[dict]:
    """Densities of maps of at most `limit` bytes, the smallest first."""
    return [{"samples": s} for s in samplings(part.field.spaces, limit / (_bits(path) // 8))]


def smaller(path: Path, choice: dict) -> dict | None:
    """The choice with fewer bits, if the file can have them."""
    return choice | {"bits": 16} if _bits(path) == 32 else None


def readings(
    part: Part, path: Path, samples: Sampling | None = None, tolerance: float | None = None, bits: int | None = None
) -> Readings:
    """The surface as read from the map by bicubic interpolation."""
    counts = _counts(part, _bits(path, bits), samples, tolerance)
    return {"error": lambda: reading.of_points(counts.grid.x, counts.grid.y, counts.z)}


def _bits(path: Path, bits: int | None = None) -> int:
    suffix = path.suffix.lower()
    if suffix not in SUFFIXES:
        raise InputError(f"{path}: a height map is written as {', '.join(SUFFIXES)}")
    return BITS[suffix] if bits is None else bits


def _counts(part: Part, bits: int, samples: Sampling | None, tolerance: float | None) -> Counts:
    if samples is not None and tolerance is not None:
        raise InputError("⟨samples⟩ and ⟨tolerance⟩ both say how fine the map is: give one of them")
    spaces = part.field.spaces
    even = counts_of(spaces, STEPS_PER_SPAN if samples is None else samples)  # pixels are equally spaced, whatever the knots
    grid = sample_grid(part.field, part.heights, even if tolerance is None else _points_within(part, tolerance))
    low, high = float(grid.z.min()), float(grid.z.max())
    if bits == 16:
        quantum = (high - low) / COUNTS or 1.0
        return Counts(grid, np.rint((grid.z - low) / quantum).astype(np.uint16), low, high, quantum, quantum)
    return Counts(grid, (grid.z - low).astype(np.float32), low, high, 1.0, float(np.spacing(np.float32(high - low))))


def _points_within(part: Part, tolerance: float) -> tuple[int, int]:
    """Points along x and y with which bilinear interpolation is within a tolerance, mm."""
    step = step_within(part.field, part.heights, tolerance)
    nx, ny = (
        max(math.ceil(2.0 * r / step), A_SPAN * (len(s.breaks) - 1)) + 1
        for s, r in zip(part.field.spaces, part.field.half_size, strict=True)
    )
    if max(nx, ny) > MAX_SAMPLES:
        raise InputError(f"⟨tolerance⟩ {tolerance:g} must give at most {MAX_SAMPLES} points along an axis, got {max(nx, ny)}")
    return nx, ny


def _bilinear_deviation(counts: Counts, part: Part) -> float:
    """Largest deviation of the bilinear interpolation in height, at random points, mm."""
    random, z = np.random.default_rng(reading.SEED), counts.z
    x, y = (random.uniform(-r, r, reading.POINTS) for r in part.field.half_size)
    (i, s), (j, t) = _cells(counts.grid.x, x), _cells(counts.grid.y, y)
    low, high = ((1.0 - s) * z[i, b] + s * z[i + 1, b] for b in (j, j + 1))  # on the cell's two lines of y
    own = part.field.at(part.heights, torch.from_numpy(x), torch.from_numpy(y), [(0, 0)])[0].numpy()
    return float(np.abs((1.0 - t) * low + t * high - own).max())


def _cells(lines: np.ndarray, at: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Index of the cell of positions (N,), and the place in it, 0 to 1."""
    cell = np.clip(np.searchsorted(lines, at, "right") - 1, 0, len(lines) - 2)
    return cell, (at - lines[cell]) / (lines[cell + 1] - lines[cell])


def _said(part: Part, counts: Counts, name: str) -> dict:
    """Contents of the JSON."""
    (nx, ny), (rx, ry) = counts.grid.shape, part.field.half_size
    field, _ = surface_of(part)
    enough = all(n >= A_SPAN * (len(s.breaks) - 1) + 1 for n, s in zip((nx, ny), field.spaces, strict=True))
    spline = {
        "degrees": [s.degree for s in field.spaces],
        "knots_u": field.spaces[0].knots.tolist(),
        "knots_v": field.spaces[1].knots.tolist(),
    }
    return (
        {
            "created_by": SOFTWARE,
            "height_map": VERSION,
            "file": name,
            "part": part.kind,
            "unit": "mm",
            "columns": nx,
            "rows": ny,
            "mm_per_column": 2.0 * rx / (nx - 1),
            "mm_per_row": 2.0 * ry / (ny - 1),
            "x_of_column_0": -rx,
            "y_of_row_0": ry,
            "orientation": "seen from +z: columns run along +x, rows along -y; pixels are points, borders included",
            "z_of_zero": counts.low,
            "mm_per_count": counts.scale,
            "quantum_mm": counts.quantum,
            "z_least": counts.low,
            "z_most": counts.high,
            "z_of_flat_face": part.lens.z_in,
            "turned": part.turned,
            "to_the_scene": "(x, -y, -z)" if part.turned else "(x, y, z)",
            "round": part.lens.opening.round,
        }
        | ({"spline": spline} if enough else {})
        | ({} if part.register is None else {"register": part.register.figures})
    )
