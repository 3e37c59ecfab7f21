"""Lens surfaces from files, to begin a design from or to render: `.npz` and `.step` as exported, `.npy` of heights.

Everything is mm in the scene's coordinates: heights above z = 0, aperture centred on the axis.
"""

from __future__ import annotations

import re
import zipfile
from pathlib import Path

import numpy as np
import torch
from scipy.interpolate import RectBivariateSpline
from torch import Tensor

from caustic_cli.config.table import TABLE
from caustic_cli.errors import InputError
from caustic_cli.optics.bspline import SplineSpace
from caustic_cli.optics.surfaces.heightfield import HeightField

#: Most control points along one axis of a surface.
MAX_CONTROL = int(TABLE["lens.control"].high)
#: Kinds of file, by suffix.
SUFFIXES = (".npz", ".step", ".stp", ".npy")
#: Relative difference up to which two lengths, or poles and Greville abscissae, are the same.
SAME = 1e-9

_POINT = re.compile(r"(#\d+)\s*=\s*CARTESIAN_POINT\s*\(\s*'[^']*'\s*,\s*\(([^()]*)\)\s*\)\s*;")
_SURFACE = re.compile(
    r"B_SPLINE_SURFACE_WITH_KNOTS\s*\(\s*'[^']*'\s*,\s*(\d+)\s*,\s*(\d+)\s*,\s*\(((?:\s*\([#\d,\s]*\)\s*,?)+)\)"
    r"\s*,[^()]*,\s*\(([\d,\s]*)\)\s*,\s*\(([\d,\s]*)\)\s*,\s*\(([^()]*)\)\s*,\s*\(([^()]*)\)\s*,"
)


def read_surface(path: str | Path, half_size: tuple[float, float]) -> tuple[HeightField, Tensor]:
    """The surface in a file and its control heights (n, m) mm float64.

    Args:
        half_size: (r_x, r_y) mm of the aperture it must fill.  A `.npy` of heights (a, b) mm, [i, j] with i along +x, is laid
            over it, borders included, and interpolated by a spline.

    Raises:
        InputError: no such file, it holds no such surface, or one of another size.
    """
    path = Path(path)
    if not path.is_file():
        raise InputError(f"{path}: no such file; a lens surface is needed: {', '.join(SUFFIXES)}")
    if path.suffix.lower() not in SUFFIXES:
        raise InputError(f"{path}: a lens surface is read from {', '.join(SUFFIXES)}")
    if path.suffix.lower() == ".npy":
        return _read_heights(path, half_size)
    found = read_npz(path) if path.suffix.lower() == ".npz" else read_step(path)
    if any(abs(a - b) > SAME * b for a, b in zip(found[0].half_size, half_size, strict=True)):
        wide, high = (2.0 * r for r in found[0].half_size)
        raise InputError(
            f"{path}: the lens is {wide:g} x {high:g} mm, not {2 * half_size[0]:g} x {2 * half_size[1]:g} mm;"
            " ⟨lens_size⟩ must be its own"
        )
    return found


def onto(field: HeightField, heights: Tensor, net: HeightField) -> Tensor:
    """Control heights of the same surface on another net: exact where that holds all its knots, else interpolated."""
    tu, tv = (a.change_of_basis(b) for a, b in zip(field.spaces, net.spaces, strict=True))
    return tu @ heights @ tv.T


def load_npz(path: Path) -> dict[str, np.ndarray]:
    """All arrays of an archive.

    Raises:
        InputError: it cannot be read.
    """
    try:
        with np.load(path, allow_pickle=False) as archive:
            return dict(archive)
    except (OSError, ValueError, EOFError, zipfile.BadZipFile, AttributeError) as error:
        raise InputError(f"{path}: is not a readable .npz archive of plain arrays") from error


def read_npz(path: Path) -> tuple[HeightField, Tensor]:
    """The exact B-spline of an archive made by `caustic export format lighttools`."""
    return surface_of(load_npz(path), path)


def surface_of(data: dict[str, np.ndarray], path: Path) -> tuple[HeightField, Tensor]:
    """The surface that an archive's arrays describe.

    Raises:
        InputError: something is missing or not a surface; `path` is named.
    """
    missing = [key for key in ("control_points", "degrees", "knots_u", "knots_v", "lens_half_size") if key not in data]
    if missing:
        raise InputError(f"{path}: has no {', '.join(missing)}; an archive of caustic export ⟨format⟩ lighttools is needed")
    degrees, half = data["degrees"], data["lens_half_size"]
    if degrees.shape != (2,) or half.shape != (2,) or degrees.dtype.kind not in "iu" or not np.isfinite(half).all():
        raise InputError(f"{path}: degrees must be two whole numbers and lens_half_size two lengths in mm")
    return _surface(
        path, data["control_points"], [int(p) for p in degrees], (data["knots_u"], data["knots_v"]), tuple(float(h) for h in half)
    )


