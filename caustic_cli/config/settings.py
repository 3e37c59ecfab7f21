"""Reading and writing of project.toml, and construction of the scene from it.

What a user gives is a nested dict with the keys of the file (`Given`); completed, it is a `Settings` of typed sections.  Names,
types and defaults are defined in `schema.table`.  Keys and types are checked here, ranges when the scene and the stages are
constructed.
"""

from __future__ import annotations

import math
import re
import tomllib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import datetime
from pathlib import Path
from typing import Any, Self

import numpy as np
import tomli_w

from caustic_cli import __version__
from caustic_cli.errors import InputError, alternatives, near
from caustic_cli.io.files import read_bytes
from caustic_cli.loading import OnDemand
from caustic_cli.scene import COMPONENTS, Component, FreeForm, Lens, Light, Offset, Scene, Screen, SecondTarget, Source, sources
from caustic_cli.scene.aperture import Aperture, Pupil, larger
from caustic_cli.scene.gradient import KINDS, Gradient
from caustic_cli.scene.materials import refractive_index
from caustic_cli.scene.packing import cells_of
from caustic_cli.scene.screen import PLANE, Sags
from caustic_cli.scene.sources.plane import GRAZING
from caustic_cli.scene.sources.section import content
from caustic_cli.schema.table import (
    TABLE,
    DesignSettings,
    ElementSettings,
    LampSettings,
    LensSettings,
    RoomSettings,
    ScreenSettings,
    SecondSettings,
    Section,
    Setting,
    SourceSettings,
    StageSettings,
    TargetSettings,
    check,
    default,
    in_section,
)

parallel, rooms = OnDemand("caustic_cli.optics.parallel"), OnDemand("caustic_cli.scene.room")

#: Settings as given, by section and key.
Given = dict[str, dict[str, Any]]
FORMAT_VERSION = 1
MAX_BYTES = 1 << 23  # of a TOML file, enough for a hundred thousand source points
ACCEPTED = "a TOML file is needed"
#: Limits of a TOML file: components of a dotted key, nesting of brackets, and number of keys and headings.
MOST_NAMES, MOST_NESTED, MOST_KEYS = 4, 16, 20_000
_NAME = r"""(?:"(?:[^"\\\n]|\\.)*+"|'[^'\n]*+'|[A-Za-z0-9_+-]++)"""
_DOT = r"[ \t]*+\.[ \t]*+"
#: Tokens of a TOML text that determine its nesting.
_TOKEN = re.compile(
    r"""#[^\n]*+|\"{3}(?s:[^"\\]|\\.|"{1,2}(?!"))*+\"{3,5}|'{3}(?:[^']|'{1,2}(?!'))*+'{3,5}"""
    rf"|(?P<names>{_NAME}(?:{_DOT}{_NAME}){{{MOST_NAMES}}})|(?!\"{{3}}|'{{3}}){_NAME}"
    r"""|(?P<endless>["'])|(?P<open>[\[{])|(?P<close>[\]}])|(?P<equals>=)"""
)


#: The sections of a project that are not lists of tables.
NAMES = ("source", "room", "lamp", "lens", "screen", "target", "second", "design")


def _schema() -> dict[str, dict[str, Setting]]:
    """Keys of every section: those of the table, and in [source] those that source types define."""
    found = {section: in_section(section) for section in NAMES}
    found["source"]["type"] = replace(found["source"]["type"], help=sources.in_words())
    found["source"] |= {key: Setting(f"source.{key}", *spec) for key, spec in sources.own_keys().items()}
    found["element"] = {}  # a list of tables, kept as the section's only key, "list"
    return found


SCHEMA = _schema()
STAGE, ELEMENT = in_section("design.stages"), in_section("element")
#: Keys that hold tables: their heading in the file, and their keys.  Sources after the first are stored in [source] also; keys in
#: FIRST belong to the first source only.
FIRST = ("polarisation", "profile", "power_unit", "each")
TABLES = {
    ("design", "stages"): ("design.stages", STAGE),
    ("element", "list"): ("element", ELEMENT),
    ("source", "also"): ("source", {k: v for k, v in SCHEMA["source"].items() if k not in FIRST}),
}
#: Section and keys of which one says what another would: a preset gives way to either.
ALTERNATIVES = (("lens", "index", "glass"), ("", "throw", "screen_place"), ("", "mag", "picture_size"))
#: Parameters from which settings are derived, such as mag: allowed in a configuration, before its first section, but not in a
#: project.
PARAMETERS = {key: row for key, row in in_section("").items() if row.kind != "tables"}
#: Kinds of settings that are read as they are: type, and how messages name it.
PLAIN = {"text": (str, "text in quotes"), "flag": (bool, "true or false")}


