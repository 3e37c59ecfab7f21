"""Reader of LightTools ray files in text format, `.ray` and `.txt`: comments after #, lines `lt_name: value`, then one ray per
line.

    lt_rdf_version: 2.0
    lt_datatype: radiant_power            or luminous_flux
    lt_radiant_flux: 1                    or lt_luminous_flux: of all rays, W or lm
    lt_far_field_data: NO
    lt_color_info: none                   or wavelength
    lt_length_units: millimeters
    lt_data_origin: 0 0 0
    lt_startofdata
    x y z  L M N  flux [wavelength, nm] [more columns, such as Stokes parameters]
    lt_endofdata

Names are case-insensitive.
"""

from __future__ import annotations

import io
import re

import numpy as np

from caustic_cli.errors import InputError
from caustic_cli.scene.sources.rayset import RaySet

BEGIN, END = b"lt_startofdata", b"lt_endofdata"
#: Bytes within which the rays must begin.
HEADER = 1 << 16
MILLIMETRES = {
    "millimeters": 1.0,
    "mm": 1.0,
    "centimeters": 10.0,
    "cm": 10.0,
    "meters": 1000.0,
    "m": 1000.0,
    "micrometers": 1e-3,
    "microns": 1e-3,
    "um": 1e-3,
    "inches": 25.4,
    "in": 25.4,
    "feet": 304.8,
    "ft": 304.8,
}
FLUXES = {
    "radiant_power": ("W", "radiant_flux"),
    "radiant_flux": ("W", "radiant_flux"),
    "luminous_flux": ("lm", "luminous_flux"),
    "luminous_power": ("lm", "luminous_flux"),
}
#: Most columns of a ray: position, direction, flux, wavelength and Stokes parameters, and as many again.
MOST_COLUMNS = 24


def begins(data: bytes) -> bool:
    """Whether the data are of this format."""
    head = data[:HEADER].lower()
    return b"\0" not in head and re.search(rb"^[ \t]*lt_", head, re.MULTILINE) is not None


def parse(data: bytes) -> RaySet:
    """Parse the contents of a file.

    Raises:
        InputError: it is invalid.
    """
    start = data[:HEADER].lower().find(BEGIN)
    if start < 0:
        raise InputError(f"has no line {BEGIN.decode()} within its first {HEADER:,} bytes")
    header = _header(data[:start])
    unit = header.get("length_units", "millimeters").lower()
    if unit not in MILLIMETRES:
        raise InputError(f"has lt_length_units {unit!r}; one of {', '.join(MILLIMETRES)} is needed")
    kind = header.get("datatype", "radiant_power").lower()
    if kind not in FLUXES:
        raise InputError(f"has lt_datatype {kind!r}; radiant_power or luminous_flux is needed")
    if header.get("far_field_data", "no").lower() not in ("no", "0", "false"):
        raise InputError("has far-field data, whose rays start nowhere; lt_far_field_data must be NO")
    if any(float(v) != 0 for v in _numbers(header.get("data_origin", "0 0 0"), "lt_data_origin")):
        raise InputError("has an lt_data_origin that is not 0 0 0; ⟨source_position⟩ moves a source")
    colored = header.get("color_info", "none").lower()
    if colored not in ("none", "wavelength"):
        raise InputError(f"has lt_color_info {colored!r}; none or wavelength is needed")
    first = data.find(b"\n", start) + 1
    lower = data[-256:].lower()
    last = lower.rfind(END)
    stop = len(data) if last < 0 else len(data) - len(lower) + last
    least = 8 if colored == "wavelength" else 7
    table = _rows(data, first, stop, least) if first else np.zeros((0, least))
    unit_of_flux, key = FLUXES[kind]
    totals = _numbers(header.get(key, "0"), f"lt_{key}")
    return RaySet(
        MILLIMETRES[unit] * table[:, 0:3],
        table[:, 3:6],
        table[:, 6],
        totals[0],
        unit_of_flux,
        table[:, 7] if colored == "wavelength" else None,
    )


def _header(data: bytes) -> dict[str, str]:
    """Values of the header by their names without lt_."""
    header = {}
    for line in data.decode("ascii", "replace").splitlines():
        name, colon, value = line.partition("#")[0].strip().partition(":")
        if colon and name.lower().startswith("lt_"):
            header[name.lower()[3:].strip()] = value.strip()
    return header


def _numbers(text: str, name: str) -> list[float]:
    try:
        found = [float(v) for v in text.split()]
    except ValueError:
        found = []
    if not found or not np.isfinite(found).all():
        raise InputError(f"has {name} {text!r}; a number is needed")
    return found


def _rows(data: bytes, first: int, stop: int, least: int) -> np.ndarray:
    """Rays as a table, (N, at least `least` columns)."""
    head = (line.partition(b"#")[0].split() for line in data[first : min(stop, first + HEADER)].splitlines())
    line = next(filter(None, head), [])
    if not line:
        raise InputError("holds no rays; at least one is needed")
    if not least <= len(line) <= MOST_COLUMNS:
        raise InputError(f"has {len(line)} columns in its first ray; {least} to {MOST_COLUMNS} are needed")
    try:
        return np.loadtxt(io.BytesIO(data[first:stop]), dtype=np.float64, usecols=range(least), ndmin=2, encoding="latin1")
    except (ValueError, IndexError) as error:
        raise InputError(f"has rays that are not {least} numbers in a line ({str(error).splitlines()[0][:120]})") from error
