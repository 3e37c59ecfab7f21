"""An image and its energy account, and how rays on a screen become one."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Generic, TypeVar

from torch import Tensor

#: A tensor while rays are traced, a number of a whole exposure.
Amount = TypeVar("Amount", bound=Tensor | float)


@dataclass(frozen=True)
class Image(Generic[Amount]):
    """Power on a screen's pixels and what became of the rest, as parts of the source's power.

    image: (n_x, n_y) float64, or (3, n_x, n_y) with colours; leaving: the power that left the last element, () or (3,); lost: by a
    name of `rays.LOSSES`.  While rays are traced all three are tensors, image and leaving differentiable; of a whole exposure
    leaving and lost are numbers.  rays: how many.  image.sum() + sum(lost.values()) = 1 over all rays of a source.
    """

    image: Tensor
    leaving: Amount
    lost: dict[str, Amount]
    rays: int = 0
