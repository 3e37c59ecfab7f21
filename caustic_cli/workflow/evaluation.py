"""Outputs of the evaluation of a finished design, a render and a report, and the time that it takes."""

from __future__ import annotations

import time
from functools import partial

import numpy as np
import torch

from caustic_cli.inverse.accuracy_cost import price
from caustic_cli.inverse.designer import Designer, State
from caustic_cli.inverse.target import grey
from caustic_cli.io.files import discard
from caustic_cli.io.picture import WIDE, write_image
from caustic_cli.kinds.evaluation import Evaluated
from caustic_cli.loading import OnDemand, load_behind
from caustic_cli.optics.resolution import Resolution
from caustic_cli.optics.sampling import Sample
from caustic_cli.optics.surfaces.heightfield import HeightField
from caustic_cli.optics.system import trace_arguments
from caustic_cli.project import uptodate
from caustic_cli.project.project import FARTHER, RENDER, REPORT, WAVE, Project
from caustic_cli.studies.irradiance import irradiance
from caustic_cli.studies.retrace import evaluation_rays, retrace
from caustic_cli.studies.viewing import as_lit, as_viewed, in_colour

design_report, by_waves = OnDemand("caustic_cli.studies.design_report"), OnDemand("caustic_cli.studies.waves")

#: Points along each side of the aperture for the plot of the surface.
REPORT_SAMPLES = 401
#: For `expected_seconds`: divisor of the final rays for the probe, retraces and wave images of an evaluation, further retraces with
#: a least radius, and time of the report, s.
PROBE, RETRACES, WAVE_IMAGES, RADIUS, REPORT_SECONDS = 16, 2.5, 4, 1.5, 2.5
#: Time of an iteration relative to that of its image alone.
BACKWARD = 2.5
#: Time of the retraces and wave images of an evaluation, in iterations of the last stage on the wave image.
WAVE_ITERATIONS = 15


def evaluate_and_write(project: Project, designer: Designer, state: State, timed: bool = False) -> Evaluated:
    """Evaluate the finished lens; write render.png, wave.png and report.png into the project, if it has a directory."""
    target = designer.problem.target.numpy()
    evaluated = designer.problem.evaluate(designer, state, project.settings.target.size, timed)
    if project.path is None:
        return evaluated
    encoding = project.settings.target.encoding
    scene, screen = designer.scene, designer.scene.screen
    made = uptodate.image_provenance(project, evaluated.state.heights, evaluated.figures)
    write_image(project.path / RENDER, *as_lit(scene, evaluated.image, target, evaluated.xyz), encoding, WIDE, made)
    discard(project.path / WAVE)  # of an earlier lens
    if evaluated.waves is not None:
        write_image(project.path / WAVE, *as_lit(scene, evaluated.waves, target, evaluated.waves_xyz), encoding, WIDE)
    discard(project.path / FARTHER)
    if evaluated.farther is not None:
        write_image(project.path / FARTHER, *as_viewed(scene, *evaluated.farther), encoding, WIDE)
    if not designer.problem.effort.report:
        return evaluated
    history = np.array(state.history, dtype=float).reshape(-1, 5)
    images = (target, evaluated.image, evaluated.waves, evaluated.xyz, evaluated.waves_xyz)
    aim, seen, waves, *colours = (None if a is None else irradiance(a, screen) for a in images)
    assert aim is not None and seen is not None
    surface = _surface(designer.field(evaluated.state.stage), designer.exit(evaluated.state))
    design_report.write_report(
        project.path / REPORT,
        grey(aim),
        grey(seen),
        surface,
        history,
        scene.lens,
        screen,
        evaluated.figures,
        encoding,
        None if waves is None else grey(waves),
        [(stage.rendering.blur, bool(stage.waves)) for stage in designer.stages],
        [(row.seconds, row.error) for row in state.accuracy],
        price(state.accuracy),
        [None if a is None else partial(in_colour, scene, a) for a in colours],
    )
    return evaluated


def prepare_report(project: Project, designer: Designer) -> None:
    """Load what draws the report, while the iterations run."""
    if project.path is not None and designer.problem.effort.report:
        load_behind(design_report)


def expected_seconds(designer: Designer, state: State) -> float:
    """Estimated time of `evaluate_and_write` under a time limit, s, from a retrace with few rays, and a wave image if refined."""
    problem, scene, field, began = designer.problem, designer.scene, designer.field(state.stage), time.monotonic()
    target = problem.target.numpy()
    retrace(
        *trace_arguments(scene, field, state.heights),
        target,
        rays=evaluation_rays(scene, problem.effort.final_rays) // PROBE,
        device=problem.device,
        noise=False,
    )
    retraces = RETRACES + (0.0 if state.unrounded is None else RADIUS) + problem.further_retraces
    seconds = retraces * PROBE * (time.monotonic() - began) + REPORT_SECONDS
    if any(s.waves for s in designer.stages):
        began = time.monotonic()
        by_waves.wave_figures(
            scene, field, state.heights.to(problem.device), target, Resolution.before(scene, scene.screen.size), required=False
        )
        seconds += WAVE_IMAGES * (time.monotonic() - began)
    return seconds


def evaluation_seconds(designer: Designer, state: State) -> float:
    """Rough time of `evaluate_and_write`, s, without a probe: an iteration takes BACKWARD times as long as its image alone."""
    history, seconds = np.array(state.history, dtype=float).reshape(-1, 5), {}
    rays = evaluation_rays(designer.scene, designer.problem.effort.final_rays)
    for k, stage in enumerate(designer.stages):
        times = history[history[:, 1] == k, 4]
        if len(times) > 1:
            images = WAVE_ITERATIONS if stage.waves else RETRACES * rays / stage.rays / BACKWARD
            seconds[bool(stage.waves)] = images * float(np.median(np.diff(times)))  # by the last stage of each kind
    return REPORT_SECONDS + sum(seconds.values())


def _surface(field: HeightField, heights: torch.Tensor) -> np.ndarray:
    """Heights on a regular grid over the aperture, mm."""
    u = torch.linspace(0.0, 1.0, REPORT_SAMPLES, dtype=torch.float64)
    return field.prepare(Sample(u, u, True, torch.ones(())), torch.float64)(heights)[0].numpy()
