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
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from caustic_cli.optics.interface import reflectance, refract
from caustic_cli.optics.lamp_side import InnerSide, PolarSide, inner_side
from caustic_cli.optics.sampling import SOBOL_RAYS, Sample, numbers
from caustic_cli.optics.surfaces.polarfield import (
    PolarField,
    PolarHit,
    Vectors,
    direction_of,
    frame,
    from_frame,
    polar_hit,
    stereographic,
    to_frame,
)
from caustic_cli.optics.tolerances import LEAST_COSINE
from caustic_cli.scene.lamp import Chip, Goal, Lamp
from caustic_cli.scene.sources.distribution import Distribution
from caustic_cli.scene.sources.rayset import RaySet

#: Causes for which light is lost, in the order of their occurrence.
LOSSES = ("inner_fresnel", "missed", "total_internal_reflection", "outer_fresnel")
#: Least component along z of light that is followed to a plane: flatter light lands beyond 50 distances from the axis.
SHALLOW = 0.02
#: Rays by which the light that uncoated surfaces pass is summed.
LIMIT_RAYS = 100_000
#: Rays traced at a time.
CHUNK = 1 << 17
#: The constant a of a `PointGrid`, and its points over those of them within the circle.
DENSER, CORNERS = 1.0, 1.1
#: Steps of an additive sequence that covers the unit square evenly (Roberts 2018, from the plastic number).
LATTICE = (0.7548776662466927, 0.5698402909980532)
LAMBERTIAN = Chip()
#: Of light on either side of the planes x = 0 and y = 0.
WHOLE = (False, False)
_DEGREE = 180.0 / math.pi
#: Squared sine of an angle below which the angle is its sine and the next term of the series.
NEAR = 1e-8


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


def on_chip(chip: Chip, s: Tensor, t: Tensor) -> tuple[Tensor, Tensor]:
    """Points of a chip with an extent, mm, of equal area for equal area of the unit square."""
    x, y = (2.0 * s - 1.0, 2.0 * t - 1.0) if chip.shape == "rectangle" else concentric(s, t)
    return 0.5 * chip.size[0] * x, 0.5 * chip.size[1] * y


def emissions(chip: Chip, count: int, seed: int) -> Iterator[ChipRays]:
    """About `count` rays of equal power, CHUNK at a time: stratified ones of a point, a Sobol sequence of a wider chip, and of a
    ray file its own, drawn at random by their flux, with replacement."""
    if chip.rays is not None:
        yield from _drawn(chip.rays, count, seed)
        return
    point, side = chip.shape == "point", max(1, round(math.sqrt(count)))
    total = side * side if point else min(count, SOBOL_RAYS)
    for start in range(0, total, CHUNK):
        stop = min(start + CHUNK, total)
        if point:
            s, t = numbers("stratified", (side, side), seed, 2, start, stop)
            x = y = torch.zeros_like(s)
        else:
            s, t, k, m = numbers("sobol", (1, 1), seed, 4, start, stop)
            x, y = on_chip(chip, k, m)
        dx, dy = concentric(s, t)
        if chip.intensity is not None:
            dx, dy = _tabulated(chip.intensity, dx, dy)
        dz = (1.0 - dx * dx - dy * dy).clamp_min(0.0).sqrt()
        yield ChipRays((x, y, torch.zeros_like(x)), (dx, dy, dz), torch.full_like(dx, 1.0 / total))


def _drawn(rays: RaySet, count: int, seed: int) -> Iterator[ChipRays]:
    """Rays of a ray file."""
    rng, sums = np.random.default_rng(seed), np.cumsum(rays.flux)
    for start in range(0, count, CHUNK):
        at = np.searchsorted(sums, sums[-1] * rng.uniform(size=min(CHUNK, count - start)), side="right")
        (x, y, z), (dx, dy, dz) = (torch.from_numpy(c[at]).unbind(1) for c in (rays.positions, rays.directions))
        yield ChipRays((x, y, z), (dx, dy, dz), torch.full_like(x, 1.0 / count))


def _tabulated(intensity: Distribution, x: Tensor, y: Tensor) -> tuple[Tensor, Tensor]:
    """Components of directions, of equal flux for equal area of the unit disc."""
    fraction = x * x + y * y
    sine = torch.from_numpy(np.sin(intensity.angle_of(fraction.numpy(), 0.5 * math.pi)))
    scale = sine / fraction.sqrt().clamp_min(1e-300)
    return scale * x, scale * y


