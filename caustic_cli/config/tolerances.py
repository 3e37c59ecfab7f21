"""Reading of tolerances.toml, see `scene.tolerances`.

draws = 200                     # and seed = 0
[throw]                         # one section for each error of KINDS
sigma = 1.0                     # normal, or half_width = 1.0 for uniform; a pair [x, y] where there are two axes
[form_error]                    # rms, exponent, longest, shortest
[waviness]                      # amplitude, period, direction
"""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

from caustic_cli.config.settings import read_text, toml_of
from caustic_cli.errors import InputError, near
from caustic_cli.scene.tolerances import KINDS, NORMAL, UNIFORM, FormError, Tolerance, Tolerances, Waviness

SURFACES: dict[str, tuple[str, type]] = {"form_error": ("form", FormError), "waviness": ("waviness", Waviness)}
KEYS = ("draws", "seed")


def parse(text: str, where: str) -> Tolerances:
    """Tolerances from TOML text.

    Raises:
        InputError: naming `where` and the offending key.
    """
    raw = toml_of(text, where)
    try:
        return _built(raw)
    except InputError as error:
        raise InputError(f"{where}: {error}") from error


def read(path: Path) -> Tolerances:
    """Tolerances from a TOML file.

    Raises:
        InputError: the file is missing, too large or not text, or `parse` rejects it.
    """
    return parse(read_text(path), str(path))


def _built(raw: dict[str, Any]) -> Tolerances:
    given: dict[str, Any] = {key: raw.pop(key) for key in KEYS if key in raw}
    errors = []
    for name, table in raw.items():
        if name not in {**KINDS, **SURFACES}:
            raise InputError(f"[{name}] is not an error{near(name, [*KINDS, *SURFACES, *KEYS])}")
        if not isinstance(table, dict):
            raise InputError(f"{name} must be a section, written [{name}]")
        if name in SURFACES:
            key, kind = SURFACES[name]
            given[key] = _surface(name, table, kind)
        else:
            errors.append(_error(name, table))
    return Tolerances(tuple(errors), **given)


def _error(name: str, table: dict[str, Any]) -> Tolerance:
    if len(table) != 1 or not table.keys() <= {NORMAL, UNIFORM}:
        raise InputError(
            f"[{name}] must say {NORMAL} (normal) or {UNIFORM} (uniform), one of them, got {', '.join(table) or 'nothing'}"
        )
    ((distribution, width),) = table.items()
    values = width if isinstance(width, list) else [width] * len(KINDS[name].axes)
    for value in values:
        if isinstance(value, bool) or not isinstance(value, int | float):
            raise InputError(f"[{name}] {distribution} must be a number or a pair of numbers, got {width!r}")
    return Tolerance(name, distribution, tuple(float(v) for v in values))


def _surface(name: str, table: dict[str, Any], kind: type):
    fields = {f.name: f for f in dataclasses.fields(kind)}
    for key in table:
        if key not in fields:
            raise InputError(f"[{name}] {key} is not a key{near(key, fields)}")
    for key, field in fields.items():
        if field.default is dataclasses.MISSING and key not in table:
            raise InputError(f"[{name}] {key} is missing; it needs {', '.join(fields)}")
    return kind(**table)
