"""The [source] section of project.toml: the descriptor of a source type, and the reading of keys that several types share.

A `SourceType` registers a type; everything that depends on the name of a type is looked up there.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from caustic_cli.errors import InputError
from caustic_cli.scene.sources.base import Source
from caustic_cli.scene.sources.distribution import Distribution
from caustic_cli.schema.table import check

#: Angular diameter of the sun, degrees.
SUN = 0.533

Table = Mapping[str, Any]
#: Isotropic; proportional to the cosine of the angle to +z.
INTENSITIES = ("uniform", "lambertian")
#: Keys common to all sources: the name of the type, and the power, W.
COMMON = ("type", "power")
#: Defaults of a near source: distance in front of the lens and width, in lens widths; the grid of fig. 6.4.1.
DISTANCE, WIDTH, GRID = 5.0, 0.2, (25, 25)


class Attached(str):
    """A file name in the settings together with the file's content; used as a string it is the name.

    data: the file's bytes; content: the object read from them; suffix: of its name in a project.
    """

    data: bytes = b""
    content: Any = None
    suffix: str = ""

    @classmethod
    def of(cls, name: str, data: bytes, content: Any, suffix: str = "") -> Attached:
        """An attached file of that name."""
        attached = cls(name)
        attached.data, attached.content, attached.suffix = data, content, suffix
        return attached

    def named(self, name: str) -> Attached:
        """The same file under another name."""
        return self.of(name, self.data, self.content, self.suffix)


def content(table: Table, key: str, kind: type) -> Any | None:
    """The content of the file that a key names, if it is of type `kind`; else None."""
    read = getattr(table.get(key), "content", None)
    return read if isinstance(read, kind) else None


def no_defaults(_lens: Table) -> dict[str, Any]:
    """Defaults of a type without any."""
    return {}


def no_idle_keys(_table: Table) -> dict[str, str]:
    """Ignored keys of a type that always uses all of its keys."""
    return {}


@dataclass(frozen=True)
class SourceType:
    """Descriptor of a source type."""

    #: Value of [source] type.
    name: str
    #: The name with a remark for a comment.
    note: str
    #: Keys of the section that it uses besides COMMON.
    keys: tuple[str, ...]
    #: Constructs the source from the complete section and the profile's irradiance, if any.
    from_settings: Callable[[Table, np.ndarray | None], Source]
    #: Of its keys, from the [lens] section.
    defaults: Callable[[Table], dict[str, Any]] = no_defaults
    #: Keys that the other keys of a section make meaningless, and why.
    idle: Callable[[Table], dict[str, str]] = no_idle_keys
    #: Keys that no other type has, each with its kind and help as of `table.Setting`.
    own: Mapping[str, tuple[str, str]] = field(default_factory=dict)


def position_defaults(lens: Table) -> dict[str, Any]:
    """Default position and size of a near source, the same for all near types, so that the type can be changed."""
    width = max(lens["size"])
    return {"position": [[0.0, 0.0, lens["z_in"] - DISTANCE * width]], "size": [WIDTH * width] * 2, "grid": list(GRID)}


def emission_arguments(table: Table) -> dict[str, Any]:
    """The emission keys of a near source as arguments of its class."""
    intensity = content(table, "intensity", Distribution) or str(table["intensity"])
    return {"cone": table.get("cone"), "intensity": intensity, "aimed": table["aim"]}


def check_emission(source: Source) -> None:
    """Check the cone and the intensity of a near source.

    Raises:
        InputError: one is invalid.
    """
    if source.cone is not None:
        check("source.cone", source.cone)
    if not isinstance(source.intensity, Distribution) and source.intensity not in INTENSITIES:
        raise InputError(f"⟨source.intensity⟩ must be one of {', '.join(INTENSITIES)}, or a .csv file, got {source.intensity!r}")


def positions(table: Table) -> tuple[tuple[float, float, float], ...]:
    """All positions of the section, mm."""
    return tuple(tuple(p) for p in table["position"])


def single_position(table: Table, name: str) -> tuple[float, float, float]:
    """The single position of a source type that has a centre; not checked for a source at infinity, which has none.

    Raises:
        InputError: there are several.
    """
    places = positions(table)
    if len(places) != 1 and "angle" not in table:
        raise InputError(f"⟨source.position⟩ of a {name} is its centre, one [x, y, z], got {len(places)}")
    return places[0]
