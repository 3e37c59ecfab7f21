"""Readers of lens surfaces, as initial surface of a design: exported `.npz`, `.step` and height maps, and `.npy` of heights.

Lengths are mm in the coordinates of the scene: heights above z = 0, aperture centred on the axis.
"""

from __future__ import annotations

import math
import re
from array import array
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from caustic_cli.errors import InputError
from caustic_cli.io import heightmaps
from caustic_cli.io.arrays import Archive, open_npy, open_npz
from caustic_cli.io.files import naming, read_bytes
from caustic_cli.optics.bspline import MAX_DEGREE, SplineSpace
from caustic_cli.optics.surfaces.heightfield import HeightField
from caustic_cli.schema.checks import LENGTH
from caustic_cli.schema.table import TABLE

#: Most control points along one axis of a surface.
MAX_CONTROL = int(TABLE["lens.control"].high)
#: Suffixes of supported files.
SUFFIXES = (".npz", ".step", ".stp", ".npy", *heightmaps.SUFFIXES)
#: Relative tolerance for lengths, and for poles at the Greville abscissae, which files may hold rounded.
SAME = 1e-6

#: Largest STEP file read: a net of 1600 x 1600 control points as exported.
MAX_STEP_BYTES = 1 << 28
ACCEPTED = "an archive of caustic export ⟨format⟩ lighttools is needed"
HEIGHTS = f"a 2-D .npy array of heights in mm, 2 to {MAX_CONTROL} along each axis, is needed"

# Possessive quantifiers prevent backtracking, so that parsing time is linear in the length of a file.  For text without strings and
# comments:
_STRING = re.compile(r"(?:'[^']*+')++|/\*(?:[^*]|\*(?!/))*+\*/|(?:'|/\*)(?s:.*)")
_POINT = re.compile(
    r"#(\d{1,18})\s*+=\s*+CARTESIAN_POINT\s*+\(\s*+''\s*+,\s*+\(([^(),]*+),([^(),]*+),([^(),]*+)\)\s*+\)\s*+;", re.A
)
SPLINE = "B_SPLINE_SURFACE_WITH_KNOTS"
_DEGREES = re.compile(r"\s*+\(\s*+''\s*+,\s*+(\d{1,4})\s*+,\s*+(\d{1,4})\s*+,\s*+\(", re.A)
_ROW = re.compile(r"\s*+\(([#\d,\s]*+)\)\s*+(,?)", re.A)
_FORM = re.compile(r"\s*+\)(?:\s*+,\s*+\.\w++\.){4}", re.A)
_LIST = re.compile(r"\s*+,\s*+\(([^()]*+)\)", re.A)


def read_surface(path: str | Path, half_size: tuple[float, float]) -> tuple[HeightField, Tensor]:
    """The surface in a file and its control heights (n, m) mm float64.

    Args:
        half_size: (r_x, r_y) mm of the aperture.  A `.npy` of heights (a, b) mm, [i, j] with i along +x, is placed on a regular
            grid over it, borders included, and interpolated by a spline.

    Raises:
        InputError: the file cannot be read, holds no such surface, or one of another size.
    """
    path = Path(path)
    if path.suffix.lower() not in _READERS:
        raise InputError(f"{path}: a lens surface is read from {', '.join(SUFFIXES)}")
    return _READERS[path.suffix.lower()](path, half_size)


def _of_this_size(found: tuple[HeightField, Tensor], half_size: tuple[float, float]) -> tuple[HeightField, Tensor]:
    """The surface; refused if its size is not that of the aperture."""
    if any(abs(a - b) > SAME * b for a, b in zip(found[0].half_size, half_size, strict=True)):
        wide, high = (2.0 * r for r in found[0].half_size)
        raise InputError(
            f"the lens is {wide:g} x {high:g} mm, not {2 * half_size[0]:g} x {2 * half_size[1]:g} mm; ⟨lens_size⟩ must be its own"
        )
    return found


def onto(field: HeightField, heights: Tensor, net: HeightField) -> Tensor:
    """Control heights of the same surface on another net: exact if that contains all its knots, else interpolated."""
    tu, tv = (a.change_of_basis(b) for a, b in zip(field.spaces, net.spaces, strict=True))
    return tu @ heights @ tv.T


