"""Height maps for milling programs: 16-bit grey PNG, or TIFF of 32-bit floats, by the suffix.

Pixels are points, borders included: column 0 is the edge at -x, the last one that at +x, row 0 the edge at +y, as seen from +z.
Height = z_of_zero + value * mm_per_count in both formats; a JSON file beside the picture holds these numbers, the orientation of
the part (`part`), and the control net of the spline, so that the surface can be read back as such.

By default the bilinear interpolation of the points is within `TOLERANCE` of the spline, by bounds of its second derivatives, with
at least two points per knot span, as far as the default file size allows.  Heights are rounded to the nearest count.  The deviation
of the bilinear interpolation of the written values is measured.
"""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
from PIL import Image, PngImagePlugin, TiffImagePlugin

from caustic_cli.errors import InputError
from caustic_cli.export.accuracy import of_bilinear
from caustic_cli.export.part import Part, surface_of
from caustic_cli.export.surface import MAX_SAMPLES, SurfaceGrid, most_points, sample_grid, step_within
from caustic_cli.export.text import CREATED
from caustic_cli.io.files import SOFTWARE, atomic_file, write_bytes
from caustic_cli.io.heightmaps import COUNTS, SUFFIXES, VERSION, beside

#: Largest deviation of the bilinear interpolation of the default points, mm.
TOLERANCE = 1e-4
#: Least default number of points per knot span.
A_SPAN = 2
#: Bytes per point.
SUFFIX_BYTES = {".png": 2, ".tif": 4, ".tiff": 4}


def write_heightmap(path: str | Path, part: Part, samples: tuple[int, int] | None = None, tolerance: float | None = None) -> dict:
    """Write the picture and its JSON, each atomically.

    Args:
        samples: (nx, ny) points; tolerance: of the bilinear interpolation, mm, instead.

    Returns:
        the contents of the JSON.

    Raises:
        InputError: another suffix, both samples and tolerance, too many points, or a file that cannot be written there.
    """
    path = Path(path)
    suffix = path.suffix.lower()
    if suffix not in SUFFIXES:
        raise InputError(f"{path}: a height map is written as {', '.join(SUFFIXES)}")
    if samples is not None and tolerance is not None:
        raise InputError("⟨samples⟩ and ⟨tolerance⟩ both say how fine the map is: give one of them")
    grid = sample_grid(part.field, part.heights, samples or _counts(part, suffix, tolerance))
    low, high = float(grid.z.min()), float(grid.z.max())
    picture = np.ascontiguousarray(grid.z.T[::-1])  # rows from +y down
    if suffix == ".png":
        quantum = (high - low) / COUNTS or 1.0
        scale, values = quantum, np.rint((picture - low) / quantum).astype(np.uint16)
        info = PngImagePlugin.PngInfo()
        info.add_text("Software", SOFTWARE)
        more = {"format": "PNG", "pnginfo": info}
    else:
        scale, values = 1.0, (picture - low).astype(np.float32)
        quantum = float(np.spacing(np.float32(high - low)))
        tags = TiffImagePlugin.ImageFileDirectory_v2()
        tags[270] = CREATED
        more = {"format": "TIFF", "tiffinfo": tags}
    with atomic_file(path) as file:
        Image.fromarray(values).save(file, **more)
    written = replace(grid, z=(low + scale * values.astype(np.float64))[::-1].T.copy())
    said = _said(part, grid, path.name, low, high, scale, quantum)
    said["height_error_mm"] = of_bilinear(written, part.field, part.heights).height
    write_bytes(beside(path), (json.dumps(said, indent=1, allow_nan=False) + "\n").encode())
    return said


def _counts(part: Part, suffix: str, asked: float | None) -> tuple[int, int]:
    """Points along x and y for the tolerance asked, mm, or for the default one within the default file size."""
    tolerance = TOLERANCE if asked is None else asked
    step = step_within(part.field, part.heights, tolerance)
    counts = [
        max(math.ceil(2.0 * r / step), A_SPAN * (len(s.breaks) - 1)) + 1
        for s, r in zip(part.field.spaces, part.field.half_size, strict=True)
    ]
    most = most_points(SUFFIX_BYTES[suffix])
    if asked is None and math.prod(counts) > most:
        shrink = math.sqrt(most / math.prod(counts))
        counts = [max(2, math.floor(shrink * n)) for n in counts]
    if max(counts) > MAX_SAMPLES:
        raise InputError(f"⟨tolerance⟩ {tolerance:g} must give at most {MAX_SAMPLES} points along an axis, got {max(counts)}")
    return counts[0], counts[1]


def _said(part: Part, grid: SurfaceGrid, name: str, low: float, high: float, scale: float, quantum: float) -> dict:
    """Contents of the JSON."""
    (nx, ny), (rx, ry) = grid.z.shape, part.field.half_size
    field, _ = surface_of(part)
    enough = all(n >= A_SPAN * (len(s.breaks) - 1) + 1 for n, s in zip((nx, ny), field.spaces, strict=True))
    spline = {
        "degrees": [s.degree for s in field.spaces],
        "knots_u": field.spaces[0].knots.tolist(),
        "knots_v": field.spaces[1].knots.tolist(),
    }
    return {
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
        "z_of_zero": low,
        "mm_per_count": scale,
        "quantum_mm": quantum,
        "z_least": low,
        "z_most": high,
        "z_of_flat_face": part.lens.z_in,
        "turned": part.turned,
        "to_the_scene": "(x, -y, -z)" if part.turned else "(x, y, z)",
        "round": part.lens.round,
    } | ({"spline": spline} if enough else {})
