"""Light that is reflected within a lamp, followed until it leaves or is absorbed: ghosts, and the light that its chip reflects.

What `optics.lamp` books as lost by reflection at either surface goes on here: through the cavity to the chip and the board, or
through the lens to its base, to the inner surface and out of the outer one.  A ray is reflected or refracted at random by the
Fresnel equations for unpolarised light, so that it keeps its power and does not split.  The chip reflects diffusely, by Lambert's
law, the part `Chip.reflectance` of the light; the board around it and the base of the lens are black.

Snell's law is applied by vectors along the normals: independently of `optics.lamp`.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from caustic_cli.optics.lamp import ChipRays, LampLight, concentric, sides
from caustic_cli.optics.lamp_side import InnerSide, PolarSide, inner_side
from caustic_cli.optics.surfaces.polarfield import PolarField, Vectors, stereographic
from caustic_cli.scene.lamp import Chip, Lamp

#: Every how many rays are followed, with the power of all.
EVERY = 4
#: Most interactions of a ray.
MOST = 40
#: Part of its distance from the origin by which a point on a surface is moved to the side on which light goes on.
NUDGE = 1e-9
#: Causes for which such light is lost: absorbed by the chip, by the board in the cavity, at the base of the lens, or not followed
#: any further.
ENDS = ("chip", "board", "base", "unfollowed")


class Going(NamedTuple):
    """Rays on their way: origins, mm, and directions (N, 3), power (N,), and whether they are within the lens."""

    origin: Tensor
    direction: Tensor
    power: Tensor
    inside: Tensor

    def where(self, mask: Tensor) -> Going:
        """Those of a mask (N,)."""
        return Going(*(c[mask] for c in self))


class Sides(NamedTuple):
    """Both sides of a lens; outer: control values."""

    lamp: Lamp
    field: PolarField
    inner: InnerSide
    outer: Tensor

    def in_cavity(self, o: Tensor, d: Tensor) -> tuple[Tensor, Tensor]:
        """Distance (N,) along rays in the cavity to the inner side, and whether they meet it before the plane of the chip."""
        hit = self.inner.hit(_three(o.unbind(1)), _three(d.unbind(1)))
        at = torch.stack(hit.point, 1)
        return ((at - o) * d).sum(1), hit.valid & (at[:, 2] >= 0)

    def to_outer(self, o: Tensor, d: Tensor) -> tuple[Tensor, Tensor]:
        """The same within the lens to the outer surface."""
        hit = self.field.intersect(self.outer, _three(o.unbind(1)), _three(d.unbind(1)))
        return ((torch.stack(hit.point, 1) - o) * d).sum(1), hit.valid

    def normals(self, at: Tensor, outer: bool) -> Tensor:
        """Unit normals away from the origin at points (N, 3)."""
        return (PolarSide(self.field, self.outer) if outer else self.inner).normals_at(at)


def ghosts(lamp: Lamp, field: PolarField, values: Tensor, rays: ChipRays, rng: np.random.Generator) -> LampLight:
    """The light that leaves the lens after reflections, of rays of which `optics.lamp.through` has the rest.

    lost: what it books by `ENDS`, and, negative, what it does not book as reflected any more: the sum of all with the light that
    leaves is 0.  No light of `spare`.
    """
    inner, outer = sides(values)
    both = Sides(lamp, field, inner_side(lamp, field, inner), outer)
    with torch.no_grad():
        begun, reflected = _reflected_once(both, rays)
        found, ends = _followed(both, begun, rng)
    point, direction = (tuple(torch.cat(c).unbind(1)) for c in zip(*((g.origin, g.direction) for g in found), strict=True))
    power = torch.cat([g.power for g in found])
    lost = ends | {cause: -part for cause, part in reflected.items()}
    return LampLight(_three(point), _three(direction), power, lost, power[:0])


def _three(columns: tuple[Tensor, ...]) -> Vectors:
    x, y, z = columns
    return x, y, z


def refracted(d: Tensor, normal: Tensor, before: float, after: float) -> tuple[Tensor, Tensor, Tensor]:
    """Directions (N, 3) behind an interface and of reflected light, and reflectances (N,), 1 where reflection is total.

    before, after: refractive indices on the side of the light and beyond.
    """
    cosine = (d * normal).sum(1)
    facing = torch.where((cosine < 0)[:, None], -normal, normal)
    c, ratio = cosine.abs(), before / after
    square = 1.0 - ratio * ratio * (1.0 - c * c)
    s = square.clamp_min(0.0).sqrt()
    out = ratio * d + (s - ratio * c)[:, None] * facing
    rs, rp = (before * c - after * s) / (before * c + after * s), (before * s - after * c) / (before * s + after * c)
    return out, d - 2.0 * c[:, None] * facing, torch.where(square > 0, 0.5 * (rs * rs + rp * rp), torch.ones_like(c))


def _reflected_once(both: Sides, rays: ChipRays) -> tuple[Going, dict[str, Tensor]]:
    """The light of a chip that is reflected at the inner surface, and at the outer one, every EVERY-th ray with the power of all;
    and how much of it was booked for which cause."""
    o, d = (torch.stack(c, 1) for c in (rays.origin, rays.direction))
    t, met = both.in_cavity(o, d)
    at = o + t[:, None] * d
    out, back, r = refracted(d, both.normals(at, False), 1.0, both.lamp.index)
    first = torch.where(met, rays.power, torch.zeros_like(r))
    t, met = both.to_outer(at, out)
    end = at + t[:, None] * out
    _, within, again = refracted(out, both.normals(end, True), both.lamp.index, 1.0)
    second = torch.where(met, first * (1.0 - r) * again, torch.zeros_like(r))
    total = again >= 1.0
    part = slice(None, None, EVERY)
    causes = {
        "inner_fresnel": (first * r, at, back, False),
        "outer_fresnel": (torch.where(total, torch.zeros_like(r), second), end, within, True),
        "total_internal_reflection": (torch.where(total, second, torch.zeros_like(r)), end, within, True),
    }
    going, booked = [], {}
    for cause, (power, point, direction, inside) in causes.items():
        kept = power[part]
        if not float(kept.sum()) > 0:
            continue
        booked[cause] = power.sum()
        own = kept > 0
        scaled = kept * (booked[cause] / kept.sum())
        going.append(Going(point[part], direction[part], scaled, torch.full_like(own, inside)).where(own))
    return Going(*(torch.cat(c) for c in zip(*going, strict=True))), booked


def _followed(both: Sides, going: Going, rng: np.random.Generator) -> tuple[list[Going], dict[str, Tensor]]:
    """Light that leaves the lens, and what is lost by cause."""
    lamp, left = both.lamp, [going.where(torch.zeros_like(going.inside))]
    ends = dict.fromkeys(ENDS, torch.zeros((), dtype=torch.float64))

    def book(cause: str, power: Tensor) -> None:
        ends[cause] = ends[cause] + power.sum()

    for _ in range(MOST):
        cavity, glass, on = going.where(~going.inside), going.where(going.inside), []
        # Through the cavity, to the inner surface or to the plane of the chip
        o, d = cavity.origin * (1.0 - NUDGE), cavity.direction
        t, met = both.in_cavity(o, d)
        lower = d[:, 2] < 0
        book("base", cavity.power[~met & ~lower])  # the side of a cavity with a flat roof
        on.append(_interact(both, cavity, o + t[:, None] * d, met, False, rng))
        on.append(_from_chip(lamp.chip, cavity.where(~met & lower), book, rng))
        # Through the lens, to the outer surface, to the inner one or to the base
        inwards = _beyond(both, glass.origin).double()
        here = glass.origin * (1.0 + NUDGE * (1.0 - 2.0 * inwards))[:, None]
        d = glass.direction
        outer, reaches = both.to_outer(here, d)
        down = (both.inner.rim - here[:, 2]) / d[:, 2].clamp_max(-1e-300)
        base = torch.where(d[:, 2] < 0, down.clamp_min(0.0), torch.full_like(outer, math.inf))
        reaches &= outer <= base
        most = torch.where(reaches, outer, torch.minimum(base, torch.full_like(base, 4.0 * lamp.radius)))
        inner = both.inner.met_from_glass(here, d, most)
        back = inner <= most
        outwards = reaches & ~back
        book("base", glass.power[~back & ~outwards & torch.isfinite(base)])
        book("unfollowed", glass.power[~back & ~outwards & torch.isinf(base)])
        on.append(_interact(both, glass, here + inner[:, None] * d, back, False, rng))
        on.append(_interact(both, glass, here + outer[:, None] * d, outwards, True, rng, left))
        going = Going(*(torch.cat(c) for c in zip(*on, strict=True)))
        if not len(going.power):
            break
    book("unfollowed", going.power)
    return left, ends


def _interact(
    both: Sides, rays: Going, at: Tensor, met: Tensor, outer: bool, rng: np.random.Generator, left: list[Going] | None = None
) -> Going:
    """Rays behind a surface that those of a mask meet; what passes the outer surface has left."""
    rays, at = rays.where(met), at[met]
    indices = (both.lamp.index, 1.0) if bool(rays.inside.any()) else (1.0, both.lamp.index)
    out, back, r = refracted(rays.direction, both.normals(at, outer), *indices)
    passes = torch.from_numpy(rng.uniform(size=len(r))) >= r
    found = Going(at, torch.where(passes[:, None], out, back), rays.power, rays.inside ^ passes)
    if left is None:
        return found
    left.append(found.where(passes))
    return found.where(~passes)


def _beyond(both: Sides, at: Tensor) -> Tensor:
    """Whether points on one of the surfaces lie on the outer one."""
    r = both.field.net.evaluate(both.outer, *stereographic(*at.unbind(1)))[0]
    return (r - at.norm(dim=1)).abs() < 1e-6 * r


def _from_chip(chip: Chip, rays: Going, book, rng: np.random.Generator) -> Going:
    """Light that the chip reflects of that which meets its plane."""
    o, d = rays.origin, rays.direction
    at = o - (o[:, 2] / d[:, 2])[:, None] * d
    x, y = (2.0 * at[:, k] / s if s > 0 else torch.full_like(at[:, k], math.inf) for k, s in enumerate(chip.size))
    hit = x * x + y * y <= 1.0 if chip.shape == "disc" else torch.maximum(x.abs(), y.abs()) <= 1.0
    book("board", rays.power[~hit])
    book("chip", (1.0 - chip.reflectance) * rays.power[hit])
    own = rays.where(hit & (chip.reflectance > 0))
    s, t = (torch.from_numpy(c) for c in rng.uniform(size=(2, len(own.power))))
    dx, dy = concentric(s, t)
    up = torch.stack([dx, dy, (1.0 - dx * dx - dy * dy).clamp_min(0.0).sqrt()], 1)
    start = torch.cat([at[hit & (chip.reflectance > 0)][:, :2], torch.zeros(len(own.power), 1, dtype=torch.float64)], 1)
    return Going(start, up, chip.reflectance * own.power, own.inside)
