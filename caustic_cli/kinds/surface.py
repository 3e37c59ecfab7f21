"""A single free-form surface, the lens' exit: the kind of which all others are made."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import replace
from functools import cached_property, partial
from typing import Any, ClassVar, Protocol

import numpy as np
import torch
from torch import Tensor

from caustic_cli.config.default_stages import (
    GAPS,
    Table,
    coarse_to_fine,
    creased_control,
    on_rays,
    on_spread,
    refinement,
    transport_cells,
)
from caustic_cli.config.design import build_options, build_stages, relative_to_initial
from caustic_cli.config.settings import Settings
from caustic_cli.config.wave_stages import wave_stages
from caustic_cli.effort import current_effort
from caustic_cli.errors import CausticError, InputError
from caustic_cli.inverse.deconvolution import SMOOTH_STEPS
from caustic_cli.inverse.designer import Designer, State
from caustic_cli.inverse.initial_surface import InitialSurface, first_surface
from caustic_cli.inverse.objective import LossOfHeights, Objective, SourceBlur
from caustic_cli.inverse.projection import BeamProjection
from caustic_cli.inverse.reachability import refuse_unreachable
from caustic_cli.inverse.relay import RelayedScreen
from caustic_cli.inverse.sharpness import advice
from caustic_cli.inverse.source_limits import SourceLimits, best_irradiance, performance_limits, source_spread
from caustic_cli.inverse.target import grey
from caustic_cli.kinds.defaults import Defaults
from caustic_cli.kinds.evaluation import Evaluated, LensEvaluation
from caustic_cli.kinds.waves import OnWaves, refuse_contradiction, smoothed
from caustic_cli.loading import OnDemand
from caustic_cli.optics.emission.measured import coarse_words
from caustic_cli.optics.image import Image
from caustic_cli.optics.obstruction import refuse_obstructed
from caustic_cli.optics.resolution import Resolution
from caustic_cli.optics.spread import Spread, point_source
from caustic_cli.optics.spreads import Spreads
from caustic_cli.optics.system import trace_arguments
from caustic_cli.scene import Scene
from caustic_cli.scene.interaction import interaction_of
from caustic_cli.schema.table import LensSettings, ScreenSettings, check, default
from caustic_cli.studies.retrace import evaluation_rays, retrace

manufacture = OnDemand("caustic_cli.studies.manufacture")

#: To first order a decentre d changes the irradiance of a Gaussian beam by 4 x d / w^2, of the RMS 2 d / w over the beam.
CENTRED = (
    "a laser beam decentred by 1 % of its radius, or 1 % wider than it should be, adds about 0.02 to the error in the mask,"
    " whatever the lens"
)
DEFAULT_SPANS = 128  # knot spans of the final net; divisible by 2 through the stages
#: Of one that shapes a laser beam, whose light beside the picture takes the finest structure: with 128 spans the hardest of the
#: field's targets has 3.8 times the error.
BEAM_SPANS = 192
NETWORK_CONTROL = 50  # table D.2
PLATE, WALL = 20.0, 3.0  # width beyond which a lens is a thin plate, and its least wall thickness, mm


class Described(Protocol):
    """What a problem is made from, such as a project."""

    settings: Settings

    def scene(self) -> Scene:
        """The complete scene."""

    def target(self, scene: Scene) -> np.ndarray:
        """The target on its screen, (n_x, n_y), or (3, n_x, n_y) in colour."""

    def targets(self, scene: Scene) -> list[np.ndarray]:
        """The target of each lenslet there, j fastest; a single one for a common picture."""

    def second_target(self, scene: Scene) -> np.ndarray | None:
        """The second target on its screen, (k_x, k_y), or (3, k_x, k_y) in colour, or None."""


class OneSurface(OnWaves):
    """One free-form surface, on rays and on the wave image, under any source."""

    #: Whether the optimisation is that of the stage loop; otherwise the kind brings its own, `iterate`.
    in_stages = True
    #: Whether the thickness and the range of the heights may be adapted to the initial surface.
    adapts = True
    #: The first and the last lens that `errors` traced: heights, their version, (rays, seed), and the image.
    _traced: tuple[tuple[Tensor, int, tuple[int, int], Image], ...] = ()

    # Settings

    #: Settings of other kinds of design, and what makes a design one.
    idle: ClassVar[Mapping[str, str]] = {
        f"lens.{key}": "⟨+lens.gradient⟩ free" for key in ("index_range", "index_control", "index_layers", "with_surface")
    }

    @classmethod
    def refuse_idle(cls, given: Mapping[str, Any]) -> None:
        """Refuse settings, given by path, that this kind of design does not have.

        Raises:
            InputError: naming one.
        """
        for path in filter(given.__contains__, cls.idle):
            raise InputError(f"⟨{path}⟩ belongs to {cls.idle[path]}")

    @classmethod
    def applies(cls, s: Settings) -> bool:
        """Whether a design with these settings is of this kind."""
        return True

    @classmethod
    def of(cls, described: Described, device: str = "cpu") -> OneSurface:
        """The problem of a project."""
        scene, s = described.scene(), described.settings
        target = torch.from_numpy(described.target(scene))
        return cls(scene, target, build_stages(s), build_options(s), device, current_effort(), **cls.further(described, scene))

    @classmethod
    def further(cls, described: Described, scene: Scene) -> dict[str, Any]:
        """Further arguments of the constructor."""
        return {}

    @classmethod
    def blank(cls, lens: LensSettings, screen: ScreenSettings, index: float) -> LensSettings:
        """The lens with its default thickness and range of heights.

        Raises:
            InputError: a value is out of range, or two contradict each other.
        """
        width = max(lens.size)
        thickness = interaction_of(lens.mirror).first(width / 2.0 if width <= PLATE else WALL + width / 10.0, lambda: 0.0)
        lens = lens.filled(thickness=lens.z_in + WALL if lens.entrance == "parallel" else thickness)
        return lens.filled(height_range=(-width / 10.0, width / 10.0))

    @classmethod
    def complete(cls, d: Defaults) -> None:
        """Complete [design], its stages and the control net.

        Raises:
            InputError: a value is out of range, or two contradict each other.
        """
        asked = check("design.waves", d.design.waves)
        d.fill_design(start=cls.default_start(d))
        cls.refuse_settings(d)
        cls.complete_control(d)
        d.fill_design(preconditioner="laplacian" if d.plain and not cls.exact_start(d) else "none")
        if d.complete_given_stages():
            refuse_contradiction(asked, d)
            return
        waves = wave_stages(d.s, d.source, d.effort, d.lit)
        waves = smoothed(d, waves) if cls.exact_start(d) else waves
        stages = cls.default_stages(d, waves) + waves
        if d.design.loss.strip() == "rms":  # eq. 5.2.1 is defined on the screen only
            stages = [stage | {"apron": 0} for stage in stages]
        d.set_stages(stages)

    @classmethod
    def default_start(cls, d: Defaults) -> str:
        """The initial surface unless one is given."""
        able = d.from_surface and cls.fine_net(d)
        return "transport" if able and (d.source.by_lenslet or not d.source.apart or d.shifts) else "offset"

    @classmethod
    def refuse_settings(cls, d: Defaults) -> None:
        """Refuse contradictions of the settings.

        Raises:
            InputError: there is one.
        """
        if d.source.in_turn and len(d.source.members) != (count := math.prod(d.lens.array)):
            raise InputError(
                f"⟨source.tilt⟩ of several sources is for an array of as many lenslets, each for one of them: got"
                f" {len(d.source.members)} sources and {count} lenslets"
            )
        if d.design.start != "offset" and d.trained and not relative_to_initial(d.design):
            raise InputError(
                f"⟨design.start⟩ {d.design['start']} gives a surface, from which a network can start only with"
                " ⟨+design.preconditioner⟩ laplacian; use that, start offset, or network none"
            )

    @classmethod
    def fine_net(cls, d: Defaults) -> bool:
        """Whether the control net resolves an initial surface by transport."""
        return d.fine_net

    @classmethod
    def spread(cls, d: Defaults) -> bool:
        """Whether the image of the source's centre is to be convolved with that of the source."""
        return d.plain and cls.fine_net(d) and not d.source.sharp and d.shifts

    @classmethod
    def exact_start(cls, d: Defaults) -> bool:
        """Whether the initial surface is accurate at every scale: by transport, for a point source or plane wave, if the net
        resolves it, and for an extended source that shifts the image, apart from its blur.  Otherwise stages are coarse to fine."""
        return d.plain and cls.fine_net(d) and d.design.start != "offset" and (d.source.sharp or cls.spread(d))

    @classmethod
    def complete_control(cls, d: Defaults) -> None:
        """Complete the control net."""
        if not d.own_control:
            d.set_control(cls.default_control(d))

    @classmethod
    def default_control(cls, d: Defaults) -> list[int]:
        """The control net unless one is given."""
        if d.trained:
            return [NETWORK_CONTROL] * 2
        fine = cls.exact_start(d) and not d.shaped
        coarse = BEAM_SPANS if d.shaped else DEFAULT_SPANS
        spans = d.effort.refinement.spans(max(d.resolution)) if fine else coarse
        return [spans + p for p in d.lens.degree]

    @classmethod
    def default_stages(cls, d: Defaults, waves: list[Table]) -> list[Table]:
        """The stages on rays unless they are given; waves: those on the wave image that follow.

        After an accurate initial surface, stages on rays do not lower the error that stages on the wave image end with.
        """
        lens = d.lens
        if cls.exact_start(d):
            stages = cls.refinement(d, cls.creased(d, waves))
            return [stage | {"spare": True} for stage in stages] if waves and d.source.sharp else stages
        if d.plain and "knots_u" not in lens:
            return coarse_to_fine(lens.control, lens.degree, d.sampled, d.resolution, d.effort, sampler=d.sampler)
        return [
            on_rays(
                lens.control,
                d.sampled,
                d.sampler,
                apron=math.ceil(0.04 * max(d.resolution)),
                iterations=default("design.stages.iterations"),
                tolerance=2e-3 if d.plain else 0.0,
            )
        ]

    @classmethod
    def creased(cls, d: Defaults, waves: list[Table]) -> bool:
        """Whether the surface has creases, for which the control net is then made fine.

        Diffraction and extended sources smooth creases more than a coarser net.
        """
        creased = cls.has_creases(d) and not (d.own_control or waves or d.shaped or cls.spread(d))
        if creased:
            plan = d.effort.creased if d.by_rows else d.effort.creased.coarser
            along = zip(d.lens.degree, d.lens.array, cls.pieces(d), strict=True)
            d.set_control([creased_control(max(d.resolution) * n, p, plan, k) for p, n, k in along])
        return creased

    @staticmethod
    def pieces(d: Defaults) -> tuple[int, int]:
        """Pieces along x and y between which the knots of its spline permit creases."""
        return (1, 1)

    @classmethod
    def has_creases(cls, d: Defaults) -> bool:
        """Whether the surface has creases where its spline has none: by dark gaps of the picture."""
        return d.gaps >= GAPS

    @classmethod
    def refinement(cls, d: Defaults, creased: bool = False) -> list[Table]:
        """The stages after a transport start."""
        how = d.effort.creased if creased else d.effort.refinement
        if creased and not cls.known_to_transport(d):
            how = replace(how, plan=d.effort.joint)
        stages = partial(refinement, d.lens.control, d.rays, d.resolution, how, least=cls.least_rays(d))
        return on_spread(stages(d.fewer_blurred)) if cls.spread(d) else stages(d.fewer_rays)

    @classmethod
    def known_to_transport(cls, d: Defaults) -> bool:
        """Whether what is asked for is the picture alone, of the surface that the transport finds."""
        limited = d.design.max_slope or d.design.min_radius or d.lens.finish
        return d.design.loss.strip() in ("rms", "rms-light") and not limited

    @classmethod
    def least_rays(cls, d: Defaults) -> int:
        """Least number of rays of the stages after a transport start."""
        return 0

    # Numerics

    def check(self) -> None:
        super().check()
        if any(stage.lenslets and not self.takes_lenslets(k) for k, stage in enumerate(self.stages)):
            raise InputError("⟨design.stages.lenslets⟩ needs ⟨lens.array⟩, and neither waves nor spread in the same stage")

    def takes_lenslets(self, k: int) -> bool:
        """Whether stage k can compare each lenslet with its own target."""
        return False

    def objective_by_rays(self, scene: Scene, k: int, initial: Tensor) -> LossOfHeights:
        """On the image of the source's centre, convolved with that of the source, where the stage asks for it and that is a good
        approximation."""
        lit = self.lit(scene, k)
        if (found := self.source_spread(k, lit, self.field(k), initial)) is not None:
            return self.blurred(lit, k, found)
        return super().objective_by_rays(scene, k, initial)

    def source_spread(self, k: int, scene: Scene, *lens: Any) -> Spread | Spreads | None:
        """That of a scene, and a lens as of `source_limits.source_spread`, if stage k asks for it, else None."""
        return source_spread(scene, *lens) if self.stages[k].spread else None

    def blurred(self, scene: Scene, k: int, spread: Spread | Spreads) -> Objective:
        """The objective of stage k on the image of the source's centre, convolved with this point-spread function."""
        stage, o, field = self.stages[k], self.options, self.field(k)
        expected = best_irradiance(scene, grey(self.target.cpu().numpy()), spread, SMOOTH_STEPS).kept
        how = stage.sampler, stage.rays, stage.rendering.oversample
        scene, rays, spreads = spread.rays(scene, *how, self.seed(k), self.device)
        blur = SourceBlur(spreads, expected)
        return Objective(scene, field, rays, self.target, o.loss, stage.rendering, o.limits, blur=blur, dtype=o.dtype)

    # Initial surface

    def refuse_unreachable(self) -> None:
        """Refuse a picture out of reach, before any work.

        Raises:
            InputError: the screen is obstructed, or the picture cannot be reached by refraction.
        """
        for scene in self.scenes:
            refuse_unreachable(scene.unfolded, grey(self.target.numpy()))

    def refuse_obstructed(self) -> None:
        """Refuse a screen that is in the light of its source.

        Raises:
            InputError: it is.
        """
        for scene in self.scenes:
            refuse_obstructed(scene)

    def offset(self) -> Tensor | None:
        """Heights (n, m) mm of the offset surface with the slope that turns its light to the centre of a shifted screen; None for
        one that is not shifted, or for a network, whose heights are relative to the offset surface."""
        screen, lens, source = self.scene.screen, self.scene.lens, self.scene.source
        if not (any(screen.shift) and self.options.parametrisation.free):
            return None
        x, y = (c.numpy() for c in self.field(0).control_xy())
        vertex, index = lens.offset.thickness, lens.effective_index
        slope = [c / ((index - 1.0) * (screen.z - vertex)) for c in screen.shift]
        if self.scene.behind:
            slope = RelayedScreen(self.scene, vertex).lean(index)
        elif source.lean:
            slope = BeamProjection(screen, vertex, lens.interaction.side, source.axis).lean(index)
        return torch.from_numpy(lens.offset.heights(x, y) + slope[0] * x[:, None] + slope[1] * y[None, :])

    def transport(self, fixed: bool, seconds: float, rough: bool = False) -> InitialSurface:
        """Initial heights by transport on the control net of the first stage.

        fixed: the thickness is given by the user; a surface below the least thickness is raised, which leaves slopes unchanged.
        seconds: approximate time allowed for a near source; rough: by the fewest cells.

        Raises:
            InputError: the picture cannot be reached.
        """
        spans = min(n - p for n, p in zip(self.stages[0].control, self.scene.lens.degree, strict=True))
        rays, least = 0 if rough else max(s.rays for s in self.stages), self.effort.source_cells
        cells = transport_cells(rays, not self.scene.source.parallel, 0 if rough else spans, least)
        surface, lens = self.solved(*self.unblurred(self.scene), cells, fixed, seconds), self.scene.lens
        floors = lens.floors(*(c.numpy() for c in self.field(0).control_xy()))
        short = float((floors - surface.heights.numpy()).max())
        return replace(surface, heights=surface.heights + 1.01 * short) if fixed and short > 0 else surface

    def unblurred(self, scene: Scene) -> tuple[Scene, np.ndarray]:
        """A scene and the irradiance on its screen that its light is to give, where the stages convolve the image of the source's
        centre: of this centre, on a screen with room for the blur, and the irradiance from which the blur makes the picture."""
        goal = grey(self.target.numpy())
        if (found := self.source_spread(0, scene)) is None:
            return scene, goal
        light = best_irradiance(scene, goal, found, SMOOTH_STEPS)
        return replace(scene, source=point_source(scene), screen=scene.screen.grown(light.beside)), light.light

    def solved(self, scene: Scene, goal: np.ndarray, cells: int, fixed: bool, seconds: float) -> InitialSurface:
        """`transport` of the light of a scene to an irradiance on its screen, with this number of source cells."""
        return first_surface(scene, goal, self.field(0), cells, fixed, seconds, self.effort.vertex_cells)

    # Messages

    def notes(self, size: tuple[float, float], timed: bool, without_waves: str) -> Iterator[str]:
        """What is to be said of the limits set by source and diffraction before the design.

        size: of the picture, mm; timed: under a time limit; without_waves: why `waves = "auto"` leaves out the wave image.
        """
        if coarse := coarse_words(self.scene):
            yield coarse
        seen = Resolution.before(self.scene, size)
        yield from self.resolution_notes(seen)
        if self.scene.source.uneven and self.stages[-1].rendering.bright is not None:
            yield CENTRED
        if words := self.source_limits(timed).sentence():
            yield words
        if seen.matters and without_waves and self.refines_waves:
            yield f"the wave image is not refined: {without_waves}"

    def resolution_notes(self, seen: Resolution) -> Iterator[str]:
        """What is to be said of the resolution before the design."""
        yield seen.sentence()

    def preview(self, heights: Tensor, size: int) -> Iterator[str]:
        """What is to be said of an initial surface; size: expected bytes of its file."""
        yield manufacture.preview(self.scene, self.field(0), heights, size)

    def advice(self, size: tuple[float, float]) -> str:
        """A recommendation after the design, or "".

        size: of the picture, mm.
        """
        return advice(self.scene, grey(self.target.numpy()), size)

    # Evaluation

    #: Whether the loss is that of one scene, so that a lens can be compared with the initial one by the picture there.
    one_scene = True

    @cached_property
    def _limits(self) -> dict[int, SourceLimits]:
        return {}

    def source_limits(self, timed: bool = False) -> SourceLimits:
        """The limits set by the source, which are the same for any lens: computed once; timed: under a time limit."""
        steps = SMOOTH_STEPS if timed else self.effort.bound_steps
        if steps not in self._limits:
            self._limits[steps] = performance_limits(self.scene, self.target.cpu().numpy(), steps)
        return self._limits[steps]

    @property
    def further_retraces(self) -> float:
        """Retraces of an evaluation beyond those of one scene, in the time of one."""
        return 0.0

    def evaluate(self, designer: Designer, state: State, size: tuple[float, float], timed: bool = False) -> Evaluated:
        """Retrace the finished lens with independent rays, and compute its wave image if that was refined.

        If the loss measures the error of the picture alone, a lens that is worse than the initial one is replaced by it; they are
        compared by the wave image if that was refined.

        Args:
            size: width and height of the picture, mm; timed: under a time limit, do not increase the number of rays, and limit the
                iterations for the least error.
        """
        evaluation = LensEvaluation(designer, state, size, timed, self.traced)
        if self.one_scene:
            evaluation.compare_with_start()
        evaluation.compare_unrounded()
        bounds = self.source_limits(timed)
        evaluation.figures |= {
            key: bound
            for key, bound in (("least_relative_rms", bounds.error), ("etendue_limit", bounds.etendue))
            if bound is not None
        }
        evaluation.add_unseen()
        evaluation.add_beam()
        evaluation.figures |= self.further_figures(designer, evaluation.state)
        return evaluation.result()

    def errors(
        self, designer: Designer, state: State, rays: int, seed: int, middle: bool = True, noise: bool = True
    ) -> list[dict[str, Any]]:
        """Figures of the lens with independent rays, a row for each scene that it is for; noise: with that of its error.

        Raises:
            CausticError: no light reaches the screen.
        """
        lens, how = trace_arguments(self.scene, designer.field(state.stage), state.heights), (rays, seed)
        known = self.traced(state.heights, *how)
        image, figures = retrace(*lens, self.target.numpy(), rays=rays, seed=seed, device=self.device, noise=noise, known=known)
        self._traced = (*self._traced[:1], (state.heights, state.heights._version, how, image))
        return [figures]

    def traced(self, heights: Tensor, rays: int, seed: int) -> Image | None:
        """The image of a lens that `errors` traced with these rays, of the first and the last; None of others."""
        for net, version, how, image in self._traced:
            if how == (rays, seed) and net._version == version and net.device == heights.device and torch.equal(net, heights):
                return image
        return None

    def error_of(self, designer: Designer, state: State) -> float | None:
        """Error of a lens by light that the optimiser does not use, as `evaluate` judges it but faster: of the wave image if that
        is refined and exists, else the quadratic mean of `errors`, without that of their noise; None if no light reaches the
        screen."""
        if self.one_scene and (found := self.error_by_waves(designer, state)) is not None:
            return found
        rays = max(1, int(evaluation_rays(self.scene, self.effort.final_rays) / max(1.0, self.further_retraces)))
        try:
            rows = self.errors(designer, state, rays, self.options.seed, middle=False, noise=False)
        except CausticError:
            return None
        return math.sqrt(math.fsum(row["relative_rms"] ** 2 for row in rows) / len(rows))

    def further_figures(self, designer: Designer, state: State) -> dict[str, Any]:
        """Figures beyond those of any kind."""
        return {}
