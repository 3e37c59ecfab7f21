"""Reader of the spectra of sources: a built-in name, or text of two columns, wavelength in nm and relative power per nm."""

from __future__ import annotations

import math
import re
from pathlib import Path

from caustic_cli.errors import InputError
from caustic_cli.io.files import naming, read_bytes
from caustic_cli.scene.spectrum import MOST_ROWS, Spectrum, built_in

#: Largest file read.
MOST_BYTES = 1 << 22
TABLE = "a .csv of two columns is needed: wavelength in nm, ascending, and relative power per nm"


def spectrum_of(name_or_path: str | Path, directory: Path | None = None) -> Spectrum:
    """The spectrum of a built-in name, or of a file whose name ends in .csv, relative to `directory`.

    Raises:
        InputError: there is none of that name, or the file cannot be read or holds no spectrum.
    """
    if Path(name_or_path).suffix.lower() != ".csv":
        return built_in(str(name_or_path))
    path = Path(directory or ".") / name_or_path
    return parse_spectrum(read_bytes(path, MOST_BYTES, TABLE), str(path))


def parse_spectrum(data: bytes, where: str) -> Spectrum:
    """Parse the contents of a file: a header line is optional; columns are separated by commas, semicolons or blanks; # begins a
    comment.

    Raises:
        InputError: naming `where` and the line.
    """
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise InputError(f"{where}: is not text; {TABLE}") from error
    if "\0" in text:
        raise InputError(f"{where}: is not text; {TABLE}")
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
        if len(values) != 2 or None in values:
            raise InputError(f"{where}: line {number} is {line.strip()!r}; {TABLE}")
        wavelength, power = values
        if not (math.isfinite(wavelength) and math.isfinite(power) and power >= 0):
            raise InputError(f"{where}: line {number} is {line.strip()!r}; finite numbers are needed, and a power of at least 0")
        rows.append((wavelength, power))
        if len(rows) > MOST_ROWS:
            raise InputError(f"{where}: has more than {MOST_ROWS:,} wavelengths; {TABLE}")
    if len(rows) < 2:
        raise InputError(f"{where}: has {'one wavelength' if rows else 'no wavelengths'}, at least 2 are needed; {TABLE}")
    with naming(where):
        return Spectrum(where, *zip(*rows, strict=True))


def _number(cell: str) -> float | None:
    try:
        return float(cell)
    except ValueError:
        return None
