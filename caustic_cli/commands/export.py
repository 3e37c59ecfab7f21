"""caustic export: hand the lens to other programs."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from caustic_cli.commands import console, options
from caustic_cli.errors import InputError
from caustic_cli.export import FORMATS, UNSAMPLED, WITHIN
from caustic_cli.export.milling import Milling

EXAMPLES = """Examples:

  caustic export flame.caustic --format lighttools -o flame.npz

  caustic export flame.caustic --format stl --tolerance 0.0001 -o flame.stl

  caustic export flame.caustic --format gcode --tool-radius 2 --scallop 0.0005
"""


@options.from_fields(Milling, "milling")
def run(
    project: options.Project,
    format: Annotated[
        str,
        typer.Option("--format", help="; ".join(f"{name} ({suffix}, {what})" for name, (suffix, _, what) in FORMATS.items()) + "."),
    ] = "lighttools",
    output: Annotated[
        Path | None,
        typer.Option("-o", "--out", metavar="FILE", help="File to write.  [default: PROJECT's name + the format's suffix, here]"),
    ] = None,
    samples: Annotated[
        str | None,
        typer.Option(metavar="N[xM]", help="Points along x and y.  [default: 4 a knot span, so that every knot is a grid line]"),
    ] = None,
    tolerance: Annotated[
        float | None,
        typer.Option(
            metavar="MM",
            help="stl, ply, obj, mitsuba: as many points as keep every triangle so close to the surface, instead of --samples;"
            " heightmap: a bilinear surface (1e-4); gcode: straight moves (a hundredth of the scallops).",
        ),
    ] = None,
    mould: Annotated[
        bool, typer.Option("--mould", help="step, stl, ply, obj, heightmap, gcode: the negative, turned to be cut from above.")
    ] = False,
    block: Annotated[
        float | None,
        typer.Option(
            metavar="MM", help="Of a mirror or a mould: least material behind the surface.  [default: a fifth of the larger side]"
        ),
    ] = None,
    milling: dict[str, Any] = {},  # noqa: B006 (it stands for the options of Milling)
    script: Annotated[
        bool,
        typer.Option(
            "--script",
            help="lighttools: also write a Python script for its COM interface and an .lts point block that rebuild the scene.",
        ),
    ] = False,
    force: options.Force = False,
    json: options.Json = False,
    quiet: options.Quiet = False,
    debug: options.Debug = False,
) -> None:
    """Write the lens of PROJECT in the format of another program."""
    say = console.Reporter(quiet)
    if format not in FORMATS:
        raise InputError(f"--format must be one of {', '.join(FORMATS)}, got {format!r}")
    given: dict = {"mould": True} if mould else {}
    if block is not None:
        if not 0 < block < 1e6:
            raise InputError(f"--block must be greater than 0 mm, got {block:g}")
        given["block"] = block
    if milling:
        if format != "gcode":
            raise InputError(f"--{next(iter(milling)).replace('_', '-')} belongs to --format gcode, got {format}")
        rough = [name for name in milling if name in ("roughing_tool", "roughing_radius", "allowance")]
        if rough and "roughing" not in milling:
            raise InputError(f"--{rough[0].replace('_', '-')} belongs to --roughing, which is not given")
        if "scallop" in milling and "step_over" in milling:
            raise InputError("--scallop and --step-over both say how far passes are apart: give one of them")
        given["milling"] = milling
        Milling(**milling)
    if samples:
        given["samples"] = tuple(options.both(options.counts("--samples", samples)))
        if format in UNSAMPLED:
            what = "step file holds the spline itself" if format == "step" else "program follows the spline itself"
            raise InputError(f"--samples: a {what}, which has no samples")
    if tolerance is not None:
        if format not in WITHIN:
            raise InputError(f"--tolerance belongs to --format {', '.join(WITHIN[:-1])} or {WITHIN[-1]}, got {format}")
        given["tolerance"] = tolerance
    if script and format != "lighttools":
        raise InputError(f"--script belongs to --format lighttools, got {format}")

    from caustic_cli.workflow.export import export  # noqa: PLC0415

    figures, reused = export(project, format, output, script, given, force, say)
    if not reused:
        for file in (figures["file"], *figures.get("beside", ())):
            say.say(f"{file}: {Path(file).stat().st_size:,} bytes")
        if "milling" in figures:
            from caustic_cli.studies.scallops import rows  # noqa: PLC0415

            say.table("milling", rows(figures["milling"]))
    if json:
        console.emit_json(figures)
