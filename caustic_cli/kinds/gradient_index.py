"""Lenses whose refractive index is designed, evaluated like any lens: a flat plate, and a lens whose exit is designed with it.

The control values of the index are a file of the project, which [lens] index_file names; the checkpoint holds the exit.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import cached_property
from typing import Any, ClassVar

import numpy as np
import torch
from torch import Tensor

from caustic_cli.config.default_stages import MOST_CELLS, Table
from caustic_cli.config.settings import Settings
from caustic_cli.errors import InputError
from caustic_cli.inverse.designer import Designer, State
from caustic_cli.inverse.graded_lens import (
    BOTH,
    INDEX_ALONE,
    FirstValues,
    IndexAndExit,
    OnIteration,
    design_graded_lens,
)
from caustic_cli.inverse.gradient_index import index_of_plate, layers_along, shared_index, with_index
from caustic_cli.inverse.initial_surface import InitialSurface
from caustic_cli.inverse.objective import LossOfLens
from caustic_cli.kinds.defaults import Defaults
from caustic_cli.kinds.elements import AmongElements, FreeElements
from caustic_cli.kinds.surface import Described
from caustic_cli.loading import OnDemand
from caustic_cli.optics import ranks
from caustic_cli.optics.system import trace_arguments
from caustic_cli.scene import Scene
from caustic_cli.schema.table import LensSettings, ScreenSettings, check, check_all

manufacture = OnDemand("caustic_cli.studies.manufacture")

#: Half range about the index; degree of its splines, knot spans per pixel, those for pictures with creases, and their largest
#: number; source cells of the transport per span.
HALF_RANGE, INDEX_DEGREE, INDEX_SPANS, CREASED_SPANS, MOST_SPANS, CELLS_A_SPAN = 0.05, 3, 2, 8, 768, 2
RAYS_BENT, ITERATIONS = 16, 24  # largest number of rays per pixel, since they cost more; and iterations where there are no creases


class IndexPlate(AmongElements):
    """A plate with a designed index; its surface is flat.

    Args:
        index: number of control values along x and y, their range, and their layers along z.
    """

    in_stages = False
    #: What a user may call the start.
    starts: tuple[str, ...] = ("offset", "transport")

    def __init__(self, *args: Any, index: tuple[tuple[int, int], tuple[float, float], int], **more: Any):
        self.index = index
        super().__init__(*args, **more)

    idle: ClassVar[Mapping[str, str]] = {}

    @classmethod
    def applies(cls, s: Settings) -> bool:
        return s.lens.gradient == "free"

    @classmethod
    def further(cls, described: Described, scene: Scene) -> dict[str, Any]:
        lens = described.settings.lens
        return {"index": (lens.index_control, lens.index_range, lens.index_layers)} | super().further(described, scene)

    @classmethod
    def blank(cls, lens: LensSettings, screen: ScreenSettings, index: float) -> LensSettings:
        """The lens with the range and the control values of its index."""
        lens = cls.sides(lens).filled(index_range=(max(1.0, index - HALF_RANGE), index + HALF_RANGE))
        check_all("lens", lens, "index_range", "index_layers")
        if not lens.index_range[0] < lens.index_range[1]:
            raise InputError(f"⟨lens.index_range⟩ must ascend, got {list(lens.index_range)}")
        return super().blank(lens, screen, index)

    @classmethod
    def sides(cls, lens: LensSettings) -> LensSettings:
        """The lens with what both sides are: flat, on the smallest control net."""
        lens = lens.filled(radius=(math.inf, math.inf))
        if "base_file" in lens:
            raise InputError(
                "⟨lens.gradient⟩ free of a plate has two flat sides, without ⟨lens.base_file⟩; ⟨+lens.with_surface⟩ has one"
            )
        if any(map(math.isfinite, lens.radius)):
            raise InputError(f"⟨lens.radius⟩ of a free gradient must be [inf, inf], two flat sides, got {list(lens.radius)}")
        return lens.filled(control=[p + 1 for p in check("lens.degree", lens.degree)])

    @classmethod
    def complete(cls, d: Defaults) -> None:
        """L-BFGS from optimal transport, on rays."""
        design = d.design
        check("design.waves", design.waves)
        if design.get("start", "transport") not in cls.starts:
            raise InputError(f"⟨design.start⟩ of a free gradient must be transport, got {design.start}")
        spans = CREASED_SPANS if cls.has_creases(d) else INDEX_SPANS
        lens = d.lens.filled(index_control=[min(MOST_SPANS, spans * n) + INDEX_DEGREE for n in d.resolution])
        check("lens.index_control", lens.index_control)
        if "index_layers" not in lens:
            lens = lens.changed(index_layers=layers_along(d.scene, lens.index_control))
        d.s = d.s.changed(lens=lens)
        cls.complete_surface(d)
        if "stages" not in design:
            stage = cls.default_stage(d)
            rays = d.rays or min(stage["rays"], RAYS_BENT * math.prod(d.resolution))
            sampler = stage["sampler"] if d.source.sharp or cls.spread(d) else d.sampler
            d.set_stages([stage | {"rays": rays, "sampler": sampler, "oversample": min(4, stage["oversample"])}])

    @classmethod
    def fine_net(cls, d: Defaults) -> bool:
        """That of the index does."""
        return True

    @classmethod
    def complete_surface(cls, d: Defaults) -> None:
        """Complete how the exit is designed: it is flat, and the index starts from optimal transport."""
        d.set_design(start="offset")
        d.fill_design(preconditioner="laplacian")

    @classmethod
    def default_stage(cls, d: Defaults) -> Table:
        """The stage unless it is given, before its rays are limited."""
        stage = cls.refinement(d)[-1]
        return stage if cls.has_creases(d) else stage | {"iterations": ITERATIONS}

    def iterate(
        self,
        lens: LensSettings,
        state: State,
        total: int,
        began: float,
        time_limit: float,
        stop: Callable[[], bool],
        on_iteration: Callable[[State], None],
    ) -> tuple[np.ndarray, State]:
        """Design the index of the plate: its control values, and the final state.

        Args:
            lens: the [lens] section; state: the initial one, after whose iterations the index is that of the lens.
            total: iterations, with those.
            began: start of the command by `time.monotonic`; time_limit: of the command, s, of which two thirds are for the
                iterations and the rest for the evaluation.
            stop: called before every iteration; on_iteration: after.

        Raises:
            InputError: as of `start_of_index`.
        """
        limit = time_limit if math.isinf(time_limit) else 2.0 * time_limit / 3.0
        before, now = state.seconds, State(self.first_exit(state), total=state.total, iteration=state.total)
        now.history = list(state.history)

        def late() -> bool:
            return time.monotonic() - began > limit

        def done(k: int, loss: float, on_screen: float, image: Tensor | None) -> None:
            now.total = now.iteration = state.total + k
            now.seconds, now.image = before + time.monotonic() - began, image
            now.history.append((now.total, 0, loss, on_screen, now.seconds))
            with ranks.alone():
                on_iteration(now)

        values = self.search(lens, state, now, max(0, total - state.total), done, lambda: ranks.decide(lambda: stop() or late()))
        if stop():
            now.reason = "interrupted"
        elif now.total >= total:
            now.reason = "iterations"
        else:
            now.reason = "time limit" if late() else "no progress"
        return values, now

    def first_exit(self, state: State) -> Tensor:
        """Heights (n, m) mm of the exit before the first iteration: flat."""
        return torch.full_like(state.heights, float(self.scene.lens.offset.thickness))

    @property
    def _blank(self) -> Scene:
        """The scene with a lens of one index."""
        return replace(self.scene, lens=replace(self.scene.lens, gradient=None))

    @property
    def _designed(self) -> np.ndarray | None:
        """Control values (n, m, layers) of the index that a design has found so far, None before it."""
        gradient = self.scene.lens.gradient
        return None if gradient is None else gradient.volume

    @cached_property
    def initial_index(self) -> Tensor:
        """Control values (n, m, layers) of the initial index."""
        control, limits, layers = self.index
        cells = min(MOST_CELLS, max(self.effort.source_cells, CELLS_A_SPAN * (max(control) - INDEX_DEGREE)))
        return self.start_of_index(*self.unblurred(self._blank), control, limits, cells, layers)

    #: What finds them, from scene, target, number along x and y and range of the control values, source cells, and layers.
    start_of_index: Callable[..., Tensor] = staticmethod(index_of_plate)
    #: Of the unknowns, see `inverse.graded_lens.JointLoss`.
    weights = INDEX_ALONE

    def search(
        self, lens: LensSettings, state: State, now: State, iterations: int, done: OnIteration, stop: Callable[[], bool]
    ) -> np.ndarray:
        """Iterate from the index and the exit of `state`; the control values (n, m, layers) found, and the exit in `now`."""
        begun = self._designed if state.total else None
        first = self.initial_index if begun is None else torch.from_numpy(begun)
        start = FirstValues(now.heights, first, self.bounds(0), self.index[1])
        found = design_graded_lens(
            self.objective_of(with_index(self._blank, start.index)),
            self.scene.lens,
            start,
            self.weights,
            iterations=iterations,
            known=state.optimizer,
            on_iteration=done,
            stop=stop,
        )
        now.optimizer = found.state
        self.keep(found, now)
        return found.index.numpy()

    def objective_of(self, scene: Scene) -> LossOfLens:
        """The loss in a scene whose lens has an index that varies; the blur of its source is that behind a lens of one index."""
        k = len(self.stages) - 1
        scene, stage = self.lit(scene, k), self.stages[k]
        if (found := self.source_spread(k, replace(scene, lens=replace(scene.lens, gradient=None)))) is not None:
            return self.blurred(scene, k, found)
        return self.on_rays(scene, k, self.field(k), self.target, stage.rays)

    def keep(self, found: IndexAndExit, now: State) -> None:
        """Take the exit that was found."""

    def words(self, lens: LensSettings) -> str:
        """What is designed, before it is."""
        return (
            f"index: {lens.index_control[0]} x {lens.index_control[1]} x {lens.index_layers} control values"
            f" of {lens.index_range[0]:.4g} to {lens.index_range[1]:.4g}, {self.stages[-1].rays:,} rays"
        )


class GradedLens(IndexPlate):
    """A lens whose index and exit are designed together."""

    starts = ("transport",)
    start_of_index = staticmethod(shared_index)
    weights = BOTH

    @classmethod
    def applies(cls, s: Settings) -> bool:
        return super().applies(s) and s.lens.with_surface

    @classmethod
    def fine_net(cls, d: Defaults) -> bool:
        return d.fine_net

    @classmethod
    def sides(cls, lens: LensSettings) -> LensSettings:
        return lens

    @classmethod
    def complete_surface(cls, d: Defaults) -> None:
        """It starts from optimal transport of the light that the initial index bends."""
        d.set_design(start="transport")
        cls.complete_control(d)
        d.fill_design(preconditioner="none")

    @classmethod
    def known_to_transport(cls, d: Defaults) -> bool:
        return False

    @classmethod
    def default_stage(cls, d: Defaults) -> Table:
        """With the net of a surface alone."""
        return cls.refinement(d, cls.creased(d, []))[-1]

    def solved(self, scene: Scene, goal: np.ndarray, cells: int, fixed: bool, seconds: float) -> InitialSurface:
        """Of the given thickness, which that of the index is, too."""
        return super().solved(with_index(scene, self.initial_index), goal, cells, True, seconds)

    def first_exit(self, state: State) -> Tensor:
        return state.heights

    def keep(self, found: IndexAndExit, now: State) -> None:
        now.heights = self.feasible(0, found.heights)

    def further_figures(self, designer: Designer, state: State) -> dict[str, Any]:
        return manufacture.wall_and_stock(*trace_arguments(self.scene, designer.field(state.stage), state.heights))

    def words(self, lens: LensSettings) -> str:
        control = self.stages[-1].control
        return f"{super().words(lens)}; exit: {control[0]} x {control[1]} control points"


class GradedElements(GradedLens, FreeElements):
    """A lens whose index and exit are designed together with surfaces of other elements."""

    @classmethod
    def applies(cls, s: Settings) -> bool:
        return IndexPlate.applies(s) and FreeElements.applies(s)
