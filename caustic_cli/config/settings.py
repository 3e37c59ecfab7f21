"""What project.toml may say: sections, keys, units, defaults; and how it becomes a scene and a schedule.

Settings are a plain nested dict with the file's own keys.  Ranges are checked where the scene and the stages are
built; here, keys and types.
"""

from __future__ import annotations

import difflib
import math
import re
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import tomli_w

from caustic_cli import __version__
from caustic_cli.errors import InputError
from caustic_cli.scene import Lens, Light, Offset, Scene, Screen, Source, checks, sources
from caustic_cli.scene.materials import D_LINE, refractive_index

FORMAT_VERSION = 1
MAX_BYTES = 1 << 24  # of a TOML file: a hundred thousand source points fit


@dataclass(frozen=True)
class Key:
    """A key of project.toml: its type, and the comment written beside it."""

    kind: str  # number, whole, text, flag, numbers (two), wholes (two), list (of numbers), points (x, y, z, or a list of such)
    note: str = ""


SCHEMA: dict[str, dict[str, Key]] = {
    "source": {
        "type": Key("text", sources.in_words()),
        "power": Key("number", "of all: through the aperture, or into the cone"),
        "power_unit": Key("text", "W, or lm for images in lux; without it, W"),
        "profile": Key("text", "plane: file here with the relative irradiance over the aperture"),
        "file": Key("text", "rays: ray file here, IES TM-25, Zemax or LightTools; disc: picture of its brightness"),
        "position": Key("points", "mm; point: one or several [x, y, z]; grid, disc: the centre; rays: the file's origin"),
        "powers": Key("list", "point: relative power of each position"),
        "size": Key("numbers", "mm, full width and height of a grid or disc"),
        "grid": Key("wholes", "points of a grid along x and y"),
        "cone": Key("number", "degrees, half-angle of the cone about +z; without it, as wide as the lens"),
        "angle": Key("number", "degrees, disc at infinity (the sun: 0.533): full angle it is seen under"),
        "intensity": Key("text", "uniform in solid angle, lambertian, or a .csv here: degrees from +z, intensity"),
        "aim": Key("flag", "sample rays on the lens, not all over the cone"),
        **{key: Key(*spec) for key, spec in sources.own_keys().items()},
        "polarisation": Key("number", "degrees from +x, of linearly polarised light; without it, unpolarised"),
        "wavelengths": Key("list", "nm, of the source's spectrum; dispersed by [lens] glass"),
        "weights": Key("list", "relative power at each wavelength"),
    },
    "lens": {
        "size": Key("numbers", "mm, full width and height of the aperture"),
        "z_in": Key("number", "mm, flat entrance surface"),
        "thickness": Key("number", "mm, offset surface at the centre"),
        "radius": Key("numbers", "mm, of the offset along x and y; inf is flat, positive spreads light"),
        "height_range": Key("numbers", "mm, least and largest departure from the offset"),
        "min_thickness": Key("number", "mm, least distance of the surface from z_in"),
        "index": Key("number", "refractive index"),
        "glass": Key("text", "material, instead of index"),
        "wavelength": Key("number", "nm, at which the glass is taken"),
        "fresnel": Key("text", "reflection losses: none, schlick or exact"),
        "absorption": Key("number", "1/mm, a in exp(-a t) through t mm of glass (Beer-Lambert)"),
        "roughness": Key("number", "standard deviation of the slopes of the exit's microfacets along an axis"),
        "mirror": Key("flag", "the surface reflects; the screen stands on the source's side"),
        "aperture": Key("text", "rectangle, or circle: the largest within size"),
        "border": Key("number", "mm, width of a rim around the aperture, for the mount"),
        "control": Key("wholes", "control points of the finished lens"),
        "degree": Key("wholes", "spline degrees"),
        "knots_u": Key("list", "knot vector on [0, 1] along x"),
        "knots_v": Key("list", "knot vector on [0, 1] along y"),
    },
    "screen": {
        "z": Key("number", "mm, from the lens' origin"),
        "size": Key("numbers", "mm, full width and height"),
        "resolution": Key("wholes", "pixels"),
        "tilt": Key("numbers", "degrees, turned about its own middle along x, then along y"),
        "shift": Key("numbers", "mm, of its middle from the axis"),
    },
    "target": {
        "file": Key("text", "the picture, in this directory"),
        "size": Key("numbers", "mm, width and height of the picture on the screen"),
        "encoding": Key("text", "of the picture's values: srgb or linear"),
        "flip": Key("text", "mirror the picture along x, y or xy; empty for none"),
        "color": Key("flag", "red, green and blue apart, at the source's three wavelengths"),
    },
    "design": {
        "loss": Key("text", "weighted sum of rms (eq. 5.2.1), rms-light, throughput, light, diffusion, uniformity, laplacian,"
                            " curvature"),
        "max_slope": Key("number", "limit of the surface's slope; 0 for none"),
        "min_radius": Key("number", "mm, least radius of concave places (the tool's); 0 for any"),
        "optimizer": Key("text", "lbfgs or adam"),
        "lr": Key("number", "learning rate of adam"),
        "network": Key("text", "none, sparse or dense"),
        "initial": Key("text", "parameters at first: zero, uniform (+-1e-4) or random"),
        "preconditioner": Key("text", "none or laplacian"),
        "filter_target": Key("flag", "filter the target as the render is filtered"),
        "waves": Key("text", "auto, on or off: refine the wave image after the ray image"),
        "start": Key("text", "transport, offset, or the project or file whose lens was the first surface"),
        "iterations": Key("whole", "in all; 0: what the stages say"),
        "time_limit": Key("number", "s; inf for none"),
        "checkpoint_every": Key("number", "s between checkpoints"),
        "seed": Key("whole", "of rays and networks"),
        "dtype": Key("text", "of the rays: float32 or float64"),
    },
}
STAGE: dict[str, Key] = {
    "source": Key("text", "type of source in this stage, with the other keys of [source]"),
    "control": Key("wholes", "control points"),
    "rays": Key("whole"),
    "sampler": Key("text", "grid, lines, stratified, uniform or sobol"),
    "reconstruction": Key("text", "bincount, gaussian or cosine"),
    "filter_size": Key("wholes", "pixels, odd"),
    "alpha_per_mm2": Key("number", "of the gaussian, 1/mm^2 (eq. 4.4.5)"),
    "alpha_per_pixel2": Key("number", "of the gaussian, 1/pixel^2, instead of alpha_per_mm2"),
    "spread": Key("flag", "rays of the source's middle, whose image is spread by the source's extent"),
    "oversample": Key("whole", "filter on pixels so many times smaller, added up: sharper than the filter"),
    "blur": Key("number", "pixels, of render and target in the loss"),
    "apron": Key("whole", "dark pixels around the screen that catch stray light"),
    "iterations": Key("whole"),
    "tolerance": Key("number", "ends the stage when 10 iterations gain less than this part; 0 never"),
    "waves": Key("list", "nm, refine the wave image at these, of light that says none, instead of the ray image"),
}
#: Keys that hold tables: their heading in the file, and what each may say.  Sources beside the first are those of [source] also;
#: FIRST is the first's alone.
FIRST = ("polarisation", "profile", "power_unit")
TABLES = {("design", "stages"): ("design.stages", STAGE),
          ("source", "also"): ("source", {k: v for k, v in SCHEMA["source"].items() if k not in FIRST})}
