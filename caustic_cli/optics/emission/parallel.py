"""Sampling of a plane wave: points of the aperture, since a plane entrance does not deviate normally incident rays."""

from __future__ import annotations

import numpy as np
import torch

from caustic_cli.optics.emission.base import Illuminated
from caustic_cli.optics.sampling import Sampler
from caustic_cli.scene import Aperture

#: Points along each axis for the mean of a profile over a round aperture.
ROUND = 1000


def parallel(scene: Illuminated, kind: str, rays: int, seed: int = 0, device: str | torch.device = "cpu") -> Sampler:
    """A sampler of about `rays` rays parallel to +z over the aperture, weighted by the source's profile if it has one."""
    profile = None if scene.source.profile is None else torch.from_numpy(scene.source.profile)
    (rx, ry), aperture = scene.pupil.half_size, scene.pupil.aperture
    return Sampler.of_size(kind, rays, rx / ry, seed=seed, profile=profile, device=device, aperture=aperture)


def mean_irradiance(profile: np.ndarray, aperture: Aperture) -> float:
    """Mean of a relative irradiance over an aperture, whose half widths are those of the profile (a, b), by ROUND points along each
    axis of a round one."""
    if not aperture.round:
        return float(profile.mean())
    at = (np.arange(ROUND) + 0.5) / ROUND
    inside = aperture.covers(2.0 * at[:, None] - 1.0, 2.0 * at[None, :] - 1.0)
    i, j = ((at * n).astype(int) for n in profile.shape)
    return float(profile[i[:, None], j[None, :]][inside].mean())


EMISSIONS = {"plane": parallel}
