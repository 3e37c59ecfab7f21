"""The stages of a design on the wave image: what they are made from, and by what a lens is judged that they refined."""

from __future__ import annotations

from typing import Any, NamedTuple, cast
from weakref import ref

import torch
from torch import Tensor

from caustic_cli.config.default_stages import Table
from caustic_cli.errors import InputError
from caustic_cli.inverse.designer import Designer, State
from caustic_cli.inverse.objective import LossOfHeights
from caustic_cli.inverse.optimisers import Adam, QuasiNewton
from caustic_cli.inverse.parametrisation import FreeHeights, Heights
from caustic_cli.inverse.problem import Problem, Skipped
from caustic_cli.kinds.defaults import Defaults
from caustic_cli.loading import OnDemand
from caustic_cli.optics.system import trace_arguments
from caustic_cli.optics.waves.unsupported import NoWaveImage
from caustic_cli.scene import Scene

waves = OnDemand("caustic_cli.inverse.wave_objective")
by_waves, beams = OnDemand("caustic_cli.studies.waves"), OnDemand("caustic_cli.studies.beam")

#: Knot spans per pixel of a lens for light, at most: drafts of 300 pixels, a photograph and the flame, have 0.172 and 0.175 with
#: 600 spans, 0.179 and 0.182 with 1277, in less than half the time.
LIGHT_SPANS = 2


def refuse_contradiction(asked: str, d: Defaults) -> None:
    """Refuse given stages that contradict design.waves.

    Raises:
        InputError: they do.
    """
    if asked != "auto" and any(stage.waves for stage in d.design.stages) != (asked == "on"):
        raise InputError(
            f"⟨design.waves⟩ {asked} and the given [[design.stages]] contradict each other: "
            + ("none of them has waves, such as waves = [550.0]" if asked == "on" else "one of them has waves")
        )


def smoothed(d: Defaults, stages: list[Table]) -> list[Table]:
    """Stages on the wave image after an accurate initial surface; the default control net is no finer for them than diffraction
    lets it be."""
    if not stages or d.own_control or max(d.lens.array) > 1:
        return stages
    most = max(d.effort.refinement.least_spans, LIGHT_SPANS * max(d.resolution))
    d.set_control([min(n, most + p) for n, p in zip(d.lens.control, d.lens.degree, strict=True)])
    return [stage | {"control": list(d.lens.control)} for stage in stages]


class Ahead(NamedTuple):
    """The objective of stage k in a scene, made before its turn for these initial heights (n, m) mm."""

    scene: Scene
    k: int
    initial: Tensor
    objective: LossOfHeights

    def of(self, scene: Scene, k: int, initial: Tensor) -> bool:
        """Whether it is that of stage k in a scene for these heights."""
        return scene is self.scene and k == self.k and torch.equal(initial, self.initial)


class OnWaves(Problem):
    """A design of which some stages may be on the wave image."""

    #: The objective of a stage on the wave image, made in order to leave out stages on rays before it.
    _ahead: Ahead | None = None
    #: The stage on the wave image that runs, or the last that did, and its objective.
    _refining: tuple[int, ref[LossOfHeights]] | None = None
    #: Whether the wave image can be refined at all.
    refines_waves = True

    def check(self) -> None:
        super().check()
        if not self.options.parametrisation.free and any(s.waves for s in self.stages):
            raise InputError("⟨design.stages.waves⟩ needs network none: the wave image refines the heights themselves")

    def parametrised(self, k: int, start: Tensor | None, loaded: bool = False) -> Heights:
        if self.stages[k].waves:
            return FreeHeights(*self.bounds(k), start)
        return super().parametrised(k, start, loaded)

    def carries_parameters(self, k: int) -> bool:
        by_rays = not (self.stages[k].waves or self.stages[k - 1].waves)
        return super().carries_parameters(k) and (by_rays or not self.options.parametrisation.free)

    def carries_curvature(self, k: int) -> bool:
        before, stage = self.stages[k - 1 : k + 1]
        return bool(before.waves and stage.waves) and before.control == stage.control

    def optimiser(self, k: int) -> type[Adam] | type[QuasiNewton]:
        return QuasiNewton if self.stages[k].waves else super().optimiser(k)

    def objective_in(self, scene: Scene, k: int, initial: Tensor) -> LossOfHeights:
        stage = self.stages[k]
        if stage.waves:
            made, self._ahead = self._ahead, None
            if made is not None and made.of(scene, k, initial):
                refined = made.objective
            else:
                refined = self.on_waves(self.lit(scene, k), k, initial)
            self._refining = k, ref(refined)
            return refined
        if stage.spare and self.takes_waves(scene, k, initial):
            raise Skipped("left out, since the wave image is refined", "waves")
        return self.objective_by_rays(scene, k, initial)

    def objective_by_rays(self, scene: Scene, k: int, initial: Tensor) -> LossOfHeights:
        """That of a stage on rays."""
        return super().objective_in(scene, k, initial)

    def takes_waves(self, scene: Scene, k: int, initial: Tensor) -> bool:
        """Whether a stage after k can refine the wave image of this surface, given on the control net of stage k."""
        later = next((j for j, stage in enumerate(self.stages) if j > k and stage.waves), None)
        if later is None or self.stages[later].control != self.stages[k].control:
            return False
        if self._ahead is not None and self._ahead.of(scene, later, initial):
            return True
        try:
            self._ahead = Ahead(scene, later, initial.clone(), self.on_waves(self.lit(scene, later), later, initial))
        except Skipped:
            return False
        return True

    def on_waves(self, scene: Scene, k: int, initial: Tensor, target: Tensor | None = None) -> LossOfHeights:
        """The objective of stage k on the wave image; target: another than the picture's.

        Raises:
            Skipped: there is none, and it is not asked for; else NoWaveImage.
        """
        stage, o = self.stages[k], self.options
        try:
            return waves.WaveObjective(
                scene,
                self.field(k),
                initial,
                self.target if target is None else target,
                o.loss,
                stage.rendering,
                o.limits,
                wavelengths=stage.waves,
                dtype=o.dtype,
                device=self.device,
            )
        except NoWaveImage as error:
            if o.waves:
                raise
            raise Skipped(f"the wave image is not refined: {error}", "no wave image") from error

    def error_by_waves(self, designer: Designer, state: State) -> float | None:
        """Error of a lens by the wave image, at wavelengths that the optimiser does not use; None where that is not refined, or
        there is none."""
        used = next((stage.waves for stage in reversed(self.stages) if stage.waves), ())
        if not used:
            return None
        objective = self._refining[1]() if self._refining is not None and self._refining[0] == state.stage else None
        if (found := self.beam_error(designer, state, objective)) is not None:
            return found
        approximately = {} if objective is None else {"image_at": cast(Any, objective).image_at}
        lens = trace_arguments(self.scene, designer.field(state.stage), state.heights.to(self.device))
        return by_waves.fast_error(*lens, self.target.numpy(), used, **approximately)

    def beam_error(self, designer: Designer, state: State, objective: Any) -> float | None:
        """Error in the mask of a shaped laser beam, whose other wavelengths tell nothing, by the objective if there is one; None of
        other light."""
        scene = self.scene
        if (how := self.stages[-1].rendering.bright) is None or self.target.ndim > 2 or not scene.screen.upright:
            return None
        bright = how.on(self.target)
        image = None if objective is None else objective.image_at(state.heights, scene.light.wavelengths)
        if image is None:
            image = beams.image_at(scene, designer.field(state.stage), state.heights, bright.mask.numpy())
        return None if image is None else float(bright.error(image.cpu()))
