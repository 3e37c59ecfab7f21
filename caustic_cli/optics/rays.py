"""The ray state: the representation of light between source and screen, with the account of losses.

Notation, a ray of N
    o       origin, (x, y, z), z measured from `datum`, mm
    d       unit direction
    power   fraction of the source's power
    path    optical path length so far, the sum of n t over the media, mm
    E       unit vector of the electric field of linearly polarised light, perpendicular to d; None if not tracked

Components of o, d and E are (N,) tensors, or plain floats where all rays share them, so that products with the 0 and 1 of a plane
wave are never computed.  Sources emit ray states, elements transform them, screens collect them.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from enum import IntEnum

import torch
from torch import Tensor

from caustic_cli.optics.sampling import Sample

#: Kinds of losses; with the image they sum to the source's power, 1.
LOSSES = ("missed_lens", "missed_surface", "total_internal_reflection", "fresnel", "absorbed", "off_screen")

Vector = tuple


class RayStatus(IntEnum):
    """Outcome of a ray in front of the screen."""

    OK = 0
    TOTAL_INTERNAL_REFLECTION = 1
    AWAY_FROM_SCREEN = 2
    MISSED_SURFACE = 3


@dataclass
class RayState:
    """Rays at one stage of a trace; see the module."""

    origin: Vector
    direction: Vector
    power: Tensor
    path: Tensor | float = 0.0
    #: E.
    polarised: Vector | None = None
    #: (N,) int64, a `RayStatus` each; None while all are OK.
    status: Tensor | None = None
    #: Power lost so far, by name, see LOSSES.
    lost: dict[str, Tensor | float] = field(default_factory=dict)
    #: nm; None if no medium needs it.
    wavelength: float | None = None
    #: Points of the aperture through which the rays of a plane wave pass while they are still parallel to the axis.
    sample: Sample | None = None
    datum: float = 0.0
    #: Power behind the last element, for rays on a screen.
    leaving: Tensor | None = None

    @property
    def count(self) -> int:
        """Number of rays."""
        return self.power.numel() if self.sample is None else math.prod(self.sample.shape)

    @property
    def along_axis(self) -> bool:
        """Whether they are rays of an axial plane wave with a sample of the aperture."""
        return self.sample is not None and self.direction == (0.0, 0.0, 1.0)

    def total(self, power: Tensor) -> Tensor:
        """Total power, (); a scalar `power` is that of each ray."""
        return power.sum(dtype=torch.float64) if power.ndim else power.double() * self.count

    def lose(self, name: str, power: Tensor) -> None:
        """Add the rays' power to the account of losses under `name`."""
        self.book(name, self.total(power))

    def book(self, name: str, amount: Tensor | float) -> None:
        """Add an amount of power to the account of losses under `name`."""
        self.lost[name] = self.lost.get(name, 0.0) + amount

    def mark(self, where: Tensor, status: RayStatus) -> None:
        """Set the status of the rays `where` that are still OK."""
        status_so_far = torch.zeros(where.shape, dtype=torch.int64, device=where.device) if self.status is None else self.status
        self.status = torch.where(where & (status_so_far == RayStatus.OK), int(status), status_so_far)

    def statuses(self) -> Tensor:
        """A `RayStatus` for every ray, (N,) int64."""
        if self.status is None:
            return torch.zeros(self.power.shape, dtype=torch.int64, device=self.power.device)
        return self.status

    def counted_from(self, datum: float) -> RayState:
        """The same rays with z measured from another datum, mm."""
        if datum == self.datum:
            return self
        x, y, z = self.origin
        return replace(self, origin=(x, y, z - (datum - self.datum)), lost=dict(self.lost), datum=datum)

    def full(self, vector: Vector) -> Vector:
        """A vector of this state with all components expanded to (N,)."""
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
        """Rays parallel to +z through sampled points of an aperture of half widths `half_size` at z, mm."""
        (rx, ry) = half_size
        x, y = (2.0 * sample.u - 1.0) * rx, (2.0 * sample.v - 1.0) * ry
        if sample.tensor:
            x, y = x[:, None], y[None, :]
        return cls((x, y, z), (0.0, 0.0, 1.0), sample.flux, sample=sample)

    def expanded(self) -> RayState:
        """The same rays with x, y and power expanded to (N,): of a tensor-product sample they are a column, a row and a number."""
        s = self.sample
        if s is None or (not s.tensor and self.power.ndim):
            return self
        x, y, power = (torch.broadcast_to(c, s.shape).reshape(-1) for c in (*self.origin[:2], self.power))
        if s.tensor:
            u, v = (torch.broadcast_to(c, s.shape).reshape(-1) for c in (s.u[:, None], s.v[None, :]))
            s = replace(s, u=u, v=v, tensor=False)
        return replace(self, origin=(x, y, self.origin[2]), power=power, sample=s, lost=dict(self.lost))

    def only(self, kept: Tensor) -> RayState:
        """Some of the rays, `kept` (N,) bool, with the losses of all."""
        rays = self.expanded()

        def of(value):
            return value[kept] if isinstance(value, Tensor) and value.ndim else value

        s, power = rays.sample, of(rays.power)
        return replace(
            rays,
            origin=tuple(map(of, rays.origin)),
            direction=tuple(map(of, rays.direction)),
            power=power,
            path=of(rays.path),
            polarised=None if rays.polarised is None else tuple(map(of, rays.polarised)),
            status=of(rays.status),
            lost=dict(rays.lost),
            sample=None if s is None else Sample(of(s.u), of(s.v), False, power),
        )


@dataclass
class Hit:
    """Where rays meet a surface, in its element's frame."""

    #: Points of intersection, mm.
    local: tuple
    #: Unit directions in front of the surface.
    incoming: tuple
    #: Slopes of the surface.
    slopes: tuple
    #: Length of the path to it, mm.
    length: Tensor | float = 0.0
