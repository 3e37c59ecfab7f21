"""Evaluation of a finished design: its lens and the initial one, retraced with independent rays; render and report.

The loss of the optimiser does not qualify: it overfits its own rays and reconstruction filter.
"""

from __future__ import annotations

import math
import time
from dataclasses import dataclass, replace

import numpy as np
import torch

from caustic_cli.inverse.deconvolution import SMOOTH_STEPS
from caustic_cli.inverse.designer import Designer, State
from caustic_cli.inverse.loss_terms import parse
from caustic_cli.inverse.target import grey
from caustic_cli.io.files import discard
from caustic_cli.io.picture import WIDE, write_image
from caustic_cli.optics.resolution import Resolution
from caustic_cli.optics.sampling import Sample
from caustic_cli.optics.surfaces.heightfield import HeightField
from caustic_cli.optics.system import split_heights, trace_arguments
from caustic_cli.optics.waves.image import WaveImage
from caustic_cli.project import uptodate
from caustic_cli.project.project import FARTHER, RENDER, REPORT, WAVE, Project
from caustic_cli.studies.design_report import write_report
from caustic_cli.studies.irradiance import irradiance
from caustic_cli.studies.metrics import judged
from caustic_cli.studies.retrace import FINAL_RAYS, RELATIVE_NOISE, evaluation_rays, retrace, white_level
from caustic_cli.studies.second_target import second_figures
from caustic_cli.studies.waves import unseen_figures, wave_figures
from caustic_cli.workflow import range_evaluation

#: Points along each side of the aperture for the plot of the surface.
REPORT_SAMPLES = 401
#: Losses that measure the error of the picture alone; others may increase it in exchange for another objective.
LIKENESS = {"rms", "rms-light", "throughput"}
#: For `expected_seconds`: divisor of FINAL_RAYS for the probe, retraces and wave images of an evaluation, further retraces with a
#: least radius, and time of the report, s.
PROBE, RETRACES, WAVE_IMAGES, RADIUS, REPORT_SECONDS = 16, 2.5, 4, 1.5, 2.5
#: Time of an iteration relative to that of its image alone.
BACKWARD = 2.5
#: Divisor of the rays for the initial surfaces of a lens with two free-form sides.
STARTS = 4
#: Divisor of the rays for each of the lenses of a network over ranges.
OVER = 4
#: Ratio of the light on the screen from which a lens is kept although the initial surface has a smaller error.
BRIGHTER = 1.01


@dataclass(frozen=True, eq=False)
class Evaluation:
    """Result of the evaluation of a design.

    state: with the lens that was kept; figures: of the JSON table, with start_error, its judged error, and start_relative_rms if
    the initial surface was retraced;
    image, waves: power per pixel on the screen, ray image and wave image (None if that was not refined), (n_x, n_y) or
    (3, n_x, n_y), float64; second: that on a second screen, or None.
    """

    state: State
    figures: dict
    image: np.ndarray
    waves: np.ndarray | None
    second: np.ndarray | None = None


def evaluate_and_write(
    project: Project, designer: Designer, target: np.ndarray, state: State, device: str, timed: bool = False
) -> Evaluation:
    """Evaluate the finished lens; write render.png, wave.png and report.png into the project, if it has a directory."""
    chosen = project.settings.design
    found = evaluate(designer, target, state, device, chosen.seed, project.settings.target.size, timed)
    if project.path is None:
        return found
    encoding = project.settings.target.encoding
    seen, aim = (irradiance(a, designer.scene.screen) for a in (found.image, target))
    made = uptodate.image_provenance(project, found.state.heights, found.figures)
    write_image(project.path / RENDER, seen, white_level(seen, aim), encoding, WIDE, made)
    discard(project.path / WAVE)  # of an earlier lens
    if found.waves is not None:
        write_image(project.path / WAVE, found.waves, white_level(found.waves, target), encoding, WIDE)
    discard(project.path / FARTHER)
    if found.second is not None and designer.second is not None:
        write_image(project.path / FARTHER, found.second, white_level(found.second, designer.second.numpy()), encoding, WIDE)
    history = np.array(state.history, dtype=float).reshape(-1, 5)
    surface = _surface(designer.field(found.state.stage), designer.exit(found.state))
    write_report(
        project.path / REPORT,
        grey(aim),
        grey(seen),
        surface,
        history,
        designer.scene.lens,
        designer.scene.screen,
        found.figures,
        encoding,
        None if found.waves is None else grey(found.waves),
        [(stage.blur, bool(stage.waves)) for stage in designer.stages],
    )
    return found