DEFAULTS: dict[str, dict[str, Any]] = {
    "source": {"type": "plane", "power": 1.0, "intensity": "uniform", "aim": True},
    "lens": {"size": [10.0, 10.0], "z_in": 0.0, "min_thickness": 1.0, "fresnel": "exact", "degree": [3, 3]},
    "screen": {"z": 300.0},
    "target": {"encoding": "srgb", "flip": ""},
    "design": {"loss": "rms-light", "optimizer": "lbfgs", "waves": "auto", "lr": 1e-3, "network": "none", "initial": "zero",
               "filter_target": True, "max_slope": 0.0, "min_radius": 0.0, "iterations": 0, "time_limit": math.inf,
               "checkpoint_every": 10.0, "seed": 0, "dtype": "float32"},
}
DEFAULT_INDEX = 1.5443  # table D.2


def parse(text: str, where: str) -> dict[str, dict[str, Any]]:
    """Settings from TOML text: every key known and of its type; defaults are not filled in.

    Raises:
        InputError: naming `where` and the offending key.
    """
    try:
        raw = tomllib.loads(text)
    except (ValueError, RecursionError) as error:  # besides TOML's own: digits without end, brackets without end
        raise InputError(f"{where}: is not valid TOML: {error}") from error
    if not _fits(raw):
        raise InputError(f"{where}: holds a whole number of more than 64 bits")
    version = raw.pop("format_version", FORMAT_VERSION)
    if type(version) is not int or not 1 <= version <= FORMAT_VERSION:
        raise InputError(f"{where}: has format_version {version!r}; this caustic {__version__} reads 1 to {FORMAT_VERSION}")
    raw.pop("created_by", None)
    out: dict[str, dict[str, Any]] = {}
    for section, table in raw.items():
        if section not in SCHEMA:
            raise InputError(f"{where}: [{section}] is not a section{_near(section, SCHEMA)}")
        if section == "source" and isinstance(table, list) and table and isinstance(table[0], dict):
            table = {**table[0], "also": table[1:]}
        if not isinstance(table, dict):
            raise InputError(f"{where}: {section} must be a section, written [{section}]")
        out[section] = {}
        for key, value in table.items():
            if (section, key) in TABLES:
                out[section][key] = _tables(value, where, *TABLES[section, key])
                continue
            out[section][key] = _typed(f"{where}: [{section}] {key}", key, value, SCHEMA[section])
    return out


