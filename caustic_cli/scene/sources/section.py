"""The [source] section of project.toml: which types there are of it, the keys that each uses, and the reading of those they share.

A type of source is registered by a `SourceType`; everything that depends on the name of a type is looked up there.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from caustic_cli.config.table import check
from caustic_cli.errors import InputError
from caustic_cli.scene.sources.base import Source
from caustic_cli.scene.sources.distribution import Distribution

Table = Mapping[str, Any]
#: The same power into every solid angle; in proportion to the cosine from +z.
INTENSITIES = ("uniform", "lambertian")
#: Keys of every source: the name of its type, and its power, W.
COMMON = ("type", "power")
#: Of a source that stands somewhere, if not said: how far before the lens, how wide, in lens widths; the grid of fig. 6.4.1.
DISTANCE, WIDTH, GRID = 5.0, 0.2, (25, 25)


class Attached(str):
    """The name of a file that [source] speaks of, together with what it holds; to whoever asks for text it is the name.

    data: the file's bytes; content: what was read from them.
    """

    data: bytes = b""
    content: Any = None

    @classmethod
    def of(cls, name: str, data: bytes, content: Any) -> Attached:
        """A file of that name."""
        found = cls(name)
        found.data, found.content = data, content
        return found

    def named(self, name: str) -> Attached:
        """The same file under another name."""
        return self.of(name, self.data, self.content)


def content(table: Table, key: str, kind: type) -> Any | None:
    """What the file holds that a key names, if it is of that kind; None if not, or if there is no such file."""
    read = getattr(table.get(key), "content", None)
    return read if isinstance(read, kind) else None


def nothing(_lens: Table) -> dict[str, Any]:
    """Defaults of a type that needs none."""
    return {}


def none_idle(_table: Table) -> dict[str, str]:
    """Idle keys of a type that uses all of its keys always."""
    return {}


@dataclass(frozen=True)
class SourceType:
    """A type of source as [source] describes it.

    name: [source] type; note: the name with what has to be said about it in a line; keys: of the section that it uses besides
    COMMON; from_settings: makes it of the complete section and of the profile's irradiance, if one is named; defaults: of its keys,
    from the [lens] section; idle: of a section, keys of the type that mean nothing beside the others, and why; own: keys of the
    section that no other type has, each with its kind and help as of `table.Setting`.
    """

    name: str
    note: str
    keys: tuple[str, ...]
    from_settings: Callable[[Table, np.ndarray | None], Source]
    defaults: Callable[[Table], dict[str, Any]] = nothing
    idle: Callable[[Table], dict[str, str]] = none_idle
    own: Mapping[str, tuple[str, str]] = field(default_factory=dict)


def standing(lens: Table) -> dict[str, Any]:
    """Where a source stands and how large it is: the same for all types that stand somewhere, so that a type may be changed."""
    width = max(lens["size"])
    return {"position": [[0.0, 0.0, lens["z_in"] - DISTANCE * width]], "size": [WIDTH * width] * 2, "grid": list(GRID)}


def shining(table: Table) -> dict[str, Any]:
    """How a source that stands somewhere shines, as arguments of its class."""
    intensity = content(table, "intensity", Distribution) or str(table["intensity"])
    return {"cone": table.get("cone"), "intensity": intensity, "aimed": table["aim"]}


def check_shining(source: Source) -> None:
    """Refuse a cone or an intensity that there is none of."""
    if source.cone is not None:
        check("source.cone", source.cone)
    if not isinstance(source.intensity, Distribution) and source.intensity not in INTENSITIES:
        raise InputError(f"⟨source.intensity⟩ must be one of {', '.join(INTENSITIES)}, or a .csv file, got {source.intensity!r}")


def positions(table: Table) -> tuple[tuple[float, float, float], ...]:
    """All positions of the section."""
    return tuple(tuple(p) for p in table["position"])


def middle(table: Table, name: str) -> tuple[float, float, float]:
    """The one position of a type that has a centre; a source at infinity has none, so nobody counts them.

    Raises:
        InputError: there are several.
    """
    found = positions(table)
    if len(found) != 1 and "angle" not in table:
        raise InputError(f"⟨source.position⟩ of a {name} is its centre, one [x, y, z], got {len(found)}")
    return found[0]
