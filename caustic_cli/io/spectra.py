"""Reader of the spectra of sources: a built-in name, or text of two columns, wavelength in nm and relative power per nm."""

from __future__ import annotations

import math
import re

from caustic_cli.errors import InputError
from caustic_cli.io.files import naming
from caustic_cli.scene.spectrum import MOST_ROWS, Spectrum

#: Largest file read.
MOST_BYTES = 1 << 22
TABLE = "a .csv of two columns is needed: wavelength in nm, ascending, and relative power per nm"


def parse_spectrum(data: bytes, where: str) -> Spectrum:
    """Parse the contents of a file: a header line is optional; columns are separated by commas, semicolons or blanks; # begins a
    comment.

    Raises:
        InputError: naming `where` and the line.
    """
    text = _text(data, where)
    rows: list[tuple[float, float]] = []
    named = False
    for number, line in enumerate(text.splitlines(), 1):
        cells = [c for c in re.split(r"[,;\s]+", line.partition("#")[0].strip(), maxsplit=2) if c]
        if not cells:
            continue
        values = [_number(c) for c in cells]
        if not rows and not named and all(v is None for v in values):
            named = True
            continue
        rows.append(_row(values, f"{where}: line {number} is {line.strip()!r}"))
        if len(rows) > MOST_ROWS:
            raise InputError(f"{where}: has more than {MOST_ROWS:,} wavelengths; {TABLE}")
    if len(rows) < 2:
        raise InputError(f"{where}: has {'one wavelength' if rows else 'no wavelengths'}, at least 2 are needed; {TABLE}")
    with naming(where):
        return Spectrum(where, *zip(*rows, strict=True))


def _row(values: list[float | None], where: str) -> tuple[float, float]:
    """Wavelength and power of a row."""
    if len(values) != 2 or None in values:
        raise InputError(f"{where}; {TABLE}")
    wavelength, power = values
    if not (math.isfinite(wavelength) and math.isfinite(power) and power >= 0):
        raise InputError(f"{where}; finite numbers are needed, and a power of at least 0")
    return wavelength, power


def _text(data: bytes, where: str) -> str:
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise InputError(f"{where}: is not text; {TABLE}") from error
    if "\0" in text:
        raise InputError(f"{where}: is not text; {TABLE}")
    return text


def _number(cell: str) -> float | None:
    try:
        return float(cell)
    except ValueError:
        return None
