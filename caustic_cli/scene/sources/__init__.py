"""Light sources, a file each (thesis 4.2), and the registry of their types by the name that [source] type has for them.

A new type of source is a file here that holds its class, a `Source`, and in TYPES what the [source] section says of it; it is
found by itself.  Unless its rays are drawn as another's are (`Source.emission`), `optics/emission` has a file of it too.
"""

from __future__ import annotations

import pkgutil
from collections.abc import Sequence
from importlib import import_module

from caustic_cli.config import checks
from caustic_cli.errors import InputError
from caustic_cli.scene.sources.base import Source
from caustic_cli.scene.sources.disc import SUN, Disc
from caustic_cli.scene.sources.plane import PlaneWave
from caustic_cli.scene.sources.points import Points
from caustic_cli.scene.sources.section import COMMON, SourceType, Table
from caustic_cli.scene.sources.several import Several, light_of_all, lights_of

__all__ = [
    "COMMON",
    "Disc",
    "PlaneWave",
    "Points",
    "Source",
    "SourceType",
    "either",
    "in_words",
    "light_of_all",
    "names",
    "own_keys",
    "register",
    "together",
    "type_of",
    "used_by",
]

#: Files in the order in which messages and comments name their types; others follow by name.
_FIRST = ("plane", "points", "disc")
_TYPES: dict[str, SourceType] = {}


def register(type: SourceType) -> None:
    """Make a type of source known to [source] type and source."""
    _TYPES[type.name] = type


def names() -> tuple[str, ...]:
    """Of all types."""
    return tuple(_TYPES)


#: What people call sources, and how each is said.
CALLED = {
    "sun": f"sunlight is ⟨source⟩ disc with ⟨+source.angle⟩ {SUN:g}",
    "led": "an LED is ⟨source⟩ disc with ⟨+source.size⟩ 1x1, ⟨+source.position⟩ 0,0,-50 and ⟨+source.intensity⟩ lambertian",
    "lambertian": "that is an ⟨+source.intensity⟩, of ⟨source⟩ point, grid or disc",
    "laser": "a laser's parallel beam is ⟨source⟩ plane",
    "lamp": "a lamp is ⟨source⟩ disc with ⟨+source.size⟩ and ⟨+source.position⟩",
}


def type_of(name: str, where: str = "⟨source.type⟩") -> SourceType:
    """The type of that name.

    Raises:
        InputError: naming `where` it was asked for: there is none.
    """
    if name in CALLED and name not in _TYPES:
        raise InputError(f"{where} must be one of {', '.join(names())}, got {name!r}: {CALLED[name]}")
    return _TYPES[checks.choice(where, name, names())]


def in_words() -> str:
    """All types in a line, as a comment has them."""
    *others, last = (type.note for type in _TYPES.values())
    return f"{', '.join(others)} or {last}"


def own_keys() -> dict[str, tuple[str, str]]:
    """Keys of [source] that one type alone brings along, each with its kind and comment."""
    return {key: spec for type in _TYPES.values() for key, spec in type.own.items()}


def used_by(key: str) -> tuple[str, ...]:
    """Names of the types that use a key of [source]."""
    return tuple(name for name, type in _TYPES.items() if key in type.keys)


def either(names: Sequence[str]) -> str:
    """Names in a clause."""
    *others, last = names
    return f"{', '.join(others)} or {last}" if others else last


def together(first: Source, section: Table) -> Source:
    """The first source of a [source] section, with the others where it names some."""
    if not section.get("also"):
        return first
    others = (type_of(table["type"], "⟨source.also.type⟩").from_settings(table, None) for table in section["also"])
    return Several((first, *others), tuple((light.wavelengths, light.weights) for light in lights_of(section)))


for _module in sorted(
    (m.name for m in pkgutil.iter_modules(__path__)), key=lambda name: (_FIRST.index(name) if name in _FIRST else len(_FIRST), name)
):
    for _type in getattr(import_module(f"{__name__}.{_module}"), "TYPES", ()):
        register(_type)
