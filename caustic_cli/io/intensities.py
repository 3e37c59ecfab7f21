"""Reader of tabulated intensity distributions: text of two columns, degrees from the axis and relative intensity, or a photometric
file that is symmetric about its axis."""

from __future__ import annotations

import math
import re

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from caustic_cli.errors import InputError
from caustic_cli.io.photometry import SUFFIXES, Photometry, parse_photometry
from caustic_cli.scene.sources.distribution import MOST_ANGLES, Distribution

#: Largest file read.
MOST_BYTES = 1 << 24
TABLE = (
    "a .csv of two columns is needed, degrees from +z, ascending from 0, and relative intensity, or a photometric file, .ies or"
    " .ldt"
)
#: Largest difference of the planes of a symmetric photometric file from their mean within one step of the angle, over its peak.
SYMMETRIC = 0.05


def parse_distribution(data: bytes, where: str) -> Distribution:
    """Parse the contents of a file, by the suffix of its name.

    Raises:
        InputError: naming `where`.
    """
    if where.lower().endswith(SUFFIXES):
        return _mean(parse_photometry(data, where), where)
    return _table(data, where)


def _mean(light: Photometry, where: str) -> Distribution:
    """The mean over the planes of a photometric file.

    Raises:
        InputError: they differ.
    """
    values = light.values.mean(0)
    around = sliding_window_view(np.pad(values, 1, mode="edge"), 3)  # an edge may run within one step of the angle
    beyond = np.maximum(light.values - around.max(1), around.min(1) - light.values)
    off = float(beyond.max()) / max(float(values.max()), 1e-300)
    if off > SYMMETRIC:
        raise InputError(
            f"{where}: its planes C differ by {off:.0%} of the peak, and the intensity of a source depends on the angle to its axis"
            " alone; a file that is symmetric about the axis is needed"
        )
    try:
        return Distribution(tuple(light.angles.tolist()), tuple(values.clip(0.0).tolist()))
    except InputError as error:
        raise InputError(f"{where}: {error}") from error


def _table(data: bytes, where: str) -> Distribution:
    """Parse text: a header line is optional; columns are separated by commas, semicolons or blanks; # begins a
    comment.

    Raises:
        InputError: naming `where` and the line.
    """
    try:
        lines = data.decode("utf-8-sig").splitlines()
    except UnicodeDecodeError as error:
        raise InputError(f"{where}: is not text; {TABLE}") from error
    rows: list[tuple[float, float]] = []
    named = False
    for number, line in enumerate(lines, 1):
        cells = [c for c in re.split(r"[,;\s]+", line.partition("#")[0].strip(), maxsplit=2) if c]
        if not cells:
            continue
        row = _numbers(cells)
        if row is None and not rows and not named and not any(map(_number, cells)):
            named = True
            continue
        if row is None:
            raise InputError(f"{where}: line {number} is {line.strip()!r}; {TABLE}")
        rows.append(row)
        if len(rows) > MOST_ANGLES:
            raise InputError(f"{where}: has more than {MOST_ANGLES:,} angles; {TABLE}")
    if not rows:
        raise InputError(f"{where}: has no angles; {TABLE}")
    try:
        return Distribution(*(tuple(column) for column in zip(*rows, strict=True)))
    except InputError as error:
        raise InputError(f"{where}: {error}") from error


def _numbers(cells: list[str]) -> tuple[float, float] | None:
    values = [_number(c) for c in cells]
    return None if len(values) != 2 or None in values else (values[0], values[1])


def _number(cell: str) -> float | None:
    try:
        value = float(cell)
    except ValueError:
        return None
    return value if math.isfinite(value) else None
