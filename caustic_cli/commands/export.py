"""caustic export: hand the lens to other programs."""

from __future__ import annotations

import time
from importlib import import_module
from pathlib import Path
from typing import Annotated

import typer

from caustic_cli import console
from caustic_cli.commands import options
from caustic_cli.errors import InputError

EXAMPLES = """Examples:

  caustic export flame.caustic --format lighttools -o flame.npz

  caustic export flame.caustic --format stl --tolerance 0.0001 -o flame.stl
"""

#: Format -> suffix of its default file, where its `write_<format>` is, what the file is.
FORMATS = {
    "lighttools": (".npz", "lighttools", "point cloud with normals and the exact spline"),
    "zemax": (".dat", "zemax", "Grid Sag with exact derivatives"),
    "step": (".step", "step", "the exact spline as a solid"),
    "stl": (".stl", "stl", "closed mesh"),
    "ply": (".ply", "ply", "closed mesh"),
    "obj": (".obj", "obj", "closed mesh"),
    "csv": (".csv", "points", "points of the exit surface"),
    "xyz": (".xyz", "points", "points of the exit surface"),
    "mitsuba": (".xml", "mitsuba", "the whole scene for Mitsuba 3, ready to run, with two meshes beside it"),
}
MESHES = ("stl", "ply", "obj", "mitsuba")


def run(
    project: options.Project,
    format: Annotated[str, typer.Option("--format", help="; ".join(f"{name} ({suffix}, {what})" for name, (suffix, _, what)
                                                                   in FORMATS.items()) + ".")] = "lighttools",
    output: Annotated[Path | None, typer.Option("-o", "--out", metavar="FILE", help="File to write."
                                                "  [default: PROJECT's name + the format's suffix, here]")] = None,
    samples: Annotated[str | None, typer.Option(metavar="N[xM]", help="Points along x and y.  [default: 4 a knot span, so"
                                                " that every knot is a grid line]")] = None,
    tolerance: Annotated[float | None, typer.Option(metavar="MM", help="stl, ply, obj, mitsuba: as many points as keep every"
                                                    " triangle so close to the surface, instead of --samples.")] = None,
    script: Annotated[bool, typer.Option("--script", help="lighttools: also write a Python script for its COM interface and an"
                                         " .lts point block that rebuild the scene.")] = False,
    force: options.Force = False,
    json: options.Json = False,
    quiet: options.Quiet = False,
    debug: options.Debug = False,
) -> None:
    """Write the lens of PROJECT in the format of another program."""
    began = time.monotonic()
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

    from caustic_cli.files import refuse_foreign  # noqa: PLC0415
    from caustic_cli.project import Project  # noqa: PLC0415

    opened = Project.open(project)
    suffix, module, _ = FORMATS[format]
    path = output or Path(project.resolve().stem + suffix)
    home = import_module(f"caustic_cli.export.{module}")
    beside = import_module("caustic_cli.export.lighttools_script") if script else None
    scene = opened.scene()
    written = [path]
    if format == "mitsuba":
        written += home.companions(path, scene.lens.round)
    elif script:
        written += beside.companions(path)
    for file in written:
        refuse_foreign(file, force)
    if scene.lens.mirror:
        raise InputError(f"{project}: is a mirror, and the formats hold lenses: nothing is exported")
    field, checkpoint = opened.lens(scene)
    getattr(home, f"write_{format}")(path, scene, field, checkpoint.state.heights, **given)
    if beside is not None:
        beside.write_script(path, scene, field, checkpoint.state.heights, **given)
    sizes = [file.stat().st_size for file in written]
    for file, size in zip(written, sizes, strict=True):
        console.Reporter(quiet).say(f"{file}: {size:,} bytes")
    if json:
        more = {"beside": [str(file) for file in written[1:]]} if len(written) > 1 else {}
        console.emit_json({"file": str(path), "format": format, "bytes": sizes[0], **more, "seconds": time.monotonic() - began})