def read_npz(path: Path, half_size: tuple[float, float]) -> tuple[HeightField, Tensor]:
    """The exact B-spline of an archive made by `caustic export format lighttools`, over this aperture."""
    with open_npz(path, ACCEPTED) as data:
        return _of_this_size(surface_of(data), half_size)


def surface_of(data: Archive, side: str = "") -> tuple[HeightField, Tensor]:
    """The surface in the arrays of an archive; side: prefix of their names, such as "entrance_".

    Raises:
        InputError: an array is missing or invalid.
    """
    own = {key: side + key for key in ("control_points", "degrees", "knots_u", "knots_v")}
    missing = [key for key in (*own.values(), "lens_half_size") if key not in data]
    if missing:
        raise InputError(f"has no {', '.join(missing)}; {ACCEPTED}")
    degrees, half = data.wholes(own["degrees"], 2), tuple(data.reals("lens_half_size", 2).tolist())
    knots = [data.reals(own[key], None, most=MAX_CONTROL + MAX_DEGREE + 1) for key in ("knots_u", "knots_v")]
    return _surface(data.reals(own["control_points"], None, None, 3, most=MAX_CONTROL), degrees, knots, half)


def read_step(path: Path, half_size: tuple[float, float]) -> tuple[HeightField, Tensor]:
    """The single B-spline surface of a STEP file in millimetres, with poles at the Greville abscissae, over this aperture.

    Files have at most MAX_STEP_BYTES; time and memory are linear in their length: 20 s and 2.2 GB for the longest.

    Raises:
        InputError: there is not exactly one surface, it is not such a height field, or the unit is another.
    """
    with naming(path):
        return _of_this_size(spline_in(step_text(path)), half_size)


def step_text(path: Path) -> str:
    """The text of a STEP file in millimetres, with empty strings and without comments.

    Raises:
        InputError: it cannot be read, or the unit is another.
    """
    text = read_bytes(path, MAX_STEP_BYTES, "a STEP file is needed").decode("latin-1")
    if "ISO-10303-21" not in text[:1000]:
        raise InputError("is not a STEP file, which begins with ISO-10303-21")
    text = _STRING.sub("''", text)
    if not re.search(r"SI_UNIT\s*+\(\s*+\.MILLI\.\s*+,\s*+\.METRE\.\s*+\)", text):
        raise InputError("its lengths are not millimetres")
    return text


def spline_in(text: str) -> tuple[HeightField, Tensor]:
    """The single B-spline surface in the text of a STEP file, see `read_step`.

    Raises:
        InputError: there is not exactly one, or it is not such a height field.
    """
    count = text.count(SPLINE)
    if count != 1 or "RATIONAL_B_SPLINE_SURFACE" in text:
        raise InputError(f"must hold one B-spline surface, not rational, got {count} plain ones")
    try:
        return _surface(*_step_surface(text, text.index(SPLINE) + len(SPLINE)))
    except (ValueError, OverflowError) as error:
        if isinstance(error, InputError):
            raise
        raise InputError("its B-spline surface is damaged") from error


def _step_surface(text: str, at: int) -> tuple[np.ndarray, list[int], list[np.ndarray]]:
    """Parse poles (n, m, 3), degrees and knots of the surface whose arguments begin at `at`.

    Raises:
        ValueError: a syntax error.
    """
    found, rows, more = _after(_DEGREES, text, at), [], ","
    degrees, at = [int(found[1]), int(found[2])], found.end()
    while more:
        found = _after(_ROW, text, at)
        if len(rows) == MAX_CONTROL or found[1].count(",") >= MAX_CONTROL:
            raise InputError(f"has more than {MAX_CONTROL} control points a side, which are read at most")
        rows.append(np.array([int(name.strip().removeprefix("#")) for name in found[1].split(",")], dtype=np.int64))
        at, more = found.end(), found[2]
    at, lists = _after(_FORM, text, at).end(), []
    for _ in range(4):
        found = _after(_LIST, text, at)
        at = found.end()
        lists.append([] if found[1].count(",") > MAX_CONTROL + MAX_DEGREE else found[1].split(","))
    knots = [_knots(counts, values) for counts, values in zip(lists[:2], lists[2:], strict=True)]
    if any(len(row) != len(rows[0]) for row in rows):
        raise ValueError("rows of unequal length")
    names, places = array("q"), array("d")
    for point in _POINT.finditer(text):
        names.append(int(point[1]))
        places.extend((float(point[2]), float(point[3]), float(point[4])))
    wanted, order = np.stack(rows), np.argsort(names, kind="stable")
    known = np.asarray(names)[order]
    where = np.searchsorted(known, wanted)
    if not len(known) or not (known[np.minimum(where, len(known) - 1)] == wanted).all():
        raise ValueError("a control point that is not there")
    return np.asarray(places).reshape(-1, 3)[order][where], degrees, knots


