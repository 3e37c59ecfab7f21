"""Command-line options: those generated from the table of settings, those shared by several commands, and parsing of their
values."""

from __future__ import annotations

import dataclasses
import gc
import inspect
import math
import re
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from functools import cached_property
from importlib import import_module
from pathlib import Path
from typing import Annotated, Any, get_type_hints

import typer

from caustic_cli.commands import console
from caustic_cli.commands.console import ConsoleReporter
from caustic_cli.errors import InputError, near, no_project
from caustic_cli.loading import keep_freed_memory
from caustic_cli.schema import checks, table
from caustic_cli.schema.table import Setting

#: Options whose value `list` prints all that are known: key in JSON, heading of the table, and the module that has them.
LISTS = {
    "glass": ("glasses", ("NAME", "n_d", "V_d", "g/cm^3", "steepest slope", "also"), "caustic_cli.scene.materials"),
    "preset": ("presets", (), "caustic_cli.config.presets"),
}
At = Annotated[
    str | None,
    typer.Option(
        metavar="KEY=VALUE[,...]",
        help="For a network trained --over a range: the lens for this value, like throw=300 (mm).  [default: the middle]",
    ),
]

#: How photographs in other light or on another screen are given.
SEVERAL_PHOTOS = (
    'Repeatable: photographs of the same part, one on another screen or in other light as a TOML file, photo = "far.jpg", marks ='
    ' "far.csv", throw = 400, and sections of project.toml.'
)
#: Where the screen is in a photograph.
Marks = Annotated[
    str | None,
    typer.Option(
        metavar="auto|FILE",
        help="Where the screen is in the photograph: by the marks of the test card in it, or else by the picture itself (auto), or"
        " by a CSV of marks: column, row (pixels from the centre of the upper left one), x, y (mm on the screen).  [default: auto]",
    ),
]
ScreenCorners = Annotated[
    tuple[str, str, str, str] | None,
    typer.Option(
        metavar="C,R C,R C,R C,R",
        help="The same by the pixels of the screen's corners: column,row of its upper left, upper right, lower right and lower left"
        " corner, as in render.png.",
    ),
]


class Given:
    """Arguments and options of a command, as given.

    A subclass declares them as annotated attributes with their defaults, in the order of the help; the options of a base class
    follow its own.  `command_of` makes the command's signature of them.  An attribute annotated with a group of options
    (`TableOptions`, `FieldOptions`) holds what the group makes of those that were given.
    """

    json: bool
    quiet: bool
    progress: str = "auto"

    def __init__(self, **values: Any):
        vars(self).update(values)
        #: What ends with the command.
        self.held = ExitStack()

    @classmethod
    def follow(cls, values: dict[str, Any]) -> None:
        """What all processes but the first do instead of the command if torchrun has started several, with their options."""

    @cached_property
    def say(self) -> ConsoleReporter:
        """Where results and messages go."""
        return ConsoleReporter(self.quiet, self.progress, self.json)


class Presentation(Given):
    """Options of all commands: what they print and write."""

    force: Annotated[bool, typer.Option("--force", help="Overwrite existing files.")] = False
    json: Annotated[bool, typer.Option("--json", help="Print exactly one JSON object on stdout instead of the table.")] = False
    quiet: Annotated[bool, typer.Option("--quiet", "-q", envvar="CAUSTIC_QUIET", help="Print nothing on stderr except errors.")] = (
        False
    )


class OfDesign(Presentation):
    """Options of the commands that take the lens of a project as it is."""

    at: At = None


class WithProgress(Given):
    """The option of the commands that show their progress."""

    progress: Annotated[
        str,
        typer.Option(
            envvar="CAUSTIC_PROGRESS",
            metavar="auto|json",
            help="json: print JSON on stderr, one object per line, including the progress; errors stay plain text.",
        ),
    ] = "auto"


class Debugging(Given):
    """The last option of all commands."""

    debug: Annotated[bool, typer.Option("--debug", envvar="CAUSTIC_DEBUG", help="Show the traceback of an error.")] = False


