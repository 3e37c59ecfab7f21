"""Light sources, one file each (thesis 4.2), and the registry of source types by their names in [source] type.

A new source type is a module of this package with its class, a `Source`, and with a list TYPES that describes its keys in the
[source] section; it is discovered automatically.  Unless its rays are sampled like another type's (`Source.emission`),
`optics/emission` needs a module for it, too.
"""

from __future__ import annotations

import pkgutil
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
    "combined",
    "in_words",
    "light_of_all",
    "names",
    "own_keys",
    "register",
    "type_of",
    "used_by",
]

#: Modules in the order in which messages and comments list their types; others follow in alphabetical order.
_FIRST = ("plane", "points", "disc")
_TYPES: dict[str, SourceType] = {}


def register(type: SourceType) -> None:
    """Add a source type to the registry."""
    _TYPES[type.name] = type


def names() -> tuple[str, ...]:
    """Names of all types."""
    return tuple(_TYPES)


#: Common names of light sources, and the settings that describe each.
CALLED = {
    "sun": f"sunlight is ⟨source⟩ disc with ⟨+source.angle⟩ {SUN:g}",
    "led": "an LED is ⟨source⟩ disc with ⟨+source.size⟩ 1x1, ⟨+source.position⟩ 0,0,-50 and ⟨+source.intensity⟩ lambertian",
    "lambertian": "that is an ⟨+source.intensity⟩, of ⟨source⟩ point, grid or disc",
    "laser": "a laser's parallel beam is ⟨source⟩ plane",
    "lamp": "a lamp is ⟨source⟩ disc with ⟨+source.size⟩ and ⟨+source.position⟩",
}


def type_of(name: str, where: str = "⟨source.type⟩") -> SourceType:
    """The source type of that name.

    Raises:
        InputError: naming `where`: there is none.
    """
    if name in CALLED and name not in _TYPES:
        raise InputError(f"{where} must be one of {', '.join(names())}, got {name!r}: {CALLED[name]}")
    return _TYPES[checks.choice(where, name, names())]


def in_words() -> str:
    """All types in a line, for a comment."""
    *others, last = (type.note for type in _TYPES.values())
    return f"{', '.join(others)} or {last}"


def own_keys() -> dict[str, tuple[str, str]]:
    """Keys of [source] that belong to a single type, each with its kind and help."""
    return {key: spec for type in _TYPES.values() for key, spec in type.own.items()}


def used_by(key: str) -> tuple[str, ...]:
    """Names of the types that use a key of [source]."""
    return tuple(name for name, type in _TYPES.items() if key in type.keys)


def combined(first: Source, section: Table) -> Source:
    """The source of a [source] section: `first`, or a `Several` of it and the further [[source]] tables."""
    if not section.get("also"):
        return first
    others = (type_of(table["type"], "⟨source.also.type⟩").from_settings(table, None) for table in section["also"])
    return Several((first, *others), tuple((light.wavelengths, light.weights) for light in lights_of(section)))


for _module in sorted(
    (m.name for m in pkgutil.iter_modules(__path__)), key=lambda name: (_FIRST.index(name) if name in _FIRST else len(_FIRST), name)
):
    for _type in getattr(import_module(f"{__name__}.{_module}"), "TYPES", ()):
        register(_type)
