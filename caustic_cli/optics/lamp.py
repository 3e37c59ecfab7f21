"""Light of a chip through the lens of a lamp: emission, both refractions, and where it goes.

A Lambertian emitter sends equal flux into equal areas of the orthographic disc (d_x, d_y), d_x^2 + d_y^2 <= 1: of the solid angle
dw it is cos(theta) dw / pi.  In stereographic coordinates that is

    dPhi = 4 (1 - rho^2) / (pi (1 + rho^2)^3) du dv,

so that the light of a point can also be sampled on a tensor grid of (u, v), on which a spline is two products of matrices.

The power of every ray is booked as transmitted, reflected at either surface by Fresnel, totally reflected, or missed; it is not
followed any further when reflected.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import NamedTuple

import torch
from torch import Tensor

from caustic_cli.optics.interface import reflectance, refract
from caustic_cli.optics.sampling import SOBOL_RAYS, Sample, Sampler, numbers
from caustic_cli.optics.surfaces.polarfield import (
    PolarField,
    PolarHit,
    Vectors,
    frame,
    from_frame,
    polar_hit,
    stereographic,
    to_frame,
)
from caustic_cli.optics.tolerances import LEAST_COSINE
from caustic_cli.scene.lamp import Chip, Goal, Lamp

#: Causes for which light is lost, in the order of their occurrence.
LOSSES = ("inner_fresnel", "missed", "total_internal_reflection", "outer_fresnel")
#: Least component along z of light that is followed to a plane: flatter light lands beyond 50 distances from the axis.
SHALLOW = 0.02
#: Rays traced at a time.
CHUNK = 1 << 17
_DEGREE = 180.0 / math.pi


class ChipRays(NamedTuple):
    """Rays as emitted: origins on the chip, mm, unit directions, and power, of sum 1; (N,) each."""

    origin: Vectors
    direction: Vectors
    power: Tensor


class LampLight(NamedTuple):
    """Light behind the lens.

    point: where it left the surface, mm; direction: unit vectors, meaningless for rays of power 0; power: of each ray; lost: power
    by cause (`LOSSES`), whose sum with that of `power` is the power emitted; spare: squared cosine of the angle at which each ray
    leaves, or would leave if it is totally reflected (negative).
    """

    point: Vectors
    direction: Vectors
    power: Tensor
    lost: dict[str, Tensor]
    spare: Tensor


def concentric(s: Tensor, t: Tensor) -> tuple[Tensor, Tensor]:
    """Points of the unit disc, of equal area for equal area of the unit square (Shirley and Chiu, J. Graphics Tools 2, 1997)."""
    a, b = 2.0 * s - 1.0, 2.0 * t - 1.0
    wide = a.abs() > b.abs()
    r = torch.where(wide, a, b)
    safe = torch.where(r == 0, torch.ones_like(r), r)
    angle = torch.where(wide, 0.25 * math.pi * b / safe, 0.5 * math.pi - 0.25 * math.pi * a / safe)
    return r * torch.cos(angle), r * torch.sin(angle)


def emissions(chip: Chip, count: int, seed: int) -> Iterator[ChipRays]:
    """About `count` rays of equal power, CHUNK at a time: stratified ones of a point, a Sobol sequence of a wider chip."""
    point, side = chip.shape == "point", max(1, round(math.sqrt(count)))
    total = side * side if point else min(count, SOBOL_RAYS)
    for start in range(0, total, CHUNK):
        stop = min(start + CHUNK, total)
        if point:
            s, t = numbers("stratified", (side, side), seed, 2, start, stop)
            x = y = torch.zeros_like(s)
        else:
            s, t, k, m = numbers("sobol", (1, 1), seed, 4, start, stop)
            x, y = (2.0 * k - 1.0, 2.0 * m - 1.0) if chip.shape == "rectangle" else concentric(k, m)
            x, y = 0.5 * chip.size[0] * x, 0.5 * chip.size[1] * y
        dx, dy = concentric(s, t)
        dz = (1.0 - dx * dx - dy * dy).clamp_min(0.0).sqrt()
        yield ChipRays((x, y, torch.zeros_like(x)), (dx, dy, dz), torch.full_like(dx, 1.0 / total))


class PointGrid:
    """Rows of a tensor grid of directions (u, v) of the light of a point, without the corners that it does not reach.

    u, v: (N,) coordinates of the directions; power: (N,), of sum 1 over all rows.
    """

    def __init__(self, field: PolarField, sample: Sample):
        u, v = torch.meshgrid(2.0 * sample.u - 1.0, 2.0 * sample.v - 1.0, indexing="ij")
        self.lit = (u * u + v * v < 1.0).reshape(-1).nonzero()[:, 0]
        self.u, self.v = u.reshape(-1)[self.lit], v.reshape(-1)[self.lit]
        rho2 = self.u * self.u + self.v * self.v
        self.power = (1.0 - rho2) / (1.0 + rho2) ** 3
        self._surface = field.net.prepare(sample, torch.float64)

    @classmethod
    def of(cls, field: PolarField, count: int) -> list[PointGrid]:
        """About `count` rays, CHUNK at a time: small tensors stay in the cache of the processor."""
        sampler = Sampler.of_size("grid", max(1, round(count * 4.0 / math.pi)))
        grids = [cls(field, sample) for sample in sampler.chunks(CHUNK)]
        total = sum(float(grid.power.sum()) for grid in grids)
        for grid in grids:
            grid.power /= total
        return grids

    def hits(self, values: Tensor) -> PolarHit:
        """`PolarField.from_origin` in these directions."""
        g, gu, gv = (c.reshape(-1).index_select(0, self.lit) for c in self._surface(values))
        return polar_hit(self.u, self.v, g, gu, gv)


def through_point(lamp: Lamp, rays: PointGrid, values: Tensor) -> LampLight:
    """Light of a point at the origin through the lens; differentiable by the control values (n, m) of log r."""
    return _from_point(lamp, rays.hits(values), rays.power)


def _from_point(lamp: Lamp, hit: PolarHit, power: Tensor) -> LampLight:
    """Light of the origin, which meets the hemisphere at normal incidence and the surface along the frame's axis."""
    zero, one = torch.zeros_like(hit.p), torch.ones_like(hit.p)
    kept = 1.0 - ((lamp.index - 1.0) / (lamp.index + 1.0)) ** 2
    return _leave(lamp, hit, (zero, zero, one), kept * power, {"inner_fresnel": (1.0 - kept) * power})