class OnDevice(Debugging):
    """Options of the commands that trace rays."""

    seed: Annotated[
        int | None,
        typer.Option(envvar="CAUSTIC_SEED", help="Seed of all random numbers; the same seed gives the same bytes.  [default: 0]"),
    ] = None
    device: Annotated[
        str, typer.Option(envvar="CAUSTIC_DEVICE", help="cpu or cuda; auto is cpu, which gives the same bytes every time.")
    ] = "auto"
    dtype: Annotated[
        str | None,
        typer.Option(envvar="CAUSTIC_DTYPE", help="Precision of the rays: float32 or float64. The CPU kernels always use float64."),
    ] = None
    threads: Annotated[int | None, typer.Option(envvar="CAUSTIC_THREADS", help="Threads to use; default: all cores.")] = None

    def start_torch(self) -> str:
        """See `start_torch`; joins the other processes if torchrun has started several."""
        device = start_torch(self.device, self.threads, self.say)
        if checks.rank_and_size()[1] > 1:
            from caustic_cli.optics import ranks  # noqa: PLC0415

            self.held.enter_context(ranks.process_group(device))
        return device

    @classmethod
    def follow(cls, values: dict[str, Any]) -> None:
        from caustic_cli.workflow.processes import follow  # noqa: PLC0415

        follow(start_torch(values["device"], values["threads"], ConsoleReporter(True, "auto", False)))


class Computation(Presentation, WithProgress, OnDevice):
    """Options of the commands that compute for long."""


@dataclasses.dataclass(frozen=True)
class TableOptions:
    """The options that the table of settings defines for a command.

    They become path -> value of the settings given, those that are options of every command included; messages then refer to these
    settings by option (`console.named`).
    """

    command: str

    @cached_property
    def rows(self) -> dict[str, Setting]:
        """The settings by the name of the parameter."""
        return {row.option.name.lstrip("-").replace("-", "_"): row for row in table.options_of(self.command)}

    def parameters(self) -> list[inspect.Parameter]:
        """The options as parameters for Typer."""
        return [_parameter(name, row) for name, row in self.rows.items()]

    def read(self, values: dict[str, Any]) -> dict[str, Any]:
        """The settings given, from the values of all parameters of the command."""
        rows = self.rows
        said = {name: value for name in rows if not ((value := values[name]) is None or value is False or value == [])}
        spoken = {path: rows[name].option.name for name in said for path in (rows[name].path, *rows[name].speaks_for)}
        common = {name: row for name, row in COMMON.items() if values.get(name) is not None}
        console.set_option_names(spoken | {row.path: row.option.name for row in common.values()})
        given: dict[str, Any] = {row.path: values[name] for name, row in common.items()}
        for name, value in said.items():
            given |= _read(rows[name], value)
        return given


@dataclasses.dataclass(frozen=True)
class FieldOptions:
    """An option for each field of a dataclass, whose metadata have its help and unit; they become a dictionary of those given."""

    kind: type

    def parameters(self) -> list[inspect.Parameter]:
        """The options as parameters for Typer."""
        return [_of_field(row) for row in dataclasses.fields(self.kind)]

    def read(self, values: dict[str, Any]) -> dict[str, Any]:
        """The fields given, from the values of all parameters of the command."""
        return {row.name: value for row in dataclasses.fields(self.kind) if (value := values[row.name]) is not None}


def command_of(body: Callable[[Any], None]) -> Callable[..., None]:
    """A command for Typer that calls `body` with its only argument, made of the options that the class of this one declares."""
    (given,) = (kind for name, kind in get_type_hints(body).items() if name != "return")
    hints = get_type_hints(given, include_extras=True)
    bases = given.__mro__[: given.__mro__.index(Given)]
    declared = dict.fromkeys(name for base in bases for name in inspect.get_annotations(base))
    groups, parameters = {}, []
    for name in declared:
        group = getattr(hints[name], "__metadata__", (None,))[0]
        if isinstance(group, TableOptions | FieldOptions):
            groups[name] = group
            parameters += group.parameters()
        else:
            default = getattr(given, name, inspect.Parameter.empty)
            parameters.append(inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, default=default, annotation=hints[name]))

    def run(**values):
        if checks.rank_and_size()[0] > 0:
            given.follow(values)
            return
        own = {name: value for name, value in values.items() if name in declared}
        asked = given(**own, **{name: group.read(values) for name, group in groups.items()})
        with asked.held:
            body(asked)

    run.__signature__ = inspect.Signature(parameters)
    run.__annotations__ = {p.name: p.annotation for p in parameters}
    run.__doc__ = body.__doc__
    return run


