"""Sampling of a plane wave: points of the aperture, since a plane entrance does not deviate normally incident rays."""

from __future__ import annotations

import torch

from caustic_cli.optics.emission.base import Illuminated
from caustic_cli.optics.sampling import Sampler


def parallel(scene: Illuminated, kind: str, rays: int, seed: int = 0, device: str | torch.device = "cpu") -> Sampler:
    """A sampler of about `rays` rays parallel to +z over the aperture, weighted by the source's profile if it has one."""
    profile = None if scene.source.profile is None else torch.from_numpy(scene.source.profile)
    (rx, ry), round_ = scene.pupil.half_size, scene.pupil.round
    return Sampler.of_size(kind, rays, rx / ry, seed=seed, profile=profile, device=device, round=round_)


EMISSIONS = {"plane": parallel}
