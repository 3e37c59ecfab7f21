"""caustic convergence: studies of error against computing time."""

from __future__ import annotations

import time
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from caustic_cli.commands import console, options
from caustic_cli.errors import InputError
from caustic_cli.workflow.convergence import NETWORKS, STUDIES, StudyKind, StudyRequest

if TYPE_CHECKING:
    from caustic_cli.studies.report import Study

EXAMPLES = """Examples:

  caustic convergence -o accuracy

  caustic convergence flame.caustic --study design --seconds 20
"""


class ConvergenceOptions(options.Computation):
    """Arguments and options of caustic convergence."""

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
    ] = None
    study: Annotated[
        str,
        typer.Option(
            help="intersection: of rays and surface, by the thesis' triangle mesh and by Newton's"
            " method; rays: samplers; reconstruction: filters; precision: float32 and float64;"
            " effects: each on and off; design:"
            " optimisers, networks and control nets; diffraction: rays against waves over lens"
            " size, wavelength and source size; light: image error against efficiency, over"
            " thickness and the loss' weight of light; stability: numerically difficult cases"
            " beside what a naive formula gives; all: one after the other (stability without PROJECT only)."
        ),
    ] = "intersection"
    networks: Annotated[
        bool,
        typer.Option(
            "--networks",
            help="Study design: a grid of networks over layers, width, activation, learning rate and preconditioner, all trained"
            " equally; for a project designed --over a range also one lens for the whole range and a network for each value.",
        ),
    ] = False
    rays: Annotated[
        str | None,
        typer.Option(
            metavar="N",
            help="Rays of the largest setting; the reference takes 16 times as"
            " many.  Study intersection: rays intersected; study design: rays of a retrace."
            "  [default: by study, about half a minute in all]",
        ),
    ] = None
    repeats: Annotated[
        int | None,
        typer.Option(
            help="Rounds, each with fresh rays (intersection: the same); the times' median and"
            " range are reported.  [default: 3; intersection: 9]"
        ),
    ] = None
    seconds: Annotated[
        float | None,
        typer.Option(
            help="Study design: time per method, with --networks on average.  [default: 4]  Study light: per lens.  [default: 10]"
        ),
    ] = None
    output: Annotated[Path, typer.Option("-o", "--out", metavar="DIR", help="Directory for CSV, JSON and PNG.")] = Path(
        "convergence"
    )


def run(asked: ConvergenceOptions) -> None:
    """Measure errors and computing times for many settings."""
    began, say = time.monotonic(), asked.say
    kinds, rays = _kinds(asked), options.rays("--rays", asked.rays) if asked.rays else None
    given, output = _given(asked, kinds), asked.output
    device = asked.start_torch()

    from caustic_cli.studies import report  # noqa: PLC0415
    from caustic_cli.workflow.lens import load  # noqa: PLC0415

    if output.is_dir():
        for kind in kinds:
            report.refuse_foreign_files(report.paths_of(kind.name, output, kind.plots), asked.force)
    lens, done = None if asked.project is None else load(asked.project), []
    for kind in kinds:
        start, own = time.monotonic(), {option: value for option, value in given.items() if option in kind.takes}
        own["rays"] = rays if kind.rays_of_all or len(kinds) == 1 else None
        with say.progress(None) as show:
            tell = partial(show, kind.name, kind.unit)
            found = kind.measure(StudyRequest(lens, device, say, tell, seed=asked.seed, **own))
        paths = report.write(found, output)
        _show(kind, found, paths, say)
        done.append(_as_json(kind, found, paths) | {"seconds": time.monotonic() - start})
    failed = any(not row.get("holds", True) for each in done for row in each["rows"])
    if asked.json:
        whole = {"study": "all", "studies": done, "seconds": time.monotonic() - began}
        console.emit_json(done[0] if len(kinds) == 1 else whole)
    if failed:
        raise typer.Exit(1)


def _given(asked: ConvergenceOptions, kinds: list[StudyKind]) -> dict[str, Any]:
    """The options that apply to some studies only.

    Raises:
        InputError: one applies to none of these, there is no such precision, or something stands in the place of the directory.
    """
    given: dict[str, Any] = {"seconds": asked.seconds, "repeats": asked.repeats, "dtype": asked.dtype}
    for option, value in given.items():
        if value is not None and not any(option in kind.takes for kind in kinds):
            raise InputError(f"--{option} has no meaning for --study {asked.study}: leave it out")
    given["dtype"] = options.dtype_of(asked.dtype) if asked.dtype else None
    if (asked.output.exists() or asked.output.is_symlink()) and not asked.output.is_dir():
        raise InputError(f"{asked.output}: is no directory; a directory for CSV, JSON and PNG is needed")
    if asked.project is not None:
        options.require_project(asked.project)
    return given


def _kinds(asked: ConvergenceOptions) -> list[StudyKind]:
    """The studies to run.

    Raises:
        InputError: there is none of this name, or it has no networks.
    """
    if asked.study not in (*STUDIES, "all"):
        raise InputError(f"--study must be one of {', '.join(STUDIES)} or all, got {asked.study!r}")
    if asked.networks and asked.study != "design":
        raise InputError(f"--networks belongs to --study design, got {asked.study}")
    if asked.networks:
        return [NETWORKS]
    every = [kind for kind in STUDIES.values() if asked.project is None or kind.takes_project]
    return every if asked.study == "all" else [STUDIES[asked.study]]


def _show(kind: StudyKind, found: Study, paths: list[Path], say: console.ConsoleReporter) -> None:
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
    if kind.of_lenses:
        rows.insert(0, ("errors", "against the picture, by rays"))
    rows += found.lines
    say.table(
        f"{found.name}: fitted orders" if found.orders else found.name,
        [*rows, ("advice", found.advice), ("written", ", ".join(map(str, paths)))],
    )


def _as_json(kind: StudyKind, found: Study, paths: list[Path]) -> dict:
    return {
        "study": found.name,
        **({"error_by": "rays"} if kind.of_lenses else {}),
        "advice": found.advice,
        "rows": found.rows,
        "files": [str(p) for p in paths],
        "orders": {k: None if o is None else o.exponent for k, o in found.orders.items()},
    }