def expected_seconds(designer: Designer, target: np.ndarray, state: State, device: str) -> float:
    """Estimated time of `evaluate_and_write` under a time limit, s, from a retrace with few rays, and a wave image if refined."""
    scene, field, began = designer.scene, designer.field(state.stage), time.monotonic()
    retrace(
        *trace_arguments(scene, field, state.heights),
        target,
        rays=evaluation_rays(scene, FINAL_RAYS) // PROBE,
        device=device,
        noise=False,
    )
    over = designer.options.over
    retraces = (
        RETRACES
        + (0.0 if state.unrounded is None else RADIUS)
        + (0.0 if over is None else 2.0 * len(over.evaluation_points()) / OVER)
    )
    seconds = retraces * PROBE * (time.monotonic() - began) + REPORT_SECONDS
    if any(s.waves for s in designer.stages):
        began = time.monotonic()
        wave_figures(scene, field, state.heights.to(device), target, Resolution.before(scene, scene.screen.size), required=False)
        seconds += WAVE_IMAGES * (time.monotonic() - began)
    return seconds


def evaluation_seconds(designer: Designer, state: State) -> float:
    """Rough time of `evaluate_and_write`, s, without a probe: an iteration takes BACKWARD times as long as its image alone."""
    history, seconds = np.array(state.history, dtype=float).reshape(-1, 5), {}
    for k, stage in enumerate(designer.stages):
        times = history[history[:, 1] == k, 4]
        if len(times) > 1:
            images = WAVE_IMAGES if stage.waves else RETRACES * evaluation_rays(designer.scene, FINAL_RAYS) / stage.rays
            seconds[bool(stage.waves)] = images * float(np.median(np.diff(times))) / BACKWARD  # by the last stage of each kind
    return REPORT_SECONDS + sum(seconds.values())