def parse(text: str, where: str, parameters: bool = False) -> Given:
    """Settings from TOML text: every key known and of its type; defaults are not filled in.

    Args:
        parameters: allow PARAMETERS, too; they become the section "".

    Raises:
        InputError: naming `where` and the offending key.
    """
    raw = toml_of(text, where)
    version = raw.pop("format_version", FORMAT_VERSION)
    if type(version) is not int or not 1 <= version <= FORMAT_VERSION:
        raise InputError(f"{where}: has format_version {version!r}; this caustic {__version__} reads 1 to {FORMAT_VERSION}")
    raw.pop("created_by", None)
    out: Given = {}
    for section, table in raw.items():
        if parameters and section in PARAMETERS:
            out.setdefault("", {})[section] = _typed(f"{where}: {section}", section, table, PARAMETERS)
            continue
        if section not in SCHEMA:
            raise InputError(f"{where}: [{section}] is not a section{near(section, SCHEMA)}")
        out[section] = _section(section, table, where)
    return out


def _section(section: str, table: Any, where: str) -> dict[str, Any]:
    """The values of a section, of their types; errors as of `parse`."""
    if section == "source" and isinstance(table, list) and table and isinstance(table[0], dict):
        table = {**table[0], "also": table[1:]}
    if section == "element":
        table = {"list": table}
    if not isinstance(table, dict):
        raise InputError(f"{where}: {section} must be a section, written [{section}]")
    values = {
        key: _tables(value, where, *TABLES[section, key])
        if (section, key) in TABLES
        else _typed(f"{where}: [{section}] {key}", key, value, SCHEMA[section])
        for key, value in table.items()
    }
    return _by_angles(values, f"{where}: [{section}]") if section == "source" else values


def _by_angles(source: dict[str, Any], where: str) -> dict[str, Any]:
    """A table of [source] in which a direction has become the tilt that it stands for.

    Raises:
        InputError: there is a tilt, too, or the light does not reach the lens from there.
    """
    if "direction" not in source:
        return source
    if "tilt" in source:
        raise InputError(f"{where} takes direction or tilt, not both")
    (x, y, z), *others = source["direction"]
    if others or not 0 < z < math.inf or not math.hypot(x, y) <= z * math.tan(math.radians(GRAZING)):
        raise InputError(
            f"{where} direction must be one finite vector [x, y, z] with z > 0, within {GRAZING:g} degrees of +z, got"
            f" {[[x, y, z], *others]}"
        )
    tilt = [angle + 0.0 for angle in rooms.tilt_of((x, y, z))]
    return {key: value for key, value in source.items() if key != "direction"} | {"tilt": tilt}


def toml_of(text: str, where: str) -> dict[str, Any]:
    """The content of a TOML text, of any schema.

    Raises:
        InputError: it is invalid TOML, nested too deeply, too long, or contains an integer beyond 64 bits.
    """
    _refuse_deep(text, where)
    try:
        raw = tomllib.loads(text)
    except ValueError as error:  # also raised for integers with too many digits
        raise InputError(f"{where}: is not valid TOML: {error}") from error
    if not _fits(raw):
        raise InputError(f"{where}: holds a whole number of more than 64 bits")
    return raw


def _refuse_deep(text: str, where: str) -> None:
    """Reject dotted keys of more than MOST_NAMES names, brackets nested deeper than MOST_NESTED, and more than MOST_KEYS keys.

    tomllib's time is quadratic in the number of names, it recurses over both, and takes a kilobyte per key.  A single pass
    recognises strings and comments like tomllib, and stops at an unterminated one, where tomllib raises an error.
    """
    depth = keys = 0
    for found in _TOKEN.finditer(text):
        kind, wrong = found.lastgroup, ""
        if kind == "endless":
            return
        if kind == "names":
            wrong = f"joins more than {MOST_NAMES} names by dots; sections and keys have one or two"
        elif kind == "close":
            depth -= 1
        elif kind is not None:
            keys += kind == "equals" or depth == 0
            depth += kind == "open"
        if depth > MOST_NESTED:
            wrong = f"has more than {MOST_NESTED} brackets within each other; lists of lists have two"
        if keys > MOST_KEYS:
            wrong = f"is beyond {MOST_KEYS:,} keys and headings, the most that are read"
        if wrong:
            raise InputError(f"{where}: line {text.count(chr(10), 0, found.start()) + 1} {wrong}")


