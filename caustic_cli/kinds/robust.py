"""A robust design: the loss of the last stage is a mean over manufacturing and alignment errors."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from caustic_cli.config.settings import Settings
from caustic_cli.inverse.graded_lens import INDEX
from caustic_cli.inverse.objective import Evaluation, LossOfHeights, LossOfLens
from caustic_cli.inverse.robust import robust_objective
from caustic_cli.kinds.defaults import Defaults
from caustic_cli.kinds.elements import AmongElements, FreeElements
from caustic_cli.kinds.gradient_index import GradedElements, GradedLens, IndexPlate
from caustic_cli.kinds.lenslet_array import LensletArray
from caustic_cli.kinds.surface import Described, OneSurface
from caustic_cli.kinds.two_sided import TwoSides, TwoSidesAmongElements
from caustic_cli.optics import ranks
from caustic_cli.optics.trace import Parameters
from caustic_cli.scene import Scene
from caustic_cli.scene.sources.section import content
from caustic_cli.scene.tolerances import Tolerances


def _tolerances(s: Settings) -> Tolerances | None:
    return content(s.design, "robust", Tolerances)


class RobustSurface(OneSurface):
    """One surface, robust.

    Args:
        tolerances: the errors.
    """

    one_scene = False

    def __init__(self, *args: Any, tolerances: Tolerances, **more: Any):
        self.tolerances = tolerances
        super().__init__(*args, **more)

    @classmethod
    def applies(cls, s: Settings) -> bool:
        return _tolerances(s) is not None and super().applies(s)

    @classmethod
    def further(cls, described: Described, scene: Scene) -> dict[str, Any]:
        return {"tolerances": _tolerances(described.settings)} | super().further(described, scene)

    @classmethod
    def known_to_transport(cls, d: Defaults) -> bool:
        return False

    def objective(self, k: int, initial: Tensor) -> LossOfHeights:
        if k < len(self.stages) - 1:
            return super().objective(k, initial)
        with ranks.alone():
            return robust_objective(
                lambda scene, heights: self.objective_in(scene, k, heights), self.scene, self.field(k), initial, self.tolerances
            )


class RobustAmongElements(RobustSurface, AmongElements):
    """One surface among other elements, robust."""


class RobustElements(RobustSurface, FreeElements):
    """Surfaces of several elements, robust."""


class RobustTwoSides(RobustSurface, TwoSides):
    """Entrance and exit, robust."""


class RobustTwoSidesAmongElements(RobustSurface, TwoSidesAmongElements):
    """Entrance and exit among other elements, robust."""


class RobustArray(RobustSurface, LensletArray):
    """An array of lenslets, robust."""


class Denser:
    """The loss of a lens whose index is larger by this than its control values say."""

    def __init__(self, objective: LossOfLens, by: float):
        self.objective, self.by, self.loss = objective, by, objective.loss

    def evaluate(self, parameters: Parameters) -> Evaluation:
        """Value and gradients."""
        return self.objective.evaluate({**parameters, INDEX: parameters[INDEX] + self.by})


class RobustPlate(RobustSurface, IndexPlate):
    """The index of a plate, robust."""

    def objective_of(self, scene: Scene) -> LossOfLens:
        def in_scene(one: Scene, _: Tensor) -> Denser:
            return Denser(IndexPlate.objective_of(self, one), one.lens.index - scene.lens.index)

        field = self.field(len(self.stages) - 1)
        with ranks.alone():
            return robust_objective(in_scene, scene, field, torch.zeros(field.shape, dtype=torch.float64), self.tolerances)


class RobustGradedLens(RobustPlate, GradedLens):
    """Index and exit, robust."""


class RobustGradedElements(RobustPlate, GradedElements):
    """Index, exit and surfaces of other elements, robust."""
