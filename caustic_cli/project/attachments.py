"""Files referenced by [source], [lens], [screen] and [design]: read once, validated, and copied into the project under fixed
names."""

from __future__ import annotations

import io
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from caustic_cli.config import settings, tolerances
from caustic_cli.io.arrays import open_npy
from caustic_cli.io.files import read_bytes
from caustic_cli.io.intensities import MOST_BYTES, TABLE, parse_distribution
from caustic_cli.io.picture import read_picture
from caustic_cli.io.rayfiles import ACCEPTED, MAX_BYTES, SUFFIXES, parse_rays
from caustic_cli.io.sags import read_sags
from caustic_cli.scene.gradient import MOST_VALUES, checked_volume
from caustic_cli.scene.sources.rayset import RaySet
from caustic_cli.scene.sources.section import Attached

#: Name in a project of the file of [design] robust.
ERRORS = "tolerances.toml"
#: Name in a project, without suffix, of the file of [screen] shape_file.
SHAPE = "screen"
#: Name in a project of the file of [lens] index_file, and its largest size, bytes.
INDEX, MOST_INDEX = "index.npy", 8 * MOST_VALUES + (1 << 12)
#: Keys of [source] that may name a file, and its name in a project without suffix.
STEMS = {"file": "source", "intensity": "intensity"}
#: Beginnings of the names of all of them.
ALL = (*STEMS.values(), SHAPE, Path(INDEX).stem, Path(ERRORS).stem)


def attached(source: Mapping[str, Any], folder: Path | None = None) -> dict[str, Any]:
    """A [source] section in which file names carry the contents of the files (`Attached`).

    Args:
        folder: the directory of the files; None if names are paths given by the user.

    Raises:
        InputError: a file is missing, too large, or not of the kind of its key.
    """
    found = dict(source)
    for key in STEMS:
        name = source.get(key)
        if isinstance(name, str) and not isinstance(name, Attached) and _is_file(key, name):
            found[key] = _read(key, name if folder is None else str(folder / name))
            if folder is not None:
                found[key] = found[key].named(name)
    if "also" in source:
        found["also"] = [attached(table, folder) for table in source["also"]]
    return found


def rays_of(name: str) -> RaySet:
    """The rays of a ray file.

    Raises:
        InputError: the file is missing, too large, or not a ray file.
    """
    return parse_rays(read_bytes(Path(name), MAX_BYTES, ACCEPTED), name)


def with_errors(design: Mapping[str, Any], folder: Path | None = None) -> dict[str, Any]:
    """A [design] section whose `robust` carries the contents of its file, if it names one; folder: as in `attached`.

    Raises:
        InputError: the file is missing, too large, or invalid.
    """
    name = design.get("robust")
    if not name or not isinstance(name, str) or isinstance(name, Attached):
        return dict(design)
    path = Path(name) if folder is None else folder / name
    data = read_bytes(path, settings.MAX_BYTES, settings.ACCEPTED)
    return {**design, "robust": Attached.of(name, data, tolerances.read(path))}


def with_shape(screen: Mapping[str, Any], folder: Path | None = None) -> dict[str, Any]:
    """A [screen] section whose `shape_file` carries the heights of its file, if it names one; folder: as in `attached`.

    Raises:
        InputError: the file is missing or holds no heights.
    """
    name = screen.get("shape_file")
    if name is None or isinstance(name, Attached):
        return dict(screen)
    data, heights = read_sags(Path(name) if folder is None else folder / name)
    return {**screen, "shape_file": Attached.of(name, data, heights)}


def with_index(lens: Mapping[str, Any], folder: Path | None = None) -> dict[str, Any]:
    """A [lens] section whose `index_file` carries the control values of its file, if it names one; folder: as in `attached`.

    Raises:
        InputError: the file is missing, too large, or holds no volume of refractive indices.
    """
    name = lens.get("index_file")
    if not isinstance(name, str) or isinstance(name, Attached):
        return dict(lens)
    path = Path(name) if folder is None else folder / name
    accepted = "a .npy array of (n, m) or (n, m, k) refractive indices is needed"
    with open_npy(path, accepted) as stored:
        values = checked_volume(stored.read_reals(), "the array")
    return {**lens, "index_file": Attached.of(name, read_bytes(path, MOST_INDEX, accepted), values)}


def index_attached(values: np.ndarray) -> Attached:
    """Control values (n, m, k) as the file that is stored in a project."""
    held = io.BytesIO()
    np.save(held, np.ascontiguousarray(values, dtype=np.float64))
    return Attached.of(INDEX, held.getvalue(), values)


def index_of(lens: Mapping[str, Any]) -> np.ndarray | None:
    """The control values that a [lens] section's `index_file` carries."""
    return getattr(lens.get("index_file"), "content", None)


def named_in_project(full: Mapping[str, dict[str, Any]]) -> None:
    """Rename the files of complete settings to their names in a project, those of further sources with a number."""
    source, lens, screen, design = (full[section] for section in ("source", "lens", "screen", "design"))
    if isinstance(shape := screen.get("shape_file"), Attached):
        screen["shape_file"] = shape.named(f"{SHAPE}{Path(shape).suffix.lower()}")
    if isinstance(lens.get("index_file"), Attached):
        lens["index_file"] = lens["index_file"].named(INDEX)
    if isinstance(design.get("robust"), Attached):
        design["robust"] = design["robust"].named(ERRORS)
    for k, table in enumerate((source, *source.get("also", ()))):
        for key, stem in STEMS.items():
            if isinstance(table.get(key), Attached):
                table[key] = table[key].named(f"{stem}{f'-{k + 1}' if k else ''}{Path(table[key]).suffix.lower()}")


def of(full: Mapping[str, Mapping[str, Any]]) -> list[Attached]:
    """All files referenced by complete settings."""
    source = full["source"]
    others = full["design"].get("robust"), full["screen"].get("shape_file"), full["lens"].get("index_file")
    return [file for file in others if isinstance(file, Attached)] + [
        value for table in (source, *source.get("also", ())) for key in STEMS if isinstance(value := table.get(key), Attached)
    ]


def _is_file(key: str, name: str) -> bool:
    """Whether the value of a key is a file name: an intensity may also be a keyword, which has no suffix."""
    return bool(name) and (key != "intensity" or bool(Path(name).suffix))


def _read(key: str, name: str) -> Attached:
    path = Path(name)
    if key == "intensity":
        data = read_bytes(path, MOST_BYTES, TABLE)
        return Attached.of(name, data, parse_distribution(data, name))
    if path.suffix.lower() in SUFFIXES:
        data = read_bytes(path, MAX_BYTES, ACCEPTED)
        return Attached.of(name, data, parse_rays(data, name))
    light = read_picture(path, linear=True).irradiance()
    return Attached.of(name, read_bytes(path, MAX_BYTES, ACCEPTED), light)
