"""The one state of light between source and screen: rays, what they carry, and what was lost on the way.

Notation, a ray of N
    o       origin, (x, y, z), z counted from `datum`, mm
    d       unit direction
    power   part of what the source emits
    path    optical path length, the sum of n t over the media behind it, mm
    E       unit vector of the field of linearly polarised light, normal to d; None where that is not asked for

Components of o, d and E are (N,) tensors, or plain floats where all rays share them: the products with 0 and 1 of a plane wave
are then never computed.  Sources emit such rays, every element hands them on, screens collect them.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from enum import IntEnum

import torch
from torch import Tensor

from caustic_cli.optics.sampling import Sample

#: What may become of the source's power besides the image; with it they sum to 1.
LOSSES = ("missed_lens", "missed_surface", "total_internal_reflection", "fresnel", "absorbed", "off_screen")

Vector = tuple


class Status(IntEnum):
    """What became of a ray before the screen."""

    OK = 0
    TOTAL_INTERNAL_REFLECTION = 1
    AWAY_FROM_SCREEN = 2
    MISSED_SURFACE = 3


@dataclass
class RayState:
    """Rays at one place of their way.

    origin, direction, power, path, polarised (E): see above; status (N,) int64, a `Status` each, None while all are OK; lost, the
    power lost so far, by a name of LOSSES; wavelength, nm, None where no medium asks; sample, the points of the aperture on which
    rays of a plane wave stand, all of which still run along the axis; datum, mm; leaving, the power that left the last element, of
    rays that have got to a screen.
    """

    origin: Vector
    direction: Vector
    power: Tensor
    path: Tensor | float = 0.0
    polarised: Vector | None = None
    status: Tensor | None = None
    lost: dict[str, Tensor | float] = field(default_factory=dict)
    wavelength: float | None = None
    sample: Sample | None = None
    datum: float = 0.0
    leaving: Tensor | None = None

    @property
    def count(self) -> int:
        """Number of rays."""
        return self.power.numel() if self.sample is None else math.prod(self.sample.shape)

    @property
    def along_axis(self) -> bool:
        """Whether they are those of a plane wave along the axis, known by their sample of the aperture."""
        return self.sample is not None and self.direction == (0.0, 0.0, 1.0)

    def total(self, power: Tensor) -> Tensor:
        """Power of all rays together: of a number that all of them carry, so many times that."""
        return power.sum(dtype=torch.float64) if power.ndim else power.double() * self.count

    def lose(self, name: str, power: Tensor) -> None:
        """Enter power of each ray in the account."""
        self.book(name, self.total(power))

    def book(self, name: str, amount: Tensor | float) -> None:
        """Enter an amount of power in the account."""
        self.lost[name] = self.lost.get(name, 0.0) + amount

    def mark(self, where: Tensor, status: Status) -> None:
        """Say what became of the rays `where`, if nothing has been said before."""
        before = torch.zeros(where.shape, dtype=torch.int64, device=where.device) if self.status is None else self.status
        self.status = torch.where(where & (before == Status.OK), int(status), before)

    def statuses(self) -> Tensor:
        """A `Status` for every ray, (N,) int64."""
        if self.status is None:
            return torch.zeros(self.power.shape, dtype=torch.int64, device=self.power.device)
        return self.status

    def counted_from(self, datum: float) -> RayState:
        """The same rays with z counted from another height."""
        if datum == self.datum:
            return self
        x, y, z = self.origin
        return replace(self, origin=(x, y, z - (datum - self.datum)), lost=dict(self.lost), datum=datum)

    def full(self, vector: Vector) -> Vector:
        """A vector of this state with every component (N,)."""
        return tuple(c if isinstance(c, Tensor) else torch.full_like(self.power, c) for c in vector)

    def to(self, dtype: torch.dtype) -> RayState:
        """The same rays in another precision."""

        def cast(value):
            return value.to(dtype) if isinstance(value, Tensor) else value

        return replace(
            self,
            origin=tuple(map(cast, self.origin)),
            direction=tuple(map(cast, self.direction)),
            power=cast(self.power),
            path=cast(self.path),
            lost=dict(self.lost),
            polarised=None if self.polarised is None else tuple(map(cast, self.polarised)),
        )

    @classmethod
    def on_axis(cls, sample: Sample, half_size: tuple[float, float], z: float) -> RayState:
        """Rays along +z through the points of a sample of an aperture of half widths `half_size` at z, mm."""
        (rx, ry) = half_size
        x, y = (2.0 * sample.u - 1.0) * rx, (2.0 * sample.v - 1.0) * ry
        if sample.tensor:
            x, y = x[:, None], y[None, :]
        return cls((x, y, z), (0.0, 0.0, 1.0), sample.flux, sample=sample)

    def expanded(self) -> RayState:
        """The same with x, y and power (N,): of a sample they are rows, columns and a number until rays go their own ways."""
        s = self.sample
        if s is None or (not s.tensor and self.power.ndim):
            return self
        x, y, power = (torch.broadcast_to(c, s.shape).reshape(-1) for c in (*self.origin[:2], self.power))
        if s.tensor:
            u, v = (torch.broadcast_to(c, s.shape).reshape(-1) for c in (s.u[:, None], s.v[None, :]))
            s = replace(s, u=u, v=v, tensor=False)
        return replace(self, origin=(x, y, self.origin[2]), power=power, sample=s, lost=dict(self.lost))
