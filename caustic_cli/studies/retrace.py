"""Validation of a lens: an independent bincount retrace with rays that were not used in the optimisation."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from caustic_cli.effort import STANDARD
from caustic_cli.errors import CausticError
from caustic_cli.optics.effects import NO_REQUESTS, Requests
from caustic_cli.optics.emission import Rays, rays_of
from caustic_cli.optics.image import Image
from caustic_cli.optics.reconstruction import Filter
from caustic_cli.optics.sampling import SOBOL_RAYS, stream
from caustic_cli.optics.surfaces.base import MeasuredSurface
from caustic_cli.optics.surfaces.heightfield import HeightField
from caustic_cli.optics.trace import expose
from caustic_cli.scene import Scene
from caustic_cli.studies.color_error import color_figures
from caustic_cli.studies.irradiance import irradiance_figures, source_figures, unit_figures
from caustic_cli.studies.metrics import figures_of_merit
from caustic_cli.studies.noise import black_error, image_noise, noise_bias, standard_error, variance_of

#: Pixels for which the rays of an evaluation suffice where the noise is not corrected for, and the largest factor for more pixels.
FINAL_PIXELS, MOST_FINAL = 250 * 250, 16
#: Independent images whose variance estimates the noise of their mean: four suffice over thousands of pixels.
BATCHES = 4
#: Largest factor by which the number of rays is increased to reduce the noise of a figure.
MOST_TIMES = 4
#: Orders of convergence of the noise: of stratified rays in two dimensions; of a Sobol sequence in the four of a disc, measured.
ORDER, SOBOL_ORDER = 0.75, 0.58
#: The noise of a plane wave is estimated from two images with 1 / PROBE of its rays each.
PROBE = 8
#: Tolerance of the energy balance by the precision of the rays: rounding of sums.
BALANCE = {torch.float64: 1e-9, torch.float32: 1e-3}
#: Most rays of one image for a tolerance.
MOST_RAYS = 10**11


def sampler_for(scene: Scene, rays: int, seed: int, device: str = "cpu") -> Rays:
    """About `rays` rays of the scene's source, independent of those of any design."""
    return _rays(scene, rays, stream(seed, "render"), device)


def _rays(scene: Scene, rays: int, seed: int, device: str) -> Rays:
    """Stratified rays of a plane wave (two dimensions); a Sobol sequence for other sources (up to four dimensions)."""
    even = scene.source.parallel or rays > SOBOL_RAYS // 2
    return rays_of(scene, "stratified" if even else "sobol", rays, seed, device)


def _available(scene: Scene) -> int:
    """Number of rays in the smallest ray file of the scene; more than the largest request without one."""
    return min((one.rays.count for one in scene.source.members if one.rays is not None), default=BATCHES * MOST_RAYS)


@dataclass(frozen=True)
class Converged:
    """An image traced to a noise tolerance.

    exposure: the mean of BATCHES independent images; halves: the means of the first and the second half of them; error: estimated
    relative RMS noise of the mean, from their variance; traced: total number of rays, including earlier attempts.
    """

    exposure: Image
    halves: tuple[Image, Image]
    error: float
    traced: int


