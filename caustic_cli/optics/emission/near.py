"""Sampling of near sources: points, and extended sources about their positions (thesis 4.2.2).

Notation, for a source point at distance h in front of the entrance plane
    theta   angle of a ray to the source's axis, +z except where errors of alignment tilt it; theta_c half-angle of the cone
    w       1 - cos theta = 2 sin^2(theta / 2), computed without the cancellation in 1 - cos
    rho     distance on the entrance plane from the projection of the source; r^2 = rho^2 + h^2

Rays sampled over the cone in proportion to the intensity have equal power.  Rays sampled over the aperture (importance sampling)
have the power I(theta) dOmega with I = 1 / (4 pi sin^2(theta_c / 2)), or for a Lambertian source I = cos theta / (pi sin^2
theta_c), or that of a table.  Their direction is (sin a cos b, sin b, cos a cos b) with a and sin b uniform between the aperture's
edges, so that dOmega = da d(sin b).  This is nearly uniform over the aperture for a distant source point, and over directions for a
close one, where nearly all light reaches the lens near the projection of the source.
The cone itself is sampled if it lies within the aperture, or if the source is NEAR the aperture, so that hardly any ray misses it.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from functools import cached_property, partial
from typing import ClassVar

import torch
from torch import Tensor

from caustic_cli.optics.emission.base import Emission, intensity_of
from caustic_cli.optics.emission.brightness import points_by_brightness
from caustic_cli.optics.frames import turned_about
from caustic_cli.optics.pencil import Pencil
from caustic_cli.optics.rays import RayState
from caustic_cli.optics.sampling import Sampler, numbers
from caustic_cli.scene.sources.distribution import Distribution

#: A source is near if its projection is at least this many of its distances h inside the aperture's edge: of a hemisphere the
#: fraction 1 / sqrt(1 + 3^2) = 0.32 misses.
NEAR = 3.0
#: Lower bound of the squared cosine of a ray parallel to the entrance; such a ray is clamped to the aperture.
TINY = 1e-300
#: Upper bound of the squared tangent of a ray within a hemisphere.
BEYOND = 1e300


class Near(Emission):
    """Rays of a near source; those of an extended source start at points about its positions."""

    @cached_property
    def _points(self) -> tuple[Tensor, Tensor]:
        """Positions (k, 3) mm, and fractions of the power (k,)."""
        source = self.scene.source
        powers = torch.tensor(source.powers, dtype=torch.float64, device=self.device)
        return torch.from_numpy(source.points()[0]).to(self.device), powers / powers.sum()

    def _offsets(self, *draws: Tensor) -> tuple[Tensor, Tensor]:
        """Offset of each ray's start from its position along x and y, mm, from the samples beyond the first two dimensions."""
        raise NotImplementedError

    @property
    def homocentric(self) -> bool:
        """Whether its rays can be had as `pencils`: of one point in front of the aperture that illuminates all of it, and that is
        not so near that the cone is sampled."""
        source, pupil = self.scene.source, self.scene.pupil
        if not self.tensor or self.dimensions > 2 or source.several or source.lean or not source.aimed:
            return False
        if source.cone is not None and source.incidence(pupil) >= source.cone_over(pupil):
            return False
        x, y, z = source.points()[0][0]
        room = min(r - abs(far) for far, r in pupil.aperture.distances(torch.tensor(x), torch.tensor(y)))
        return 0.0 <= float(room) < NEAR * (pupil.z - z)

    def pencils(self, size: int = 1 << 20) -> Iterator[Pencil]:
        source, pupil = self.scene.source, self.scene.pupil
        x, y, z = map(float, source.points()[0][0])
        start = 0
        for sample in Sampler(self.kind, self.shape, self.seed, device=self.device).chunks(size):
            yield Pencil(
                replace(sample, flux=self._areas(sample)),
                pupil.half_size,
                (x, y, z),
                pupil.z,
                partial(intensity_of, source, source.cone_over(pupil)),
                sample.count / self.count,
                partial(self._at_points, start, start + sample.count),
            )
            start += sample.count

    def _at_points(self, start: int, stop: int) -> RayState:
        """Rays number start to stop."""
        return self._drawn(start, *numbers(self.kind, self.shape, self.seed, self.dimensions, start, stop, self.device))

    def _drawn(self, start: int, *draws: Tensor) -> RayState:
        u, v, *aside = draws
        source, pupil = self.scene.source, self.scene.pupil
        (rx, ry), cone = pupil.half_size, source.cone_over(pupil)
        per, (positions, powers) = self.shape[0] * self.shape[1], self._points
        which = torch.arange(start, start + len(u), device=self.device) // per
        part = powers[which] / per  # power of each ray at the source
        x0, y0, z0 = positions[which].unbind(1)
        if aside:  # every source point has its own cone
            across, along = self._offsets(*aside)
            x0, y0 = x0 + across, y0 + along
        h = pupil.z - z0
        reach = cone + source.lean  # largest angle to z
        radius = h * math.tan(reach) if reach < math.pi / 2 else torch.full_like(h, math.inf)
        lows = [x0 - radius, y0 - radius]
        highs = [x0 + radius, y0 + radius]
        # Distance from the projection of the source to the edge of the aperture.
        room = torch.stack([r - far for far, r in pupil.aperture.distances(x0, y0)]).amin(0)
        within = pupil.aperture.encloses(lows, highs)
        from_cone = within | (room >= NEAR * h) if source.aimed else torch.ones_like(within)

        w = _one_minus_cosine(source.intensity, cone, u)
        sine, cosine = torch.sqrt(w * (2.0 - w)), 1.0 - w
        tangent = sine / cosine.clamp_min(1e-300)
        cx, cy = tangent * torch.cos(2 * math.pi * v), tangent * torch.sin(2 * math.pi * v)  # tangents along x and y
        if source.lean:
            cx, cy = _slopes_about(source.axis, cx, cy)

        lows = [torch.maximum(lo, torch.full_like(lo, -r)) for lo, r in zip(lows, (rx, ry), strict=True)]
        highs = [torch.minimum(hi, torch.full_like(hi, r)) for hi, r in zip(highs, (rx, ry), strict=True)]
        wide, tall = (highs[0] - lows[0]).clamp_min(0.0), (highs[1] - lows[1]).clamp_min(0.0)
        ax, by_angle = _uniform_angle((lows[0] - x0) / h, (highs[0] - x0) / h, wide / h, u)
        stretch = torch.sqrt(1.0 + ax * ax)  # 1 / cos a
        tan_b, by_sine = _uniform_sine((lows[1] - y0) / (h * stretch), (highs[1] - y0) / (h * stretch), tall / (h * stretch), v)
        ay = tan_b * stretch
        rho2 = ax * ax + ay * ay  # in units of h
        secant, tangent2 = torch.sqrt(1.0 + rho2), rho2  # of theta
        if source.lean:
            tx, ty, tz = source.axis
            secant = secant / (tx * ax + ty * ay + tz).clamp_min(TINY)  # at 90 degrees and beyond there is no light
            tangent2 = secant * secant - 1.0
        aimed = part * by_angle * by_sine * intensity_of(source, cone, secant)
        limit = math.tan(cone) ** 2 * (1.0 + 2.0 * torch.finfo(torch.float64).eps) if cone < math.pi / 2 else BEYOND
        aimed = torch.where(tangent2 <= limit, aimed, torch.zeros_like(aimed))

        sx, sy = torch.where(from_cone, cx, ax), torch.where(from_cone, cy, ay)
        x, y = x0 + h * sx, y0 + h * sy
        on_lens = pupil.aperture.contains(x, y)
        flux = torch.where(on_lens, torch.where(from_cone, part, aimed), torch.zeros_like(part))
        x, y = x.clamp(-rx, rx), y.clamp(-ry, ry)
        sx, sy = (x - x0) / h, (y - y0) / h  # rays that miss the lens stay finite, with power 0
        dz = 1.0 / torch.sqrt(1.0 + sx * sx + sy * sy)
        return self._at_pupil(x, y, (sx * dz, sy * dz, dz), flux, float(part.sum()))