def _of_field(row: dataclasses.Field) -> inspect.Parameter:
    """The option of a field."""
    known, text = row.metadata, bool(row.metadata["choices"])
    words = known["help"]
    if row.default is not None:
        words += f"  [default: {row.default if text else format(row.default, 'g')}]"
    metavar = "|".join(known["choices"]) if text else known["unit"].upper()
    option = typer.Option("--" + row.name.replace("_", "-"), metavar=metavar, help=f"gcode: {words}")
    annotation = Annotated[str | None if text else float | None, option]
    return inspect.Parameter(row.name, inspect.Parameter.KEYWORD_ONLY, default=None, annotation=annotation)


def _parameter(name: str, row: Setting) -> inspect.Parameter:
    """The option of a setting, as a parameter for Typer."""
    option, flag = row.option, row.kind == "flag" or row.option.constant is not None
    words = HELP.get(row.path) or f"{_capital(row)}{f' ({row.unit})' if row.unit else ''}."
    if not flag:
        words += f"  [default: {default_words(row)}]"
    kind = bool if flag else list[str] | None if row.kind in ("points", "tables") else _scalar(row) | None
    annotation = Annotated[kind, typer.Option(option.name, metavar=option.metavar, help=words)]
    return inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, default=False if flag else None, annotation=annotation)


def with_lists(command: Any) -> None:
    """Make a command print the known values of an option in LISTS that is given the value `list`, and nothing else: a table, or a
    JSON object.  Its other options and arguments are then neither needed nor checked."""
    parse, lists = command.parse_args, [p for p in command.params if p.name in LISTS]

    def parse_args(context, arguments):
        given, _, _ = command.make_parser(context).parse_args(args=list(arguments))

        def value(parameter):
            return parameter.process_value(context, parameter.consume_value(context, given)[0])

        for parameter in lists:
            if value(parameter) == "list":
                _print_list(parameter.name, any(value(p) for p in command.params if p.name == "json"))
                raise typer.Exit()
        return parse(context, arguments)

    command.parse_args = parse_args


def _print_list(name: str, as_json: bool) -> None:
    key, heading, module = LISTS[name]
    source = import_module(module)
    if as_json:
        console.emit_json({key: source.described()})
        return
    table = [heading, *source.rows()] if heading else source.rows()
    widths = [max(map(len, column)) for column in zip(*table, strict=True)]
    for line in table:
        console.emit("  ".join(f"{cell:<{width}}" for cell, width in zip(line, widths, strict=True)).rstrip())


def _capital(row: Setting) -> str:
    """The help with a capital first letter, unless it begins with a value or a symbol."""
    first = row.help.split(maxsplit=1)[0]
    return row.help if first.endswith(":") or first in row.choices or len(first) == 1 else f"{row.help[0].upper()}{row.help[1:]}"


def _scalar(row: Setting) -> type:
    """The type for Typer: a string for values with units or several numbers."""
    if row.path in READERS or row.unit == "mm":
        return str
    return {"number": float, "whole": int}.get(row.kind, str)


def default_words(row: Setting) -> str:
    """The default as text."""
    value = row.default
    if value is None or row.derived:
        return row.derived or "none"
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, list):
        return ("," if row.option and "," in (row.option.metavar or "") else "x").join(f"{v:g}" for v in value)
    if isinstance(value, float):
        return "none" if math.isinf(value) else f"{value:g}"
    return str(value) or "none"


