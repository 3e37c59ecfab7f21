"""Sampling of a plane wave: points of the aperture, since a plane entrance does not deviate normally incident rays; or one
direction through these points for a wave that is tilted to the axis.

The power of a plane wave is that through the aperture: of a tilted one, of the cross section that the tilted aperture cuts out.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import partial

import torch
from torch import Tensor

from caustic_cli.loading import OnDemand
from caustic_cli.optics.emission.base import Emission, Illuminated
from caustic_cli.optics.pencil import Bundle
from caustic_cli.optics.rays import RayState
from caustic_cli.optics.sampling import Sample, Sampler

beam = OnDemand("caustic_cli.optics.beam")


def parallel(scene: Illuminated, kind: str, rays: int, seed: int = 0, device: str | torch.device = "cpu") -> Sampler:
    """A sampler of about `rays` rays parallel to +z over the aperture, weighted by the source's profile if it has one."""
    source, pupil = scene.source, scene.pupil
    (rx, ry), aperture = pupil.half_size, pupil.aperture

    def profile(u: Tensor, v: Tensor) -> Tensor:
        return source.irradiance((2.0 * u - 1.0) * rx, (2.0 * v - 1.0) * ry, pupil)

    irradiance = profile if source.uneven else None
    return Sampler.of_size(kind, rays, rx / ry, seed=seed, profile=irradiance, device=device, aperture=aperture)


@dataclass(frozen=True, eq=False)
class TiltedPlane(Emission):
    """Parallel rays at an angle to z, through points of the aperture."""

    @classmethod
    def of_size(cls, scene: Illuminated, kind: str, rays: int, seed: int = 0, device: str | torch.device = "cpu") -> TiltedPlane:
        """As of an `Emission`."""
        return cls(scene, kind, parallel(scene, kind, rays, seed, device).shape, seed, device)

    def _samples(self, size: int) -> Iterator[Sample]:
        """The points of the aperture, as of a plane wave along z."""
        whole = parallel(self.scene, self.kind, self.count, self.seed, self.device)
        return replace(whole, shape=self.shape).chunks(size)

    def chunks(self, size: int = 1 << 20) -> Iterator[RayState]:
        """As of an `Emission`."""
        for sample in self._samples(size):
            yield self._at(sample)

    @property
    def homocentric(self) -> bool:
        """Whether its rays can be had as `pencils`, with their vertex at infinity: where a profile does not weight them."""
        return not self.scene.source.uneven

    def pencils(self, size: int = 1 << 20) -> Iterator[Bundle]:
        """The rays in `chunks`, as beams: through as many points of the exit."""
        pupil, axis = self.scene.pupil, self.scene.source.axis
        for sample in self._samples(size):
            emitted = float(sample.flux.expand(sample.shape).sum())
            exit = replace(sample, flux=self._areas(sample))
            yield beam.Beam(exit, pupil.aperture, axis, pupil.z, 1.0 / pupil.aperture.area, emitted, partial(self._at, sample))

    def _at(self, sample: Sample) -> RayState:
        """Rays through points of the aperture."""
        shape, half = sample.shape, self.scene.pupil.half_size
        u, v = (sample.u[:, None], sample.v[None, :]) if sample.tensor else (sample.u, sample.v)
        x, y = (((2.0 * c - 1.0) * r).expand(shape).reshape(-1) for c, r in zip((u, v), half, strict=True))
        power = sample.flux.expand(shape).reshape(-1)
        dx, dy, dz = (torch.full_like(x, c) for c in self.scene.source.axis)
        return self._at_pupil(x, y, (dx, dy, dz), power, float(power.sum()))


EMISSIONS = {"plane": parallel, "tilted plane": TiltedPlane.of_size}
