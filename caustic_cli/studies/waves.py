"""Validation of a lens in wave optics: its wave image, at wavelengths and on grids not used in the optimisation."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection
from dataclasses import replace

import numpy as np
from torch import Tensor

from caustic_cli.optics.image import Image
from caustic_cli.optics.resolution import Resolution
from caustic_cli.optics.surfaces.base import MeasuredSurface
from caustic_cli.optics.surfaces.heightfield import HeightField
from caustic_cli.optics.waves.image import UNASKED, Perturbation, WaveImage, wave_image
from caustic_cli.optics.waves.unsupported import NoWaveImage
from caustic_cli.scene import Light, Scene
from caustic_cli.scene.materials import material
from caustic_cli.studies.color_error import color_figures
from caustic_cli.studies.irradiance import irradiance_figures
from caustic_cli.studies.metrics import figures_of_merit

#: Oversampling of both planes for the validation at spectral lines, those of the design.  At the wavelengths that represent a
#: continuous spectrum, others than the design's, its grids are others, too: of the default flame both differ by 0.1 %.
FINER = 1.25
#: Wavelengths relative to a spectral line, for the sensitivity to the wavelength.
ASIDE = (0.99, 1.01)
#: Wavelengths of a continuous spectrum for a fast error: how many, least distance from those of the design, nm, and numbers tried.
FEW, APART, TRIED = 5, 2.0, 6
#: Figures of a ray image that a wave image has as well.
_SAME = ("relative_rms", "psnr_db", "ssim", "on_target", "in_black", "on_screen")


def wave_figures(
    scene: Scene,
    field: HeightField,
    heights: Tensor,
    target: np.ndarray | None,
    seen: Resolution,
    *,
    wavelengths: tuple[float, ...] = (),
    finer: float | None = None,
    required: bool = True,
    perturbation: Perturbation | None = None,
) -> tuple[WaveImage | None, dict]:
    """The wave image of a lens at the scene's wavelengths, white light's where it says none, and its figures.  wavelengths: others,
    nm, see `Light.lines`; perturbation: as of `optics.waves.wave_image`; required: take it however long that takes, or raise
    NoWaveImage.

    Returns:
        the image, None if it is not available and `required` is false; and wave_relative_rms, wave_psnr_db, wave_ssim,
        wave_on_target, wave_in_black (None without a target), wave_on_screen, wave_wavelengths (nm), wave_spectrum and
        wave_detector, of the continuous spectrum that these represent, None for spectral lines, wave_spectral_error, the error of
        wave_relative_rms that follows from their number, None where that is unknown, resolvable, the number of
        resolvable details across the picture, wave_source_points, the points that the source was taken as, wave_source_error, by
        how much an extended source's light is misplaced so, mm, and wave_peak_irradiance, wave_mean_irradiance and, in colour,
        wave_ciede2000, as of a ray image.
    """
    most = math.inf if required else UNASKED
    try:
        finer = finer or (FINER if scene.light.continuum is None else 1.0)
        how = {"finer": finer, "perturbation": perturbation, "most": most}
        found = wave_image(scene, field, heights.detach(), wavelengths=wavelengths or None, **how)
    except NoWaveImage as error:
        if required:
            raise
        return None, dict.fromkeys(
            (
                *(f"wave_{name}" for name in _SAME),
                "wave_peak_irradiance",
                "wave_mean_irradiance",
            )
        ) | {"wave_wavelengths": [], "resolvable": seen.resolvable, "no_wave_image": str(error)}
    of, whole = _judged(found, target), scene.light.continuum
    further = irradiance_figures(scene, found.image) | color_figures(scene, found.image, target)
    return found, {
        **{f"wave_{name}": of[name] for name in _SAME},
        "wave_wavelengths": list(found.wavelengths),
        "wave_spectrum": None if whole is None else whole.spectrum.name,
        "wave_detector": None if whole is None else whole.detector,
        "wave_spectral_error": _spectral_error(found, of["relative_rms"], target),
        "resolvable": seen.resolvable,
        "wave_source_points": found.points,
        "wave_source_error": found.spread_error,
    } | {f"wave_{name}": value for name, value in further.items()}


def unseen_figures(scene: Scene, field: HeightField, heights: Tensor, target: np.ndarray) -> dict:
    """Figures at wavelengths beside the spectral lines of the scene; empty for a continuous spectrum, which is judged at other
    wavelengths than the design's.

    Returns:
        wave_unseen_relative_rms and wave_unseen_wavelengths, nm, those that the glass is known at.
    """
    if scene.light.continuum is not None or scene.colored:
        return {}
    low, high = material(scene.lens.glass).range_nm if scene.lens.glass is not None else (0.0, math.inf)
    images, found = [], set[float]()
    for one, fraction in zip(scene.by_source, scene.source.fractions, strict=True):
        lines = zip(one.light.wavelengths, one.light.fractions, strict=True)
        beside = [(a * w, part) for w, part in lines for a in ASIDE if low <= a * w <= high]
        if not beside:
            return {}
        wavelengths, weights = zip(*sorted(beside), strict=True)
        one = replace(one, light=replace(one.light, wavelengths=wavelengths, weights=weights))
        images.append((fraction, wave_image(one, field, heights.detach(), finer=FINER)))
        found |= set(wavelengths)
    image = sum(fraction * seen.image for fraction, seen in images)
    leaving = math.fsum(fraction * seen.leaving for fraction, seen in images)
    judged = figures_of_merit(Image(image, leaving, {}), target)
    return {"wave_unseen_relative_rms": judged["relative_rms"], "wave_unseen_wavelengths": sorted(found)}


def independent_wavelengths(light: Light, used: Collection[float]) -> tuple[float, ...]:
    """Wavelengths other than those `used` by a design, nm, at which an image differs little from that of all: of a continuous
    spectrum, or beside its spectral lines."""
    if light.continuum is None:
        return tuple(sorted(a * w for w in light.wavelengths for a in ASIDE))
    rules = (light.continuum.rule(count)[0] for count in range(FEW, FEW + TRIED))
    apart = (rule for rule in rules if all(abs(a - b) >= APART for a in rule for b in used))
    return next(apart, light.continuum.rule(FEW)[0])


def fast_error(
    scene: Scene,
    field: HeightField,
    heights: Tensor,
    target: np.ndarray,
    used: Collection[float],
    image_at: Callable[[Tensor, tuple[float, ...]], Tensor | None] = lambda *_: None,
) -> float | None:
    """Relative RMS error of the wave image at `independent_wavelengths`, or of a coloured one, and of several sources with spectral
    lines, at their own.

    image_at: image at heights and wavelengths by an approximation, None where it does not hold, such as that of a `WaveObjective`.

    Returns:
        the error, None if there is no wave image.
    """
    own = scene.light.color or (len(scene.source.members) > 1 and scene.light.continuum is None)
    wavelengths = () if own else independent_wavelengths(scene.light, used)
    try:
        image = image_at(heights, wavelengths) if wavelengths else None
        if image is None:
            image = wave_image(scene, field, heights.detach(), wavelengths=wavelengths or None, most=UNASKED).image
    except NoWaveImage:
        return None
    return figures_of_merit(Image(image, 1.0, {}), target)["relative_rms"]


def height_deviation(surface: MeasuredSurface, field: HeightField, heights: Tensor) -> Perturbation:
    """Function of points (N,) mm that returns the height of a surface above the design, mm, constant beyond the aperture."""

    def higher(x: Tensor, y: Tensor) -> Tensor:
        x, y = (c.double().cpu().clamp(-r, r) for c, r in zip((x, y), field.half_size, strict=True))
        return surface.at(None, x, y, [(0, 0)])[0] - field.at(heights, x, y, [(0, 0)])[0]

    return higher


def _spectral_error(found: WaveImage, error: float | None, target: np.ndarray | None) -> float | None:
    """Estimated error of a relative RMS of the wave image that follows from the number of its wavelengths.

    These are the midpoints of parts of the spectrum, a rule of second order: with half as many the error is four times as large, so
    that it is a third of the difference (Richardson).  Of two such halves, every second wavelength each, the mean is taken.
    """
    if found.halves is None or target is None or error is None:
        return None
    halves = [_judged(replace(found, image=half), target)["relative_rms"] for half in found.halves]
    return abs(math.fsum(halves) / 2.0 - error) / 3.0


def _judged(found: WaveImage, target: np.ndarray | None) -> dict:
    return figures_of_merit(Image(found.image, found.leaving, {}), target)
