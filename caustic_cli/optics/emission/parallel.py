"""Rays of a plane wave: samples of the aperture, since normal incidence on a flat entrance bends nothing."""

from __future__ import annotations

import torch

from caustic_cli.optics.sampling import Sampler
from caustic_cli.scene import Scene


def parallel(scene: Scene, kind: str, rays: int, seed: int = 0, device: str | torch.device = "cpu") -> Sampler:
    """About `rays` rays along +z over the aperture, weighted by the source's profile if it has one."""
    profile = None if scene.source.profile is None else torch.from_numpy(scene.source.profile)
    return Sampler.of_size(kind, rays, scene.lens.size[0] / scene.lens.size[1], seed=seed, profile=profile, device=device,
                           round=scene.lens.round)


EMISSIONS = {"plane": parallel}
