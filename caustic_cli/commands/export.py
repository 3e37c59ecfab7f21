"""caustic export: hand the lens to other programs."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from caustic_cli.commands import console, options
from caustic_cli.errors import InputError
from caustic_cli.export import FORMATS, MESHES

EXAMPLES = """Examples:

  caustic export flame.caustic --format lighttools -o flame.npz

  caustic export flame.caustic --format stl --tolerance 0.0001 -o flame.stl
"""


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
            help="stl, ply, obj, mitsuba: as many points as keep every triangle so close to the surface, instead of --samples.",
        ),
    ] = None,
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
    given: dict = {}
    if samples:
        given["samples"] = tuple(options.both(options.counts("--samples", samples)))
        if format == "step":
            raise InputError("--samples: a step file holds the spline itself, which has no samples")
    if tolerance is not None:
        if format not in MESHES:
            raise InputError(f"--tolerance belongs to --format {', '.join(MESHES[:-1])} or {MESHES[-1]}, got {format}")
        given["tolerance"] = tolerance
    if script and format != "lighttools":
        raise InputError(f"--script belongs to --format lighttools, got {format}")

    from caustic_cli.workflow.export import export  # noqa: PLC0415

    figures, reused = export(project, format, output, script, given, force, say)
    if not reused:
        for file in (figures["file"], *figures.get("beside", ())):
            say.say(f"{file}: {Path(file).stat().st_size:,} bytes")
    if json:
        console.emit_json(figures)