def _read(row: Setting, value: Any) -> dict[str, Any]:
    """The settings, by path, that an option's value represents."""
    option = row.option
    if row.path in READERS:
        return READERS[row.path](option.name, value)
    if row.kind == "flag":
        return {row.path: True}
    if option.constant is not None:
        return {row.path: option.constant}
    if row.kind == "points":
        return {row.path: [list(numbers(option.name, p, (3,), ",", unit=row.unit)) for p in value]}
    if row.kind == "numbers":
        if "," in option.metavar:
            return {row.path: list(numbers(option.name, value, (2,), ",", unit=row.unit))}
        return {row.path: both(size(option.name, value))}
    if row.kind == "wholes":
        return {row.path: both(counts(option.name, value))}
    if row.kind == "number" and row.unit == "mm":
        return {row.path: numbers(option.name, value, (1,), unit="mm", form="a number of mm, or with a unit, like 30cm or 4in")[0]}
    return {row.path: value}


def _spectrum(option: str, text: str) -> dict[str, Any]:
    """Wavelengths with optional weights: "450:2,550"."""
    form = "wavelengths in nm, each with a weight or without, like 450:2,550"
    lines = [numbers(option, part, (1, 2), ":", form) for part in text.split(",")]
    weighed = any(len(line) == 2 for line in lines)
    weights = [line[1] if len(line) == 2 else 1.0 for line in lines] if weighed else []
    return {"source.wavelengths": [line[0] for line in lines], "source.weights": weights}


def _power(option: str, text: str) -> dict[str, Any]:
    watts, unit = power(option, text)
    return {"source.power": watts, "source.power_unit": unit}


def _sun(option: str, text: str) -> dict[str, Any]:
    """Place and time: "48.1,11.6,2026-06-21T12:00+02:00"."""
    form = "latitude, longitude and time like 48.1,11.6,2026-06-21T12:00+02:00"
    latitude, longitude, time = [*text.split(",", 2), "", ""][:3]
    if not time:
        raise InputError(f"{option} must be {form}, got {text!r}")
    place = numbers(option, f"{latitude},{longitude}", (2,), ",", form)
    return {"room.place": list(place), "room.time": time.strip()}


def _place(option: str, text: str) -> str:
    """A part of a room, its distance in mm: "floor:1m" is "floor:1000"."""
    name, colon, rest = text.strip().partition(":")
    if not colon:
        return name
    distance, comma, azimuth = rest.partition(",")
    form = "a part of a room and its distance like floor:1000, wall:2m or wall:2000,90"
    return f"{name}:{numbers(option, distance, (1,), form=form, unit='mm')[0]:.15g}{comma}{azimuth}"


def _radii(option: str, text: str) -> Any:
    """Radii of a screen or a base surface: "60" for a sphere; "60,inf" or "inf,60" for a cylinder."""
    form = "one number of mm, or two with inf for straight, like 60, 60,inf or -8cm"
    parts = [part.strip() for part in text.split(",")]
    if len(parts) > 2:
        raise InputError(f"{option} must be {form}, got {text!r}")
    radii = (math.inf if part == "inf" else numbers(option, part, (1,), unit="mm", form=form)[0] for part in parts)
    return both(tuple(radii))


def _extent(option: str, text: str) -> tuple[tuple[float, ...], dict[str, Any]]:
    """A size on the screen, mm, or as an angle, mrad, which is one in the far field: "20mrad", "1degx2deg"; and what that sets."""
    unit = next((name for name in ANGLES if text.strip().endswith(name)), None)
    if unit is None:
        return size(option, text), {}
    return tuple(ANGLES[unit] * v for v in size(option, re.sub(f" ?{unit}", "", text))), {"screen.far": True}


def _screen_size(option: str, text: str) -> dict[str, Any]:
    values, far = _extent(option, text)
    return {"screen_size": values} | far


def _picture_size(option: str, text: str) -> dict[str, Any]:
    values, far = _extent(option, text)
    return {"picture_size": values} | far


def _throw(option: str, text: str) -> dict[str, Any]:
    form = "a number of mm, or with a unit, like 30cm or 4in, or inf for the far field"
    return {"throw": numbers(option, text, (1,), unit="mm", form=form, endless=True)[0]}


def _terms(option: str, text: str) -> dict[str, Any]:
    """Numbers separated by commas, one or more."""
    return {"lens.gradient_terms": list(numbers(option, text, (text.count(",") + 1,), ",", "numbers separated by commas"))}


