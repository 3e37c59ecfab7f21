"""Settings as keyword arguments of the library's functions.

A keyword is the name of an option, its hyphens as underscores (`lens_size`), or section and key of project.toml (`lens_z_in`).  Its
value is that of project.toml; where an option takes one number or two, one is accepted, too.  The lists of tables are `element` and
`stages`.
"""

from __future__ import annotations

import difflib
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np

from caustic_cli.config import settings
from caustic_cli.config.settings import TABLES, Given
from caustic_cli.errors import InputError, alternatives
from caustic_cli.schema.table import TABLE

#: Keywords of lists of tables, and their paths.
LISTED = {"element": "element", "stages": "design.stages"}


def keywords(command: str) -> dict[str, str]:
    """Paths of a command's settings by keyword: for design all of them, for render those that its options change."""
    rows = [row for row in TABLE.values() if row.option and command in row.option.commands and row.kind != "tables"]
    own = {row.path: row.option.name.lstrip("-").replace("-", "_") for row in rows if row.option}
    settable = {path for row in rows for path in (row.path, *row.speaks_for)}
    found = dict(LISTED) if command == "design" else {}
    of_tables = {name for name, _ in TABLES.values() if name != "source"}
    for path, row in TABLE.items():
        if row.kind != "tables" and row.section not in of_tables and (command == "design" or path in settable):
            found[path.replace(".", "_")] = path
    return found | {name: path for path, name in own.items()}


def from_keywords(command: str, given: Mapping[str, Any], own: Iterable[str] = ()) -> dict[str, Any]:
    """Path -> value of keyword arguments, without those that are None.

    Args:
        own: names of the function's other parameters, for hints.

    Raises:
        InputError: a keyword is unknown, with those most like it.
    """
    known, found = keywords(command), dict[str, Any]()
    for name, value in given.items():
        if name not in known:
            raise InputError(f"{name} is not a keyword of {command}{_like(name, command, (*known, *own))}")
        if value is not None:
            found |= _of_option(known[name], value)
    return found


def _of_option(path: str, value: Any) -> dict[str, Any]:
    """Path -> value, of a flag that stands for a value and of a single number for a pair, too; empty for a flag not set."""
    row = TABLE.get(path)
    if row is None or row.option is None:
        return {path: value}
    if isinstance(value, bool) and (row.option.constant is not None or not row.section):
        return {path: value if row.option.constant is None else row.option.constant} if value else {}
    if row.both and isinstance(value, int | float | np.number):
        return {path: [value] * row.both}
    return {path: value}


def checked(given: Mapping[str, Any], sections: Mapping[str, Any], where: str) -> dict[str, Any]:
    """Path -> value of settings given by path and, with lower precedence, by section as in project.toml; all of their types.

    Raises:
        InputError: naming `where` and the setting.
    """
    raw = {name: dict(values) if isinstance(values, Mapping) else values for name, values in sections.items()}
    for path, value in given.items():
        section, _, key = path.rpartition(".")
        if section and not isinstance(raw.setdefault(section, {}), dict):
            raise InputError(f"{where}: [{section}] is a list of tables, beside which {key} cannot be given")
        (raw[section] if section else raw)[key] = value
    typed: Given = settings.checked(raw, where, parameters=True)
    return {f"{section}.{key}" if section else key: value for section, values in typed.items() for key, value in values.items()}


def _like(name: str, command: str, known: Iterable[str]) -> str:
    """A hint for an unknown keyword."""
    if command != "design" and name in keywords("design"):
        return ", which keeps the lens: it is a setting of its design"
    close = difflib.get_close_matches(name, known, 3, 0.6)
    if close:
        return f"; did you mean {alternatives(close)}?"
    return f"; keywords are named like the options of caustic {command}, such as source_position"