class NearDisc(Near):
    """Rays of extended sources: ellipses of uniform radiance, or brightness pictures."""

    dimensions: ClassVar[int] = 4

    def _offsets(self, *draws: Tensor) -> tuple[Tensor, Tensor]:
        (a, b), source = draws, self.scene.source
        if source.brightness is not None:
            x, y = (w * c for w, c in zip(source.frame, points_by_brightness(source.brightness, a, b), strict=True))
            return x, y
        (ex, ey), turn = source.extent, 2 * math.pi * b
        return ex * a.sqrt() * torch.cos(turn), ey * a.sqrt() * torch.sin(turn)


def _slopes_about(axis: tuple[float, float, float], x: Tensor, y: Tensor) -> tuple[Tensor, Tensor]:
    """Slopes dx/dz and dy/dz of rays whose slopes to an axis are x and y, see `turned_about`; infinite for those that do not
    ascend."""
    *turned, dz = turned_about(axis, x, y)
    across, up = (torch.where(dz > 0, t / dz, math.inf) for t in turned)
    return across, up


def _one_minus_cosine(intensity: str | Distribution, cone: float, part: Tensor) -> Tensor:
    """w = 1 - cos theta of the angles that enclose the fractions `part` of the flux into a cone (inverse transform)."""
    if isinstance(intensity, Distribution):
        theta = torch.from_numpy(intensity.angle_of(part.cpu().numpy(), cone)).to(part.device)
        return 2.0 * torch.sin(0.5 * theta) ** 2
    if intensity == "lambertian":
        sine2 = part * math.sin(cone) ** 2
        return sine2 / (1.0 + torch.sqrt(1.0 - sine2))
    return part * (2.0 * math.sin(cone / 2.0) ** 2)


