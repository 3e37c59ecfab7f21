"""The decision on a lens: an independent retrace by bincount, with rays no optimiser has seen."""

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
from caustic_cli.optics.sampling import SOBOL_RAYS, stream
from caustic_cli.optics.surfaces.cut import CutSurface
from caustic_cli.optics.surfaces.heightfield import HeightField
from caustic_cli.optics.trace import expose
from caustic_cli.scene import Scene
from caustic_cli.studies.irradiance import irradiance_figures, unit_figures
from caustic_cli.studies.metrics import judge
from caustic_cli.studies.noise import black_error, image_noise, lift, standard_error, variance_of

#: Rays of the retrace that ends a design.
FINAL_RAYS = 4_000_000
#: Pixels that these are enough for where nothing but their number lowers the noise, and the most times more of them.
FINAL_PIXELS, MOST_FINAL = 250 * 250, 16
#: Part of relative_rms that its noise may be, where nothing is said about rays.
QUIET = 0.1
#: Independent images whose scatter tells their mean's noise: over thousands of pixels four are plenty.
BATCHES = 4
#: So many times the rays asked for may be traced to bring the noise of a figure down.
MOST_TIMES = 4
#: Orders of the noise: of stratified rays on two dimensions; of Sobol's on the four of a disc, measured.
ORDER, SOBOL_ORDER = 0.75, 0.58
#: A plane wave's noise is told by two images of one PROBE-th of its rays each.
PROBE = 8
#: By how much the account of the light may miss, by the precision of the rays: the rounding of their sums.
ACCOUNT = {torch.float64: 1e-9, torch.float32: 1e-3}
#: Most rays that tolerance may ask for in one go.
MOST_RAYS = 10**11


def sampler_for(scene: Scene, rays: int, seed: int, device: str = "cpu") -> Rays:
    """About `rays` rays of the scene's source, unrelated to those of any design."""
    return _rays(scene, rays, stream(seed, "render"), device)


def _rays(scene: Scene, rays: int, seed: int, device: str) -> Rays:
    """Stratified rays of a plane wave, whose two dimensions strata fill evenly; of other light, up to four dimensions, Sobol's."""
    even = scene.source.collimated or rays > SOBOL_RAYS // 2
    return rays_of(scene, "stratified" if even else "sobol", rays, seed, device)


def _available(scene: Scene) -> int:
    """Rays that the smallest of the scene's ray files holds; more than can be asked for where there is none."""
    return min((one.rays.count for one in scene.source.members if one.rays is not None), default=BATCHES * MOST_RAYS)


