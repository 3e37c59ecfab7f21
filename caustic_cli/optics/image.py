"""The irradiance image with its energy balance."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Generic, TypeVar

from torch import Tensor

#: A tensor while rays are traced, a number for a complete image.
Amount = TypeVar("Amount", bound=Tensor | float)


@dataclass(frozen=True)
class Image(Generic[Amount]):
    """Power on a screen's pixels and all losses, as fractions of the source's power.

    While rays are traced all three are tensors, image and leaving differentiable; for a complete image leaving and lost are
    numbers.  Over all rays of a source image.sum() + sum(lost.values()) = 1.
    """

    #: (n_x, n_y) float64, or (3, n_x, n_y) with colours.
    image: Tensor
    #: Power behind the last element, () or (3,).
    leaving: Amount
    #: Power lost, by name, see `rays.LOSSES`.
    lost: dict[str, Amount]
    #: Their number.
    rays: int = 0