def converge(
    scene: Scene,
    field: HeightField,
    heights: Tensor,
    tolerance: float,
    *,
    rays: int,
    seed: int = 0,
    device: str = "cpu",
    dtype: torch.dtype = torch.float64,
    requests: Requests = NO_REQUESTS,
) -> Converged:
    """Trace BATCHES independent sets of rays, about `rays` in all, then more until the noise is at most `tolerance`.

    The relative RMS noise of the mean of B images J_k is sqrt(mean over pixels of var(J_k) / B) / mean(J).  With order of
    convergence p and the error e of n rays, the number of rays required is n (e / tolerance)^(1 / p).

    Raises:
        CausticError: MOST_RAYS or those of a file are not enough, or no light reaches the screen.
    """
    each, traced, order = max(1, rays // BATCHES), 0, ORDER if scene.source.parallel else SOBOL_ORDER
    available, lights = _available(scene), [scene.batch(k, BATCHES) for k in range(BATCHES)]
    while True:
        if each * BATCHES > available:
            raise CausticError(f"⟨tolerance⟩ {tolerance:g} requires more rays than the file holds, {available:,}")
        parts = [
            limited_to_source(
                expose(
                    light,
                    field,
                    heights,
                    _rays(light, each, stream(seed, f"batch {k}"), device),
                    None,
                    dtype,
                    requests=requests,
                )
            )
            for k, light in enumerate(lights)
        ]
        traced += sum(p.rays for p in parts)
        images = torch.stack([p.image for p in parts])
        mean = images.mean(0)
        if not float(mean.sum()) > 0:
            raise CausticError("no light reaches the screen, so there is no image to converge")
        error = math.sqrt(float(images.var(0).mean()) / BATCHES) / float(mean.mean())
        if error <= tolerance:
            halves = mean_of(parts[: BATCHES // 2]), mean_of(parts[BATCHES // 2 :])
            return Converged(mean_of(parts), halves, error, traced)
        more = max(1.3, 1.1 * (error / tolerance) ** (1.0 / order))
        foreseen = each * more if each > mean.numel() else 0.0  # no extrapolation from less than one ray per pixel
        each = int(each * min(32.0, more))
        if max(each, foreseen) * BATCHES > MOST_RAYS:
            raise CausticError(
                f"⟨tolerance⟩ {tolerance:g} requires more than {MOST_RAYS:.0e} rays: {traced:,} left an estimated"
                f" error of {error:.2g}; fewer pixels or a larger tolerance need fewer"
            )


def limited_to_source(image: Image) -> Image:
    """The image, scaled to the power of the source if it exceeds that: a Monte-Carlo estimate from few rays aimed at the lens may
    do so slightly."""
    missed = image.lost.get("missed_lens", 0.0)
    if missed >= 0.0:
        return image
    scale = 1.0 / (1.0 - missed)
    lost = {name: 0.0 if name == "missed_lens" else scale * part for name, part in image.lost.items()}
    xyz = None if image.xyz is None else scale * image.xyz
    return Image(scale * image.image, scale * image.leaving, lost, image.rays, xyz)


def mean_of(parts: list[Image]) -> Image:
    """The mean of several images with the same number of rays each."""
    lost = {name: math.fsum(p.lost[name] for p in parts) / len(parts) for name in parts[0].lost}
    leaving = math.fsum(p.leaving for p in parts) / len(parts)
    xyz = [p.xyz for p in parts if p.xyz is not None]
    mean = torch.stack(xyz).mean(0) if xyz else None
    return Image(torch.stack([p.image for p in parts]).mean(0), leaving, lost, sum(p.rays for p in parts), mean)


def retrace(
    scene: Scene,
    field: HeightField | MeasuredSurface,
    heights: Tensor,
    target: np.ndarray | None,
    *,
    rays: int,
    seed: int = 0,
    filter: Filter | None = None,
    device: str = "cpu",
    dtype: torch.dtype = torch.float64,
    tolerance: float | None = None,
    requests: Requests = NO_REQUESTS,
    noise: bool = True,
    quiet: float | None = None,
    known: Image | None = None,
) -> tuple[Image, dict]:
    """Trace a lens with independent rays; with `tolerance`, as many as it requires (`converge`).  requests: of a plan.

    Stratified rays of a plane wave have little noise, which is not corrected for.  Other light, and all light with `tolerance`, is
    traced in two independent halves, from which the figures are corrected for noise (`studies.noise`).

    Args:
        noise: estimate the noise; for a plane wave this takes a quarter more rays.
        quiet: largest noise of relative_rms as a fraction of it: for light other than a plane wave, the number of rays is increased
            until it is reached, by a factor of at most MOST_TIMES.
        known: the image of a plane wave by bincount from an earlier call with the same arguments, which need not be traced again.

    Returns:
        the exposure, reconstructed by `filter` (bincount unless given), and the figures of the JSON table, always by bincount,
        with the rays that were traced; noise, of relative_rms, None without a target; in_black_noise, of in_black, None without
        that; error_estimate, the relative RMS noise of the image, None of a black one; those of `studies.irradiance` and of
        `studies.color_error`, which is not corrected for noise; with `tolerance` also rays_traced.
    """

    def trace(name: str, count: int, light: Scene = scene) -> Image:
        sampler = _rays(light, max(1, count), stream(seed, name), device)
        return limited_to_source(expose(light, field, heights, sampler, None, dtype, requests=requests))

    even = scene.source.parallel
    if tolerance is not None:
        found = converge(scene, field, heights, tolerance, rays=rays, seed=seed, device=device, dtype=dtype, requests=requests)
        counted = found.exposure
        figures = _figures_of_halves(counted, target, found.halves) | {"error_estimate": found.error, "rays_traced": found.traced}
    elif even:
        counted = known or trace("render", rays)
        figures = _figures_of_stratified(
            counted, target, tuple(trace(f"noise {k}", rays // PROBE) for k in (0, 1)) if noise else None
        )
    else:
        counted, figures = _in_halves(trace, scene, target, rays, quiet)
    require_energy_balance(counted, dtype)
    figures |= irradiance_figures(scene, counted.image) | unit_figures(scene) | source_figures(scene, figures["on_target"])
    figures |= color_figures(scene, counted.image, target)
    if filter is None or filter.reach == (0, 0):
        return counted, figures
    sampler = sampler_for(scene, counted.rays, seed, device)
    return limited_to_source(expose(scene, field, heights, sampler, filter, dtype, requests=requests)), figures


def _in_halves(
    trace: Callable[[str, int, Scene], Image], scene: Scene, target: np.ndarray | None, rays: int, quiet: float | None
) -> tuple[Image, dict]:
    """The mean of two independent halves of about `rays` rays, with its figures; of more where `quiet` requires them, see
    `retrace`.  trace: images by name of the random numbers, number of rays and scene."""
    parts: tuple[list[Image], list[Image]] = [], []
    lights = [scene.batch(k, 2) for k in (0, 1)]
    while True:
        for k in range(len(parts[0]), max(1, 2 * len(parts[0]))):
            for part, name, light in zip(parts, ("render", "render, other half"), lights, strict=True):
                part.append(trace(f"{name} {k}" if k else name, rays // 2, light))
        halves = mean_of(parts[0]), mean_of(parts[1])
        counted = mean_of(list(halves))
        figures = _figures_of_halves(counted, target, halves)
        enough = quiet is None or target is None or figures["noise"] <= quiet * figures["relative_rms"]
        if enough or 2 * len(parts[0]) > MOST_TIMES or rays * len(parts[0]) >= _available(scene):
            return counted, figures


def evaluation_rays(scene: Scene, usual: int = STANDARD.final_rays) -> int:
    """Rays of the evaluation of a design: for a plane wave, whose noise is not corrected for, in proportion to the pixels.

    usual: for 250 x 250 pixels.
    """
    times = math.prod(scene.screen.resolution) / FINAL_PIXELS if scene.source.parallel else 1.0
    return round(usual * min(max(1.0, times), MOST_FINAL))


def require_energy_balance(exposure: Image, dtype: torch.dtype) -> None:
    """Check the energy balance: the image and all losses are in [0, 1], and their sum is 1, within BALANCE.

    Raises:
        CausticError: naming the fractions.
    """
    parts = {"on_screen": float(exposure.image.sum()), **exposure.lost}
    room = BALANCE[dtype]
    if abs(math.fsum(parts.values()) - 1.0) <= room and all(-room <= part <= 1.0 + room for part in parts.values()):
        return
    listed = ", ".join(f"{name} {part:.6g}" for name, part in parts.items())
    raise CausticError(f"the energy balance of the light does not close, so nothing is written: {listed}")


def _figures_of_halves(counted: Image, target: np.ndarray | None, halves: tuple[Image, Image]) -> dict:
    """Figures of the mean of two halves, corrected for noise."""
    pair = [h.image.cpu().numpy() for h in halves]
    variance = variance_of(*pair)
    figures = figures_of_merit(counted, target, variance)
    noise = None if target is None else standard_error(*pair, target, figures["relative_rms"])
    dark = None if target is None else black_error(*pair, target, figures["in_black"])
    return figures | {
        "noise": noise,
        "in_black_noise": dark,
        "error_estimate": image_noise(variance, counted.image.cpu().numpy()),
    }


def _figures_of_stratified(counted: Image, target: np.ndarray | None, fewer: tuple[Image, Image] | None) -> dict:
    """Figures of an image of stratified rays, without correction for noise.

    fewer: two images with fewer rays, from which the noise is extrapolated with order 3/4 in two dimensions, or None.
    """
    figures = figures_of_merit(counted, target) | {"noise": None, "in_black_noise": None, "error_estimate": None}
    if fewer is None:
        return figures
    pair = [f.image.cpu().numpy() for f in fewer]
    image, falls = counted.image.cpu().numpy(), (sum(f.rays for f in fewer) / 2.0 / counted.rays) ** ORDER
    error = image_noise(2.0 * variance_of(*pair) * falls**2, image)
    if target is not None and error is not None:
        own = (
            standard_error(*pair, target, figures["relative_rms"]) * math.sqrt(2.0) * falls
        )  # of one image, not of the mean of two
        figures["noise"] = math.hypot(noise_bias(figures["relative_rms"], error), own)
        dark = black_error(*pair, target, figures["in_black"])
        figures["in_black_noise"] = None if dark is None else dark * math.sqrt(2.0) * falls
    return figures | {"error_estimate": error}


def white_level(image: np.ndarray, target: np.ndarray | None) -> float:
    """Irradiance displayed as white: the maximum of the target at the power of the image, for equal exposure; else of the image."""
    if target is None:
        return float(image.max()) or 1.0
    return float(target.max() / target.sum() * image.sum())
