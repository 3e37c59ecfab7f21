"""Files that settings name: each is read once, validated, and copied into the project under a fixed name.

A row of the table with a `file` is such a setting, and READERS reads its file.  The names in a configuration are relative to its
directory (`located`); those of the command line are paths.
"""

from __future__ import annotations

import io
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import numpy as np

from caustic_cli.config import settings, tolerances
from caustic_cli.config.settings import Given, Settings
from caustic_cli.errors import InputError
from caustic_cli.io.arrays import open_npy
from caustic_cli.io.files import read_bytes
from caustic_cli.io.picture import read_picture
from caustic_cli.loading import OnDemand
from caustic_cli.scene.gradient import MOST_VALUES, checked_volume
from caustic_cli.scene.screen import MAX_SAGS
from caustic_cli.scene.sources.rayset import RaySet
from caustic_cli.scene.sources.section import Attached
from caustic_cli.schema.table import TABLE, Section, Setting

faces = OnDemand("caustic_cli.io.faces")
intensities, sags = OnDemand("caustic_cli.io.intensities"), OnDemand("caustic_cli.io.sags")
spectrum = OnDemand("caustic_cli.scene.spectrum")
rayfiles, spectra = OnDemand("caustic_cli.io.rayfiles"), OnDemand("caustic_cli.io.spectra")

#: Settings that name a file.
ROWS = [row for row in TABLE.values() if row.file]
#: Beginnings of the names of all these files in a project.
STEMS = tuple(row.file for row in ROWS)
#: Name in a project of the file of [lens] index_file, and its largest size, bytes.
INDEX, MOST_INDEX = "index.npy", 8 * MOST_VALUES + (1 << 12)

Sections = TypeVar("Sections", bound=Section)


class _Located(str):
    """A file name in a configuration, with the path of the file."""

    path: Path


class _Read(NamedTuple):
    """The bytes of a file, the object read from them, and the suffix of its name in a project."""

    data: bytes
    content: Any
    suffix: str


def located(given: Given, folder: Path) -> Given:
    """Settings in which the names of files know their path, relative to `folder`."""

    def at(_row: Setting, name: str) -> str:
        found = _Located(name)
        found.path = folder / name
        return found

    return _changed(given, at)


def attached(given: Given) -> Given:
    """Settings in which the names of files carry their contents (`Attached`).

    Raises:
        InputError: a file is missing, too large, or not of the kind of its setting.
    """

    def read(row: Setting, name: str) -> str:
        found = READERS[row.path](getattr(name, "path", Path(name)), given)
        return Attached.of(name, found.data, found.content, found.suffix)

    return _changed(given, read)


def _changed(given: Given, change: Callable[[Setting, str], str]) -> Given:
    """Settings in which every name of a file that is not read yet is changed."""
    found = {section: dict(table) for section, table in given.items()}
    if "also" in (source := found.get("source", {})):
        source["also"] = [dict(table) for table in source["also"]]
    for table, row in names_in(found):
        if not isinstance(table[row.key], Attached):
            table[row.key] = change(row, table[row.key])
    return found


def names_in(given: Given) -> Iterator[tuple[dict[str, Any], Setting]]:
    """The tables of settings with a name of a file, and its row."""
    for row in ROWS:
        first = given.get(row.section, {})
        for table in (first, *first.get("also", ())):
            if _is_file(row, table.get(row.key)):
                yield table, row


def _is_file(row: Setting, value: Any) -> bool:
    """Whether a value names a file: one that may be a word, too, does so by a suffix."""
    return isinstance(value, str) and value != "" and (not row.worded or bool(Path(value).suffix))


def rays_of(name: str) -> RaySet:
    """The rays of a ray file.

    Raises:
        InputError: the file is missing, too large, or not a ray file.
    """
    return rayfiles.parse_rays(read_bytes(Path(name), rayfiles.MAX_BYTES, rayfiles.ACCEPTED), name)


def _light(path: Path, _given: Given) -> _Read:
    """A ray file, or the picture of a disc's brightness as irradiance."""
    suffix = path.suffix.lower()
    if suffix in rayfiles.SUFFIXES:
        return _rays(path, _given)
    light = read_picture(path, linear=True).irradiance()
    return _Read(read_bytes(path, rayfiles.MAX_BYTES, rayfiles.ACCEPTED), light, suffix)


def _rays(path: Path, _given: Given) -> _Read:
    """A ray file."""
    data = read_bytes(path, rayfiles.MAX_BYTES, rayfiles.ACCEPTED)
    return _Read(data, rayfiles.parse_rays(data, str(path)), path.suffix.lower())


def _intensity(path: Path, _given: Given) -> _Read:
    data = read_bytes(path, intensities.MOST_BYTES, intensities.TABLE)
    return _Read(data, intensities.parse_distribution(data, str(path)), path.suffix.lower())


