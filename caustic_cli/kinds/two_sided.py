"""A lens with two free-form sides: a picture, and a second one or the directions of the light behind it."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

from caustic_cli.config.default_stages import refinement
from caustic_cli.config.settings import Settings
from caustic_cli.config.wave_stages import wave_stages
from caustic_cli.effort import Refinement
from caustic_cli.errors import InputError
from caustic_cli.inverse.designer import Designer, State
from caustic_cli.inverse.initial_surface import InitialSurface
from caustic_cli.inverse.initial_two_sided import first_sides
from caustic_cli.inverse.internal_rays import entrance_points
from caustic_cli.inverse.objective import LossOfHeights
from caustic_cli.inverse.parametrisation import Heights, SidesTogether
from caustic_cli.inverse.target import grey
from caustic_cli.inverse.two_sided_objective import TwoSidedObjective
from caustic_cli.kinds.defaults import Defaults
from caustic_cli.kinds.elements import AmongElements
from caustic_cli.kinds.evaluation import Evaluated, radius_figures
from caustic_cli.kinds.several_surfaces import SeveralSurfaces
from caustic_cli.kinds.surface import Described
from caustic_cli.kinds.waves import refuse_contradiction
from caustic_cli.loading import OnDemand
from caustic_cli.optics.emission import rays_of
from caustic_cli.optics.resolution import Resolution
from caustic_cli.optics.surfaces.heightfield import HeightField
from caustic_cli.optics.system import split_heights
from caustic_cli.scene import Scene, Screen
from caustic_cli.schema.table import LensSettings, ScreenSettings, check, default
from caustic_cli.studies.judge import judged
from caustic_cli.studies.retrace import retrace
from caustic_cli.studies.second_target import second_figures

if TYPE_CHECKING:
    from caustic_cli.optics.waves.image import WaveImage

by_waves = OnDemand("caustic_cli.studies.waves")

THICK, SAG = 2.0, 0.45  # thickness over width of the lens, and largest height of a side over thickness
#: Figures of the initial surfaces that are kept.
STARTED = ("relative_rms", "wave_relative_rms", "second_relative_rms", "angle_rms_mrad")
#: Divisor of the rays for the initial surfaces.
STARTS = 4


class TwoSides(SeveralSurfaces):
    """Entrance and exit.

    Args:
        second_target: (k_x, k_y) irradiance on the scene's second screen, or (3, k_x, k_y) in colour, where it has one.
    """

    adapts = False

    def __init__(self, *args: Any, second_target: Tensor | None = None, **more: Any):
        self.second_target = second_target
        super().__init__(*args, **more)

    @classmethod
    def applies(cls, s: Settings) -> bool:
        return s.second is not None

    @classmethod
    def further(cls, described: Described, scene: Scene) -> dict[str, Any]:
        target = described.second_target(scene)
        return {"second_target": None if target is None else torch.from_numpy(target)}

    @classmethod
    def blank(cls, lens: LensSettings, screen: ScreenSettings, index: float) -> LensSettings:
        lens = lens.filled(thickness=THICK * max(lens.size), radius=(math.inf, math.inf))
        return lens.filled(height_range=[c * SAG * lens.thickness for c in (-1.0, 1.0)])

    @classmethod
    def complete(cls, d: Defaults) -> None:
        asked = check("design.waves", d.design.waves)
        d.fill_design(start="transport")
        if d.design.start != "transport":
            raise InputError(f"⟨design.start⟩ of two free-form sides must be transport, got {d.design.start}")
        cls.complete_control(d)
        d.fill_design(preconditioner="laplacian")
        if not d.complete_given_stages():
            stages = refinement(d.lens.control, d.rays, d.resolution, cls.effort_of(d))
            if not d.plain:
                stages = [stages[-1] | {"iterations": default("design.stages.iterations"), "tolerance": 0.0}]
            d.set_stages(stages + (wave_stages(d.s, d.source, d.effort, d.lit) if asked == "on" else []))
            return
        refuse_contradiction(asked, d)
        if any(stage.spread for stage in d.design.stages):
            raise InputError("[[design.stages]] of two free-form sides are on the rays of the whole source, without spread")

    @classmethod
    def default_control(cls, d: Defaults) -> list[int]:
        return super().default_control(d) if d.trained else [cls.effort_of(d).spans(max(d.resolution)) + p for p in d.lens.degree]

    @classmethod
    def effort_of(cls, d: Defaults) -> Refinement:
        """The numbers of its stages."""
        return d.effort.sides if d.s.chosen("second.file") is None else d.effort.pairs

    @property
    def half_sizes(self) -> list[tuple[float, float]]:
        return [self.scene.lens.half_size] * 2

    def _bounds(self, k: int) -> tuple[Tensor, Tensor]:
        low, high = super()._bounds(k)
        most = torch.full_like(low, self.scene.lens.height_range[1])
        return torch.stack([-most, low]), torch.stack([most, high])

    def parametrised(self, k: int, start: Tensor | None, loaded: bool = False) -> Heights:
        if start is None or self.stages[k].waves or not self.options.parametrisation.free:
            return super().parametrised(k, start, loaded)
        light = None if loaded else entrance_points(self.scene, self.field(k), start)
        laplacian = self.options.parametrisation.preconditioner == "laplacian"
        return SidesTogether(*self.bounds(k), start, laplacian, light)

    def objective_in(self, scene: Scene, k: int, initial: Tensor) -> LossOfHeights:
        if self.stages[k].waves:
            return super().objective_in(scene, k, initial)
        stage, o, scene = self.stages[k], self.options, self.lit(scene, k)
        targets = (self.target,) if self.second_target is None else (self.target, self.second_target)
        rays = rays_of(scene, stage.sampler, stage.rays, self.seed(k), self.device)
        found = TwoSidedObjective(scene, self.field(k), rays, targets, o.loss, stage.rendering, limits=o.limits, dtype=o.dtype)
        return found if k == 0 or len(targets) == 1 else found.balanced(initial)

    def pictures(self, scene: Scene) -> list[tuple[Screen, Tensor]]:
        farther = None if scene.second_target is None else scene.second_target.screen
        second = [] if farther is None or self.second_target is None else [(farther, self.second_target)]
        return super().pictures(scene) + second

    def seen_by_waves(
        self, field: HeightField, heights: Tensor, size: tuple[float, float], required: bool = True
    ) -> tuple[WaveImage | None, dict[str, Any]]:
        """The wave image of a lens and its figures, also at wavelengths that were not refined; size: of the picture, mm; required:
        that there is one, where it was asked for."""
        scene, exit = split_heights(self.scene, field, heights.to(self.device))
        target, needed = self.target.numpy(), required and self.options.waves
        light, figures = by_waves.wave_figures(scene, field, exit, target, Resolution.before(scene, size), required=needed)
        return light, figures | (by_waves.unseen_figures(scene, field, exit, target) if light is not None and required else {})

    def refuse_unreachable(self) -> None:
        """Its own initial surfaces say what they cannot reach."""

    def transport(self, fixed: bool, seconds: float, rough: bool = False) -> InitialSurface:
        target = None if self.second_target is None else grey(self.second_target.numpy())
        return InitialSurface(first_sides(self.scene, grey(self.target.numpy()), target, self.field(0)))

    def advice(self, size: tuple[float, float]) -> str:
        return ""

    def evaluate(self, designer: Designer, state: State, size: tuple[float, float], timed: bool = False) -> Evaluated:
        """By the picture, and a second picture or the ray directions behind it."""
        target, field, seed = self.target.numpy(), designer.field(state.stage), self.options.seed
        farther, final = None if self.second_target is None else self.second_target.numpy(), self.effort.final_rays
        refined = any(stage.waves for stage in designer.stages[: state.stage + 1])

        def trace(heights: Tensor, rays: int) -> tuple[np.ndarray, np.ndarray | None, dict[str, Any]]:
            scene, exit = split_heights(self.scene, field, heights)
            how: dict[str, Any] = {"rays": rays, "device": self.device, "seed": seed}
            exposure, figures = retrace(scene, field, exit, target, noise=rays == final, **how)
            second, more = second_figures(scene, field, exit, farther, **how)
            return exposure.image.cpu().numpy(), second, figures | more

        image, second, figures = trace(state.heights, final)
        light = None
        if refined:
            light, more = self.seen_by_waves(field, state.heights, size)
            figures |= more
        if state.start is not None:
            begun = designer.initial_surface(state)
            initial = trace(begun, final // STARTS)[2]
            if light is not None:
                initial |= self.seen_by_waves(field, begun, size, required=False)[1]
            figures |= {"start_error": judged(initial, light is not None)["error"]}
            figures |= {f"start_{key}": initial[key] for key in STARTED if initial.get(key) is not None}
            if state.unrounded is not None:
                unrounded = trace(designer.initial_surface(state, rounded=False), final // STARTS)[2]
                figures |= {"min_radius": radius_figures(self.options.limits.min_radius, initial, unrounded)}
        pair = None if second is None or farther is None else (second, farther)
        return Evaluated(state, judged(figures, refined), image, None if light is None else light.image.cpu().numpy(), farther=pair)


class TwoSidesAmongElements(TwoSides, AmongElements):
    """Entrance and exit, among other elements."""

    @classmethod
    def applies(cls, s: Settings) -> bool:
        return TwoSides.applies(s) and AmongElements.applies(s)

    def _bounds(self, k: int) -> tuple[Tensor, Tensor]:
        low, high = super()._bounds(k)
        before, lowest = [e.extent[1] for e in self.scene.in_front[-1:]], self.scene.lens.z_in + float(low[0].min())
        if before and lowest <= before[0]:
            raise InputError(
                f"⟨element.z⟩ of the element in front of the lens must end before {lowest:.4g} mm, which the lens' entrance may"
                f" reach, got a body to {before[0]:.4g} mm"
            )
        return low, high
