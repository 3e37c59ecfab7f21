"""Reader of height maps: a picture of heights and its JSON, as written by `export format heightmap`."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image
from torch import Tensor

from caustic_cli.errors import InputError
from caustic_cli.io.files import naming, open_regular, read_bytes
from caustic_cli.io.picture import undecoded
from caustic_cli.loading import OnDemand
from caustic_cli.optics.bspline import MAX_DEGREE, SplineSpace
from caustic_cli.optics.surfaces.heightfield import HeightField
from caustic_cli.schema.checks import LENGTH
from caustic_cli.schema.table import TABLE

interpolate = OnDemand("scipy.interpolate")
#: Suffixes of the pictures; largest value of a PNG; format version of the JSON.
SUFFIXES = (".png", ".tif", ".tiff")
COUNTS = 65535
VERSION = 1
#: Bytes of the JSON and of the picture; points of a map; control points of a net.
MOST_JSON, MOST_BYTES, MOST_POINTS = 1 << 20, 1 << 30, 50_000_000
MAX_CONTROL = int(TABLE["lens.control"].high)
#: Largest deviation, in quanta, of a map from the spline of its JSON: rounding is half a quantum, and for 1000 x 1000 points the
#: least-squares spline deviates by up to 0.87; an edited map deviates by many.
OFF = 1.5
ACCEPTED = "a height map of caustic export is needed: a 16-bit grey PNG or a TIFF of 32-bit floats, with its JSON beside it"


def beside(path: str | Path) -> Path:
    """Path of the JSON of a picture, NAME.png.json."""
    path = Path(path)
    return path.with_name(path.name + ".json")


def read_heightmap(path: Path, half_size: tuple[float, float]) -> tuple[HeightField, Tensor]:
    """The surface of a height map, in the coordinates of the scene: control heights (n, m) mm of the least-squares spline on the
    net of its JSON, or else of an interpolating cubic spline.

    Raises:
        InputError: the files are missing or invalid, or the heights deviate from a spline on that net by more than rounding.
    """
    header = _said(beside(path))
    with naming(path):
        values = _picture(path, header)
    with naming(beside(path)):
        z = header["z_of_zero"] + header["mm_per_count"] * values.astype(np.float64)[::-1].T  # [i, j], j along +y
        z = -z[:, ::-1] if header["turned"] else z
        if not (np.abs(z) <= LENGTH).all():
            raise InputError(f"must hold heights within +-{LENGTH:g} mm")
        half = -header["x_of_column_0"], header["y_of_row_0"]
        return fitted(z, half, header["spline"], OFF * header["quantum_mm"]) if "spline" in header else interpolated(z, half)


def interpolated(z: np.ndarray, half_size: tuple[float, float]) -> tuple[HeightField, Tensor]:
    """Interpolating spline of heights (a, b) mm on a regular grid over the aperture, borders included: cubic, or of lower
    degree."""
    if not 2 <= min(z.shape) <= max(z.shape) <= MAX_CONTROL:
        raise InputError(f"must have 2 to {MAX_CONTROL} heights along each axis, got {z.shape[0]} x {z.shape[1]}")
    return HeightField.through(z, half_size)


def fitted(z: np.ndarray, half_size: tuple[float, float], net: dict, off: float) -> tuple[HeightField, Tensor]:
    """Least-squares spline on a net for heights (a, b) mm on a regular grid.

    Raises:
        InputError: an invalid net, too few heights for it, or a deviation of more than `off` mm.
    """
    degrees, knots = net["degrees"], (net["knots_u"], net["knots_v"])
    spaces = tuple(SplineSpace(p, torch.tensor(t, dtype=torch.float64)) for p, t in zip(degrees, knots, strict=True))
    heights = z
    for space in spaces:  # along x, then along what was y
        at = np.linspace(0.0, 1.0, len(heights))
        try:
            heights = interpolate.make_lsq_spline(at, heights, space.knots.numpy(), space.degree).c.T
        except (ValueError, np.linalg.LinAlgError) as error:
            raise InputError(f"has too few heights for the net of {space.n} control points that it names") from error
    found, net_heights = HeightField(spaces, tuple(half_size)), torch.from_numpy(np.ascontiguousarray(heights))
    u, v = (s.matrix(torch.linspace(0.0, 1.0, n, dtype=torch.float64)) for s, n in zip(spaces, z.shape, strict=True))
    worst = float((u @ net_heights @ v.T - torch.from_numpy(np.ascontiguousarray(z))).abs().max())
    if worst > off:
        raise InputError(
            f"its heights are up to {worst:.3g} mm off the spline of the net that it names, more than rounding:"
            ' of a map that has been edited, leave out "spline"'
        )
    return found, net_heights


def _said(path: Path) -> dict[str, Any]:
    """The contents of the JSON, validated."""
    data = read_bytes(path, MOST_JSON, ACCEPTED)
    with naming(path):
        try:
            header = json.loads(data)
        except (ValueError, RecursionError) as error:
            raise InputError(f"is no JSON ({error}); {ACCEPTED}") from error
        if not isinstance(header, dict) or header.get("height_map") != VERSION or header.get("unit") != "mm":
            raise InputError(f"does not describe a height_map {VERSION} in mm; {ACCEPTED}")
        for key in ("z_of_zero", "mm_per_count", "quantum_mm", "x_of_column_0", "y_of_row_0"):
            if not _is_length(value := header.get(key)):
                raise InputError(f"{key} must be a number within +-{LENGTH:g}, got {value!r}")
        if not (header["x_of_column_0"] < 0 < header["y_of_row_0"] and header["quantum_mm"] > 0):
            raise InputError("x_of_column_0 must be below 0, y_of_row_0 and quantum_mm above")
        if not isinstance(header.get("turned"), bool):
            raise InputError("turned must be true or false")
        if "spline" in header:
            _check_net(header["spline"])
        return header


def _is_length(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value) and abs(value) <= LENGTH


def _check_net(net: object) -> None:
    good = isinstance(net, dict) and isinstance(net.get("degrees"), list) and len(net["degrees"]) == 2
    if good:
        for p, key in zip(net["degrees"], ("knots_u", "knots_v"), strict=True):
            t = net.get(key)
            good &= isinstance(p, int) and not isinstance(p, bool) and 1 <= p <= MAX_DEGREE
            good &= isinstance(t, list) and len(t) <= MAX_CONTROL + MAX_DEGREE + 1
            good = good and all(isinstance(v, int | float) and not isinstance(v, bool) and 0 <= v <= 1 for v in t)
    if not good:
        raise InputError("spline must have degrees of two whole numbers, and knots_u and knots_v of numbers 0 to 1")


def _picture(path: Path, header: dict) -> np.ndarray:
    """Values of the picture (rows, columns)."""
    with open_regular(path, ACCEPTED, MOST_BYTES) as file:
        try:
            with Image.open(file, formats=("PNG", "TIFF")) as image:
                size, mode = image.size, image.mode
                if list(size) != [header.get("columns"), header.get("rows")] or math.prod(size) > MOST_POINTS:
                    raise InputError(f"has {size[0]} x {size[1]} pixels, not those of its JSON, or too many; {ACCEPTED}")
                if mode not in ("I;16", "I;16B", "I", "F"):
                    raise InputError(f"has pixels of kind {mode}; {ACCEPTED}")
                return np.asarray(image)
        except (OSError, SyntaxError, ValueError, Image.DecompressionBombError) as error:
            if isinstance(error, InputError):
                raise
            raise InputError(f"{undecoded(error, 'a PNG or TIFF')}; {ACCEPTED}") from error
