"""Figures of merit of an image against its target.  NumPy, float64.

Notation
    J, T        image and target, (n_x, n_y), power or irradiance per pixel, each on any scale
    S J         sum of all pixels
    K           J S T / S J, the image scaled to the target's sum
    L           max T, the peak and the data range

    loss            sqrt(mean((J / S J - T / S T)^2)), eq. 5.2.1
    relative_rms    loss times the number of pixels: RMS error over the mean of the normalised target
    psnr_db         10 log10(L^2 / mean((K - T)^2))
    ssim            mean of (2 m_K m_T + c_1)(2 s_KT + c_2) / ((m_K^2 + m_T^2 + c_1)(s_K^2 + s_T^2 + c_2)), local
                    means m, variances s^2 and covariance s_KT under an 11 x 11 Gaussian window; c_i = (k_i L)^2
    in_black        sum of J where T < DARK L, over S J: fraction of the light on the screen in black regions, margins included

The Monte-Carlo noise of an image adds to every squared error.  If its variance V per pixel is known, on the scale of J, the figures
are corrected for it to the limit of infinitely many rays: mean(V / (S J)^2) is subtracted from loss^2, and the window's mean of V
from s_K^2, which is kept at least s_KT^2 / s_T^2.  The squares are then unbiased; the ratio in SSIM keeps a small bias.

A black image is compared as all zero: its relative_rms against a uniform target is 1.  Undefined values (the logarithm of zero
error, anything relative to a black target, light in black regions of a target without any) are None, because JSON has neither
infinity nor NaN.

Sources: thesis 5.2; Wang, Bovik, Sheikh, Simoncelli, IEEE Trans. Image Processing 13, 600 (2004) for SSIM.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from scipy.ndimage import gaussian_filter

from caustic_cli.errors import InputError

if TYPE_CHECKING:
    from caustic_cli.optics.image import Image

#: Window of Wang et al.: standard deviation and half width in pixels, and their two stabilising constants.
SSIM_SIGMA, SSIM_RADIUS, SSIM_K1, SSIM_K2 = 1.5, 5, 0.01, 0.03
#: Fraction of its peak below which a target counts as black.
DARK = 0.01
_FIGURES = ("loss", "relative_rms", "psnr_db", "ssim")


def loss(image, target, variance=None) -> float:
    """Eq. 5.2.1 between image and target, (n_x, n_y) each on any scale: RMS difference per pixel, as a fraction of the total light.

    variance: (n_x, n_y) of the noise of the image, which is corrected for, or None; an error below it is 0.

    Raises:
        InputError: the two differ in shape, or hold something that is not a finite number.
    """
    image, target = _pair(image, target)
    square = np.mean((_normalised(image) - _normalised(target)) ** 2)
    return float(np.sqrt(max(0.0, square - np.mean(_of_normalised(variance, image)))))


def relative_rms(image, target, variance=None) -> float:
    """`loss` times the number of pixels: the RMS error in units of the mean of the target."""
    return loss(image, target, variance) * np.size(_array(target))


def psnr_db(image, target, variance=None) -> float | None:
    """Peak signal to noise ratio in dB of the image scaled to the target's sum, peak = target maximum.

    None where the two are equal (it would be infinite) or the target is black (it has no peak).
    """
    image, target = _pair(image, target)
    peak = target.max()
    if not peak > 0:
        return None
    error = loss(image, target, variance) * (target.sum() / peak)  # RMS of K - T over L
    return -20.0 * math.log10(error) if error > 0 else None


def ssim(image, target, variance=None) -> float | None:
    """Mean structural similarity of the image scaled to the target's sum, at most 1; None for a black target.

    Population covariances; the mean is over the pixels whose window lies inside the picture.  A picture narrower than
    the window has none: there the borders are reflected and every pixel counts.
    """
    image, target = _pair(image, target)
    peak = target.max()
    if not peak > 0:
        return None
    k, t = _normalised(image) * (target.sum() / peak), target / peak  # the data range is 1 now

    def window(a: np.ndarray) -> np.ndarray:
        return gaussian_filter(a, SSIM_SIGMA, mode="reflect", radius=SSIM_RADIUS)

    m_k, m_t = window(k), window(t)
    var_k, var_t, cov = window(k * k) - m_k * m_k, window(t * t) - m_t * m_t, window(k * t) - m_k * m_t
    if variance is not None:
        least = np.divide(cov * cov, var_t, out=np.zeros_like(cov), where=var_t > 0)
        var_k = np.maximum(var_k - window(_of_normalised(variance, image) * (target.sum() / peak) ** 2), least)
    c1, c2 = SSIM_K1**2, SSIM_K2**2
    local = (2 * m_k * m_t + c1) * (2 * cov + c2) / ((m_k**2 + m_t**2 + c1) * (var_k + var_t + c2))
    if min(local.shape) > 2 * SSIM_RADIUS:
        local = local[SSIM_RADIUS:-SSIM_RADIUS, SSIM_RADIUS:-SSIM_RADIUS]
    return float(local.mean())


def on_target(image, target) -> float:
    """Fraction of the source's power that lands where the target is not zero; `image` as a fraction of that power per pixel."""
    image, target = _pair(image, target)
    return float(image[target > 0].sum())


