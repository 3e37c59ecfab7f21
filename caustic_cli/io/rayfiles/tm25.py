"""Reader of IES TM-25 ray files (ANSI/IES TM-25-13 and -20), `.tm25ray`: little-endian, floats of 32 bits, mm, nm.

    offset  0   "TM25", int32 version (2013 or 2020), int32 method of creation
           12   float32 luminous flux, lm; float32 radiant flux, W; uint64 number of rays
           28   28 bytes date, int32 where rays start
           60   int32 spectrum: 0 none, 1 one wavelength, 2 each ray its own, 3 one table, 4 each ray a table's number
           64   float32 wavelength, least and greatest, nm
           76   int32 number of tables, of additional columns, and bytes of additional text; zeros to 256
          256   8 int32, each 0 or 1: position, direction, radiant flux, wavelength, luminous flux, Stokes, tristimulus,
                table number
          288   9 texts of 1000 UTF-32 characters
        36288   tables: int32 N, N pairs (float32 nm, float32 weight); zeros to a multiple of 32 bytes
                512 bytes for the name of each additional column; the additional text
                rays, one after another, all float32: x y z, unit k, W, nm, lm, 3 Stokes and 3 ellipse, 2 tristimulus, table
                number, each if its flag is set, and the additional columns

Unknown quantities are 0 or NaN.
"""

from __future__ import annotations

import struct
from typing import NamedTuple

import numpy as np

from caustic_cli.errors import InputError
from caustic_cli.io.rayfiles.binary import ray_table
from caustic_cli.scene.sources.rayset import RaySet

MAGIC = b"TM25"
VERSIONS = (2013, 2020)
#: Bytes before the tables, their unit of padding, and of a column's name.
HEADER, BLOCK, NAME = 36_288, 32, 512
MOST_TABLES = 10_000
#: What a ray may consist of, in the order of the flags, with its numbers of columns.
COLUMNS = {
    "position": 3,
    "direction": 3,
    "radiant flux": 1,
    "wavelength": 1,
    "luminous flux": 1,
    "Stokes": 6,
    "tristimulus": 2,
    "table number": 1,
}


def begins(data: bytes) -> bool:
    """Whether the data are of this format."""
    return data.startswith(MAGIC)


class _Header(NamedTuple):
    """What a header declares."""

    #: Of all rays, lm and W.
    lumens: float
    watts: float
    rays: int
    #: Identifier of spectral data, 0 to 4, and the single wavelength, nm.
    spectrum: int
    wavelength: float
    #: Numbers of spectral tables and of additional columns, and bytes of additional text.
    tables: int
    more: int
    text: int
    #: Names of the columns that the rays have.
    columns: frozenset[str]


def parse(data: bytes) -> RaySet:
    """Parse the contents of a file.

    Raises:
        InputError: it is invalid.
    """
    header = _header(data)
    start = _after_tables(data, header.tables) + NAME * header.more + header.text
    widths = [n if name in header.columns else 0 for name, n in COLUMNS.items()]
    table = ray_table(data, start, header.rays, sum(widths) + header.more)
    at = dict(zip(COLUMNS, np.cumsum([0, *widths]).tolist(), strict=False))
    flux, total, unit = "luminous flux", header.lumens, "lm"
    if "radiant flux" in header.columns:
        flux, total, unit = "radiant flux", header.watts, "W"
    wavelengths = table[:, at["wavelength"]] if "wavelength" in header.columns else None
    if header.spectrum == 1:
        if not header.wavelength > 0:
            raise InputError(f"declares a single wavelength of {header.wavelength:g} nm")
        wavelengths = np.full(header.rays, header.wavelength)
    return RaySet(table[:, 0:3], table[:, 3:6], table[:, at[flux]], total if np.isfinite(total) else 0.0, unit, wavelengths)


def _header(data: bytes) -> _Header:
    """The header, validated; errors as of `parse`."""
    if len(data) < HEADER:
        raise InputError(f"is cut off: the header of TM-25 is {HEADER:,} bytes, the file {len(data):,}")
    version, _, lumens, watts, rays = struct.unpack_from("<iiffQ", data, 4)
    if version not in VERSIONS:
        swapped = struct.unpack_from(">i", data, 4)[0] in VERSIONS
        raise InputError(
            "has its bytes in big-endian order; TM-25 is little-endian"
            if swapped
            else f"is TM-25 of version {version}; 2013 and 2020 are read"
        )
    spectrum, single = struct.unpack_from("<if", data, 60)
    tables, more, text = struct.unpack_from("<iii", data, 76)
    flags = struct.unpack_from("<8i", data, 256)
    if not 0 <= spectrum <= 4:
        raise InputError(f"has a spectral data identifier of {spectrum}; TM-25 defines 0 to 4")
    if min(tables, more, text) < 0 or tables > MOST_TABLES:
        raise InputError(
            f"counts {tables} spectral tables, {more} additional columns and {text} bytes of text; none may be"
            f" negative, and tables at most {MOST_TABLES:,}"
        )
    columns = _columns(flags)
    if spectrum == 2 and "wavelength" not in columns:
        raise InputError("declares a wavelength for each ray, but has no column for it")
    return _Header(lumens, watts, rays, spectrum, single, tables, more, text, columns)


def _columns(flags: tuple[int, ...]) -> frozenset[str]:
    """What the rays consist of; errors as of `parse`."""
    for name, flag in zip(COLUMNS, flags, strict=True):
        if flag not in (0, 1):
            raise InputError(f"has a {name} flag of {flag}; 0 or 1 is needed")
    columns = frozenset(name for name, flag in zip(COLUMNS, flags, strict=True) if flag)
    if not {"position", "direction"} <= columns:
        raise InputError("declares rays without position or direction; both are needed")
    if not {"radiant flux", "luminous flux"} & columns:
        raise InputError("declares rays with neither radiant nor luminous flux; one is needed")
    return columns


def _after_tables(data: bytes, tables: int) -> int:
    """Offset of what follows the spectral tables and their padding."""
    at = HEADER
    for k in range(tables):
        if at + 4 > len(data):
            raise InputError(f"is cut off in spectral table {k + 1} of {tables}")
        (pairs,) = struct.unpack_from("<i", data, at)
        if pairs <= 0 or at + 4 + 8 * pairs > len(data):
            raise InputError(f"counts {pairs} wavelengths in spectral table {k + 1} of {tables}, which its size does not hold")
        at += 4 + 8 * pairs
    return at + -(at - HEADER) % BLOCK
