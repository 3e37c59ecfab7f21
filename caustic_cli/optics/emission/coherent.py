"""Spatially coherent modes of a source: mutually incoherent point sources, with rays through given points of the pupil.

Rays of a mode carry the optical path length from the source, and a density: the fraction of the source's power per mm^2 of the
pupil. Near points emit into the source's cone, with its intensity distribution (see `near`); a distant one illuminates the whole
pupil.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from caustic_cli.optics.emission.base import Illuminated, intensity_of
from caustic_cli.optics.emission.brightness import points_by_brightness
from caustic_cli.optics.frames import turned_about
from caustic_cli.optics.rays import RayState
from caustic_cli.optics.sampling import Sample
from caustic_cli.scene import Source

#: Golden angle, rad, between successive points of Vogel's spiral.
GOLDEN = math.pi * (3.0 - math.sqrt(5.0))
#: Lower bound of the cosine of a ray to the axis of a source: beyond it there is no light.
LEAST_COSINE = 1e-12
#: Golden ratio, for an additive recurrence of low discrepancy.
RATIO = (1.0 + math.sqrt(5.0)) / 2.0


@dataclass(frozen=True)
class Mode:
    """One point of a source."""

    scene: Illuminated
    #: mm, for a near source; for a distant one the unit direction of its light.
    position: tuple[float, float, float]
    #: Fraction of the source's power.
    part: float

    def through(self, u: Tensor, v: Tensor, index: float = 1.0) -> RayState:
        """Rays through points (N,) of the pupil, u and v in [0, 1] over its bounding rectangle; index: of the medium in front of
        it.

        Their power is a density, 1/mm^2.
        """
        source, pupil = self.scene.source, self.scene.pupil
        if source.collimated:
            state = RayState.on_axis(Sample(u, v, False, torch.ones_like(u)), pupil.half_size, pupil.z)
            return replace(state, power=self._even(u, v))
        (rx, ry), (px, py, pz) = pupil.half_size, self.position
        x, y = (2.0 * u - 1.0) * rx, (2.0 * v - 1.0) * ry
        if source.beam:
            found = source.beam(x, y, pupil, *offset(source, self.position))
            power = self.part / pupil.aperture.area * found.irradiance / source.passed(pupil)
            return RayState((x, y, pupil.z), found.directions, power, path=index * found.path)
        if source.distant:
            return RayState(
                (x, y, pupil.z),
                tuple(torch.full_like(x, c) for c in self.position),
                self._even(u, v),
                path=index * (px * x + py * y),
            )
        dx, dy, h = x - px, y - py, pupil.z - pz
        r = torch.sqrt(dx * dx + dy * dy + h * h)
        cone = source.cone_over(pupil)
        cosine, secant = h / r, r / h
        to_axis = cosine
        if source.lean:
            tx, ty, tz = source.axis
            to_axis = (tx * dx + ty * dy + tz * h) / r
            secant = 1.0 / to_axis.clamp_min(LEAST_COSINE)
        lit = to_axis >= math.cos(cone) * (1.0 - 4.0 * torch.finfo(torch.float64).eps)
        power = torch.where(lit, self.part * intensity_of(source, cone, secant) * cosine / (r * r), torch.zeros_like(r))
        return RayState((x, y, pupil.z), (dx / r, dy / r, cosine), power, path=index * r)

    def _even(self, u: Tensor, v: Tensor) -> Tensor:
        """Density of light from infinity on the pupil, 1/mm^2, with its irradiance if that is uneven."""
        source, pupil = self.scene.source, self.scene.pupil
        part, (rx, ry) = self.part / pupil.aperture.area, pupil.half_size
        if not source.uneven:
            return torch.full_like(u, part)
        return part * source.irradiance((2.0 * u - 1.0) * rx, (2.0 * v - 1.0) * ry, pupil) / source.passed(pupil)


def central_mode(scene: Illuminated) -> Mode:
    """A point at the source's centre with all its power."""
    source = scene.source
    return Mode(scene, source.axis if source.distant else source.centre, 1.0)


def outermost_modes(scene: Illuminated) -> list[Mode]:
    """The outermost points of the source along x, -x, y and -y, each with all its power; empty for a point source."""
    source = scene.source
    if source.distant:
        s = math.sin(source.half_angle)
        ways = ((1, 0), (-1, 0), (0, 1), (0, -1)) if s else ()
        return [Mode(scene, _direction(source, a * s, b * s), 1.0) for a, b in ways]
    if not source.extended:
        return []
    at, (ex, ey) = source.points()[0], source.extent
    found = []
    for k, e in ((0, ex), (1, ey)):
        for sign in (1.0, -1.0):
            point = at[np.argmax(sign * at[:, k])].copy()
            point[k] += sign * e
            x, y, z = map(float, point)
            found.append(Mode(scene, (x, y, z), 1.0))
    return found


def modes(scene: Illuminated, each: int) -> list[Mode]:
    """The source as points of equal power: `each` for every position with an extent, distributed like its brightness."""
    source = scene.source
    if source.distant:
        spread = _spots(source, each)
        ways = [_direction(source, dx, dy) for dx, dy in spread]
        whole = math.fsum(z for *_, z in ways) if source.oblique else len(ways)  # of the radiance, the cosine to the aperture
        return [Mode(scene, way, (way[2] if source.oblique else 1.0) / whole) for way in ways]
    (positions, parts), spread = source.points(), _spots(source, each)
    return [
        Mode(scene, (float(x + dx), float(y + dy), float(z)), float(part) / len(spread))
        for (x, y, z), part in zip(positions, parts, strict=True)
        for dx, dy in spread
    ]


def offset(source: Source, position: tuple[float, float, float]) -> tuple[float, float]:
    """Displacement of a mode's position from the source's centre, mm, or of a direction from its axis, in sines."""
    x, y, z = position
    if not source.distant:
        return x - source.centre[0], y - source.centre[1]
    a, b, c = source.axis
    along = (x * a + y * b) / (1.0 + c) + z  # the rotation that takes the axis to +z without twist
    return x - a * along, y - b * along


def _direction(source: Source, across: float, along: float) -> tuple[float, float, float]:
    """Unit direction with these components across the axis of a distant source."""
    c = math.sqrt(1.0 - across * across - along * along)
    x, y, z = turned_about(source.axis, across / c, along / c)
    return c * x, c * y, c * z


def _spots(source: Source, each: int) -> list[tuple[float, float]]:
    """Points about a position of a source, each for the same fraction of its power: mm, or direction sines of a distant source."""
    fx, fy = source.frame
    return [(fx * a, fy * b) for a, b in spots(source, each)]


def spots(source: Source, each: int) -> list[tuple[float, float]]:
    """These points in the source's frame, [-1, 1]^2."""
    if not max(source.frame) > 0:
        return [(0.0, 0.0)]
    if source.brightness is None:
        return vogel_disc(each)
    k = torch.arange(each, dtype=torch.float64) + 0.5
    x, y = points_by_brightness(source.brightness, k / each, torch.frac(k / RATIO))
    return list(zip(x.tolist(), y.tolist(), strict=True))


def vogel_disc(count: int) -> list[tuple[float, float]]:
    """Points of the unit disc, each for an equal area: Vogel's spiral."""
    radii = [math.sqrt((k + 0.5) / count) for k in range(count)]
    return [(r * math.cos(k * GOLDEN), r * math.sin(k * GOLDEN)) for k, r in enumerate(radii)]
