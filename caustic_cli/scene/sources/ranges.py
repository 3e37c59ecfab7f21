"""Ranges of what sources are made of, by the keys of [source] that say it."""

from __future__ import annotations

from collections.abc import Sequence

from caustic_cli.errors import InputError
from caustic_cli.scene import checks
from caustic_cli.scene.sources.distribution import Distribution

#: uniform: the same power into every solid angle; lambertian: proportional to the cosine from +z.
INTENSITIES = ("uniform", "lambertian")


def power(value) -> None:
    """Of the whole source, W."""
    checks.number("[source] power", value, 0.0, checks.POWER, open_low=True)


def position(value) -> tuple[float, float, float]:
    """(x, y, z), mm."""
    where = "[source] position"
    if isinstance(value, str) or not isinstance(value, Sequence) or len(value) != 3:
        raise InputError(f"{where} must be three numbers x, y, z in mm, got {value!r}")
    return tuple(checks.number(where, v, -1e12, 1e12) for v in value)


def size(value) -> None:
    """Full widths along x and y, mm."""
    checks.pair("[source] size", value, lambda w, x: checks.number(w, x, 0.0, 1e9))


def cone(value: float | None) -> None:
    """Half-angle, degrees."""
    if value is not None:
        checks.number("[source] cone", value, 1e-9, 90.0)


def intensity(value: str | Distribution) -> None:
    """One of INTENSITIES, or a table."""
    if not isinstance(value, Distribution) and value not in INTENSITIES:
        raise InputError(f"[source] intensity must be one of {', '.join(INTENSITIES)}, or a .csv file, got {value!r}")
