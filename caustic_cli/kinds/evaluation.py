"""Judgement of a finished lens by independent rays, and by the wave image if that was refined, against the initial one.

The loss of the optimiser does not qualify: it overfits its own rays and reconstruction filter.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from torch import Tensor

from caustic_cli.inverse.designer import Designer, State
from caustic_cli.inverse.loss_terms import parse
from caustic_cli.loading import OnDemand, give_back_freed_memory
from caustic_cli.optics.image import Image
from caustic_cli.optics.resolution import Resolution
from caustic_cli.optics.system import trace_arguments
from caustic_cli.studies.judge import judged
from caustic_cli.studies.retrace import evaluation_rays, retrace
from caustic_cli.studies.viewing import tristimulus_values

by_waves = OnDemand("caustic_cli.studies.waves")
beams = OnDemand("caustic_cli.studies.beam")

#: Losses that measure the error of the picture alone; others may increase it in exchange for another objective.
LIKENESS = {"rms", "rms-light", "throughput"}
#: Ratio of the light on the screen from which a lens is kept although the initial surface has a smaller error.
BRIGHTER = 1.01
#: Ratio of the errors by waves from which one at few wavelengths tells that the initial surface is worse.
CLEARLY = 1.5


@dataclass(frozen=True, eq=False)
class Evaluated:
    """Result of the evaluation of a design."""

    #: With the lens that was kept.
    state: State
    #: Of the JSON table, with start_error, its judged error, and start_relative_rms if the initial surface was retraced.
    figures: dict[str, Any]
    #: Power per pixel on the screen by rays, (n_x, n_y) or (3, n_x, n_y), float64.
    image: np.ndarray
    #: The same by waves, None if that was not refined.
    waves: np.ndarray | None = None
    #: Tristimulus values of both, (3, n_x, n_y), None for light without colour.
    xyz: np.ndarray | None = None
    waves_xyz: np.ndarray | None = None
    #: The image on a screen farther away and its target, (k_x, k_y) each, or (3, k_x, k_y), or None.
    farther: tuple[np.ndarray, np.ndarray] | None = None

    @property
    def shown(self) -> np.ndarray:
        """The wave image if there is one, else that by rays; its tristimulus values for light with colour."""
        image, xyz = (self.image, self.xyz) if self.waves is None else (self.waves, self.waves_xyz)
        return image if xyz is None else xyz


class Seen(NamedTuple):
    """A retraced lens: its ray image, wave image if refined, and figures."""

    exposure: Image
    light: Any | None
    figures: dict[str, Any]


class LensEvaluation:
    """Figures of a finished lens, and the lens that is kept; see `OneSurface.evaluate`.

    traced: the image of a lens (n, m) mm by this number of rays and this seed where it has been traced, else None.
    """

    def __init__(
        self,
        designer: Designer,
        state: State,
        size: tuple[float, float],
        timed: bool,
        traced: Callable[[Tensor, int, int], Image | None],
    ):
        self.problem, self.designer, self.state, self.timed, self.traced = designer.problem, designer, state, timed, traced
        self.count = evaluation_rays(designer.scene, self.problem.effort.final_rays)
        self.field = designer.field(state.stage)
        self.refined = any(s.waves for s in designer.stages[: state.stage + 1])
        self.seen = Resolution.before(designer.scene, size)
        self.target = designer.problem.target.numpy()
        self.initial: dict[str, Any] | None = None  # figures of the initial surface
        self.exposure, self.light, self.figures = self.see(state.heights)

    def rays(self, heights: Tensor, noise: bool = True) -> tuple[Image, dict[str, Any]]:
        """Image and figures by independent rays."""
        scene, seed = self.problem.scene, self.problem.options.seed
        return retrace(
            *trace_arguments(scene, self.field, heights),
            self.target,
            rays=self.count,
            device=self.problem.device,
            seed=seed,
            known=self.traced(heights, self.count, seed),
            noise=noise,
            quiet=None if self.timed else self.problem.effort.noise,
        )

    def see(self, heights: Tensor, noise: bool = True, wavelengths: tuple[float, ...] = ()) -> Seen:
        """The same, and by waves if these were refined; wavelengths: of a continuous spectrum, instead of the verdict's, nm."""
        exposure, figures = self.rays(heights, noise)
        if not self.refined:
            return Seen(exposure, None, figures)
        give_back_freed_memory()
        problem = self.problem
        light, more = by_waves.wave_figures(
            *trace_arguments(problem.scene, self.field, heights.to(problem.device)),
            self.target,
            self.seen,
            wavelengths=wavelengths,
            required=problem.options.waves,
        )
        return Seen(exposure, light, figures | more)

    def add_beam(self) -> None:
        """Add the figures of a shaped beam, where the loss is that of one."""
        problem, seen = self.problem, self.light or self.exposure
        lens = trace_arguments(problem.scene, self.field, self.state.heights)
        self.figures |= beams.shaped_figures(*lens, problem.target.numpy(), problem.stages[-1].rendering.bright, seen)

    @property
    def start_by_waves(self) -> float:
        """Error of the initial surface by waves, at other wavelengths than the design's, measured when its objective was
        ready; 0 where it was not."""
        rows, history, stages = self.state.accuracy, self.state.history, self.designer.stages
        by_waves = bool(history) and stages[history[0][1]].waves and stages[-1].rendering.bright is None
        return rows[0].error if by_waves and rows and rows[0].iteration == 0 else 0.0

    def compare_with_start(self) -> None:
        """Keep the initial surface if it is better, where the loss measures the error of the picture alone."""
        problem, state = self.problem, self.state
        by_likeness = {name for _, name in parse(problem.options.loss)} <= LIKENESS
        if state.start is None or not by_likeness:
            return
        heights = problem.feasible(state.stage, self.designer.initial_surface(state))
        # other light has an estimate of the noise anyway
        noise, figures = not problem.scene.source.parallel or state.unrounded is not None, self.figures
        if self.light is not None and (known := self.start_by_waves) > CLEARLY * figures["wave_relative_rms"]:
            light, initial = None, self.rays(heights, noise)[1] | {"wave_relative_rms": known}
        else:
            _, light, initial = self.see(heights, noise)
        # rays of a lens that was refined on its wave image say nothing of it once there is none
        lost = figures["no_wave_image"] if self.light is None and light is not None else ""
        if lost or _worse(figures, initial):
            better = f"its start was better and is kept: {_difference(figures, initial)}"
            why = f"it has no wave image any more, and its start is kept: {lost}" if lost else better
            self.state = replace(self.designer.showing(state, heights), reason=f"{state.reason}; {why}")
            self.exposure, retraced = self.rays(heights)
            figures, self.light = initial | retraced, light
        elif initial["on_screen"] > 0:
            likeness, light_of = _keys(figures, initial)
            if figures[likeness] > initial[likeness]:
                brighter = figures[light_of] / initial[light_of] - 1.0
                why = f"its start was more like the picture, this lens is {brighter:.1%} brighter: {_difference(figures, initial)}"
                self.state = replace(state, reason=f"{state.reason}; {why}")
        self.initial = initial
        self.figures = figures | {
            "start_error": initial[_keys(initial, initial)[0]],
            "start_relative_rms": initial["relative_rms"],
        }
        if initial["noise"] is not None:
            self.figures |= {"start_noise": initial["noise"]}
        if self.refined:
            self.figures |= {"start_wave_relative_rms": initial["wave_relative_rms"]}

    def compare_unrounded(self) -> None:
        """Add the cost of a least radius, if there is one."""
        state, problem = self.state, self.problem
        if state.unrounded is None:
            return
        rounded = self.initial or self.rays(problem.feasible(state.stage, self.designer.initial_surface(state)))[1]
        unrounded = self.rays(self.designer.initial_surface(state, rounded=False))[1]
        self.figures |= {"min_radius": radius_figures(problem.options.limits.min_radius, rounded, unrounded)}

    def add_unseen(self) -> None:
        """Add the error of the wave image at wavelengths that were not refined."""
        if self.light is not None:
            lens = trace_arguments(self.problem.scene, self.field, self.state.heights.to(self.problem.device))
            self.figures |= by_waves.unseen_figures(*lens, self.target)

    def result(self) -> Evaluated:
        """The result."""
        scene, rays, waves = self.problem.scene, self.exposure, self.light
        return Evaluated(
            self.state,
            judged(self.figures, self.refined),
            rays.image.cpu().numpy(),
            None if waves is None else waves.image.cpu().numpy(),
            tristimulus_values(scene, rays),
            None if waves is None else tristimulus_values(scene, waves),
        )


def radius_figures(radius: float, rounded: dict, unrounded: dict) -> dict[str, float | None]:
    """Cost of a least radius of concave regions: light in black regions for the initial surface, with the limit and without.

    Args:
        radius: mm; rounded, unrounded: figures of that surface, with the same rays, within all limits and within all but the
            radius.

    Returns:
        radius_mm; start_in_black and start_in_black_without, fractions of the light on the screen; in_black_per_mm, their
        difference over the radius, and its noise; None if the picture has no black region.
    """
    light, light_without = rounded["in_black"], unrounded["in_black"]
    noises = rounded["in_black_noise"], unrounded["in_black_noise"]
    return {
        "radius_mm": radius,
        "start_in_black": light,
        "start_in_black_without": light_without,
        "in_black_per_mm": None if light is None or light_without is None else (light - light_without) / radius,
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
