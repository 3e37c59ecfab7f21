"""Sampling of a disc at infinity, such as the sun: uniform over the aperture, and by its radiance over solid angle projected
onto the aperture; and of a laser beam.

Notation, for a direction at the angle theta to the disc's axis d, in the frame that is d's by the rotation of `turned_about`
    s           its sines, |s| = sin theta
    phi         azimuth of s, from that of (d_x, d_y)
    W           cosine to z over that of the axis and over cos theta: 1 - e cos phi with e = tan theta |(d_x, d_y)| / d_z

Uniform radiance fills the disc of sines of the plane normal to d; the aperture receives W of it.  So the radius is that of an even
disc, and the azimuth has the density 1 - e cos phi: its distribution function is Kepler's equation phi - e sin phi = 2 pi b.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from functools import cached_property
from typing import Any, ClassVar

import numpy as np
import torch
from torch import Tensor

from caustic_cli.optics.emission.base import Emission
from caustic_cli.optics.emission.brightness import points_by_brightness
from caustic_cli.optics.frames import turned_about
from caustic_cli.optics.rays import RayState
from caustic_cli.optics.sampling import numbers
from caustic_cli.scene import Source

#: Newton iterations for Kepler's equation, and their tolerance, rad.
STEPS, FOUND = 60, 1e-14
#: Least number of parts of a picture along each axis of which W is constant.
FINE = 256
#: Rays of a beam at a time for their whole power.
BATCH = 1 << 20


class Distant(Emission):
    """Rays at angles to the source's axis of at most its half-angle."""

    dimensions: ClassVar[int] = 4

    def _drawn(self, start: int, *draws: Tensor) -> RayState:
        (u, v, a, b), source = draws, self.scene.source
        if source.brightness is None:
            sine = a.sqrt() * math.sin(source.half_angle)
            turn = _azimuth(source, sine, 2 * math.pi * b)
            dx, dy = sine * torch.cos(turn), sine * torch.sin(turn)
        else:
            dx, dy = (w * c for w, c in zip(source.frame, points_by_brightness(_received(source), a, b), strict=True))
        along = torch.sqrt(1.0 - dx * dx - dy * dy)
        if source.oblique:
            dx, dy, along = (along * c for c in turned_about(source.axis, dx / along, dy / along))
        flux, (x, y) = torch.full_like(u, 1.0 / self.count), self.scene.pupil.aperture.spread(u, v)
        return self._at_pupil(x, y, (dx, dy, along), flux, len(u) / self.count)


def _azimuth(source: Source, sine: Tensor, mean: Tensor) -> Tensor:
    """Azimuth of s, rad, from |s| and uniform numbers in [0, 2 pi]."""
    if not source.oblique:
        return mean
    x, y, z = source.axis
    e = sine / torch.sqrt(1.0 - sine * sine) * (math.hypot(x, y) / z)
    phi = torch.full_like(mean, math.pi)  # from where Newton's method converges for every e up to 1
    for _ in range(STEPS):
        step = (phi - e * torch.sin(phi) - mean) / (1.0 - e * torch.cos(phi))
        phi = phi - step
        if float(step.abs().max()) <= FOUND:
            break
    return phi + math.atan2(y, x)


def _received(source: Source) -> np.ndarray:
    """The radiance of the picture's cells, (a, b), times W at the middles of parts of them, which the aperture receives."""
    assert source.brightness is not None
    if not source.oblique:
        return source.brightness
    light = source.brightness
    for axis, n in enumerate(light.shape):
        light = light.repeat(-(-FINE // n), axis)
    dx, dy = (f * ((2.0 * np.arange(n) + 1.0) / n - 1.0) for f, n in zip(source.frame, light.shape, strict=True))
    (x, y, z), dx, dy = source.axis, dx[:, None], dy[None, :]
    within = np.maximum(1.0 - dx * dx - dy * dy, 0.0)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(within > 0, light * np.maximum(1.0 - (x * dx + y * dy) / (z * np.sqrt(within)), 0.0), 0.0)


class BeamRays(Emission):
    """Rays along the normals of the wavefronts of a beam (`gaussian`), weighted by its irradiance; where it is partly coherent,
    each belongs to one of the beams that it consists of."""

    dimensions: ClassVar[int] = 4

    def _drawn(self, start: int, *draws: Tensor) -> RayState:
        x, y, found = self._found(*draws)
        power = found.irradiance / self._whole
        return self._at_pupil(x, y, found.directions, power, float(power.sum()))

    def _found(self, u: Tensor, v: Tensor, a: Tensor, b: Tensor) -> tuple[Tensor, Tensor, Any]:
        """Points of the pupil, mm, and the beam there."""
        source, pupil = self.scene.source, self.scene.pupil
        x, y = pupil.aperture.spread(u, v)
        tilt: tuple = (0.0, 0.0)
        if source.brightness is not None:
            tilt = tuple(f * c for f, c in zip(source.frame, points_by_brightness(source.brightness, a, b), strict=True))
        assert source.beam is not None
        found = source.beam(x, y, pupil, *tilt)
        directions = tuple(d if isinstance(d, Tensor) else torch.full_like(x, d) for d in found.directions)
        return x, y, found._replace(directions=directions)

    def _irradiances(self) -> Iterator[Tensor]:
        for start in range(0, self.count, BATCH):
            stop = min(start + BATCH, self.count)
            yield self._found(*numbers(self.kind, self.shape, self.seed, self.dimensions, start, stop, self.device))[2].irradiance

    @cached_property
    def _whole(self) -> float:
        """Sum of the irradiances of all rays."""
        return sum(float(some.sum()) for some in self._irradiances())


EMISSIONS = {"far disc": Distant.of_size, "gaussian": BeamRays.of_size}