def evaluate(
    designer: Designer,
    target: np.ndarray,
    state: State,
    device: str,
    seed: int,
    size: tuple[float, float],
    timed: bool = False,
) -> Evaluation:
    """Retrace the finished lens with independent rays, and compute its wave image if that was refined.

    If the loss measures the error of the picture alone, a lens that is worse than the initial one is replaced by it; they are
    compared by the wave image if that was refined.

    Args:
        seed: of the rays; size: width and height of the picture, mm; timed: under a time limit, do not increase the number of rays,
            and limit the iterations for the least error.
    """
    scene, field = designer.scene, designer.field(state.stage)
    if scene.second is not None:
        return _both_sides(designer, target, state, device, seed)

    def trace(heights: torch.Tensor, noise: bool = True):
        return retrace(
            *trace_arguments(scene, field, heights),
            target,
            rays=evaluation_rays(scene, FINAL_RAYS),
            device=device,
            seed=seed,
            noise=noise,
            quiet=None if timed else RELATIVE_NOISE,
        )

    refined = any(s.waves for s in designer.stages[: state.stage + 1])
    light, seen = None, Resolution.before(scene, size)

    def as_waves(heights: torch.Tensor) -> tuple[WaveImage | None, dict]:
        return wave_figures(scene, field, heights.to(device), target, seen, required=designer.options.waves)

    exposure, figures = trace(state.heights)
    if refined:
        light, more = as_waves(state.heights)
        figures |= more
    began = None
    by_likeness = {name for _, name in parse(designer.options.loss)} <= LIKENESS
    for_one = designer.options.robust is None and designer.options.over is None  # these have other objectives
    if state.start is not None and by_likeness and for_one:
        start = designer.within_limits(replace(state, heights=designer.begun(state)))
        _, began = trace(
            start, noise=not scene.source.collimated or state.unrounded is not None
        )  # other light has an estimate of the noise anyway
        of_start = None
        if refined:
            of_start, more = as_waves(start)
            began |= more
        if _worse(figures, began):
            why = f"its start was better and is kept: {_difference(figures, began)}"
            state = replace(designer.showing(state, start), reason=f"{state.reason}; {why}")
            exposure, retraced = trace(start)
            figures, light = began | retraced, of_start
        elif began["on_screen"] > 0:
            likeness, light_of = _keys(figures, began)
            if figures[likeness] > began[likeness]:
                brighter = figures[light_of] / began[light_of] - 1.0
                why = f"its start was more like the picture, this lens is {brighter:.1%} brighter: {_difference(figures, began)}"
                state = replace(state, reason=f"{state.reason}; {why}")
        figures = figures | {"start_error": judged(began, refined)["error"], "start_relative_rms": began["relative_rms"]}
        if began["noise"] is not None:
            figures |= {"start_noise": began["noise"]}
        if refined:
            figures |= {"start_wave_relative_rms": began["wave_relative_rms"]}
    if state.unrounded is not None:
        rounded = began or trace(designer.within_limits(replace(state, heights=designer.begun(state))))[1]
        unrounded = trace(designer.begun(state, rounded=False))[1]
        figures |= {"min_radius": radius_figures(designer.options.min_radius, rounded, unrounded)}
    bounds = designer.source_limits(SMOOTH_STEPS if timed else None)
    if bounds.error is not None:
        figures |= {"least_relative_rms": bounds.error}
    if bounds.etendue is not None:
        figures |= {"etendue_limit": bounds.etendue}
    if light is not None:
        figures |= unseen_figures(scene, field, state.heights.to(device), target)
    if designer.options.over is not None:
        figures |= {"over": range_evaluation.errors(designer, state, target, rays=FINAL_RAYS // OVER, seed=seed, device=device)}
    figures = judged(figures, refined)
    return Evaluation(state, figures, exposure.image.cpu().numpy(), None if light is None else light.image.cpu().numpy())


def _both_sides(designer: Designer, target: np.ndarray, state: State, device: str, seed: int) -> Evaluation:
    """`evaluate` for a lens with two free-form sides: its picture, and a second picture or the ray directions behind it."""
    field, farther = designer.field(state.stage), None if designer.second is None else designer.second.numpy()

    def trace(heights: torch.Tensor, rays: int = FINAL_RAYS):
        scene, exit = split_heights(designer.scene, field, heights)
        exposure, figures = retrace(scene, field, exit, target, rays=rays, device=device, seed=seed, noise=rays == FINAL_RAYS)
        second, more = second_figures(scene, field, exit, farther, rays=rays, seed=seed, device=device)
        return exposure.image.cpu().numpy(), second, figures | more

    image, second, figures = trace(state.heights)
    if state.start is not None:
        began = trace(designer.begun(state), FINAL_RAYS // STARTS)[2]
        figures |= {"start_error": began["relative_rms"]}
        figures |= {f"start_{key}": began[key] for key in ("relative_rms", "second_relative_rms", "angle_rms_mrad") if key in began}
        if state.unrounded is not None:
            unrounded = trace(designer.begun(state, rounded=False), FINAL_RAYS // STARTS)[2]
            figures |= {"min_radius": radius_figures(designer.options.min_radius, began, unrounded)}
    return Evaluation(state, judged(figures, False), image, None, second)


def radius_figures(radius: float, rounded: dict, unrounded: dict) -> dict[str, float | None]:
    """Cost of a least radius of concave regions: light in black regions for the initial surface, with the limit and without.

    Args:
        radius: mm; rounded, unrounded: figures of that surface, with the same rays, within all limits and within all but the
            radius.

    Returns:
        radius_mm; start_in_black and start_in_black_without, fractions of the light on the screen; in_black_per_mm, their
        difference over the radius, and its noise; None if the picture has no black region.
    """
    one, other = rounded["in_black"], unrounded["in_black"]
    noises = rounded["in_black_noise"], unrounded["in_black_noise"]
    return {
        "radius_mm": radius,
        "start_in_black": one,
        "start_in_black_without": other,
        "in_black_per_mm": None if one is None or other is None else (one - other) / radius,
        "noise": None if None in noises else math.hypot(*noises) / radius,
    }


def _keys(figures: dict, than: dict) -> tuple[str, str]:
    """Names of the figures by which two lenses are compared, error and light: those of the wave image if both have one."""
    as_waves = None not in (f.get("wave_relative_rms") for f in (figures, than))
    return ("wave_relative_rms", "wave_on_screen") if as_waves else ("relative_rms", "on_screen")


def _difference(figures: dict, start: dict) -> str:
    """By which figures a lens and its initial surface differ, as a clause."""
    likeness, light = _keys(figures, start)
    by = "waves" if likeness.startswith("wave") else "rays"
    return (
        f"relative RMS error by {by} {start[likeness]:.4f}, after the iterations {figures[likeness]:.4f},"
        f" with {start[light]:.2%} and {figures[light]:.2%} of the light on the screen"
    )


def _worse(figures: dict, than: dict) -> bool:
    """Whether a picture has a larger error without being brighter; a black one is worse than any other."""
    if than["on_screen"] == 0:
        return False
    likeness, light = _keys(figures, than)
    return figures["on_screen"] == 0 or (figures[likeness] > than[likeness] and figures[light] < BRIGHTER * than[light])


def _surface(field: HeightField, heights: torch.Tensor) -> np.ndarray:
    """Heights on a regular grid over the aperture, mm."""
    u = torch.linspace(0.0, 1.0, REPORT_SAMPLES, dtype=torch.float64)
    return field.prepare(Sample(u, u, True, torch.ones(())), torch.float64)(heights)[0].numpy()
