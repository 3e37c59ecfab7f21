"""A network that is trained over ranges of scene parameters, and gives a lens for each of their values."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from typing import Any

from torch import Tensor

from caustic_cli.config.default_stages import Table, refinement
from caustic_cli.config.settings import Settings
from caustic_cli.errors import InputError
from caustic_cli.inverse.designer import Designer, State
from caustic_cli.inverse.objective import LossOfHeights
from caustic_cli.inverse.optimisers import Adam, QuasiNewton
from caustic_cli.inverse.range_training import RangeAdam, RangeObjective
from caustic_cli.inverse.scene_parameters import Range, Ranges
from caustic_cli.kinds.defaults import Defaults
from caustic_cli.kinds.elements import AmongElements
from caustic_cli.kinds.surface import DEFAULT_SPANS, Described, OneSurface
from caustic_cli.optics import ranks
from caustic_cli.optics.emission import rays_of
from caustic_cli.scene import Scene
from caustic_cli.studies.retrace import retrace

OVER_ITERATIONS = 200  # caustic convergence, study design, networks
#: Divisor of the rays for each of the lenses of an evaluation.
OVER = 4


class NetworkOverRange(OneSurface):
    """A network over ranges.

    Args:
        ranges: of the scene parameters.
        conditioned: whether the network takes them as inputs, or is a single lens for all.
    """

    one_scene = False

    def __init__(self, *args: Any, ranges: Ranges, conditioned: bool = True, **more: Any):
        self.ranges, self.inputs = ranges, len(ranges.each) if conditioned else 0
        super().__init__(*args, **more)

    @classmethod
    def applies(cls, s: Settings) -> bool:
        return bool(s.design.over.strip()) and super().applies(s)

    @classmethod
    def further(cls, described: Described, scene: Scene) -> dict[str, Any]:
        return {"ranges": Ranges.parse(described.settings.design.over)}

    @classmethod
    def complete(cls, d: Defaults) -> None:
        super().complete(d)
        _refuse_idle_inputs(d.trained, d.design.initial)

    @classmethod
    def default_control(cls, d: Defaults) -> list[int]:
        return [DEFAULT_SPANS + p for p in d.lens.degree]

    @classmethod
    def default_stages(cls, d: Defaults, waves: list[Table]) -> list[Table]:
        last = refinement(d.lens.control, d.sampled, d.resolution, d.effort.refinement)[-1]
        return [last | {"iterations": OVER_ITERATIONS, "tolerance": 0.0}]

    def check(self) -> None:
        super().check()
        how = self.options.parametrisation
        _refuse_idle_inputs(not how.free, how.initial)
        if any(s.spread or s.source for s in self.stages):
            raise InputError("⟨design.over⟩ needs stages on the rays of the scene's own source, without spread")

    @property
    def scenes(self) -> list[Scene]:
        """Those at all combinations of the ends of the ranges."""
        return self.ranges.ends(self.scene)

    def optimiser(self, k: int) -> type[Adam] | type[QuasiNewton]:
        return RangeAdam

    def objective_in(self, scene: Scene, k: int, initial: Tensor) -> LossOfHeights:
        stage = self.stages[k]
        with ranks.alone():
            middle = self.on_rays(scene, k, self.field(k), self.target, stage.rays)
        return RangeObjective(
            middle, self.ranges, lambda s, seed: rays_of(s, stage.sampler, stage.rays, seed, self.device), self.seed(k)
        )

    def blind(self, values: Sequence[float] | None = None) -> NetworkOverRange:
        """The same with a single lens for all, or in the scene at these values alone."""
        other = copy.copy(self)
        other.inputs = 0
        if values is not None:
            other.scene = self.ranges.scene(self.scene, values)
            other.ranges = Ranges(tuple(Range(k, v, v) for k, v in zip(self.ranges.keys, values, strict=True)))
        return other

    def heights_at(self, designer: Designer, state: State, values: Sequence[float]) -> Tensor:
        """The lens (n, m), mm, for values of the scene parameters, in the order of the ranges."""
        return designer.heights_at(state, self.ranges.scaled([values]))

    @property
    def further_retraces(self) -> float:
        return 2.0 * len(self.ranges.evaluation_points()) / OVER

    def further_figures(self, designer: Designer, state: State) -> dict[str, Any]:
        return {"over": self.errors(designer, state, self.effort.final_rays // OVER, self.options.seed)}

    def errors(
        self, designer: Designer, state: State, rays: int, seed: int, middle: bool = True, noise: bool = True
    ) -> list[dict[str, Any]]:
        """Figures at each of `Ranges.evaluation_points`, with independent rays: the parameter values by their keys, mm;
        relative_rms, noise, on_screen and of_source of the lens for them; and, with `middle`, middle_relative_rms, of the lens for
        the middle of the ranges used there.

        Raises:
            CausticError: no light reaches the screen.
        """
        over, field, target = self.ranges, designer.field(state.stage), self.target.numpy()
        lens_of_middle, rows = self.heights_at(designer, state, over.middle), []
        for values in over.evaluation_points():
            scene, row = over.scene(self.scene, values), dict[str, Any](zip(over.keys, values, strict=True))
            heights = self.heights_at(designer, state, values)
            figures = retrace(scene, field, heights, target, rays=rays, seed=seed, device=self.device, noise=noise)[1]
            row |= {key: figures.get(key) for key in ("relative_rms", "noise", "on_screen", "of_source")}
            if middle:
                of_middle = retrace(scene, field, lens_of_middle, target, rays=rays, seed=seed, device=self.device, noise=False)[1]
                row["middle_relative_rms"] = of_middle["relative_rms"]
            rows.append(row)
        return rows


def _refuse_idle_inputs(trained: bool, initial: str) -> None:
    """Refuse heights that do not depend on the parameters.

    Raises:
        InputError: there is no network, or one whose inputs never have an effect.
    """
    if not trained:
        raise InputError("⟨design.over⟩ needs a network, which gives a lens for every value: ⟨+design.network⟩ dense or sparse")
    if initial == "zero":
        raise InputError(
            "⟨design.initial⟩ zero leaves the inputs of a network without any effect, for good: zero-last, uniform or random"
        )


class NetworkAmongElements(NetworkOverRange, AmongElements):
    """A network over ranges for a lens among other elements."""