def _uniform_angle(low: Tensor, high: Tensor, width: Tensor, part: Tensor) -> tuple[Tensor, Tensor]:
    """Tangent of the angle at the fraction `part` between those of tangents low and high = low + width, and their difference, rad.

    If both have one sign the tangent is computed by the addition theorem from the smaller one: far off the axis atan would lose the
    digits of their difference.
    """
    way, first = torch.atan2(width, 1.0 + low * high), low.abs() < high.abs()
    near, turn = torch.where(first, low, high), torch.tan(torch.where(first, part, part - 1.0) * way)
    aside = near + turn * (1.0 + near * near) / (1.0 - near * turn)
    return torch.where(low * high > 0, aside, torch.tan(torch.atan(low) + part * way)), way


def _uniform_sine(low: Tensor, high: Tensor, width: Tensor, part: Tensor) -> tuple[Tensor, Tensor]:
    """Tangent of the angle whose sine is at the fraction `part` between the two sines, and the difference of the sines.

    cos^2 = cos_0^2 - 2 s_0 d - d^2 at the distance d from the smaller sine s_0, without the cancellation in 1 - s^2 for s near 1.
    """
    way, first = torch.atan2(width, 1.0 + low * high), low.abs() < high.abs()
    way = 2.0 * torch.sin(0.5 * way) * torch.cos(torch.atan(low) + 0.5 * way)
    near = torch.where(first, low, high)
    cosine2 = 1.0 / (1.0 + near * near)
    sine, step = near * torch.sqrt(cosine2), torch.where(first, part, part - 1.0) * way
    left = (cosine2 - step * (2.0 * sine + step)).clamp_min(TINY)
    return (sine + step) / torch.sqrt(left), way


EMISSIONS = {"point": Near.of_size, "grid": Near.of_size, "disc": NearDisc.of_size}