def _after(pattern: re.Pattern, text: str, at: int) -> re.Match:
    """Match of a pattern at position `at`."""
    found = pattern.match(text, at)
    if found is None:
        raise ValueError("an argument that is not there")
    return found


def _knots(counts: list[str], values: list[str]) -> np.ndarray:
    """The knot vector on [0, 1] with these distinct knots and multiplicities."""
    if any(len(c.strip()) > 4 for c in counts):
        raise ValueError("a multiplicity of more than four digits")
    times, distinct = [int(c) for c in counts], [float(v) for v in values]
    if not all(1 <= n <= MAX_DEGREE + 1 for n in times) or not all(map(math.isfinite, distinct)):
        raise ValueError("a multiplicity that no spline has, or a knot that is not finite")
    t = np.repeat(distinct, times)
    with np.errstate(over="ignore"):
        length = t[-1] - t[0]
        return (t - t[0]) / length if 0 < length < math.inf else t


def _surface(poles: np.ndarray, degrees, knots, half=None) -> tuple[HeightField, Tensor]:
    """The height field with these poles (n, m, 3); half sizes from the poles unless given."""
    if min(poles.shape) < 2 or not (np.abs(poles) <= LENGTH).all():
        raise InputError(f"control points must be n x m x 3 numbers within +-{LENGTH:g} mm, n and m at least 2, got {poles.shape}")
    spaces = tuple(SplineSpace(p, torch.as_tensor(t)) for p, t in zip(degrees, knots, strict=True))
    half = half or (float(poles[-1, 0, 0]), float(poles[0, -1, 1]))
    if (spaces[0].n, spaces[1].n) != poles.shape[:2]:
        raise InputError(
            f"its knots and degrees belong to {spaces[0].n} x {spaces[1].n} control points, not {poles.shape[0]} x {poles.shape[1]}"
        )
    field = HeightField(spaces, half)
    x, y = (c.numpy() for c in field.control_xy())
    if (
        not min(half) > 0
        or not np.abs(poles[..., 0] - x[:, None]).max() <= SAME * half[0]
        or not np.abs(poles[..., 1] - y[None, :]).max() <= SAME * half[1]
    ):
        raise InputError(
            "is not a height field over an aperture centred on the axis: its control points must be at the"
            " Greville abscissae, rows along +x"
        )
    return field, torch.from_numpy(np.ascontiguousarray(poles[..., 2]))


def read_heights(path: Path, half_size: tuple[float, float]) -> tuple[HeightField, Tensor]:
    """Interpolating spline of heights on a regular grid over the aperture, borders included."""
    with open_npy(path, HEIGHTS) as stored:
        shape = stored.shape
        if len(shape) != 2 or stored.dtype.kind not in "fiu" or not 2 <= min(shape) <= max(shape) <= MAX_CONTROL:
            raise InputError(f"must be a 2-D array of heights in mm, 2 to {MAX_CONTROL} along each axis, got shape {shape}")
        z = stored.read_reals()
        if not (np.abs(z) <= LENGTH).all():
            raise InputError(f"must hold heights within +-{LENGTH:g} mm")
    return heightmaps.interpolated(z, half_size)


def read_heightmap(path: Path, half_size: tuple[float, float]) -> tuple[HeightField, Tensor]:
    """The surface of a height map and its JSON, over this aperture."""
    found = heightmaps.read_heightmap(path, half_size)
    with naming(path):
        return _of_this_size(found, half_size)


#: Reader of each suffix.
_READERS = {".npz": read_npz, ".step": read_step, ".stp": read_step, ".npy": read_heights} | dict.fromkeys(
    heightmaps.SUFFIXES, read_heightmap
)