def checked(given: Mapping[str, Any], where: str) -> dict[str, dict[str, Any]]:
    """Settings given as Python values, NumPy's too, with the refusals of a file."""
    def plain(value):
        if isinstance(value, Mapping):
            return {str(k): plain(v) for k, v in value.items()}
        if isinstance(value, np.ndarray | np.generic):
            return plain(value.tolist())
        return [plain(v) for v in value] if isinstance(value, list | tuple) else value

    try:
        text = tomli_w.dumps(plain(given))
    except TypeError as error:
        raise InputError(f"{where}: holds what is neither text, a number, true or false nor a list of such ({error})") from error
    return parse(text, where)


def _fits(value) -> bool:
    """Whether all whole numbers within have at most the 64 bits that TOML asks for."""
    if isinstance(value, dict | list):
        return all(map(_fits, value.values() if isinstance(value, dict) else value))
    return not isinstance(value, int) or -(2**63) <= value < 2**63


def _tables(tables, where: str, name: str, keys: dict[str, Key]) -> list[dict[str, Any]]:
    if not isinstance(tables, list) or not (tables or name == "source") or not all(isinstance(t, dict) for t in tables):
        raise InputError(f"{where}: [[{name}]] must be a list of tables")
    return [{k: _typed(f"{where}: [[{name}]] {k}", k, v, keys) for k, v in t.items()} for t in tables]


def _typed(where: str, key: str, value, keys: dict[str, Key]):
    if key not in keys:
        raise InputError(f"{where} is not a key{_near(key, keys)}")
    kind = keys[key].kind
    if kind == "text":
        if not isinstance(value, str):
            raise InputError(f"{where} must be text in quotes, got {value!r}")
        return value
    if kind == "flag":
        if not isinstance(value, bool):
            raise InputError(f"{where} must be true or false, got {value!r}")
        return value
    if kind in ("number", "whole"):
        return _numeric(where, value, kind == "whole")
    if kind == "points":
        points = value if isinstance(value, list) and value and isinstance(value[0], list) else [value]
        if not all(isinstance(p, list) and len(p) == 3 for p in points):
            raise InputError(f"{where} must be [x, y, z] or a list of such, got {value!r}")
        return [[_numeric(where, v, False) for v in p] for p in points]
    if not isinstance(value, list) or (kind != "list" and len(value) != 2):
        raise InputError(f"{where} must be a pair [x, y], got {value!r}")
    return [_numeric(where, v, kind == "wholes") for v in value]


def _numeric(where: str, value, whole: bool):
    wanted = int if whole else int | float
    if isinstance(value, bool) or not isinstance(value, wanted) or (isinstance(value, float) and math.isnan(value)):
        raise InputError(f"{where} must be a {'whole ' if whole else ''}number, got {value!r}")
    return value if whole else float(value)


def _near(name: str, known) -> str:
    close = difflib.get_close_matches(name, known, 1, 0.5)
    return f"; did you mean {close[0]}?" if close else f"; known are {', '.join(known)}"


def with_defaults(settings: dict[str, dict[str, Any]]) -> dict[str, dict[str, Any]]:
    """Settings with every section present and constant defaults filled in."""
    return {section: {**DEFAULTS[section], **settings.get(section, {})} for section in SCHEMA}


def dump(settings: dict[str, dict[str, Any]]) -> str:
    """TOML text in the schema's order, each key with its unit or meaning beside it."""
    lines = ["# A caustic project: edit by hand as you like, then render it or resume its design.",
             f"format_version = {FORMAT_VERSION}", f'created_by = "caustic {__version__}"']
    for section, keys in SCHEMA.items():
        first = settings.get(section, {})
        also = first.get("also", []) if section == "source" else []
        for table in (first, *also):
            lines += ["", f"[[{section}]]" if also else f"[{section}]", *_assignments(table, keys)]
    for stage in settings.get("design", {}).get("stages", []):
        lines += ["", "[[design.stages]]", *_assignments(stage, STAGE)]
    return "\n".join(lines) + "\n"


def _assignments(values: dict[str, Any], keys: dict[str, Key]) -> list[str]:
    rows = [(f"{key} = {_toml(values[key])}", spec.note) for key, spec in keys.items() if key in values]
    width = min(40, max((len(text) for text, _ in rows), default=0))
    return [f"{text:<{width}}  # {note}" if note else text for text, note in rows]


