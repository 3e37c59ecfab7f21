"""The verdict on a lens: an independent retrace by bincount, with rays no optimiser has seen."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from caustic_cli.optics.emission import Rays, rays_of
from caustic_cli.optics.heightfield import HeightField
from caustic_cli.optics.reconstruction import Filter
from caustic_cli.optics.sampling import stream
from caustic_cli.optics.tracing import Exposure, expose
from caustic_cli.scene import Scene, Screen
from caustic_cli.studies.metrics import judge

#: Rays of the retrace that ends a design.
FINAL_RAYS = 4_000_000


def sampler_for(scene: Scene, rays: int, seed: int, device: str = "cpu") -> Rays:
    """About `rays` stratified rays of the scene's source, unrelated to those of any design."""
    return rays_of(scene, "stratified", rays, stream(seed, "render"), device)


def retrace(scene: Scene, field: HeightField, heights: Tensor, target: np.ndarray, *, rays: int, seed: int = 0,
            filter: Filter | None = None, screen: Screen | None = None, device: str = "cpu",
            dtype: torch.dtype = torch.float64) -> tuple[Exposure, dict]:
    """Trace a lens with stratified rays of its own.

    Returns:
        the exposure, reconstructed by `filter` (bincount unless given), and the figures of the JSON table, always by
        bincount, with the rays that were traced.
    """
    sampler = sampler_for(scene, rays, seed, device)
    counted = expose(scene, field, heights, sampler, None, dtype, screen)
    figures = judge(counted, target)
    if filter is None or filter.reach == (0, 0):
        return counted, figures
    return expose(scene, field, heights, sampler, filter, dtype, screen), figures


def white_level(image: np.ndarray, target: np.ndarray) -> float:
    """The irradiance drawn white: the target's maximum at the image's power, so both are exposed alike."""
    return float(target.max() / target.sum() * image.sum())
