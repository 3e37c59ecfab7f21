"""Sides of the lens of a lamp: how light from the cavity meets each, and where it lies.

    PolarSide    a free-form surface, P = r d (`surfaces.polarfield`): the outer side, and the inner one of two
    Hemisphere   about the chip's centre, whose light it does not deflect
    Roof         a disc of a plane square to the axis, the roof of a cylindrical cavity, whose side is matt and black

All answer in the frames of directions from the origin, in which N = d - p a - q b is normal to a surface: z / d_z to the plane.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import Tensor

from caustic_cli.optics.surfaces.polarfield import PolarField, PolarHit, Vectors, direction_of, polar_hit, stereographic
from caustic_cli.scene.lamp import Lamp

#: Points of a path within the lens at which it is tested against the cavity; of paths of reflected light, and bisections there.
PROBES, CLOSE_PROBES, BISECTIONS = 3, 24, 50


class InnerSide:
    """The side of a lens towards the chip; methods take coordinates (N,) each, in mm."""

    #: Whether light of the origin meets it at normal incidence.
    undeflected = False

    @property
    def spline(self) -> tuple[PolarField, Tensor] | None:
        """r as a spline over (u, v), with its control values, mm; None for a plane."""
        return None

    @property
    def rim(self) -> float:
        """Height of its rim above the plane of the chip, mm."""
        return 0.0

    def hit(self, origin: Vectors, direction: Vectors) -> PolarHit:
        """Where rays from within the cavity, with unit directions, meet it; differentiable by the directions and origins."""
        raise NotImplementedError

    def from_origin(self, u: Tensor, v: Tensor) -> PolarHit:
        """Where rays from the origin in these directions meet it."""
        raise NotImplementedError

    def on_grid(self, u: Tensor, v: Tensor, hits: Callable[[Tensor], PolarHit]) -> PolarHit:
        """The same in the directions of a grid, on which `hits` evaluates control values of a spline."""
        return self.from_origin(u, v)

    def crossed(self, start: Vectors, end: Vectors) -> Tensor:
        """Whether straight paths within the lens pass through the cavity between their ends."""
        return torch.zeros_like(start[0], dtype=torch.bool)

    def met_from_glass(self, o: Tensor, d: Tensor, most: Tensor) -> Tensor:
        """Distance (N,) along rays (N, 3) within the lens at which they meet it, inf beyond `most`."""
        raise NotImplementedError

    def points(self, u: Tensor, v: Tensor) -> Vectors:
        """Its points over the unit disc, whose border is the rim, mm."""
        raise NotImplementedError

    def normals(self, u: Tensor, v: Tensor) -> Vectors:
        """Unit normals there, away from the origin."""
        raise NotImplementedError

    def normals_at(self, points: Tensor) -> Tensor:
        """Unit normals (N, 3) at points (N, 3) of it."""
        return torch.stack(self.normals(*stereographic(*points.unbind(1))), 1)

    def wall(self, field: PolarField, outer: Tensor) -> float:
        """Least distance of the outer surface from the cavity, mm, at points of `PolarField.extent`; negative where they cross."""
        raise NotImplementedError


@dataclass(frozen=True, eq=False)
class PolarSide(InnerSide):
    """A free-form surface: control values (n, m) of r, mm."""

    field: PolarField
    values: Tensor

    @property
    def spline(self) -> tuple[PolarField, Tensor]:
        return self.field, self.values

    def hit(self, origin: Vectors, direction: Vectors) -> PolarHit:
        return self.field.intersect(self.values, origin, direction)

    def from_origin(self, u: Tensor, v: Tensor) -> PolarHit:
        return self.field.from_origin(self.values, u, v)

    def on_grid(self, u: Tensor, v: Tensor, hits: Callable[[Tensor], PolarHit]) -> PolarHit:
        return hits(self.values)

    def crossed(self, start: Vectors, end: Vectors) -> Tensor:
        """At PROBES points of each path."""
        with torch.no_grad():
            found = torch.zeros_like(start[0], dtype=torch.bool)
            for k in range(1, PROBES + 1):
                x, y, z = (a + k / (PROBES + 1) * (b - a) for a, b in zip(start, end, strict=True))
                found |= (x * x + y * y + z * z).sqrt() < self.field.net.evaluate(self.values, *stereographic(x, y, z))[0]
            return found

    def met_from_glass(self, o: Tensor, d: Tensor, most: Tensor) -> Tensor:
        low, high = torch.zeros_like(most), torch.full_like(most, math.inf)
        for k in range(1, CLOSE_PROBES + 1):
            t = k / CLOSE_PROBES * most
            open_ = torch.isinf(high)
            deep = open_ & (self._depth(o + t[:, None] * d) > 0)
            high, low = torch.where(deep, t, high), torch.where(open_ & ~deep, t, low)
        met = torch.isfinite(high)
        end = torch.where(met, high, most)
        for _ in range(BISECTIONS):
            middle = 0.5 * (low + end)
            deep = self._depth(o + middle[:, None] * d) > 0
            low, end = torch.where(deep, low, middle), torch.where(deep, middle, end)
        return torch.where(met, low, torch.full_like(low, math.inf))

    def _depth(self, at: Tensor) -> Tensor:
        """Depth of points within the surface, along radii, mm; none beyond the plane of the chip."""
        x, y, z = at.unbind(1)
        r = self.field.net.evaluate(self.values, *stereographic(x, y, z.clamp_min(0.0)))[0]
        return torch.where(z >= 0, r - at.norm(dim=1), torch.full_like(r, -1.0))

    def points(self, u: Tensor, v: Tensor) -> Vectors:
        return self.field.points(self.values, u, v)

    def normals(self, u: Tensor, v: Tensor) -> Vectors:
        return self.field.normals(self.values, u, v)

    def wall(self, field: PolarField, outer: Tensor) -> float:
        at = field.sampled()
        one, other = (
            np.stack([c.numpy() for c in f.points(net, *at)], 1) for f, net in ((self.field, self.values), (field, outer))
        )
        apart = float((np.linalg.norm(other, axis=1) - np.linalg.norm(one, axis=1)).min())  # along radii: an upper bound
        return apart if apart <= 0 else min(apart, float(cKDTree(one).query(other, distance_upper_bound=apart)[0].min()))


@dataclass(frozen=True)
class Hemisphere(InnerSide):
    """A hemisphere about the origin; radius in mm."""

    radius: float
    undeflected = True

    @property
    def spline(self) -> tuple[PolarField, Tensor]:
        field = PolarField.uniform((4, 4))
        return field, field.sphere(self.radius)

    def hit(self, origin: Vectors, direction: Vectors) -> PolarHit:
        """All rays do."""
        (x, y, z), (dx, dy, dz) = origin, direction
        along = x * dx + y * dy + z * dz
        inside = (self.radius * self.radius - (x * x + y * y + z * z)).clamp_min(0.0)  # the origin lies within: one root
        t = (along * along + inside).sqrt() - along
        point, flat = (x + t * dx, y + t * dy, z + t * dz), torch.zeros_like(t)
        return PolarHit(point, *stereographic(*point), flat, flat, torch.ones_like(t, dtype=torch.bool))

    def from_origin(self, u: Tensor, v: Tensor) -> PolarHit:
        return polar_hit(u, v, torch.full_like(u, self.radius), *(torch.zeros_like(u),) * 2)

    def met_from_glass(self, o: Tensor, d: Tensor, most: Tensor) -> Tensor:
        along = (o * d).sum(1)
        square = along * along - (o * o).sum(1) + self.radius**2
        t = torch.where((square > 0) & (along < 0), -along - square.clamp_min(0.0).sqrt(), torch.full_like(along, math.inf))
        return torch.where((t > 0) & (o[:, 2] + t * d[:, 2] >= 0), t, torch.full_like(t, math.inf))

    def points(self, u: Tensor, v: Tensor) -> Vectors:
        x, y, z = (self.radius * d for d in direction_of(u, v))
        return x, y, z

    def normals(self, u: Tensor, v: Tensor) -> Vectors:
        return direction_of(u, v)

    def wall(self, field: PolarField, outer: Tensor) -> float:
        return field.extent(outer)[0] - self.radius


@dataclass(frozen=True)
class Roof(InnerSide):
    """A disc of a plane at a height above the chip, about the axis; lengths in mm."""

    height: float
    radius: float

    @property
    def rim(self) -> float:
        return self.height

    def hit(self, origin: Vectors, direction: Vectors) -> PolarHit:
        (x, y, z), (dx, dy, dz) = origin, direction
        t = (self.height - z) / dz.clamp_min(1e-300)
        return self._at(x + t * dx, y + t * dy, dz > 0)

    def from_origin(self, u: Tensor, v: Tensor) -> PolarHit:
        dx, dy, dz = direction_of(u, v)
        t = self.height / dz.clamp_min(1e-300)
        return self._at(t * dx, t * dy, dz > 0)

    def _at(self, x: Tensor, y: Tensor, ahead: Tensor) -> PolarHit:
        """At these places; rays that miss the disc are given its centre, where all is finite."""
        valid, zero = ahead & (x * x + y * y <= self.radius * self.radius), torch.zeros_like(x)
        x, y, z = torch.where(valid, x, zero), torch.where(valid, y, zero), zero + self.height
        u, v = stereographic(x, y, z)
        k = 2.0 / (1.0 + u * u + v * v)
        return PolarHit((x, y, z), u, v, k * u / (k - 1.0), k * v / (k - 1.0), valid)

    def met_from_glass(self, o: Tensor, d: Tensor, most: Tensor) -> Tensor:
        t = (self.height - o[:, 2]) / d[:, 2].clamp_max(-1e-300)
        x, y = (o[:, k] + t * d[:, k] for k in (0, 1))
        met = (d[:, 2] < 0) & (t > 0) & (x * x + y * y <= self.radius**2)
        return torch.where(met, t, torch.full_like(t, math.inf))

    def points(self, u: Tensor, v: Tensor) -> Vectors:
        return self.radius * u, self.radius * v, torch.full_like(u, self.height)

    def normals(self, u: Tensor, v: Tensor) -> Vectors:
        zero = torch.zeros_like(u)
        return zero, zero, zero + 1.0

    def wall(self, field: PolarField, outer: Tensor) -> float:
        return float(self.clearance(field.points(outer.detach(), *field.sampled())).min())

    def clearance(self, points: Vectors) -> Tensor:
        """Distance of points from the cylinder below the disc, mm, negative within it; differentiable."""
        x, y, z = points
        beside, above = (x * x + y * y).clamp_min(1e-24).sqrt() - self.radius, z - self.height
        inside = torch.maximum(beside, above)
        outside = (beside.clamp_min(0.0) ** 2 + above.clamp_min(0.0) ** 2).clamp_min(1e-24).sqrt()
        return torch.where(inside < 0, inside, outside)


def inner_side(lamp: Lamp, field: PolarField, inner: Tensor | None) -> InnerSide:
    """The inner side of a lamp; inner: control values (n, m) mm where it is free-form."""
    if inner is not None:
        return PolarSide(field, inner)
    return Hemisphere(lamp.inner) if lamp.flat is None else Roof(lamp.flat, lamp.inner)