def _elements(option: str, texts: list[str]) -> dict[str, Any]:
    """Lenses and mirrors: "lens z=-40 thickness=4 radius=50,inf glass=N-BK7"."""
    return {"elements": [_element(option, text) for text in texts]}


def _element(option: str, text: str) -> dict[str, Any]:
    """The [[element]] table of a text."""
    rows = table.in_section("element")
    keys = {key: row for key, row in rows.items() if key != "type"}
    kind, *words = text.split() or [""]
    if kind not in rows["type"].choices:
        raise InputError(
            f"{option} must begin with {' or '.join(rows['type'].choices)}, like 'mirror z=150 tilt=45,0', got {text!r}"
        )
    found: dict[str, Any] = {"type": kind}
    for word in words:
        key, equals, value = word.partition("=")
        if not equals or not value:
            raise InputError(f"{option} {text!r}: {word!r} must be KEY=VALUE without blanks, like z=-40")
        if key not in keys:
            raise InputError(f"{option} {text!r}: {key} is not a key{near(key, keys)}")
        if key in found:
            raise InputError(f"{option} {text!r}: says {key} twice")
        found[key] = _element_value(f"{option} {text!r}: {key}", keys[key], value, kind)
    return found


def _element_value(where: str, row: Setting, text: str, kind: str) -> Any:
    """The value of a key of an [[element]] table."""
    if row.kind == "text":
        return text
    if row.kind == "number":
        return numbers(where, text, (1,), unit=row.unit, form="a number")[0]
    if row.key == "size":
        return both(size(where, text))
    alone = (1, 2) if row.key == "radius" and kind == "mirror" else (2,)
    form = "two numbers separated by a comma, like " + ("50,inf" if row.key == "radius" else "45,0")
    return both(numbers(where, text, alone, ",", form, unit=row.unit, endless=row.key == "radius"))


#: Options with their own parser.
READERS = {
    "elements": _elements,
    "lens.gradient_terms": _terms,
    "source.power": _power,
    "source.wavelengths": _spectrum,
    "lens.radius": lambda option, text: {"lens.radius": _radii(option, text)},
    "screen.radius": lambda option, text: {"screen.radius": _radii(option, text)},
    "screen.tilt": lambda option, text: {"screen.tilt": list(numbers(option, text, (2, 3), ",", "two or three angles like 20,0"))},
    "room.place": _sun,
    "rays": lambda option, text: {"rays": rays(option, text)},
    "screen_place": lambda option, text: {"screen_place": _place(option, text)},
    "screen_size": _screen_size,
    "picture_size": _picture_size,
    "throw": _throw,
    "resolution": lambda option, text: {"resolution": counts(option, text)},
}
#: Help of options that are more restricted than their setting.
HELP = {
    "target.encoding": "Pixel values are linear irradiance, not sRGB-encoded.",
    "design.iterations": "Total number of iterations, including those before --resume.",
    "source.position": "Point (may be repeated), centre of a grid or disc, or origin of a ray file (mm).",
    "room.place": "Light of the sun: place (degrees to the north and to the east) and time (with its offset from UTC), such as"
    " 48.1,11.6,2026-06-21T12:00+02:00, for a lens in a window (--faces, --slope); a disc as wide as the sun, or --source plane.",
    "design.over": "Train a network whose inputs vary over ranges (mm), so that it gives a lens for every value, selected with --at"
    " in the other commands: throw=250:350; also source.x, source.y, source.z.",
    "target.flip": "Mirror the picture along x, y or xy, for a viewer on the lens' side.",
    "lens.mirror": "The surface is a mirror; the screen is on the source's side, at the distance --throw, square to light of"
    " --source-tilt, or else shifted out of the source's light, unless --screen-shift says where.",
    "source.wavelengths": "Spectrum of the source: wavelengths (nm) and relative powers; a --glass has its own index at each.",
}
#: Settings that are options of every command.
COMMON = {row.option.name.lstrip("-"): row for row in table.TABLE.values() if row.option and row.option.common}
#: Least limit of the size of a file, bytes.
LEAST_FILE = 10_000
#: Units of length, mm, and of sizes in the far field, mrad.
UNITS = {"mm": 1.0, "cm": 10.0, "m": 1000.0, "in": 25.4}
ANGLES = {"mrad": 1.0, "deg": 1000.0 * math.radians(1.0)}