def chip_grids(chip: Chip, points: int, count: int, halves: tuple[bool, bool] = WHOLE) -> Iterator[ChipRays]:
    """About `count` rays from points x points places of a chip, CHUNK at a time, of unequal power: in a grid of directions
    (u, v), displaced from place to place by a part of its cells.  halves: whether only those from places at x > 0, and at y > 0.

    The places have the mean square distances of the chip's points.  Their images are as smooth as those of a `PointGrid`, which a
    design needs more than independence of the rays; those of a ray file are its own.
    """
    if chip.rays is not None:
        return emissions(chip, count, 0)
    middle = (torch.arange(points, dtype=torch.float64) + 0.5) / points
    s, t = (c.reshape(-1) for c in torch.meshgrid(middle, middle, indexing="ij"))
    square = 1.0 / 12.0 if chip.shape == "rectangle" else 1.0 / 16.0
    x, y = (c * (square * d * d / (c * c).mean()).sqrt() for c, d in zip(on_chip(chip, s, t), chip.size, strict=True))
    side = max(1, round(math.sqrt(count / len(x) * 4.0 / math.pi)))
    kept = torch.stack(
        [c > 0 if half else torch.ones_like(c, dtype=torch.bool) for half, c in zip(halves, (x, y), strict=True)]
    ).all(0)
    x, y = x[kept], y[kept]
    each = max(1, CHUNK // (side * side))
    cells, total = torch.arange(side, dtype=torch.float64), 0.0
    parts = []
    for places in torch.arange(len(x)).split(each):
        u, v = ((cells + ((places[:, None] + 1) * step).frac()) * (2.0 / side) - 1.0 for step in LATTICE)
        u, v = (c.reshape(-1) for c in torch.broadcast_tensors(u[:, :, None], v[:, None, :]))
        lit = u * u + v * v < 1.0
        at, u, v = places.repeat_interleave(side * side)[lit], u[lit], v[lit]
        parts.append(ChipRays((x[at], y[at], torch.zeros_like(u)), direction_of(u, v), emitted(chip, u, v)))
        total += float(parts[-1].power.sum())
    return (part._replace(power=part.power / total) for part in parts)


def lambertian(u: Tensor, v: Tensor) -> Tensor:
    """Light of a Lambertian emitter per area of (u, v), up to a factor, see the module; for u^2 + v^2 <= 1."""
    rho2 = u * u + v * v
    return (1.0 - rho2) / (1.0 + rho2) ** 3


def emitted(chip: Chip, u: Tensor, v: Tensor) -> Tensor:
    """The same of the points of a chip."""
    if chip.intensity is None:
        return lambertian(u, v)
    rho2 = u * u + v * v
    return torch.from_numpy(chip.intensity.relative(2.0 * np.arctan(rho2.sqrt().numpy()))) / (1.0 + rho2) ** 2


class PointGrid:
    """Rows of a tensor grid of directions (u, v) of the light of a point, without the corners that it does not reach.

    The coordinates of equispaced s are u = tan(a s) / tan(a): denser about the axis, where most of the light is, so that rays are
    of less unequal power.

    u, v: (N,) coordinates of the directions; power: (N,), of sum 1 over all rows; shape: of the grid with its corners, lit: (N,)
    which of its points have light, row by row.
    """

    def __init__(self, field: PolarField, sample: Sample, chip: Chip):
        s, t = (2.0 * c - 1.0 for c in (sample.u, sample.v))
        u, v = (torch.tan(DENSER * c) / math.tan(DENSER) for c in (s, t))
        sample = replace(sample, u=0.5 * (u + 1.0), v=0.5 * (v + 1.0))
        stretch = torch.outer(*(1.0 / torch.cos(DENSER * c) ** 2 for c in (s, t))).reshape(-1)
        u, v = torch.meshgrid(u, v, indexing="ij")
        self.shape = tuple(u.shape)
        self.lit = (u * u + v * v < 1.0).reshape(-1).nonzero()[:, 0]
        self.u, self.v = u.reshape(-1)[self.lit], v.reshape(-1)[self.lit]
        self.power = emitted(chip, self.u, self.v) * stretch[self.lit]
        self._surface = field.net.prepare(sample, torch.float64)

    @classmethod
    def of(
        cls,
        field: PolarField,
        count: int,
        chip: Chip = LAMBERTIAN,
        halves: tuple[bool, bool] = WHOLE,
        aspect: float = 1.0,
    ) -> list[PointGrid]:
        """About `count` rays of the centre of a chip, CHUNK at a time: small tensors stay in the cache of the processor.

        halves: whether only those towards u > 0, and towards v > 0, whose power is of sum 1 then; aspect: rays along u over those
        along v.
        """
        one, points = torch.ones((), dtype=torch.float64), []
        for half, share in zip(halves, (aspect, 1.0 / aspect), strict=True):
            pairs = max(1, round(0.5 * math.sqrt(count * CORNERS * share)))
            points.append((torch.arange(pairs if half else 0, 2 * pairs, dtype=torch.float64) + 0.5) / (2 * pairs))
        u, v = points
        grids = [cls(field, Sample(some, v, True, one), chip) for some in u.split(max(1, CHUNK // len(v)))]
        total = sum(float(grid.power.sum()) for grid in grids)
        for grid in grids:
            grid.power /= total
        return grids

    def hits(self, values: Tensor) -> PolarHit:
        """`PolarField.from_origin` in these directions."""
        r, ru, rv = (c.reshape(-1).index_select(0, self.lit) for c in self._surface(values))
        return polar_hit(self.u, self.v, r, ru, rv)


def sides(values: Tensor) -> tuple[Tensor | None, Tensor]:
    """Control values (n, m) of the inner surface, None for a hemisphere, and of the outer one, from those of a lamp: (n, m) of the
    outer surface, or (2, n, m) of both."""
    return (None, values) if values.ndim == 2 else (values[0], values[1])


def surfaces_of(lamp: Lamp, field: PolarField, values: Tensor) -> tuple[PolarSide, InnerSide]:
    """The outer and the inner side."""
    inner, outer = sides(values.detach())
    return PolarSide(field, outer), inner_side(lamp, field, inner)


def least_wall(lamp: Lamp, field: PolarField, values: Tensor) -> float:
    """Least distance of the outer surface from the cavity, mm, see `InnerSide.wall`."""
    inner, outer = sides(values.detach())
    return inner_side(lamp, field, inner).wall(field, outer)


def through_point(lamp: Lamp, field: PolarField, rays: PointGrid, values: Tensor) -> LampLight:
    """Light of a point at the origin through the lens; differentiable by the control values of r, see `sides`."""
    inner, outer = sides(values)
    side = inner_side(lamp, field, inner)
    if side.undeflected:
        return _from_point(lamp, rays.hits(outer), rays.power)
    return _between(lamp, field, side, outer, side.on_grid(rays.u, rays.v, rays.hits), _along(rays.power), rays.power)


def _along(like: Tensor) -> Vectors:
    """The direction of the frame's axis, for as many rays."""
    zero = torch.zeros_like(like)
    return zero, zero, zero + 1.0


def _from_point(lamp: Lamp, hit: PolarHit, power: Tensor) -> LampLight:
    """Light of the origin, which meets the hemisphere at normal incidence and the surface along the frame's axis."""
    kept = lamp.normal_transmittance
    return _leave(
        lamp, hit, _along(power), kept * power, {"inner_fresnel": (1.0 - kept) * power, "missed": torch.zeros_like(power)}
    )


def through(lamp: Lamp, field: PolarField, rays: ChipRays, values: Tensor) -> LampLight:
    """Light of a chip through the lens; differentiable by the control values of r, see `sides`."""
    inner, outer = sides(values)
    side = inner_side(lamp, field, inner)
    if lamp.chip.shape == "point":
        at = stereographic(*rays.direction)
        if side.undeflected:
            return _from_point(lamp, field.from_origin(outer, *at), rays.power)
        return _between(lamp, field, side, outer, side.from_origin(*at), _along(rays.power), rays.power)
    hit = side.hit(rays.origin, rays.direction)
    return _between(lamp, field, side, outer, hit, to_frame(frame(hit.u, hit.v), rays.direction), rays.power)


def entered(lamp: Lamp, hit: PolarHit, local: Vectors, power: Tensor) -> tuple[Vectors, Tensor, dict[str, Tensor]]:
    """Directions within the lens behind the inner side, the power of each ray there, and what is lost by cause; local: directions
    in front of it, in the frames of the points."""
    met, local = _met(hit, local)
    out, _, c, s = refract(local, hit.p, hit.q, 1.0 / lamp.index)
    arriving = torch.where(met, power, torch.zeros_like(power))
    reflected = arriving * reflectance("exact", c, s, 1.0 / lamp.index)
    return from_frame(frame(hit.u, hit.v), out), arriving - reflected, {"inner_fresnel": reflected, "missed": power - arriving}


def uncoated_limit(lamp: Lamp) -> float:
    """Largest fraction of the light of the chip's centre that can leave without coatings: what passes the inner side, a hemisphere
    for a free-form one, and the outer one at normal incidence."""
    field = PolarField.uniform((4, 4))
    side, passed = inner_side(lamp, field, None), 0.0
    for grid in PointGrid.of(field, LIMIT_RAYS, lamp.chip):
        passed += float(entered(lamp, side.from_origin(grid.u, grid.v), _along(grid.power), grid.power)[1].sum())
    return lamp.normal_transmittance * passed


def from_centre(lamp: Lamp, field: PolarField, directions: Tensor, power: Tensor) -> tuple[Tensor, Tensor]:
    """Directions (N, 3) within a lens with one free-form surface of the light of the chip's centre, and its power (N,) there, of
    sum 1 as in front of it."""
    side = inner_side(lamp, field, None)
    if side.undeflected:
        return directions, power
    within, passed, _ = entered(lamp, side.from_origin(*stereographic(*directions.unbind(1))), _along(power), power)
    return torch.stack(within, 1), passed / passed.sum()


def _between(
    lamp: Lamp, field: PolarField, side: InnerSide, outer: Tensor, hit: PolarHit, local: Vectors, power: Tensor
) -> LampLight:
    """Refraction at the inner side, and what follows; local: as of `entered`.

    Without derivatives, light that passes through the cavity again, from within the lens, is booked as missed.
    """
    direction, within, lost = entered(lamp, hit, local, power)
    further = field.intersect(outer, hit.point, direction)
    if not torch.is_grad_enabled():  # in a judgement; a design has a wall instead
        further = further._replace(valid=further.valid & ~side.crossed(hit.point, further.point))
    return _leave(lamp, further, to_frame(frame(further.u, further.v), direction), within, lost)


def _met(hit: PolarHit, local: Vectors) -> tuple[Tensor, Vectors]:
    """Whether rays meet a surface from within, and their directions, masked where they do not, which keeps NaN out of gradients."""
    met = hit.valid & (local[2] - hit.p * local[0] - hit.q * local[1] > LEAST_COSINE)
    if bool(met.all()):
        return met, local
    (x, y, z), zero = local, torch.zeros_like(hit.u)
    return met, (torch.where(met, x, zero - hit.p), torch.where(met, y, zero - hit.q), torch.where(met, z, zero + 1.0))


def _leave(lamp: Lamp, hit: PolarHit, local: Vectors, power: Tensor, lost: dict[str, Tensor]) -> LampLight:
    """Refraction at the free-form surface; local: directions within the lens, in the frames of the points."""
    n, zero = lamp.index, torch.zeros_like(power)
    met, local = _met(hit, local)
    out, passes, c, s = refract(local, hit.p, hit.q, n)
    square = 1.0 + hit.p * hit.p + hit.q * hit.q
    spare = 1.0 - n * n * (1.0 - c * c / square)
    reflected = reflectance("exact", c, s, n)
    passes = passes & met
    arriving = torch.where(met, power, zero)
    leaving = torch.where(passes, power * (1.0 - reflected), zero)
    lost = lost | {
        "missed": lost["missed"] + (power - arriving),
        "total_internal_reflection": torch.where(met & ~passes, power, zero),
        "outer_fresnel": torch.where(passes, power * reflected, zero),
    }
    return LampLight(hit.point, from_frame(frame(hit.u, hit.v), out), leaving, lost, torch.where(met, spare, zero + 1.0))


def land(goal: Goal, light: LampLight) -> tuple[Tensor, Tensor, Tensor]:
    """Coordinates of the light from the centre of the target, mm or degrees, and whether it travels towards it.

    Light towards z <= 0 never meets a plane: it has the coordinates of a shallow ray.
    """
    (x, y, z), (dx, dy, dz) = light.point, light.direction
    if goal.far and goal.projection == "latitude":
        return torch.atan2(dx, dz) * _DEGREE, torch.asin(dy.clamp(-1.0 + 1e-12, 1.0 - 1e-12)) * _DEGREE, dz > 0
    if goal.far:
        scale, ahead = _radial(goal.projection, dx, dy, dz)
        return dx * scale * _DEGREE, dy * scale * _DEGREE, ahead
    ahead = dz > SHALLOW
    t = (goal.distance - z) / torch.where(ahead, dz, torch.full_like(dz, SHALLOW))
    return x + t * dx - goal.shift[0], y + t * dy - goal.shift[1], ahead


def _radial(projection: str, dx: Tensor, dy: Tensor, dz: Tensor) -> tuple[Tensor, Tensor]:
    """Radius of directions on a map about the axis (`scene.anglemap`) over the sine of their angle from it, and whether they are
    followed there."""
    if projection == "gnomonic":
        ahead = dz > SHALLOW
        return 1.0 / torch.where(ahead, dz, torch.full_like(dz, SHALLOW)), ahead
    ahead = dz > 0
    if projection == "stereographic":
        return 2.0 / (1.0 + torch.where(ahead, dz, torch.zeros_like(dz))), ahead
    square = dx * dx + dy * dy
    near = square < NEAR
    sine = torch.where(near, torch.ones_like(square), square).sqrt()
    return torch.where(near, 1.0 + square / 6.0, torch.atan2(sine, dz) / sine), ahead
