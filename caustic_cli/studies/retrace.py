"""The verdict on a lens: an independent retrace by bincount, with rays no optimiser has seen."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from caustic_cli.errors import CausticError
from caustic_cli.optics.effects import NO_REQUESTS, Requests
from caustic_cli.optics.emission import Rays, rays_of
from caustic_cli.optics.image import Image
from caustic_cli.optics.reconstruction import Filter
from caustic_cli.optics.sampling import stream
from caustic_cli.optics.surfaces.heightfield import HeightField
from caustic_cli.optics.trace import expose
from caustic_cli.scene import Scene, Screen
from caustic_cli.studies.metrics import judge

#: Rays of the retrace that ends a design.
FINAL_RAYS = 4_000_000
#: Independent images whose scatter tells their mean's noise: over thousands of pixels four are plenty.
BATCHES = 4
#: Most rays that --tolerance may ask for in one go.
MOST_RAYS = 10**11


def sampler_for(scene: Scene, rays: int, seed: int, device: str = "cpu") -> Rays:
    """About `rays` stratified rays of the scene's source, unrelated to those of any design."""
    return rays_of(scene, "stratified", rays, stream(seed, "render"), device)


@dataclass(frozen=True)
class Converged:
    """An image traced until its noise was low enough.

    exposure: the mean of BATCHES independent ones; error: estimated relative RMS of that mean's noise, from their variance;
    traced: rays spent in all, those of the attempts before it included.
    """

    exposure: Image
    error: float
    traced: int


def converge(scene: Scene, field: HeightField, heights: Tensor, tolerance: float, *, rays: int, seed: int = 0,
             screen: Screen | None = None, device: str = "cpu", dtype: torch.dtype = torch.float64,
             requests: Requests = NO_REQUESTS) -> Converged:
    """Trace BATCHES independent sets of stratified rays, about `rays` in all, then more until the noise is at most `tolerance`.

    The relative RMS noise of the mean of B images J_k is sqrt(mean over pixels of var(J_k) / B) / mean(J).  Stratified rays
    converge with order 3/4, so n rays that leave an error e are followed by n (e / tolerance)^(4/3).

    Raises:
        CausticError: MOST_RAYS are not enough, or no light reaches the screen.
    """
    each, traced = max(1, rays // BATCHES), 0
    while True:
        parts = [expose(scene, field, heights, rays_of(scene, "stratified", each, stream(seed, f"batch {k}"), device), None, dtype,
                        screen, requests=requests) for k in range(BATCHES)]
        traced += sum(p.rays for p in parts)
        images = torch.stack([p.image for p in parts])
        mean = images.mean(0)
        if not float(mean.sum()) > 0:
            raise CausticError("no light reaches the screen, so there is no image to converge")
        error = math.sqrt(float(images.var(0).mean()) / BATCHES) / float(mean.mean())
        if error <= tolerance:
            lost = {name: math.fsum(p.lost[name] for p in parts) / BATCHES for name in parts[0].lost}
            leaving = math.fsum(p.leaving for p in parts) / BATCHES
            return Converged(Image(mean, leaving, lost, sum(p.rays for p in parts)), error, traced)
        more = max(1.3, 1.1 * (error / tolerance) ** (4.0 / 3.0))
        foreseen = each * more if each > mean.numel() else 0.0  # too few rays a pixel foretell nothing
        each = int(each * min(32.0, more))
        if max(each, foreseen) * BATCHES > MOST_RAYS:
            raise CausticError(f"--tolerance {tolerance:g} asks for more than {MOST_RAYS:.0e} rays: {traced:,} left an estimated"
                               f" error of {error:.2g}; fewer pixels or a larger tolerance need fewer")


def retrace(scene: Scene, field: HeightField, heights: Tensor, target: np.ndarray | None, *, rays: int, seed: int = 0,
            filter: Filter | None = None, screen: Screen | None = None, device: str = "cpu",
            dtype: torch.dtype = torch.float64, tolerance: float | None = None,
            requests: Requests = NO_REQUESTS) -> tuple[Image, dict]:
    """Trace a lens with stratified rays of its own; with `tolerance`, as many as that asks for (`converge`).  requests: of a plan.

    Returns:
        the exposure, reconstructed by `filter` (bincount unless given), and the figures of the JSON table, always by
        bincount, with the rays that were traced; with `tolerance` also error_estimate and rays_traced.
    """
    if tolerance is None:
        counted = expose(scene, field, heights, sampler_for(scene, rays, seed, device), None, dtype, screen, requests=requests)
        figures = judge(counted, target)
    else:
        found = converge(scene, field, heights, tolerance, rays=rays, seed=seed, screen=screen, device=device, dtype=dtype,
                         requests=requests)
        counted = found.exposure
        figures = judge(counted, target) | {"error_estimate": found.error, "rays_traced": found.traced}
    if filter is None or filter.reach == (0, 0):
        return counted, figures
    return expose(scene, field, heights, sampler_for(scene, counted.rays, seed, device), filter, dtype, screen,
                  requests=requests), figures


def white_level(image: np.ndarray, target: np.ndarray | None) -> float:
    """The irradiance drawn white: the target's maximum at the image's power, so both are exposed alike; without one the image's."""
    if target is None:
        return float(image.max()) or 1.0
    return float(target.max() / target.sum() * image.sum())
