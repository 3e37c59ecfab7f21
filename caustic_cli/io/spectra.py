"""Reader of the spectra of sources: a built-in name, or text of two columns, wavelength in nm and relative power per nm."""

from __future__ import annotations

import math

from caustic_cli.errors import InputError
from caustic_cli.io.columns import rows_of
from caustic_cli.io.files import naming
from caustic_cli.scene.spectrum import MOST_ROWS, Spectrum

#: Largest file read.
MOST_BYTES = 1 << 22
TABLE = "a .csv of two columns is needed: wavelength in nm, ascending, and relative power per nm"


def parse_spectrum(data: bytes, where: str) -> Spectrum:
    """Parse the contents of a file, see `columns`.

    Raises:
        InputError: naming `where` and the line.
    """
    rows: list[tuple[float, float]] = []
    for wavelength, power, line in rows_of(data, where, TABLE, "wavelengths", MOST_ROWS):
        if not (math.isfinite(wavelength) and math.isfinite(power) and power >= 0):
            raise InputError(f"{line}; finite numbers are needed, and a power of at least 0")
        rows.append((wavelength, power))
    if len(rows) < 2:
        raise InputError(f"{where}: has {'one wavelength' if rows else 'no wavelengths'}, at least 2 are needed; {TABLE}")
    with naming(where):
        return Spectrum(where, *zip(*rows, strict=True))