def read_step(path: Path) -> tuple[HeightField, Tensor]:
    """The one B-spline surface of a STEP file whose poles stand at the Greville abscissae, in millimetres.

    Raises:
        InputError: there is none or more than one, it is no such height field, or the unit is another.
    """
    try:
        text = path.read_text("latin-1")
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}); a STEP file is needed") from error
    if "ISO-10303-21" not in text[:1000]:
        raise InputError(f"{path}: is not a STEP file, which begins with ISO-10303-21")
    if not re.search(r"SI_UNIT\s*\(\s*\.MILLI\.\s*,\s*\.METRE\.\s*\)", text):
        raise InputError(f"{path}: its lengths are not millimetres")
    surfaces = _SURFACE.findall(text)
    if len(surfaces) != 1 or "RATIONAL_B_SPLINE_SURFACE" in text:
        raise InputError(f"{path}: must hold one B-spline surface, not rational, got {len(surfaces)} plain ones")
    p, q, net, *numbers = surfaces[0]
    try:
        points = {name: [float(v) for v in at.split(",")] for name, at in _POINT.findall(text)}
        rows = [[points[name] for name in re.findall(r"#\d+", row)] for row in re.findall(r"\(([^()]*)\)", net)]
        counts = [[int(v) for v in part.split(",")] for part in numbers[:2]]
        values = [[float(v) for v in part.split(",")] for part in numbers[2:]]
        knots = [np.repeat(v, c) for v, c in zip(values, counts, strict=True)]
        poles = np.array(rows, dtype=float)
    except (KeyError, ValueError) as error:
        raise InputError(f"{path}: its B-spline surface is damaged") from error
    knots = [(t - t[0]) / (t[-1] - t[0]) if len(t) and t[-1] > t[0] else t for t in knots]
    return _surface(path, poles, [int(p), int(q)], knots)


def _surface(path: Path, poles: np.ndarray, degrees: list[int], knots, half=None) -> tuple[HeightField, Tensor]:
    """The height field with these poles (n, m, 3); its half widths from the poles unless given."""
    if poles.ndim != 3 or poles.shape[2] != 3 or poles.dtype.kind != "f" or not np.isfinite(poles).all():
        raise InputError(f"{path}: control points must be finite numbers of shape n x m x 3, got {poles.shape}")
    if max(poles.shape[:2]) > MAX_CONTROL:
        raise InputError(f"{path}: has {poles.shape[0]} x {poles.shape[1]} control points; at most {MAX_CONTROL} a side are read")
    try:
        spaces = tuple(SplineSpace(p, torch.as_tensor(np.asarray(t, float))) for p, t in zip(degrees, knots, strict=True))
    except InputError as error:
        raise InputError(f"{path}: {error}") from error
    half = half or (float(poles[-1, 0, 0]), float(poles[0, -1, 1]))
    if (spaces[0].n, spaces[1].n) != poles.shape[:2]:
        raise InputError(
            f"{path}: its knots and degrees belong to {spaces[0].n} x {spaces[1].n} control points,"
            f" not {poles.shape[0]} x {poles.shape[1]}"
        )
    field = HeightField(spaces, half)
    x, y = (c.numpy() for c in field.control_xy())
    if (
        not min(half) > 0
        or np.abs(poles[..., 0] - x[:, None]).max() > SAME * half[0]
        or np.abs(poles[..., 1] - y[None, :]).max() > SAME * half[1]
    ):
        raise InputError(
            f"{path}: is no height field over an aperture centred on the axis: its control points must stand at the"
            " Greville abscissae, rows along +x"
        )
    return field, torch.from_numpy(np.ascontiguousarray(poles[..., 2], dtype=np.float64))


def _read_heights(path: Path, half_size: tuple[float, float]) -> tuple[HeightField, Tensor]:
    """The spline through heights on an even grid over the aperture, borders included."""
    try:
        z = np.load(path, allow_pickle=False)
    except (OSError, ValueError, EOFError) as error:
        raise InputError(f"{path}: is not a readable .npy array; a 2-D one of heights in mm is needed") from error
    if z.ndim != 2 or z.dtype.kind not in "fiu" or not np.isfinite(z).all() or not 2 <= min(z.shape) <= max(z.shape) <= MAX_CONTROL:
        raise InputError(
            f"{path}: must be a 2-D array of finite heights in mm, 2 to {MAX_CONTROL} along each axis, got shape {z.shape}"
        )
    degrees = [min(3, n - 1) for n in z.shape]
    lines = [np.linspace(0.0, 1.0, n) for n in z.shape]
    spline = RectBivariateSpline(*lines, z.astype(float), kx=degrees[0], ky=degrees[1], s=0)
    spaces = tuple(SplineSpace(p, torch.from_numpy(t)) for p, t in zip(degrees, spline.get_knots(), strict=True))
    heights = torch.from_numpy(spline.get_coeffs().reshape(z.shape))
    return HeightField(spaces, tuple(half_size)), heights
