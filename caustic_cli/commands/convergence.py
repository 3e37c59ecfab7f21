"""caustic convergence: what accuracy costs in time."""

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
#: What the progress of a study counts.
UNITS = {"intersection": "evaluations", "effects": "effects", "design": "turns", "diffraction": "cases", "light": "lenses"}


def run(
    project: Annotated[
        Path | None,
        typer.Argument(
            metavar="[PROJECT]",
            help="Project made by caustic design; without one, the"
            " sphere a design begins from (intersection: the scene of the thesis' table"
            " D.3; design: a bright disc; light: the same, from an LED 3 mm before"
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
            " size, wavelength and source size; light: the picture against the light that is kept, over"
            " thickness and the loss' weight of light."
        ),
    ] = "intersection",
    rays: Annotated[
        str | None,
        typer.Option(
            metavar="N",
            help="Rays of the largest setting; the reference takes 16 times as"
            " many.  Of intersection: rays intersected; of design: rays of a retrace."
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
        float | None, typer.Option(help="Of design: for each contender.  [default: 4]  Of light: for each lens.  [default: 10]")
    ] = None,
    output: Annotated[Path, typer.Option("-o", "--out", metavar="DIR", help="Where CSV, JSON and PNG go.")] = Path("convergence"),
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
    """Measure errors, and the time they took, for many settings in one run."""
    began, say = time.monotonic(), console.Reporter(quiet, progress)
    if study not in STUDIES:
        raise InputError(f"--study must be one of {', '.join(STUDIES)}, got {study!r}")
    count = options.rays("--rays", rays) if rays else None
    for option, given, for_study in (
        ("--seconds", seconds is not None, study in ("design", "light")),
        ("--repeats", repeats is not None, study not in ("design", "diffraction", "light")),
        ("--dtype", dtype is not None, study not in ("intersection", "light")),
    ):
        if given and not for_study:
            raise InputError(f"{option} has no meaning for --study {study}: leave it out")
    precision = options.dtype_of(dtype) if dtype else None
    if output.exists() and not output.is_dir():
        raise InputError(f"{output}: is a file; a directory for CSV, JSON and PNG is needed")
    if project is not None:
        options.require_project(project)
    device = options.start_torch(device, threads, say)

    from caustic_cli.studies import diffraction, effects, intersection, light, report, training  # noqa: PLC0415

    if output.is_dir():
        plots = {
            "intersection": intersection.PLOTS,
            "design": training.PLOTS,
            "effects": effects.PLOTS,
            "diffraction": diffraction.PLOTS,
            "light": light.PLOTS,
        }.get(study)
        report.refuse_foreign_files(report.paths_of(study, output, plots), force)
    opened = _open(project)
    with say.progress(None) as show:

        def tell(done: int, whole: int) -> None:
            show(study, UNITS.get(study, "rays"), done, whole)

        if study == "intersection":
            case = intersection.of_lens(*opened[1:], count, seed or 0) if opened else intersection.table_d3(count, seed or 0)
            found = intersection.run_intersection(case, seed=seed or 0, repeats=repeats, progress=tell)
        elif study == "design":
            from caustic_cli.workflow import comparison  # noqa: PLC0415

            scene, target, entries = comparison.entries_of(opened[0] if opened else None, device, precision, seed)
            found = training.run_training(
                scene, target, entries, seconds=seconds, seed=seed or 0, rays=count, device=device, progress=tell
            )
        elif study == "light":
            from caustic_cli.config import checks  # noqa: PLC0415
            from caustic_cli.workflow import tradeoff  # noqa: PLC0415

            each = checks.number("--seconds", light.SECONDS if seconds is None else seconds, 0.0, 1e6, open_low=True)
            count_of, lenses = tradeoff.lenses(opened[0] if opened else None, each, device)
            found = light.run_light(lenses, count_of, rays=count, seed=seed or 0, device=device, progress=tell)
        elif study == "diffraction":
            from caustic_cli.workflow.comparison import lens_of_disc  # noqa: PLC0415

            scene, field, heights = opened[1:] if opened else lens_of_disc()
            found = diffraction.run_diffraction(
                scene, field, heights.to(device), rays=count, seed=seed or 0, dtype=precision, progress=tell
            )
        else:
            from caustic_cli.studies.convergence import run_study  # noqa: PLC0415
            from caustic_cli.workflow.compilation import compile_for  # noqa: PLC0415
            from caustic_cli.workflow.design import sphere  # noqa: PLC0415

            scene, field, heights = opened[1:] if opened else sphere()
            if study == "effects":
                compile_for(None, device, say)
                found = effects.run_effects(
                    scene, field, heights.to(device), rays=count, repeats=repeats, seed=seed or 0, dtype=precision, progress=tell
                )
            else:
                found = run_study(
                    study,
                    scene,
                    field,
                    heights.to(device),
                    seed=seed or 0,
                    max_rays=count,
                    repeats=3 if repeats is None else repeats,
                    dtype=precision,
                    progress=tell,
                )
    paths = report.write(found, output)
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
    say.table(
        f"{study}: fitted orders" if found.orders else study,
        [*rows, ("advice", found.advice), ("written", ", ".join(map(str, paths)))],
    )
    if json:
        console.emit_json(
            {
                "study": study,
                "advice": found.advice,
                "rows": found.rows,
                "files": [str(p) for p in paths],
                "orders": {k: None if o is None else o.exponent for k, o in found.orders.items()},
                "seconds": time.monotonic() - began,
            }
        )


def _open(path: Path | None) -> tuple | None:
    """The project, its scene, its lens' field and heights; None for no path."""
    if path is None:
        return None
    from caustic_cli.project.project import Project  # noqa: PLC0415

    opened = Project.open(path)
    scene = opened.scene()
    field, checkpoint = opened.lens(scene)
    return opened, scene, field, checkpoint.state.heights
