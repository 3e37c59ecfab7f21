"""Light sources, one file each (thesis 4.2), and the registry of source types by their names in [source] type.

A new source type is a module of this package with its class, a `Source`, and with a list TYPES that describes its keys in the
[source] section; it is discovered automatically.  Unless its rays are sampled like another type's (`Source.emission`),
`optics/emission` needs a module for it, too.
"""

from __future__ import annotations

import pkgutil
from functools import cache
from importlib import import_module
from typing import TYPE_CHECKING, Any

from caustic_cli.errors import InputError
from caustic_cli.loading import OnDemand
from caustic_cli.scene.sources.base import Source
from caustic_cli.scene.sources.plane import PlaneWave
from caustic_cli.scene.sources.section import COMMON, SUN, SourceType, Table
from caustic_cli.schema import checks

if TYPE_CHECKING:
    from caustic_cli.scene.sources.disc import Disc
    from caustic_cli.scene.sources.points import Points

__all__ = [
    "COMMON",
    "Disc",
    "PlaneWave",
    "Points",
    "Source",
    "SourceType",
    "combined",
    "in_words",
    "names",
    "own_keys",
    "register",
    "type_of",
    "used_by",
]

several = OnDemand("caustic_cli.scene.sources.several")
#: Classes that are loaded when they are asked for, and their modules.
_CLASSES = {"Disc": "disc", "Points": "points"}
#: Modules in the order in which messages and comments list their types; others follow in alphabetical order.
_FIRST = ("plane", "points", "disc")


@cache
def _types() -> dict[str, SourceType]:
    """The registry, made when it is first asked for."""
    found = (module.name for module in pkgutil.iter_modules(__path__))
    names = sorted(found, key=lambda name: (_FIRST.index(name) if name in _FIRST else len(_FIRST), name))
    modules = [import_module(f"{__name__}.{name}") for name in names]
    return {type.name: type for module in modules for type in getattr(module, "TYPES", ())}


def register(type: SourceType) -> None:
    """Add a source type to the registry."""
    _types()[type.name] = type


def names() -> tuple[str, ...]:
    """Names of all types."""
    return tuple(_types())


#: Common names of light sources, and the settings that describe each.
CALLED = {
    "sun": f"sunlight is ⟨source⟩ disc with ⟨+source.angle⟩ {SUN:g}",
    "led": "an LED is ⟨source⟩ disc with ⟨+source.size⟩ 1x1, ⟨+source.position⟩ 0,0,-50 and ⟨+source.intensity⟩ lambertian",
    "lambertian": "that is an ⟨+source.intensity⟩, of ⟨source⟩ point, grid or disc",
    "laser": "a laser's beam is ⟨source⟩ gaussian with ⟨+source.waist⟩ and ⟨+source.wavelengths⟩, or plane where it is even",
    **dict.fromkeys(
        ("tophat", "top-hat", "flat-top", "flattop", "donut", "doughnut", "annular"),
        "a beam of that shape is ⟨source⟩ plane with ⟨+source.file⟩, a picture of its irradiance over the aperture, or ⟨source⟩"
        " measured with its phase, too",
    ),
    "lamp": "a lamp is ⟨source⟩ disc with ⟨+source.size⟩ and ⟨+source.position⟩",
}


def type_of(name: str, where: str = "⟨source.type⟩") -> SourceType:
    """The source type of that name.

    Raises:
        InputError: naming `where`: there is none.
    """
    if name in CALLED and name not in _types():
        raise InputError(f"{where} must be one of {', '.join(names())}, got {name!r}: {CALLED[name]}")
    return _types()[checks.choice(where, name, names())]


def in_words() -> str:
    """All types in a line, for a comment."""
    *others, last = (type.note for type in _types().values())
    return f"{', '.join(others)} or {last}"


def own_keys() -> dict[str, tuple[str, str]]:
    """Keys of [source] that belong to a single type, each with its kind and help."""
    return {key: spec for type in _types().values() for key, spec in type.own.items()}


def used_by(key: str) -> tuple[str, ...]:
    """Names of the types that use a key of [source]."""
    return tuple(name for name, type in _types().items() if key in type.keys)


def combined(first: Source, section: Table) -> Source:
    """The source of a [source] section: `first`, or a `Several` of it and the further [[source]] tables."""
    if not section.get("also"):
        return first
    others = (type_of(table["type"], "⟨source.also.type⟩").from_settings(table, None) for table in section["also"])
    return several.together((first, *others), several.lights_of(section))


def __getattr__(name: str) -> Any:
    if name in _CLASSES:
        return getattr(import_module(f"{__name__}.{_CLASSES[name]}"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