def through(lamp: Lamp, field: PolarField, rays: ChipRays, values: Tensor) -> LampLight:
    """Light of a chip through the lens; differentiable by the control values (n, m) of log r."""
    if lamp.chip.shape == "point":
        return _from_point(lamp, field.from_origin(values, *stereographic(*rays.direction)), rays.power)
    origin, direction, power = _enter(lamp, rays)
    hit = field.intersect(values, origin, direction)
    local = to_frame(frame(hit.u, hit.v), direction)
    return _leave(lamp, hit, local, power, {"inner_fresnel": rays.power - power})


def _enter(lamp: Lamp, rays: ChipRays) -> tuple[Vectors, Vectors, Tensor]:
    """Rays behind the hemisphere: points, directions and power."""
    (x, y, z), (dx, dy, dz), radius = rays.origin, rays.direction, lamp.inner
    along = x * dx + y * dy + z * dz
    t = (along * along + (radius * radius - (x * x + y * y + z * z))).sqrt() - along  # the origin lies within: one root
    px, py, pz = x + t * dx, y + t * dy, z + t * dz
    axes = frame(*stereographic(px, py, pz))
    local = to_frame(axes, rays.direction)
    flat = torch.zeros_like(t)
    out, passes, c, s = refract(local, flat, flat, 1.0 / lamp.index)
    power = torch.where(passes, rays.power * (1.0 - reflectance("exact", c, s, 1.0 / lamp.index)), flat)
    return (px, py, pz), from_frame(axes, out), power


def _leave(lamp: Lamp, hit: PolarHit, local: Vectors, power: Tensor, lost: dict[str, Tensor]) -> LampLight:
    """Refraction at the free-form surface; local: directions within the lens, in the frames of the points."""
    n, zero = lamp.index, torch.zeros_like(power)
    met = hit.valid & (local[2] - hit.p * local[0] - hit.q * local[1] > LEAST_COSINE)
    if not bool(met.all()):  # a masked argument keeps NaN out of gradients
        x, y, z = local
        local = torch.where(met, x, zero), torch.where(met, y, zero), torch.where(met, z, zero + 1.0)
    out, passes, c, s = refract(local, hit.p, hit.q, n)
    square = 1.0 + hit.p * hit.p + hit.q * hit.q
    spare = 1.0 - n * n * (1.0 - c * c / square)
    reflected = reflectance("exact", c, s, n)
    passes = passes & met
    arriving = torch.where(met, power, zero)
    leaving = torch.where(passes, power * (1.0 - reflected), zero)
    lost = lost | {
        "missed": power - arriving,
        "total_internal_reflection": torch.where(met & ~passes, power, zero),
        "outer_fresnel": torch.where(passes, power * reflected, zero),
    }
    return LampLight(hit.point, from_frame(frame(hit.u, hit.v), out), leaving, lost, torch.where(met, spare, zero + 1.0))


def land(goal: Goal, light: LampLight) -> tuple[Tensor, Tensor, Tensor]:
    """Coordinates of the light on the target, mm or degrees, and whether it travels towards it.

    Light towards z <= 0 never meets a plane: it has the coordinates of a shallow ray.
    """
    (x, y, z), (dx, dy, dz) = light.point, light.direction
    if goal.far:
        return torch.atan2(dx, dz) * _DEGREE, torch.asin(dy.clamp(-1.0 + 1e-12, 1.0 - 1e-12)) * _DEGREE, dz > 0
    ahead = dz > SHALLOW
    t = (goal.distance - z) / torch.where(ahead, dz, torch.full_like(dz, SHALLOW))
    return x + t * dx, y + t * dy, ahead
