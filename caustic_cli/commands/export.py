"""caustic export: write the lens in formats of other programs."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Annotated, Any

import typer

from caustic_cli.commands import console, options
from caustic_cli.errors import InputError, alternatives
from caustic_cli.export import FORMATS, MOST_BYTES, MOULDS, ORIENTATIONS, RINGS, UNSAMPLED, WITHIN, format_of
from caustic_cli.export.milling import MILLED, TURNED, TURNING, Milling
from caustic_cli.schema import checks

EXAMPLES = """Examples:

  caustic export flame.caustic --format lighttools -o flame.npz

  caustic export flame.caustic --format step,gcode --tool-radius 2
"""


#: Formats to which an option applies; those of milling apply to gcode.
TAKERS: dict[str, Sequence[str]] = {
    "mould": MOULDS,
    "block": MOULDS,
    "samples": [name for name in FORMATS if name not in UNSAMPLED],
    "tolerance": WITHIN,
    "max_size": [name for name in FORMATS if name not in ("phase", "gcode")],
    "levels": ("phase",),
    "script": ("lighttools",),
    "printer": ("3mf",),
    "orientation": ("3mf",),
    "ring": RINGS,
    "milling": ("gcode",),
}


class ExportOptions(options.OfDesign, options.Debugging):
    """Arguments and options of caustic export."""

    project: Annotated[
        Path | None, typer.Argument(metavar="PROJECT", help="Project directory made by caustic design.", show_default=False)
    ] = None
    format: Annotated[
        str | None,
        typer.Option(
            "--format",
            metavar="NAME[,NAME...]",
            help="; ".join(f"{name} ({suffix}, {what})" for name, (suffix, _, what) in FORMATS.items())
            + "; of a lamp step, stl, ply, obj, 3mf, mitsuba, zemax (.pob, a Polygon Object), lighttools (.step), ies (.ies, LM-63)"
            " and ldt (.ldt, EULUMDAT).  [default: what --out's suffix says; lighttools]",
        ),
    ] = None
    output: Annotated[
        Path | None,
        typer.Option("-o", "--out", metavar="FILE", help="File to write.  [default: PROJECT's name + the format's suffix, here]"),
    ] = None
    samples: Annotated[
        str | None,
        typer.Option(
            metavar="N[xM]",
            help="Points along x and y.  [default: as few as keep the picture: its relative RMS error as read from the file is at"
            " most 1.05 times that of the lens]",
        ),
    ] = None
    tolerance: Annotated[
        float | None,
        typer.Option(
            metavar="MM",
            help="Largest deviation from the surface.  stl, ply, obj, 3mf, mitsuba: of the triangles, instead of --samples;"
            " heightmap: of bilinear interpolation; gcode: of linear moves (a hundredth of the scallops); step: of a spline"
            " with as few knots as possible, 0 for the exact one; lighttools: 0 for exact numbers.  [default: as --samples]",
        ),
    ] = None
    max_size: Annotated[
        str | None,
        typer.Option(
            "--max-size",
            metavar="SIZE",
            help="Largest file, like 20MB.  Where the picture does not fit, the best below is written, with a warning.  "
            "[default: 100MB]",
        ),
    ] = None
    mould: Annotated[
        bool,
        typer.Option(
            "--mould", help="step, stl, ply, obj, 3mf, heightmap, gcode: the negative form, oriented for machining from above."
        ),
    ] = False
    block: Annotated[
        float | None,
        typer.Option(
            metavar="MM", help="Mirror or mould: least material behind the surface.  [default: a fifth of the larger side]"
        ),
    ] = None
    ring: Annotated[
        str | None,
        typer.Option(
            metavar="N|PROJECT[,PROJECT...]",
            help="stl, ply, obj, 3mf, gcode with --path rotary: a closed ring of N such panels on the outside of a cylinder, or of"
            " this one and those of other projects, in their order around its axis.",
        ),
    ] = None
    levels: Annotated[
        int | None,
        typer.Option(
            metavar="N",
            help="phase: values of the phase in a turn, 2 to 65536, as of a modulator or of etched steps.  [default: 65536]",
        ),
    ] = None
    printer: Annotated[
        str | None,
        typer.Option(
            metavar="LAYER,PLANE",
            help="3mf: Layers of the printer and the least step in their plane, µm, by which an orientation is advised.  [default:"
            " 50,50]",
        ),
    ] = None
    orientation: Annotated[
        str | None,
        typer.Option(
            metavar="advised|up|edge-x|edge-y",
            help="3mf: How the part stands on the plate.  [default: as in the scene, with the advice in its metadata]",
        ),
    ] = None
    milling: Annotated[dict[str, Any], options.FieldOptions(Milling)]
    script: Annotated[
        bool,
        typer.Option(
            "--script",
            help="lighttools: also write a Python script for its COM interface and an .lts point block that rebuild the scene.",
        ),
    ] = False


def run(asked: ExportOptions) -> None:
    """Write the lens of PROJECT in the formats of other programs."""
    say, project = asked.say, asked.project
    if project is None:
        listed = ", ".join(f"{name} ({suffix})" for name, (suffix, _, _) in FORMATS.items())
        raise InputError(f"a project is needed, and a --format or an --out with its suffix, of {listed}")
    if project.is_dir() and _is_lamp(project):
        _export_lamp(asked, project)
        return
    formats = _formats(asked)
    given = _given(asked, formats)
    most = MOST_BYTES if asked.max_size is None else options.size_in_bytes("--max-size", asked.max_size)
    options.require_project(project, archives=True)  # before torch is loaded

    from caustic_cli.workflow.export import export, exporter_of  # noqa: PLC0415

    exporter, opened = exporter_of(project, asked.at, say, most)
    if asked.ring is not None:
        from caustic_cli.workflow.ring import RingExporter  # noqa: PLC0415

        exporter = RingExporter.of(exporter, _ring(asked.ring))
    all_figures = []
    for name in formats:
        own = {option: value for option, value in given.items() if name in TAKERS[option]}
        script = asked.script and name in TAKERS["script"]
        figures = export(exporter, opened, name, asked.output, script, own, asked.force, asked.at)
        all_figures.append(figures)
        _say(figures, figures.get(name, {}).get("advice"), say)
    if asked.json:
        console.emit_json(all_figures[0] if len(formats) == 1 else {"exports": all_figures})


def _say(figures: dict[str, Any], advice: str | None, say: console.ConsoleReporter) -> None:
    """Print the figures of an exported file."""
    from caustic_cli.workflow.export import accuracy_words  # noqa: PLC0415

    words = accuracy_words(figures)
    say.result(f"{figures['file']}: {figures['bytes']:,} bytes{f', {words}' if words else ''}")
    for file in figures.get("beside", ()):
        say.result(f"{file}: {Path(file).stat().st_size:,} bytes")
    if advice:
        say.result(advice)
    if ring := figures.get("ring"):
        say.result(_ring_words(ring))
    if register := figures.get("register"):
        say.result(_register_words(register))
    if "milling" in figures:
        from caustic_cli.studies.scallops import rows  # noqa: PLC0415

        say.table("milling", rows(figures["milling"]))


def _is_lamp(project: Path) -> bool:
    """Whether a project holds a lamp."""
    from caustic_cli.config.lamp import says_lamp  # noqa: PLC0415

    options.require_project(project)
    return says_lamp(project)


def _export_lamp(asked: ExportOptions, path: Path) -> None:
    """Write a lamp, or its light.

    Raises:
        InputError: an option is given that does not apply to lamps, or a format does not hold them.
    """
    from caustic_cli.project.project import Project  # noqa: PLC0415
    from caustic_cli.workflow import lamp, lamp_formats  # noqa: PLC0415

    options.refuse_others(asked, ("format", "output", "samples", "milling"))
    samples = tuple(options.both(options.counts("--samples", asked.samples))) if asked.samples else None
    formats = _names(asked, lambda: lamp_formats.format_of("" if asked.output is None else asked.output.suffix))
    for name in formats:
        lamp_formats.check_export(name, samples)
    project, found = Project.open(path), []
    for name in formats:
        found.append(lamp.export(project, name, asked.output, samples, asked.force, asked.say))
        for file in (found[-1]["file"], *found[-1].get("beside", ())):
            asked.say.result(f"{file}: {Path(file).stat().st_size:,} bytes")
    if asked.json:
        console.emit_json(found[0] if len(formats) == 1 else {"exports": found})


def _names(asked: ExportOptions, default: Callable[[], str]) -> list[str]:
    """Names of the formats that are asked for."""
    names = [default()] if asked.format is None else [name.strip() for name in asked.format.split(",")]
    if asked.output and len(names) > 1:
        raise InputError("--out names one file; several formats are written beside each other under the project's own name")
    return names


def _formats(asked: ExportOptions) -> list[str]:
    """Names of the formats.

    Raises:
        InputError: one is unknown, or the output does not fit it.
    """
    formats = _names(asked, lambda: format_of(asked.output) if asked.output else "lighttools")
    for name in formats:
        format_of(asked.output, name)
    return formats


def _given(asked: ExportOptions, formats: list[str]) -> dict[str, Any]:
    """The options of formats that were given, by name, as `workflow.export.export` takes them.

    Raises:
        InputError: one applies to none of the formats, is out of range, or contradicts another.
    """
    _check_takers(asked, formats)
    if asked.block is not None and not 0 < asked.block < 1e6:
        raise InputError(f"--block must be greater than 0 mm, got {asked.block:g}")
    _check_milling(asked.milling)
    if asked.max_size is not None and (asked.samples is not None or asked.tolerance is not None):
        raise InputError("--max-size chooses the points itself: give it without --samples and --tolerance")
    if asked.orientation is not None:
        checks.choice("--orientation", asked.orientation, ("advised", *ORIENTATIONS))
    given = {
        "mould": asked.mould or None,
        "block": asked.block,
        "samples": tuple(options.both(options.counts("--samples", asked.samples))) if asked.samples else None,
        "tolerance": asked.tolerance,
        "levels": asked.levels,
        "printer": _printer(asked.printer) if asked.printer else None,
        "orientation": asked.orientation,
        "milling": asked.milling or None,
    }
    return {name: value for name, value in given.items() if value is not None}


def _ring(text: str) -> int | list[Path]:
    """Number of equal panels, or the projects of the others."""
    if text.strip().isdecimal() and len(text) < 10:
        return int(text)
    paths = [Path(name.strip()) for name in text.split(",")]
    for path in paths:
        options.require_project(path, archives=True)
    return paths


def _ring_words(ring: dict[str, Any]) -> str:
    """A ring of panels, in a line."""
    nx, ny = ring["panel_points"]
    return (
        f"ring of {ring['panels']} panels of {ring['panel_degrees']:.4g} degrees and {nx} x {ny} points, radius"
        f" {ring['outer_radius_mm']:.5g} mm, {ring['triangles']:,} triangles, {1e-3 * ring['volume_mm3']:.4g} cm³; steps between"
        f" panels up to {ring['step_mm']:.3g} mm"
    )


def _register_words(register: dict[str, Any]) -> str:
    """The register of both sides of a lens, or of the halves of its mould, in a line."""
    apart = f"backs {register['between_backs_mm']:.6g} mm apart" if "between_backs_mm" in register else ""
    if "pins_mm" not in register:
        return f"the halves of the mould are closed with their {apart}"
    wide, high, thick = register["stock_mm"]
    pins = f"pins of {register['pin_diameter_mm']:g} mm at x = {' and '.join(f'{x:g}' for x, _ in register['pins_mm'])}, y = 0"
    if apart:
        return f"the halves of the mould on {pins}, with a frame of {register['frame_mm']:.6g} mm between their faces: {apart}"
    return f"both sides in a stock of {wide:.4g} x {high:.4g} x {thick:g} mm, turned over about x on {pins}"


def _printer(text: str) -> tuple[float, float]:
    """Layer and step in its plane, mm, from µm."""
    layer, plane = options.numbers("--printer", text, (2,), ",", "two lengths in µm, like 50,35")
    if not all(0.1 <= length <= 1000.0 for length in (layer, plane)):
        raise InputError(f"--printer must be two lengths from 0.1 to 1000 µm, got {text!r}")
    return 1e-3 * layer, 1e-3 * plane


def _check_takers(asked: ExportOptions, formats: list[str]) -> None:
    """Check that every option given applies to one of the formats."""
    said = {name: getattr(asked, name) for name in TAKERS if name != "milling"}
    for name, value in (said | asked.milling).items():
        takers = TAKERS.get(name, TAKERS["milling"])
        if value is not None and value is not False and not set(takers) & set(formats):
            what = " (a spline, or a path along it, has no samples)" if name == "samples" else ""
            option = f"--{name.replace('_', '-')}"
            raise InputError(f"{option} belongs to --format {alternatives(takers)}, got {', '.join(formats)}{what}")


def _check_milling(given: dict[str, Any]) -> None:
    """Check that milling options are within range and do not contradict each other."""
    rough = [name for name in given if name in ("roughing_tool", "roughing_radius", "allowance")]
    if rough and "roughing" not in given:
        raise InputError(f"--{rough[0].replace('_', '-')} belongs to --roughing, which is not given")
    turns = given.get("path") == TURNING
    if others := [name for name in given if name in (MILLED if turns else TURNED)]:
        option = f"--{others[0].replace('_', '-')}"
        raise InputError(
            f"{option} belongs to {'another --path' if turns else '--path turning'}, got {given.get('path', 'raster')}"
        )
    if "scallop" in given and "step_over" in given:
        raise InputError("--scallop and --step-over both say how far passes are apart: give one of them")
    Milling(**given)
