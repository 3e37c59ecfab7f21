"""The files that [source] speaks of: read once, checked, and kept in the project under names of their own."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from caustic_cli.errors import InputError
from caustic_cli.rayfiles import ACCEPTED, MAX_BYTES, SUFFIXES, parse_rays, read_bytes
from caustic_cli.scene.sources.section import Attached

#: Keys of [source] that may name a file, and what it is called in a project.
STEMS = {"file": "source"}


def attached(source: Mapping[str, Any], folder: Path | None = None) -> dict[str, Any]:
    """A [source] section in which names of files carry what these hold (`Attached`).

    Args:
        folder: where they are; None where names are paths as a user gives them.

    Raises:
        InputError: a file is missing, too large, or not what its key asks for.
    """
    found = dict(source)
    for key in STEMS:
        name = source.get(key)
        if isinstance(name, str) and not isinstance(name, Attached) and _is_file(key, name):
            found[key] = _read(key, name if folder is None else str(folder / name))
            if folder is not None:
                found[key] = found[key].named(name)
    return found


def named_in_project(source: dict[str, Any]) -> None:
    """Rename the files of a section as a project calls them."""
    for key, stem in STEMS.items():
        if isinstance(source.get(key), Attached):
            source[key] = source[key].named(stem + Path(source[key]).suffix.lower())


def of(source: Mapping[str, Any]) -> list[Attached]:
    """All files of a section."""
    return [value for key in STEMS if isinstance(value := source.get(key), Attached)]


def _is_file(_key: str, name: str) -> bool:
    return bool(name)


def _read(_key: str, name: str) -> Attached:
    path = Path(name)
    if path.suffix.lower() not in SUFFIXES:
        raise InputError(f"{path}: ends in {path.suffix or 'nothing'}; {ACCEPTED}")
    data = read_bytes(path, MAX_BYTES, ACCEPTED)
    return Attached.of(name, data, parse_rays(data, name))