def checked(given: Mapping[str, Any], where: str, parameters: bool = False) -> Given:
    """Settings given as Python or NumPy values, with the same checks as those of a file; parameters: as for `parse`."""

    def plain(value):
        if isinstance(value, Mapping):
            return {str(k): plain(v) for k, v in value.items()}
        if isinstance(value, np.ndarray | np.generic):
            return plain(value.tolist())
        if isinstance(value, Path):
            return str(value)
        return [plain(v) for v in value] if isinstance(value, list | tuple) else value

    try:
        text = tomli_w.dumps(plain(given))
    except TypeError as error:
        raise InputError(f"{where}: holds what is neither text, a number, true or false nor a list of such ({error})") from error
    return parse(text, where, parameters)


def _fits(value) -> bool:
    """Whether all integers are within the 64 bits that TOML specifies."""
    if isinstance(value, dict | list):
        return all(map(_fits, value.values() if isinstance(value, dict) else value))
    return not isinstance(value, int) or -(2**63) <= value < 2**63


def _tables(tables, where: str, name: str, keys: dict[str, Setting]) -> list[dict[str, Any]]:
    if not isinstance(tables, list) or not (tables or name == "source") or not all(isinstance(t, dict) for t in tables):
        raise InputError(f"{where}: [[{name}]] must be a list of tables")
    found = [{k: _typed(f"{where}: [[{name}]] {k}", k, v, keys) for k, v in t.items()} for t in tables]
    return [_by_angles(table, f"{where}: [[{name}]]") for table in found] if name == "source" else found


def _typed(where: str, key: str, value, keys: dict[str, Setting]):
    if key not in keys:
        raise InputError(f"{where} is not a key{near(key, keys)}")
    kind = keys[key].kind
    if kind == "text" and isinstance(value, datetime):
        return value.isoformat()
    if kind in PLAIN:
        type, words = PLAIN[kind]
        if not isinstance(value, type):
            raise InputError(f"{where} must be {words}, got {value!r}")
        return value
    if kind in ("number", "whole"):
        return _numeric(where, value, kind == "whole")
    if kind == "points":
        return _points(where, value)
    if not isinstance(value, list) or (kind != "list" and len(value) not in (2, keys[key].both)):
        raise InputError(f"{where} must be a pair [x, y], got {value!r}")
    return [_numeric(where, v, kind == "wholes") for v in value]


def _points(where: str, value) -> list[list[float]]:
    points = value if isinstance(value, list) and value and isinstance(value[0], list) else [value]
    if not all(isinstance(p, list) and len(p) == 3 for p in points):
        raise InputError(f"{where} must be [x, y, z] or a list of such, got {value!r}")
    return [[_numeric(where, v, False) for v in p] for p in points]


def _numeric(where: str, value, whole: bool):
    wanted = int if whole else int | float
    if isinstance(value, bool) or not isinstance(value, wanted) or (isinstance(value, float) and math.isnan(value)):
        raise InputError(f"{where} must be a {'whole ' if whole else ''}number, got {value!r}")
    return value if whole else float(value)


@dataclass(frozen=True)
class Settings:
    """The settings of a project by section, complete unless `project.completion` is at work on them."""

    source: SourceSettings
    lens: LensSettings
    screen: ScreenSettings
    target: TargetSettings
    design: DesignSettings
    second: SecondSettings | None = None
    elements: tuple[ElementSettings, ...] = ()
    room: RoomSettings | None = None
    lamp: LampSettings | None = None

    @classmethod
    def of(cls, given: Given) -> Self:
        """Settings with the given ones, and the defaults that a new project's file contains."""
        source, design = (dict(given.get(section, {})) for section in ("source", "design"))
        if "also" in source:
            source["also"] = [SourceSettings.of(table) for table in source["also"]]
        if "stages" in design:
            design["stages"] = [StageSettings(table) for table in design["stages"]]
        return cls(
            SourceSettings.of(source),
            LensSettings.of(given.get("lens", {})),
            ScreenSettings.of(given.get("screen", {})),
            TargetSettings.of(given.get("target", {})),
            DesignSettings.of(design),
            SecondSettings.of(given["second"]) if "second" in given else None,
            tuple(map(ElementSettings, given.get("element", {}).get("list", ()))),
            RoomSettings.of(given["room"]) if "room" in given else None,
            LampSettings.of(given["lamp"]) if "lamp" in given else None,
        )

    def changed(self, **sections: Any) -> Self:
        """The settings with other sections."""
        return replace(self, **sections)

    def value(self, path: str) -> Any:
        """The value of a setting, or its default, by its path in `schema.table`; None in a section that is not there."""
        section, _, key = path.partition(".")
        return getattr(getattr(self, section), key, None)

    def chosen(self, entry: str) -> Any:
        """The value of a setting that is not the default, of a section or of an [[element]] table; None without one.

        entry: path or section; after a blank, the only value that counts.
        """
        path, _, only = entry.partition(" ")
        section, _, key = path.partition(".")
        sections = self.elements if section == "element" else (getattr(self, section),)
        none = (None, "", (), default(path) if path in TABLE else False, PLANE if path == "screen.radius" else None)
        values = (getattr(one, key, None) if key else one or None for one in sections)
        return next((value for value in values if value not in none and (not only or value == only)), None)


