"""Reader of tabulated intensity distributions: text of two columns, degrees from the axis and relative intensity."""

from __future__ import annotations

import math
import re

from caustic_cli.errors import InputError
from caustic_cli.scene.sources.distribution import MOST_ANGLES, Distribution

#: Largest file read.
MOST_BYTES = 1 << 24
TABLE = "a .csv of two columns is needed: degrees from +z, ascending from 0, and relative intensity"


def parse_distribution(data: bytes, where: str) -> Distribution:
    """Parse the contents of a file: a header line is optional; columns are separated by commas, semicolons or blanks; # begins a
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
