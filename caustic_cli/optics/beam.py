"""Rays on their way, as the steps of `stepwise` hand them on."""

from __future__ import annotations

from dataclasses import dataclass, field

import torch
from torch import Tensor


@dataclass
class Beam:
    """o: where they are, z from the tracer's reference (mm); d: unit directions; g: slopes of the surface
    there; power; length: mm of glass behind them; e: field of polarised light; status, lost: as of a `Landing`; returned: power
    reflected back into the glass, totally: where by total reflection, inward: the directions in which it had come."""

    o: tuple
    d: tuple
    g: tuple
    power: Tensor
    length: Tensor | float
    e: tuple | None
    status: Tensor
    lost: dict[str, Tensor] = field(default_factory=dict)
    returned: Tensor | None = None
    totally: Tensor | None = None
    inward: tuple | None = None

    def lose(self, name: str, power: Tensor) -> None:
        """Add to the account."""
        self.lost[name] = self.lost.get(name, 0.0) + power.sum()


def unlost(like: Tensor) -> Tensor:
    """`Status.OK` for every ray."""
    return torch.zeros(like.shape, dtype=torch.int64, device=like.device)