def dump(settings: Settings) -> str:
    """TOML text in the order of the schema, each key with a comment of its unit and meaning."""
    lines = [
        "# A caustic project: edit by hand as you like, then render it or resume its design.",
        f"format_version = {FORMAT_VERSION}",
        f'created_by = "caustic {__version__}"',
    ]
    for section in (getattr(settings, name) for name in NAMES):
        also = section.also if isinstance(section, SourceSettings) else ()
        unused = section is None or (section is settings.source and not section)  # a lamp has no source
        for table in () if unused else (section, *also):
            lines += ["", f"[[{table.section}]]" if also else f"[{table.section}]", *_assignments(table, SCHEMA[table.section])]
    for element in settings.elements:
        lines += ["", "[[element]]", *_assignments(element, ELEMENT)]
    for stage in settings.design.stages:
        lines += ["", "[[design.stages]]", *_assignments(stage, STAGE)]
    return "\n".join(lines) + "\n"


def _assignments(values: Mapping[str, Any], keys: dict[str, Setting]) -> list[str]:
    rows = [(f"{key} = {_toml(values[key])}", spec.note) for key, spec in keys.items() if key in values]
    width = min(40, max((len(text) for text, _ in rows), default=0))
    return [f"{text:<{width}}  # {note}" if note else text for text, note in rows]


def _toml(value) -> str:
    if isinstance(value, list | tuple):
        return "[" + ", ".join(_toml(v) for v in value) + "]"
    return tomli_w.dumps({"k": value})[len("k = ") :].strip()


def tables_of(settings: Settings) -> Given:
    """The settings as given ones: sections as dicts of those that are set, with lists."""

    def plain(value: Any) -> Any:
        if isinstance(value, Section):
            return {key: plain(one) for key, one in value.items()}
        return [plain(one) for one in value] if isinstance(value, tuple) else value

    found = {name: plain(getattr(settings, name)) for name in NAMES}
    if settings.elements:
        found["element"] = {"list": plain(settings.elements)}
    return {name: table for name, table in found.items() if table is not None}


def index_of(lens: LensSettings) -> float:
    """Refractive index from the keys index, or glass and wavelength."""
    if lens.glass is None:
        return lens.index
    if "index" in lens:
        raise InputError("[lens] takes index or glass, not both")
    return refractive_index(lens.glass, lens.wavelength)


def build_lens(lens: LensSettings) -> Lens:
    """The lens of the [lens] section, whose keys must be complete."""
    if ("knots_u" in lens) != ("knots_v" in lens):
        raise InputError("⟨lens.knots_u⟩ and knots_v go together: give both or neither")
    return Lens(
        lens.size,
        lens.z_in,
        index_of(lens),
        lens.control,
        lens.degree,
        None if lens.knots_u is None or lens.knots_v is None else (lens.knots_u, lens.knots_v),
        lens.min_thickness,
        build_base(lens),
        lens.height_range,
        lens.fresnel,
        lens.absorption,
        lens.roughness,
        lens.glass,
        lens.mirror,
        lens.aperture,
        lens.border,
        lens.array,
        lens.packing,
        lens.lenslets,
        entrance=build_entrance(lens),
        gradient=build_gradient(lens),
        crossing=lens.crossing,
    )


def build_base(lens: LensSettings) -> Offset:
    """The base surface of the [lens] section, from its file or its radii.

    Raises:
        InputError: the file was not read, or its face is smaller than the lens.
    """
    if "base_file" not in lens:
        return Offset(lens.thickness, lens.radius)
    base = content(lens, "base_file", Offset)
    if base is None:
        raise InputError(f"⟨lens.base_file⟩ {lens['base_file']!r} was not read: a STEP file of one face is needed")
    base.check_size(lens.size)
    return replace(base, thickness=lens.thickness)


