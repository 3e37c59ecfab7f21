"""The irradiance image with its energy balance."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Generic, TypeVar

import torch
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
    #: (3, n_x, n_y) tristimulus values on the same scale, Y that of the image, where the colour of the light differs from pixel to
    #: pixel; None elsewhere.
    xyz: Tensor | None = None

    @property
    def total(self) -> Tensor:
        """The image summed over colours, (n_x, n_y)."""
        return self.image if self.image.ndim == 2 else self.image.sum(0)


def with_colour(total: Tensor | None, image: Tensor, colour: tuple[float, float, float] | None) -> Tensor | None:
    """Tristimulus values (3, n_x, n_y) so far, None at first, and those of one more image (n_x, n_y), whose light has one colour:
    X, Y, Z with Y = 1; unchanged without colour."""
    if colour is None:
        return total
    more = torch.tensor(colour, dtype=torch.float64, device=image.device)[:, None, None] * image.detach()
    return more if total is None else total + more
