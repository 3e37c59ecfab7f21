"""caustic convergence: studies of error against computing time."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Annotated

import typer

from caustic_cli.commands import console, options
from caustic_cli.errors import InputError

EXAMPLES = """Examples:

  caustic convergence -o accuracy

  caustic convergence flame.caustic --study design --seconds 20
"""

STUDIES = ("intersection", "rays", "reconstruction", "precision", "effects", "design", "diffraction", "light")
#: Studies that use --rays for their largest setting also in --study all.
BY_RAYS = ("rays", "reconstruction", "precision", "effects")
#: Studies whose errors are those of lenses against the picture, as of a design; others compare images with each other.
OF_LENSES = ("design", "networks", "light")


def run(
    project: Annotated[
        Path | None,
        typer.Argument(
            metavar="[PROJECT]",
            help="Project made by caustic design; without one, the"
            " base sphere of a design (intersection: the scene of the thesis' table"
            " D.3; design: a bright disc; light: the same, from an LED 3 mm in front of"
            " the lens).",
            show_default=False,
        ),
    ] = None,
    study: Annotated[
        str,
        typer.Option(
            help="intersection: of rays and surface, by the thesis' triangle mesh and by Newton's"
            " method; rays: samplers; reconstruction: filters; precision: float32 and float64;"
            " effects: each on and off; design:"
            " optimisers, networks and control nets; diffraction: rays against waves over lens"
            " size, wavelength and source size; light: image error against efficiency, over"
            " thickness and the loss' weight of light; all: one after the other."
        ),
    ] = "intersection",
    networks: Annotated[
        bool,
        typer.Option(
            "--networks",
            help="Study design: a grid of networks over layers, width, activation, learning rate and preconditioner, all trained"
            " equally; for a project designed --over a range also one lens for the whole range and a network for each value.",
        ),
    ] = False,
    rays: Annotated[
        str | None,
        typer.Option(
            metavar="N",
            help="Rays of the largest setting; the reference takes 16 times as"
            " many.  Study intersection: rays intersected; study design: rays of a retrace."
            "  [default: by study, about half a minute in all]",
        ),
    ] = None,
    repeats: Annotated[
        int | None,
        typer.Option(
            help="Rounds, each with fresh rays (intersection: the same); the times' median and"
            " range are reported.  [default: 3; intersection: 9]"
        ),
    ] = None,
    seconds: Annotated[
        float | None,
        typer.Option(
            help="Study design: time per method, with --networks on average.  [default: 4]  Study light: per lens.  [default: 10]"
        ),
    ] = None,
    output: Annotated[Path, typer.Option("-o", "--out", metavar="DIR", help="Directory for CSV, JSON and PNG.")] = Path(
        "convergence"
    ),
    force: options.Force = False,
    json: options.Json = False,
    quiet: options.Quiet = False,
    progress: options.Progress = "auto",
    seed: options.Seed = None,
    device: options.Device = "auto",
    dtype: options.Dtype = None,
    threads: options.Threads = None,
    debug: options.Debug = False,
) -> None:
    """Measure errors and computing times for many settings."""
    began, say = time.monotonic(), console.Reporter(quiet, progress, json)
    if study not in (*STUDIES, "all"):
        raise InputError(f"--study must be one of {', '.join(STUDIES)} or all, got {study!r}")
    if networks and study != "design":
        raise InputError(f"--networks belongs to --study design, got {study}")
    names = STUDIES if study == "all" else ("networks",) if networks else (study,)
    count = options.rays("--rays", rays) if rays else None
    for option, given in (("--seconds", seconds), ("--repeats", repeats), ("--dtype", dtype)):
        if given is not None and not any(_takes(name, option) for name in names):
            raise InputError(f"{option} has no meaning for --study {study}: leave it out")
    precision = options.dtype_of(dtype) if dtype else None
    if (output.exists() or output.is_symlink()) and not output.is_dir():
        raise InputError(f"{output}: is no directory; a directory for CSV, JSON and PNG is needed")
    if project is not None:
        options.require_project(project)
    device = options.start_torch(device, threads, say)

    from caustic_cli.studies import report  # noqa: PLC0415
    from caustic_cli.workflow.convergence import PLOTS, UNITS, Request, measure  # noqa: PLC0415
    from caustic_cli.workflow.lens import load  # noqa: PLC0415

    if output.is_dir():
        for name in names:
            report.refuse_foreign_files(report.paths_of(name, output, PLOTS.get(name)), force)
    lens, done = None if project is None else load(project), []
    for name in names:
        asked = Request(
            count if study != "all" or name in BY_RAYS else None,
            repeats if _takes(name, "--repeats") else None,
            seconds if _takes(name, "--seconds") else None,
            seed,
            precision if _takes(name, "--dtype") else None,
        )
        start = time.monotonic()
        with say.progress(None) as show:

            def tell(part: int, whole: int, name: str = name, show=show) -> None:
                show(name, UNITS.get(name, "rays"), part, whole)

            found = measure(name, lens, asked, device, say, tell)
        paths = report.write(found, output)
        _show(found, paths, say)
        done.append(_as_json(found, paths) | {"seconds": time.monotonic() - start})
    if json:
        console.emit_json(done[0] if study != "all" else {"study": "all", "studies": done, "seconds": time.monotonic() - began})


def _takes(study: str, option: str) -> bool:
    """Whether an option applies to a study."""
    if option == "--seconds":
        return study in ("design", "networks", "light")
    if option == "--repeats":
        return study not in ("design", "networks", "diffraction", "light")
    return study not in ("intersection", "light")


def _show(found, paths: list[Path], say: console.Reporter) -> None:
    rows = [
        (
            name,
            "no order could be fitted"
            if order is None
            else f"error ~ {found.against}^-{order.exponent:.2f} (+-{order.deviation:.2f})",
        )
        for name, order in found.orders.items()
    ]
    if "source" in found.about:
        rows.insert(0, ("rays", f"{found.about['rays']:,} from {found.about['source']}"))
    if found.name in OF_LENSES:
        rows.insert(0, ("errors", "against the picture, by rays"))
    say.table(
        f"{found.name}: fitted orders" if found.orders else found.name,
        [*rows, ("advice", found.advice), ("written", ", ".join(map(str, paths)))],
    )


def _as_json(found, paths: list[Path]) -> dict:
    return {
        "study": found.name,
        **({"error_by": "rays"} if found.name in OF_LENSES else {}),
        "advice": found.advice,
        "rows": found.rows,
        "files": [str(p) for p in paths],
        "orders": {k: None if o is None else o.exponent for k, o in found.orders.items()},
    }