def black(target) -> np.ndarray:
    """Mask of black regions of a target (n_x, n_y), below DARK of its peak; of (3, n_x, n_y), for each colour separately."""
    target = _array(target)
    return target < DARK * target.max((-2, -1), keepdims=True)


def in_black(image, target) -> float | None:
    """Fraction of the light on the screen that lands where the target is `black`; (n_x, n_y), or (3, n_x, n_y) in colour.

    None if the target has no black region, or the image is black.
    """
    image, dark = _array(image), black(target)
    total = image.sum()
    return float(image[dark].sum() / total) if dark.any() and total > 0 else None


def figures_of_merit(exposure: Image, target, variance=None) -> dict:
    """The figures of merit that `render json` and `design json` share, for `json.dumps(..., allow_nan=False)`.

    Args:
        exposure: a traced image; eq. 5.2.1 is defined for bincount reconstruction.
        target: (n_x, n_y), any scale, or None: figures relative to it are None then.
        variance: of the noise of the pixels, of the shape of the image, for figures corrected for it; None for uncorrected ones.

    Returns:
        loss, relative_rms, psnr_db, ssim, in_black (None where undefined), on_screen, on_target, lost (name -> part of the
        source's power; with on_screen they sum to 1) and rays.

    For a coloured image, (3, n_x, n_y) like its target, the first four are means over the colours that the target has; in_black is
    evaluated for each colour separately.
    """
    image = exposure.image
    if image.ndim == 3 and target is not None:
        noise = [None] * len(image) if variance is None else variance
        parts = [
            figures_of_merit(replace(exposure, image=i), t, v) for i, t, v in zip(image, target, noise, strict=True) if t.sum() > 0
        ]
        means = {k: None if None in (v := [p[k] for p in parts]) else math.fsum(v) / len(v) for k in _FIGURES}
        sums = {k: math.fsum(p[k] for p in parts) for k in ("on_screen", "on_target")}
        return means | {"in_black": in_black(image, target)} | sums | {k: parts[0][k] for k in ("lost", "rays")}
    against = (loss, relative_rms, psnr_db, ssim)
    return {
        **{figure.__name__: None if target is None else figure(image, target, variance) for figure in against},
        "in_black": None if target is None else in_black(image, target),
        "on_screen": float(_array(image).sum()),
        "on_target": None if target is None else on_target(image, target),
        "lost": {name: float(value) for name, value in exposure.lost.items()},
        "rays": int(exposure.rays),
    }


def judged(figures: dict, by_waves: bool) -> dict:
    """The figure a lens is judged by, to be put before its other figures.

    by_waves: judge it by its wave image, where there is one.

    Returns:
        error, wave_relative_rms or relative_rms, and error_by, waves or rays; both None without a target.
    """
    by = "waves" if by_waves and figures.get("wave_relative_rms") is not None else "rays"
    error = figures.get("wave_relative_rms" if by == "waves" else "relative_rms")
    return {"error": error, "error_by": None if error is None else by}


def _array(a) -> np.ndarray:
    """An array, or a tensor on any device, as float64."""
    return np.asarray(a.detach().cpu() if hasattr(a, "detach") else a, dtype=np.float64)


def _pair(image, target) -> tuple[np.ndarray, np.ndarray]:
    image, target = _array(image), _array(target)
    if image.ndim != 2 or not image.size or image.shape != target.shape:
        raise InputError(f"image and target must be 2-D pictures of the same shape, got {image.shape} and {target.shape}")
    if not (np.isfinite(image).all() and np.isfinite(target).all()):
        raise InputError("image and target must hold finite numbers only, got NaN or infinity")
    return image, target


def _of_normalised(variance, image: np.ndarray) -> np.ndarray:
    """Variance of the noise of the normalised image; zero if unknown or if the image is black."""
    total = image.sum()
    return np.zeros_like(image) if variance is None or not total > 0 else _array(variance) / total**2


def _normalised(a: np.ndarray) -> np.ndarray:
    """a / S a, or zeros for a picture without light."""
    total = a.sum()
    return a / total if total > 0 else np.zeros_like(a)