def numbers(
    option: str,
    text: str,
    count: tuple[int, ...],
    separator: str = r"[xX×]",
    form: str = "",
    unit: str = "",
    endless: bool = False,
) -> tuple[float, ...]:
    """Numbers separated by x ("10x8") or by a match of `separator`; form: description of the accepted form.

    unit: mm for lengths, which may have another unit, the last one applying to all without one: "10x8cm"; endless: accept inf.

    Raises:
        InputError: naming the option.
    """
    parts = re.split(separator, text.strip())
    parts, scales = _without_units(parts) if unit == "mm" else (parts, [1.0] * len(parts))
    try:
        values = tuple(float(p) for p in parts)
    except ValueError:
        values = ()
    if len(values) not in count or not all(math.isfinite(v) or (endless and math.isinf(v)) for v in values):
        usual = "a number or two like 10x8" if separator.startswith("[x") else f"{max(count)} numbers separated by commas"
        raise InputError(f"{option} must be {form or usual}, got {text!r}")
    return tuple(v * scale for v, scale in zip(values, scales, strict=True))


def _without_units(parts: list[str]) -> tuple[list[str], list[float]]:
    """Lengths without their units, and the mm of each unit."""
    matches = [re.fullmatch(r"(.*?[0-9.]) ?(mm|cm|m|in)?", part.strip()) for part in parts]
    units = [match[2] if match else None for match in matches]
    return (
        [part if match is None else match[1] for part, match in zip(parts, matches, strict=True)],
        [UNITS[unit or units[-1] or "mm"] for unit in units],
    )


def size(option: str, text: str) -> tuple[float, float] | tuple[float]:
    """W or WxH in mm, or with units, greater than 0."""
    values = numbers(option, text, (1, 2), unit="mm")
    if min(values) <= 0:
        raise InputError(f"{option} must be greater than 0, got {text!r}")
    return values


def size_in_bytes(option: str, text: str) -> int:
    """A size of a file in bytes: "20MB", "1.5 GB", "500kB", "2000000".

    Raises:
        InputError: naming the option.
    """
    found = re.fullmatch(r"(\d{1,12}(?:\.\d{1,6})?) ?(B|kB|MB|GB)?", text.strip(), re.ASCII)
    value = round(float(found[1]) * {"B": 1.0, "kB": 1e3, "MB": 1e6, "GB": 1e9}[found[2] or "B"]) if found else 0
    if value < LEAST_FILE:
        raise InputError(f"{option} must be a size of at least {LEAST_FILE // 1000} kB, like 20MB or 500kB, got {text!r}")
    return value


def power(option: str, text: str) -> tuple[float, str]:
    """A power and its unit, W by default: "100lm", "2 W", "2".

    Raises:
        InputError: naming the option.
    """
    found = re.fullmatch(r"([0-9.]+(?:[eE][+-]?[0-9]+)?) ?(W|lm)?", text.strip(), re.ASCII)
    try:
        value = float(found[1]) if found else math.nan
    except ValueError:  # more than one decimal point
        value = math.nan
    if not 0 < value <= checks.POWER:
        raise InputError(
            f"{option} must be a number greater than 0 and at most {checks.POWER:g}, of W or lm, like 2W or 100lm, got {text!r}"
        )
    return value, found[2] or "W"


def counts(option: str, text: str) -> tuple[int, ...]:
    """N or NxM, whole and at least 1."""
    values = numbers(option, text, (1, 2))
    if any(v != int(v) or v < 1 for v in values):
        raise InputError(f"{option} must be whole numbers of at least 1, got {text!r}")
    return tuple(int(v) for v in values)


def refuse_alpha(alpha: float | None, reconstruction: str) -> None:
    """Refuse an alpha of a filter that has none."""
    if alpha is not None and reconstruction != "gaussian":
        raise InputError(f"--alpha belongs to --reconstruction gaussian, got {reconstruction}")


def both(values: tuple) -> list:
    """A pair from one value for both axes, or from one each."""
    return list(values) if len(values) == 2 else [values[0], values[0]]