def build_entrance(lens: LensSettings) -> FreeForm | None:
    """The entrance of the [lens] section, parallel to its base surface; None for a flat one.

    Raises:
        InputError: the wall is too thick for the base surface.
    """
    if check("lens.entrance", lens.entrance) == "flat":
        return None
    wall = lens.thickness - lens.z_in
    return parallel.parallel_side(build_base(lens), wall, (0.5 * lens.size[0], 0.5 * lens.size[1]))


def build_gradient(lens: LensSettings) -> Gradient | None:
    """The gradient index of the [lens] section, None if the lens is homogeneous.

    Raises:
        InputError: terms or a file are missing, or belong to another kind.
    """
    kind, values = lens.gradient, content(lens, "index_file", np.ndarray)
    if kind is not None:
        check("lens.gradient", kind)
    for key, kinds, belongs, named in (
        ("gradient_terms", KINDS, "belong", ", ".join(KINDS)),
        ("index_file", ("volume", "free"), "belongs", "volume or free"),
    ):
        if key in lens and kind not in kinds:
            raise InputError(f"⟨lens.{key}⟩ {belongs} to ⟨lens.gradient⟩ {named}, got {kind or 'none'}")
    if kind == "volume" and values is None:
        raise InputError("⟨lens.gradient⟩ volume needs ⟨lens.index_file⟩, a .npy of control values")
    if kind in KINDS:
        return Gradient(kind, lens.gradient_terms or ())
    return None if values is None else Gradient("volume", (), values)


def build_source(source: SourceSettings, type: str | None = None, lens: LensSettings | None = None) -> Source:
    """The source of the [source] section, or the same with another `type`; lens: behind whose lenslets each stands, if it does.

    Keys that the type does not use are ignored, so that stages can change the type.

    Raises:
        InputError: a value is out of range, or such a source cannot stand behind each lenslet.
    """
    made, lit = sources.type_of(type or source.type), sources.used_by("profile")
    check("source.power", source.power)  # before it is distributed to points
    if "profile" in source and not {made.name, source.type} & set(lit):
        raise InputError(f"⟨source.profile⟩ belongs to type {alternatives(lit)}, got type {source.type}")
    profile = content(source, "profile", np.ndarray)
    one = made.from_settings(source, profile)
    if source.each and lens is not None:
        if lens.mirror:
            raise InputError("⟨source.each⟩ is for lenses: behind the lenslets of a mirror, sources would stand in its light")
        pupil = Pupil(Aperture((lens.size[0] / 2.0, lens.size[1] / 2.0)), lens.z_in)
        cells, (light,) = cells_of(lens.packing, lens.array, lens.size), sources.several.lights_of(source)
        return sources.several.behind_lenslets(one, light, cells.centres, pupil)
    return one if type is not None else sources.combined(one, source)


def build_scene(settings: Settings) -> Scene:
    """The complete scene.

    Raises:
        InputError: a value is out of range, or it is a lamp, which has no height field.
    """
    if settings.lamp is not None:
        raise InputError(
            "⟨lamp.radius⟩ makes a lamp, whose surface around its light is no height field over an aperture: caustic design, render"
            " and export take it, and no other command"
        )
    return Scene(
        build_source(settings.source, lens=settings.lens),
        build_lens(settings.lens),
        build_screen(settings.screen),
        build_light(settings),
        build_second(settings),
        tuple(build_component(element, settings.lens.wavelength) for element in settings.elements),
    )


def build_component(element: ElementSettings, wavelength: float) -> Component:
    """The lens or mirror of an [[element]] table, whose size must be given."""
    kind = check("element.type", element.get("type", "lens"))
    for key in ("z", "size"):
        if key not in element:
            raise InputError(f"⟨element.{key}⟩ must be given in every [[element]]")
    for key in ("thickness", "index", "glass", "absorption") if kind == "mirror" else ():
        if key in element:
            raise InputError(f"⟨element.{key}⟩ is for lenses: light never enters a mirror")
    if {"index", "glass"} <= {*element}:
        raise InputError("[[element]] takes index or glass, not both")
    return COMPONENTS[kind](
        element.z,
        element.size,
        radius=element.radius or PLANE,
        index=refractive_index(element.glass, wavelength) if element.glass else element.index,
        glass=element.glass,
        tilt=element.tilt or (0.0, 0.0),
        thickness=element.thickness,
        absorption=element.absorption,
        aperture=element.aperture,
        free=element.free,
    )


