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

import torch
from torch import Tensor

from caustic_cli.inverse.objective import Evaluation, LossOfHeights
from caustic_cli.optics import ranks
from caustic_cli.optics.system import EXIT


@dataclass(frozen=True, eq=False)
class Member:
    """One member of a mixture."""

    objective: LossOfHeights
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


class Mixture:
    """The mean over members with the exponent `power`, as a function of the heights; see above."""

    def __init__(self, members: Sequence[Member], power: float):
        self.members, self.power = list(members), power
        self.loss = self.members[0].objective.loss

    def __call__(self, heights: Tensor) -> Evaluation:
        """Value, gradient, fraction of the light on the screen and image at heights mm float64."""
        found = ranks.divided([partial(member.objective, heights[member.where] + member.added) for member in self.members])
        loss = sum(member.weight * e.loss**self.power for member, e in zip(self.members, found, strict=True)) ** (1.0 / self.power)
        gradient = found[0].gradient.new_zeros(heights.shape)
        for member, e in zip(self.members, found, strict=True):
            weight = member.weight * (e.loss / loss) ** (self.power - 1.0) if loss > 0 else 0.0
            gradient[member.where] += weight * e.gradient
        on_screen = sum(member.seen * e.on_screen for member, e in zip(self.members, found, strict=True))
        image = torch.stack([member.shown * e.image for member, e in zip(self.members, found, strict=True) if member.shown]).sum(0)
        return Evaluation(loss, {EXIT: gradient}, on_screen, image)
