"""Validation of settings one by one, before torch is loaded: ranges and choices of the table, names of sources, glasses and losses.

What a value means together with others is judged when scene and stages are built.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from caustic_cli.config import settings, tolerances
from caustic_cli.errors import InputError
from caustic_cli.inverse.loss_terms import parse
from caustic_cli.loading import OnDemand
from caustic_cli.scene import materials, sources
from caustic_cli.schema.table import TABLE

spectrum = OnDemand("caustic_cli.scene.spectrum")
#: Words of design.start that are no file.
STARTS = ("transport", "offset")


def refuse_bad_options(given: Mapping[str, Any]) -> None:
    """Refuse values of settings, by path, that are wrong by themselves, and files that cannot be read.

    Raises:
        InputError: naming the setting and what would be accepted.
    """
    for path, value in given.items():
        _refuse(path, value)
        if path in FILES and value:
            FILES[path](value)


def _refuse(path: str, value: Any) -> None:
    """Refuse one value.  Infinity, which stands for none, is left to the scene."""
    row = TABLE.get(path)
    if row is None or value is None:
        return
    for one in value if row.kind == "points" and _nested(value) else [value]:
        if _finite(one):
            row.check([*one, *one] if row.kind in ("numbers", "wholes") and _alone(one) else one)
    if path in NAMES:
        NAMES[path](value)


def refuse_bad_file(path: Path, parameters: bool = False) -> settings.Given:
    """The settings of a TOML file, each of them valid by itself.

    Raises:
        InputError: naming the file.
    """
    given = settings.read(path, parameters)
    try:
        for section, table in given.items():
            for key, value in table.items():
                _refuse(f"{section}.{key}" if section else key, value)
    except InputError as error:
        raise InputError(f"{path}: {error!s}") from error
    return given


def _nested(value: Any) -> bool:
    """Whether a value is a list of points."""
    return isinstance(value, list | tuple) and bool(value) and all(isinstance(one, list | tuple) for one in value)


def _alone(value: Any) -> bool:
    """Whether a value is a single number that stands for both axes."""
    return isinstance(value, list | tuple) and len(value) == 1


def _finite(value: Any) -> bool:
    numbers = value if isinstance(value, list | tuple) else [value]
    return not any(isinstance(number, float) and math.isinf(number) for number in numbers)


def _start(value: str) -> None:
    if value not in STARTS and not Path(value).exists():
        raise InputError(f"⟨design.start⟩ must be {', '.join(STARTS)}, a project directory or a lens surface, got {value!r}")


def _existing(value: str) -> None:
    if not Path(value).exists():
        raise InputError(f"{value}: no such file")


def _spectrum(value: str) -> None:
    if not Path(value).suffix:
        spectrum.built_in(value)


#: Checks of names that the table does not list.
NAMES: dict[str, Callable[[str], Any]] = {
    "source.type": sources.type_of,
    "lens.glass": materials.material,
    "design.loss": parse,
    "source.spectrum": _spectrum,
}
#: Checks of files that options name.  Those named in a configuration or a project are relative to its directory, or not needed any
#: more.
FILES: dict[str, Callable[[str], Any]] = {
    **{row.path: _existing for row in TABLE.values() if row.file and row.option and row.default is None and not row.worded},
    "design.start": _start,
    "design.robust": lambda value: tolerances.read(Path(value)),
}