def build_second(settings: Settings) -> SecondTarget | None:
    """The second target of the [second] section, None without one."""
    s = settings.second
    if s is None:
        return None
    if "file" in s:
        screen = build_screen(settings.screen)
        margin = [a / b for a, b in zip(screen.size, settings.target.size, strict=True)]
        size, farther = (margin[0] * s.size[0], margin[1] * s.size[1]), s.z / screen.z
        return SecondTarget(Screen(size, s.z, screen.resolution, screen.tilt, larger(screen.shift, farther)))
    if "focus" in s:
        return SecondTarget(focus=s["focus"])
    return SecondTarget() if s.collimate else None


def build_screen(screen: ScreenSettings) -> Screen:
    """The screen of the [screen] section."""
    sags = content(screen, "shape_file", np.ndarray)
    if "shape_file" in screen and sags is None:
        raise InputError(f"⟨screen.shape_file⟩ {screen['shape_file']!r} was not read: a file of heights is needed")
    return Screen(
        screen.size,
        screen.z,
        screen.resolution,
        screen.tilt,
        screen.shift,
        screen.radius or PLANE,
        None if sags is None else Sags(sags, screen.size),
        far=screen.far,
    )


def build_light(settings: Settings) -> Light:
    """Wavelengths and polarisation of the [source] section, combined for several sources."""
    return sources.several.light_of_all(settings.source, settings.target.color)


def refuse_unused(source: Mapping[str, Any], given: Iterable[str], stages: Sequence[str | None] = ()) -> None:
    """Reject settings, given by path for the current run, that the source type and those of all stages ignore.

    Keys in a file may remain when the type changes.

    Raises:
        InputError: naming the setting.
    """
    types = {source["type"], *stages} - {None}
    keys = [path.removeprefix("source.") for path in given if path.startswith("source.")]
    for key in filter(sources.used_by, keys):
        if not types & set(sources.used_by(key)):
            raise InputError(f"⟨source.{key}⟩ belongs to ⟨source⟩ {alternatives(sources.used_by(key))}, got {source['type']}")
    if len(types) == 1 and types <= set(sources.names()):
        idle = sources.type_of(*types).idle(source)
        for key in keys:
            if key in idle:
                raise InputError(f"⟨source.{key}⟩ {idle[key]}")


def by_section(given: Mapping[str, Any]) -> Given:
    """Given from values by their paths in `schema.table`; parameters without a section become the section ""."""
    found: Given = {}
    for path, value in given.items():
        section, _, key = path.rpartition(".")
        found.setdefault(section, {})[key] = value
    return found


def implied(given: Given) -> Given:
    """Given of one level, a file or the options, with those that they imply: a diameter at infinity or a time of the sun a disc,
    and a network adam.

    A type or an optimiser of the same level takes precedence, those of other levels do not.
    """
    source, design = given.get("source", {}), given.get("design", {})
    out = dict(given)
    if "angle" in source or "time" in given.get("room", {}):
        out["source"] = {"type": "disc", **source}
    if design.get("network", "none") != "none":
        out["design"] = {"optimizer": "adam", **design}
    return out


def merged(first: Given, *others: Given) -> Given:
    """Given merged key by key, later ones taking precedence; of ALTERNATIVES, one replaces the others."""
    out = {section: dict(table) for section, table in first.items()}
    for other in others:
        for section, *keys in ALTERNATIVES:
            if {*keys} & {*other.get(section, {})}:
                for key in keys:
                    out.get(section, {}).pop(key, None)
        for section, table in other.items():
            out[section] = out.get(section, {}) | table
    return out


def read(path: Path, parameters: bool = False) -> Given:
    """Given from a TOML file of at most MAX_BYTES; parameters: as for `parse`.

    Raises:
        InputError: the file is missing, too large or not text, or `parse` rejects it.
    """
    return parse(read_text(path), str(path), parameters)


def read_text(path: Path) -> str:
    """The text of a file of at most MAX_BYTES, with newlines normalised.

    Raises:
        InputError: the file is missing, too large or not text.
    """
    data = read_bytes(path, MAX_BYTES, ACCEPTED, least=0)
    try:
        text = data.decode()
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: cannot be read as text ({error}); {ACCEPTED}") from error
    return text.replace("\r\n", "\n")