@dataclass(frozen=True)
class Converged:
    """An image traced until its noise was low enough.

    exposure: the mean of BATCHES independent ones, and halves, the means of one half of them and the other; error: estimated
    relative RMS of that mean's noise, from their variance; traced: rays spent in all, those of the attempts before it included.
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

    The relative RMS noise of the mean of B images J_k is sqrt(mean over pixels of var(J_k) / B) / mean(J).  Rays that converge with
    order p are n (e / tolerance)^(1 / p) after n that leave an error e.

    Raises:
        CausticError: MOST_RAYS or those of a file are not enough, or no light reaches the screen.
    """
    each, traced, order = max(1, rays // BATCHES), 0, ORDER if scene.source.collimated else SOBOL_ORDER
    available, lights = _available(scene), [scene.part(k, BATCHES) for k in range(BATCHES)]
    while True:
        if each * BATCHES > available:
            raise CausticError(f"⟨tolerance⟩ {tolerance:g} asks for more rays than the file holds, {available:,}")
        parts = [
            within_source(
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
        foreseen = each * more if each > mean.numel() else 0.0  # too few rays a pixel foretell nothing
        each = int(each * min(32.0, more))
        if max(each, foreseen) * BATCHES > MOST_RAYS:
            raise CausticError(
                f"⟨tolerance⟩ {tolerance:g} asks for more than {MOST_RAYS:.0e} rays: {traced:,} left an estimated"
                f" error of {error:.2g}; fewer pixels or a larger tolerance need fewer"
            )


def within_source(image: Image) -> Image:
    """An image of no more light than the source has: few rays aimed at the lens may estimate a little more than all of it, and then
    what they carry is scaled to all of it."""
    missed = image.lost.get("missed_lens", 0.0)
    if missed >= 0.0:
        return image
    scale = 1.0 / (1.0 - missed)
    lost = {name: 0.0 if name == "missed_lens" else scale * part for name, part in image.lost.items()}
    return Image(scale * image.image, scale * image.leaving, lost, image.rays)


def mean_of(parts: list[Image]) -> Image:
    """The image that several of as many rays each make together."""
    lost = {name: math.fsum(p.lost[name] for p in parts) / len(parts) for name in parts[0].lost}
    leaving = math.fsum(p.leaving for p in parts) / len(parts)
    return Image(torch.stack([p.image for p in parts]).mean(0), leaving, lost, sum(p.rays for p in parts))


def retrace(
    scene: Scene,
    field: HeightField | CutSurface,
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
) -> tuple[Image, dict]:
    """Trace a lens with rays of its own; with `tolerance`, as many as that asks for (`converge`).  requests: of a plan.

    A plane wave's stratified rays leave little noise, which its figures hold.  All other light, and with `tolerance` that too, is
    traced in independent halves, from which the figures are without noise (`studies.noise`).

    Args:
        noise: say what the noise is; a plane wave needs a quarter more rays for that.
        quiet: part of relative_rms that its noise may be: until then other light than a plane wave's gets more rays, up to
            MOST_TIMES as many.

    Returns:
        the exposure, reconstructed by `filter` (bincount unless given), and the figures of the JSON table, always by bincount,
        with the rays that were traced; noise, of relative_rms, None without a target; in_black_noise, of in_black, None without
        that; error_estimate, the relative RMS noise of the image, None of a black one; those of `studies.irradiance`; with
        `tolerance` also rays_traced.
    """

    def trace(name: str, count: int, light: Scene = scene) -> Image:
        sampler = _rays(light, max(1, count), stream(seed, name), device)
        return within_source(expose(light, field, heights, sampler, None, dtype, requests=requests))

    even = scene.source.collimated
    if tolerance is not None:
        found = converge(scene, field, heights, tolerance, rays=rays, seed=seed, device=device, dtype=dtype, requests=requests)
        counted = found.exposure
        figures = _judged_halves(counted, target, found.halves) | {"error_estimate": found.error, "rays_traced": found.traced}
    elif even:
        counted = trace("render", rays)
        figures = _judged_even(counted, target, tuple(trace(f"noise {k}", rays // PROBE) for k in (0, 1)) if noise else None)
    else:
        parts: tuple[list[Image], list[Image]] = [], []
        lights = [scene.part(k, 2) for k in (0, 1)]
        while True:
            for k in range(len(parts[0]), max(1, 2 * len(parts[0]))):
                for part, name, light in zip(parts, ("render", "render, other half"), lights, strict=True):
                    part.append(trace(f"{name} {k}" if k else name, rays // 2, light))
            halves = mean_of(parts[0]), mean_of(parts[1])
            counted = mean_of(list(halves))
            figures = _judged_halves(counted, target, halves)
            enough = quiet is None or target is None or figures["noise"] <= quiet * figures["relative_rms"]
            if enough or 2 * len(parts[0]) > MOST_TIMES or rays * len(parts[0]) >= _available(scene):
                break
    require_account(figures, dtype)
    figures |= irradiance_figures(scene, counted.image) | unit_figures(scene)
    if filter is None or filter.reach == (0, 0):
        return counted, figures
    sampler = sampler_for(scene, counted.rays, seed, device)
    return within_source(expose(scene, field, heights, sampler, filter, dtype, requests=requests)), figures


def judging_rays(scene: Scene, usual: int = FINAL_RAYS) -> int:
    """Rays that judge a finished design: of a plane wave, whose figures hold their noise, as many a pixel whatever their number."""
    times = math.prod(scene.screen.resolution) / FINAL_PIXELS if scene.source.collimated else 1.0
    return round(usual * min(max(1.0, times), MOST_FINAL))


def require_account(figures: dict, dtype: torch.dtype) -> None:
    """Stop where the account of the light is impossible: a part outside [0, 1], or a sum that is not 1.

    Raises:
        CausticError: naming the parts.
    """
    parts = {"on_screen": figures["on_screen"], **figures["lost"]}
    room = ACCOUNT[dtype]
    if abs(math.fsum(parts.values()) - 1.0) <= room and all(-room <= part <= 1.0 + room for part in parts.values()):
        return
    listed = ", ".join(f"{name} {part:.6g}" for name, part in parts.items())
    raise CausticError(f"the account of the light does not close, so nothing is written: {listed}")


def _judged_halves(counted: Image, target: np.ndarray | None, halves: tuple[Image, Image]) -> dict:
    """Figures of the mean of two halves, without its noise."""
    pair = [h.image.cpu().numpy() for h in halves]
    variance = variance_of(*pair)
    figures = judge(counted, target, variance)
    noise = None if target is None else standard_error(*pair, target, figures["relative_rms"])
    dark = None if target is None else black_error(*pair, target, figures["in_black"])
    return figures | {
        "noise": noise,
        "in_black_noise": dark,
        "error_estimate": image_noise(variance, counted.image.cpu().numpy()),
    }


def _judged_even(counted: Image, target: np.ndarray | None, fewer: tuple[Image, Image] | None) -> dict:
    """Figures of an image as it is.

    fewer: two others, from whose noise its own follows, or None: stratified rays on two dimensions converge with order 3/4.
    """
    figures = judge(counted, target) | {"noise": None, "in_black_noise": None, "error_estimate": None}
    if fewer is None:
        return figures
    pair = [f.image.cpu().numpy() for f in fewer]
    image, falls = counted.image.cpu().numpy(), (sum(f.rays for f in fewer) / 2.0 / counted.rays) ** ORDER
    error = image_noise(2.0 * variance_of(*pair) * falls**2, image)
    if target is not None and error is not None:
        own = standard_error(*pair, target, figures["relative_rms"]) * math.sqrt(2.0) * falls  # of one image, not of both's mean
        figures["noise"] = math.hypot(lift(figures["relative_rms"], error), own)
        dark = black_error(*pair, target, figures["in_black"])
        figures["in_black_noise"] = None if dark is None else dark * math.sqrt(2.0) * falls
    return figures | {"error_estimate": error}


def white_level(image: np.ndarray, target: np.ndarray | None) -> float:
    """The irradiance drawn white: the target's maximum at the image's power, so both are exposed alike; without one the image's."""
    if target is None:
        return float(image.max()) or 1.0
    return float(target.max() / target.sum() * image.sum())