def _toml(value) -> str:
    if isinstance(value, list | tuple):
        return "[" + ", ".join(_toml(v) for v in value) + "]"
    return tomli_w.dumps({"k": value})[len("k = ") :].strip()


def index_of(lens: dict[str, Any]) -> float:
    """Refractive index from the keys index, or glass and wavelength."""
    if "glass" in lens:
        if "index" in lens:
            raise InputError("[lens] takes index or glass, not both")
        return refractive_index(lens["glass"], lens.get("wavelength", D_LINE))
    return lens.get("index", DEFAULT_INDEX)


def build_lens(settings: dict[str, dict[str, Any]]) -> Lens:
    """The lens that the [lens] section describes; all its keys must be there."""
    lens = settings["lens"]
    if ("knots_u" in lens) != ("knots_v" in lens):
        raise InputError("[lens] knots_u and knots_v go together: give both or neither")
    knots = (tuple(lens["knots_u"]), tuple(lens["knots_v"])) if "knots_u" in lens else None
    offset = Offset(lens["thickness"], tuple(lens["radius"]))
    return Lens(tuple(lens["size"]), lens["z_in"], index_of(lens), tuple(lens["control"]), tuple(lens["degree"]), knots,
                lens["min_thickness"], offset, tuple(lens["height_range"]), lens["fresnel"], lens.get("absorption", 0.0),
                lens.get("roughness", 0.0), lens.get("glass"), lens.get("mirror", False),
                lens.get("aperture", "rectangle"), lens.get("border", 0.0))


def build_source(settings: dict[str, dict[str, Any]], profile: np.ndarray | None = None, type: str | None = None) -> Source:
    """What the [source] section describes, or that as another `type`.  `profile`: its irradiance if it names one.

    A key that the type has no use for is left alone, so that stages may change the type.
    """
    s = settings["source"]
    made, lit = sources.type_of(type or s["type"]), sources.used_by("profile")
    checks.number("[source] power", s["power"], 0.0, checks.POWER, open_low=True)  # before it is shared among points
    if "profile" in s and not {made.name, s["type"]} & set(lit):
        raise InputError(f"[source] profile belongs to type {sources.either(lit)}, got type {s['type']}")
    one = made.from_settings(s, profile)
    return one if type is not None else sources.together(one, s)


def build_scene(settings: dict[str, dict[str, Any]], profile: np.ndarray | None = None) -> Scene:
    """The whole scene; `profile` is the source's irradiance if [source] names one."""
    return Scene(build_source(settings, profile), build_lens(settings), build_screen(settings), build_light(settings))


def build_screen(settings: dict[str, dict[str, Any]]) -> Screen:
    """The screen that the [screen] section describes."""
    s = settings["screen"]
    return Screen(tuple(s["size"]), s["z"], tuple(s["resolution"]), tuple(s.get("tilt", (0.0, 0.0))),
                  tuple(s.get("shift", (0.0, 0.0))))


def build_light(settings: dict[str, dict[str, Any]]) -> Light:
    """Wavelengths and polarisation of the [source] section, whatever its type; of several sources, of all."""
    return sources.light_of_all(settings["source"], settings["target"].get("color", False))


def as_options(message: str, given) -> str:
    """A message about settings, in the words of the options (section, key, option) that gave them."""
    for section, key, option in given:
        message = re.sub(rf"\[{section}\] {key}\b", lambda _, option=option: option, message)
    return message


def refuse_unused(source: dict[str, Any], given, stages: Sequence[str | None] = ()) -> None:
    """Refuse options (section, key, option) for the source that its type, and that of every stage, would ignore.

    Keys in a file may stay when the type changes; an option was meant for this one run.

    Raises:
        InputError: naming the option.
    """
    types = {source["type"], *stages} - {None}
    options = {key: option for section, key, option in given if section == "source" and sources.used_by(key)}
    for key, option in options.items():
        if not types & set(sources.used_by(key)):
            raise InputError(f"{option} belongs to ⟨source⟩ {sources.either(sources.used_by(key))}, got {source['type']}")
    if len(types) == 1 and types <= set(sources.names()):
        idle = sources.type_of(*types).idle(source)
        for key, option in options.items():
            if key in idle:
                raise InputError(f"{option} {idle[key]}")


def read(path: Path) -> dict[str, dict[str, Any]]:
    """Settings from a TOML file."""
    try:
        with open(path, "rb") as f:
            text = f.read(MAX_BYTES + 1)
        if len(text) > MAX_BYTES:
            raise InputError(f"{path}: is too large; a TOML file of at most {MAX_BYTES:,} bytes is read")
        return parse(text.decode().replace("\r\n", "\n"), str(path))
    except FileNotFoundError as error:
        raise InputError(f"{path}: no such file; a TOML file is needed") from error
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"{path}: cannot be read as text ({error}); a TOML file is needed") from error
