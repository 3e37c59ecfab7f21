"""A weighted mixture of objectives: the power mean of the losses of several scenes, or parts of a lens.

    L = (sum over k of w_k L_k^p)^(1 / p),    sum of w_k = 1

L_k is a function of the section of the design's heights that belongs to member k, from which it may depart by a constant.  Of
several processes each evaluates some of the members, whose objectives are therefore made while it works `alone` (`ranks`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from types import EllipsisType
from typing import cast

import torch
from torch import Tensor

from caustic_cli.inverse.objective import Evaluation, LossOfHeights, LossOfLens
from caustic_cli.optics import ranks
from caustic_cli.optics.system import EXIT
from caustic_cli.optics.trace import Parameters


@dataclass(frozen=True, eq=False)
class Member:
    """One member of a mixture."""

    #: Of heights alone, or with further parameters.
    objective: LossOfHeights | LossOfLens
    #: Of its loss in the mean.
    weight: float
    #: Of its light in the fraction on the screen.
    seen: float
    #: Of its image in the image.
    shown: float
    #: Section of the heights that it depends on.
    where: tuple[slice | int | EllipsisType, ...] = (...,)
    #: What it adds to these, mm.
    added: Tensor | float = 0.0

    def at(self, heights: Tensor, further: Parameters) -> Evaluation:
        """Its evaluation at the design's heights, and at further parameters of the trace if there are any."""
        own = heights[self.where] + self.added
        return (
            cast(LossOfLens, self.objective).evaluate({EXIT: own, **further})
            if further
            else cast(LossOfHeights, self.objective)(own)
        )


class Mixture:
    """The mean over members with the exponent `power`, as a function of the heights; see above."""

    def __init__(self, members: Sequence[Member], power: float):
        self.members, self.power = list(members), power
        self.loss = self.members[0].objective.loss

    def __call__(self, heights: Tensor) -> Evaluation:
        """Value, gradient, fraction of the light on the screen and image at heights mm float64."""
        return self.evaluate({EXIT: heights})

    def evaluate(self, parameters: Parameters) -> Evaluation:
        """The same with gradients by further parameters of the trace, which are those of every member."""
        heights = parameters[EXIT]
        further = {name: value for name, value in parameters.items() if name != EXIT}
        found = ranks.divided([partial(member.at, heights, further) for member in self.members])
        loss = sum(member.weight * e.loss**self.power for member, e in zip(self.members, found, strict=True)) ** (1.0 / self.power)
        gradients = {name: found[0].gradients[EXIT].new_zeros(value.shape) for name, value in parameters.items()}
        for member, e in zip(self.members, found, strict=True):
            weight = member.weight * (e.loss / loss) ** (self.power - 1.0) if loss > 0 else 0.0
            gradients[EXIT][member.where] += weight * e.gradients[EXIT]
            for name in further:
                gradients[name] += weight * e.gradients[name]
        on_screen = sum(member.seen * e.on_screen for member, e in zip(self.members, found, strict=True))
        image = torch.stack([member.shown * e.image for member, e in zip(self.members, found, strict=True) if member.shown]).sum(0)
        return Evaluation(loss, gradients, on_screen, image)
