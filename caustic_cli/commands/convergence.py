"""caustic convergence: what accuracy costs in time."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Annotated

import typer

from caustic_cli import console
from caustic_cli.commands import options
from caustic_cli.errors import InputError

EXAMPLES = """Examples:

  caustic convergence flame.caustic --study rays -o accuracy

  caustic convergence --study precision --json
"""

STUDIES = ("rays", "reconstruction", "precision")


def run(
    project: Annotated[Path | None, typer.Argument(metavar="[PROJECT]", help="Project made by caustic design; without one, the"
                                                   " sphere a design begins from.", show_default=False)] = None,
    study: Annotated[str, typer.Option(help="rays, reconstruction or precision.")] = "rays",
    rays: Annotated[str | None, typer.Option(metavar="N", help="Rays of the largest setting; the reference takes 16 times as"
                                             " many.  [default: by study, about half a minute in all]")] = None,
    repeats: Annotated[int, typer.Option(help="Rounds, each with fresh rays; the times' median and range are reported.")] = 3,
    output: Annotated[Path, typer.Option("-o", "--out", metavar="DIR", help="Where CSV, JSON and PNG go.")]
    = Path("convergence"),
    force: options.Force = False,
    json: options.Json = False,
    quiet: options.Quiet = False,
    seed: options.Seed = None,
    device: options.Device = "auto",
    dtype: options.Dtype = None,
    threads: options.Threads = None,
    debug: options.Debug = False,
) -> None:
    """Measure the error of an image, and the time it took, for many settings in one run."""
    began, say = time.monotonic(), console.Reporter(quiet)
    if study not in STUDIES:
        raise InputError(f"--study must be one of {', '.join(STUDIES)}, got {study!r}")
    count = options.rays("--rays", rays) if rays else None
    if output.exists() and not output.is_dir():
        raise InputError(f"{output}: is a file; a directory for CSV, JSON and PNG is needed")
    device = options.start_torch(device, threads, say)

    from caustic_cli.files import refuse_foreign  # noqa: PLC0415
    from caustic_cli.project import Project  # noqa: PLC0415
    from caustic_cli.session import sphere  # noqa: PLC0415
    from caustic_cli.studies.convergence import run_study  # noqa: PLC0415
    from caustic_cli.studies.report import write  # noqa: PLC0415

    if output.is_dir():
        for kind in ("json", "png"):
            refuse_foreign(output / f"{study}.{kind}", force)
    if project is None:
        scene, field, heights = sphere()
    else:
        opened = Project.open(project)
        scene = opened.scene()
        field, checkpoint = opened.lens(scene)
        heights = checkpoint.state.heights
    with say.progress(None) as show:
        found = run_study(study, scene, field, heights.to(device), seed=seed or 0, max_rays=count, repeats=repeats,
                          dtype=options.dtype_of(dtype) if dtype else None,
                          progress=lambda done, whole: show(study, "rays", done, whole))
    paths = write(found, output)
    rows = [(name, "no order could be fitted" if order is None else f"error ~ rays^-{order.exponent:.2f} (+-{order.deviation:.2f})")
            for name, order in found.orders.items()]
    say.table(f"{study}: fitted orders", [*rows, ("advice", found.advice), ("written", ", ".join(map(str, paths)))])
    if json:
        console.emit_json({"study": study, "advice": found.advice, "rows": found.rows, "files": [str(p) for p in paths],
                           "orders": {k: None if o is None else o.exponent for k, o in found.orders.items()},
                           "seconds": time.monotonic() - began})
