"""A weighted mixture of objectives: the power mean of the losses of several scenes, or parts of a lens.

    L = (sum over k of w_k L_k^p)^(1 / p),    sum of w_k = 1

L_k is a function of the section of the design's heights that belongs to case k, from which it may depart by a constant.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from types import EllipsisType
from typing import Protocol

import torch
from torch import Tensor

from caustic_cli.inverse.losses import ColorLoss, Loss
from caustic_cli.inverse.objective import Evaluation
from caustic_cli.optics.system import EXIT


class SceneObjective(Protocol):
    """The loss in a single scene."""

    loss: Loss | ColorLoss

    def __call__(self, heights: Tensor) -> Evaluation:
        """Value and gradient at heights (n, m) mm."""


@dataclass(frozen=True, eq=False)
class Case:
    """One case of a mixture.

    objective: its loss; weight: of that in the mean; seen, shown: its weights in the fraction of the light on the screen and in the
    image; where: section of the heights that it depends on; added: what it adds to these, mm.
    """

    objective: SceneObjective
    weight: float
    seen: float
    shown: float
    where: tuple[slice | int | EllipsisType, ...] = (...,)
    added: Tensor | float = 0.0


class Mixture:
    """The mean over cases with the exponent `power`, as a function of the heights; see above."""

    def __init__(self, cases: Sequence[Case], power: float):
        self.cases, self.power = list(cases), power
        self.loss = self.cases[0].objective.loss

    def __call__(self, heights: Tensor) -> Evaluation:
        """Value, gradient, fraction of the light on the screen and image at heights mm float64."""
        found = [case.objective(heights[case.where] + case.added) for case in self.cases]
        loss = sum(case.weight * e.loss**self.power for case, e in zip(self.cases, found, strict=True)) ** (1.0 / self.power)
        gradient = found[0].gradient.new_zeros(heights.shape)
        for case, e in zip(self.cases, found, strict=True):
            weight = case.weight * (e.loss / loss) ** (self.power - 1.0) if loss > 0 else 0.0
            gradient[case.where] += weight * e.gradient
        on_screen = sum(case.seen * e.on_screen for case, e in zip(self.cases, found, strict=True))
        image = torch.stack([case.shown * e.image for case, e in zip(self.cases, found, strict=True) if case.shown]).sum(0)
        return Evaluation(loss, {EXIT: gradient}, on_screen, image)