def rays(option: str, text: str) -> int:
    """A number of rays, possibly in the form 2e6."""
    (value,) = numbers(option, text, (1,))
    if value != int(value) or not 1 <= value <= 1e12:
        raise InputError(f"{option} must be a whole number 1 to 1e12 (2e6 is fine), got {text!r}")
    return int(value)


def refuse_others(asked: Given, taken: Sequence[str]) -> None:
    """Refuse options that a lamp does not have.

    taken: names of those that it has, beside those of every command.

    Raises:
        InputError: naming one that was given.
    """
    common = {name for one in (Presentation, WithProgress, Debugging, OnDevice) for name in one.__annotations__}
    others = [table.TABLE[path].option for path in getattr(asked, "given", {}) if not path.startswith("design.")]
    names = [option.name for option in others if option is not None]
    for name, value in vars(asked).items():
        if name not in {*common, *taken, "given", "project", "say", "held"} and value not in (getattr(type(asked), name, None), {}):
            names.append(f"--{name.replace('_', '-')}")
    if names:
        raise InputError(f"{names[0]} is for a lens before its light, and not available for a lamp around it (--lamp)")


def require_project(path: Path, archives: bool = False) -> None:
    """Check that a path is a project whose settings are valid one by one, or an archive if accepted, before torch is loaded and
    kernels are compiled.

    Raises:
        InputError: it is neither.
    """
    if (path / "project.toml").is_file():
        from caustic_cli.config.values import refuse_bad_file  # noqa: PLC0415

        refuse_bad_file(path / "project.toml")
        return
    if archives and path.suffix.lower() == ".npz" and path.is_file():
        return
    beside = path.parent / f"{path.name}.caustic"
    if path.name and (beside / "project.toml").is_file():
        raise InputError(f"{path}: is not a caustic project; did you mean {beside}?")
    if path.is_file() and path.suffix.lower() in (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".webp", ".bmp", ".gif", ".npy"):
        raise InputError(f"{path}: is a picture, not a project; caustic design {path} makes its lens first")
    raise no_project(path)


def start_torch(device: str, threads: int | None, say: ConsoleReporter):
    """Load torch, set its number of threads and choose the device ("cpu" or "cuda"), with a message about CUDA.

    Raises:
        InputError: the device is unknown, CUDA is requested but absent, or the number of threads is invalid.
    """
    if device not in ("auto", "cpu", "cuda"):
        raise InputError(f"--device must be auto, cpu or cuda, got {device!r}")
    if threads is not None and not 1 <= threads <= 1024:
        raise InputError(f"--threads must be a whole number 1 to 1024, got {threads}")
    keep_freed_memory()
    import torch  # noqa: PLC0415

    if threads:
        torch.set_num_threads(threads)
    if device == "cuda" and not torch.cuda.is_available():
        raise InputError("--device cuda: no CUDA device is available; use auto or cpu")
    from caustic_cli.workflow.compilation import choose_device  # noqa: PLC0415

    gc.freeze()  # the libraries' objects are not searched for unused ones again
    gc.enable()
    return choose_device(device, say)


def dtype_of(name: str):
    """The torch dtype of float32 or float64."""
    import torch  # noqa: PLC0415

    if name not in ("float32", "float64"):
        raise InputError(f"--dtype must be float32 or float64, got {name!r}")
    return getattr(torch, name)


def indices(option: str, text: str) -> tuple[int, int]:
    """I,J: two whole numbers of at least 0."""
    values = numbers(option, text, (2,), ",")
    if any(v != int(v) or v < 0 for v in values):
        raise InputError(f"{option} must be two whole numbers like 3,5, got {text!r}")
    return int(values[0]), int(values[1])


def refuse_marks(asked: Any, photo: str) -> None:
    """Refuse where the screen is in a photograph without one; photo: the option that names it.

    Raises:
        InputError: marks or corners are given.
    """
    names = [name for name in ("marks", "screen-corners") if getattr(asked, name.replace("-", "_"))]
    if names and not getattr(asked, photo):
        raise InputError(f"--{names[0]} belongs to --{photo}, which names the photograph")