def _profile(path: Path, _given: Given) -> _Read:
    picture = read_picture(path, linear=True)
    return _Read(picture.encoded(), picture.irradiance(), picture.suffix)


def _second(path: Path, given: Given) -> _Read:
    """A second picture, encoded, coloured and inverted like the first."""
    goal = given.get("target", {})
    picture = read_picture(path, goal.get("encoding") == "linear", bool(goal.get("color")), given.get("", {}).get("invert", False))
    return _Read(picture.encoded(), picture.irradiance(), picture.suffix)


def _spectrum(path: Path, _given: Given) -> _Read:
    if path.suffix.lower() != ".csv":
        raise InputError(f"⟨source.spectrum⟩ {path}: {spectra.TABLE}, or one of {', '.join(spectrum.BUILT_IN)}")
    data = read_bytes(path, spectra.MOST_BYTES, spectra.TABLE)
    return _Read(data, spectra.parse_spectrum(data, str(path)), ".csv")


def _index(path: Path, _given: Given) -> _Read:
    """Control values (n, m, k) of refractive index."""
    accepted = "a .npy array of (n, m) or (n, m, k) refractive indices is needed"
    with open_npy(path, accepted) as stored:
        values = checked_volume(stored.read_reals(), "the array")
    return _Read(read_bytes(path, MOST_INDEX, accepted), values, ".npy")


def _base(path: Path, _given: Given) -> _Read:
    """The base surface of a lens, from one face."""
    return _Read(read_bytes(path, faces.MOST_BYTES, faces.ONE), faces.read_face(path), path.suffix.lower())


def _sags(path: Path, _given: Given) -> _Read:
    data, heights = sags.read_sags(path)
    return _Read(data, heights, path.suffix.lower())


def _phase(path: Path, _given: Given) -> _Read:
    """A phase over the aperture."""
    accepted = f"a 2-D .npy of the phase in rad over the aperture, of at most {MAX_SAGS} values along each axis, is needed"
    with open_npy(path, accepted) as stored:
        if len(stored.shape) != 2 or max(stored.shape) > MAX_SAGS:
            raise InputError(f"holds {' x '.join(map(str, stored.shape))} values; {accepted}")
        values = stored.read_reals()
    return _Read(read_bytes(path, sags.MOST_BYTES, accepted), values, ".npy")


def _errors(path: Path, _given: Given) -> _Read:
    data = read_bytes(path, settings.MAX_BYTES, settings.ACCEPTED)
    return _Read(data, tolerances.read(path), ".toml")


#: Reads the file of a setting, by its path, among all settings given.
READERS: dict[str, Callable[[Path, Given], _Read]] = {
    "source.profile": _profile,
    "source.file": _light,
    "source.phase_file": _phase,
    "source.intensity": _intensity,
    "lamp.intensity": _intensity,
    "lamp.file": _rays,
    "source.spectrum": _spectrum,
    "lens.base_file": _base,
    "lens.index_file": _index,
    "screen.shape_file": _sags,
    "second.file": _second,
    "design.robust": _errors,
    "design.region": _profile,
}


def index_attached(values: np.ndarray) -> Attached:
    """Control values (n, m, k) as the file that is stored in a project."""
    held = io.BytesIO()
    np.save(held, np.ascontiguousarray(values, dtype=np.float64))
    return Attached.of(INDEX, held.getvalue(), values)


def index_of(lens: Mapping[str, Any]) -> np.ndarray | None:
    """The control values that a [lens] section's `index_file` carries."""
    return getattr(lens.get("index_file"), "content", None)


def named_in_project(full: Settings) -> Settings:
    """Settings with the names of files in a project, those of further sources with a number."""

    def named(section: Sections, number: str = "") -> Sections:
        files = {row.key: (row.file, section[row.key]) for row in ROWS if isinstance(_value(section, row), Attached)}
        return section.changed(**{key: file.named(f"{stem}{number}{file.suffix}") for key, (stem, file) in files.items()})

    source = named(full.source)
    if source.also:
        source = source.changed(also=[named(table, f"-{k}") for k, table in enumerate(source.also, 2)])
    second, lamp = (None if section is None else named(section) for section in (full.second, full.lamp))
    same = {"lens": named(full.lens), "screen": named(full.screen), "design": named(full.design)}
    return full.changed(source=source, second=second, lamp=lamp, **same)


def of(full: Settings) -> list[Attached]:
    """All files referenced by complete settings."""
    sections = (full.source, *full.source.also, full.lens, full.screen, full.design, *filter(None, [full.second, full.lamp]))
    return [value for section in sections for row in ROWS if isinstance(value := _value(section, row), Attached)]


def _value(section: Section, row: Setting) -> Any:
    """The value of a row in a section, None if it belongs to another."""
    return section.get(row.key) if row.section == section.section else None
