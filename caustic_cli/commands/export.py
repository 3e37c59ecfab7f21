"""caustic export: hand the lens to other programs."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Annotated

import typer

from caustic_cli import console
from caustic_cli.commands import options
from caustic_cli.errors import InputError

EXAMPLES = """Examples:

  caustic export flame.caustic --format lighttools -o flame.npz

  caustic export flame.caustic --format stl --samples 513 -o flame.stl
"""

#: Format -> suffix of its default file.
FORMATS = {"lighttools": ".npz", "stl": ".stl"}


def run(
    project: options.Project,
    format: Annotated[str, typer.Option("--format", help="lighttools (.npz point cloud with normals and the exact spline)"
                                        " or stl (closed solid).")] = "lighttools",
    output: Annotated[Path | None, typer.Option("-o", "--out", metavar="FILE", help="File to write."
                                                "  [default: PROJECT's name + the format's suffix, here]")] = None,
    samples: Annotated[str | None, typer.Option(metavar="N[xM]", help="Points along x and y.  [default: 4 a knot span, so"
                                                " that every knot is a grid line]")] = None,
    force: options.Force = False,
    json: options.Json = False,
    quiet: options.Quiet = False,
    debug: options.Debug = False,
) -> None:
    """Write the lens of PROJECT in the format of another program."""
    began = time.monotonic()
    if format not in FORMATS:
        raise InputError(f"--format must be one of {', '.join(FORMATS)}, got {format!r}")
    grid = tuple(options.both(options.counts("--samples", samples))) if samples else None

    from caustic_cli.export.lighttools import write_lighttools  # noqa: PLC0415
    from caustic_cli.export.stl import write_stl  # noqa: PLC0415
    from caustic_cli.files import refuse_foreign  # noqa: PLC0415
    from caustic_cli.project import Project  # noqa: PLC0415

    opened = Project.open(project)
    path = output or Path(project.resolve().stem + FORMATS[format])
    refuse_foreign(path, force)
    scene = opened.scene()
    if scene.lens.mirror:
        raise InputError(f"{project}: is a mirror, and the formats hold lenses: nothing is exported")
    field, checkpoint = opened.lens(scene)
    write = {"lighttools": write_lighttools, "stl": write_stl}[format]
    write(path, scene, field, checkpoint.state.heights, grid)
    size = path.stat().st_size
    console.Reporter(quiet).say(f"{path}: {size:,} bytes")
    if json:
        console.emit_json({"file": str(path), "format": format, "bytes": size, "seconds": time.monotonic() - began})
