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


#: Figures of an image against its target, and their names.
_COMPARISONS = (loss, relative_rms, psnr_db, ssim)
_FIGURES = tuple(figure.__name__ for figure in _COMPARISONS)


def on_target(image, target) -> float:
    """Fraction of the source's power that lands where the target is not zero; `image` as a fraction of that power per pixel."""
    image, target = _pair(image, target)
    return _sum(image[target > 0])


def black(target) -> np.ndarray:
    """Mask of black regions of a target (n_x, n_y), below DARK of its peak; of (3, n_x, n_y), for each colour separately."""
    target = _array(target)
    return target < DARK * target.max((-2, -1), keepdims=True)


def in_black(image, target) -> float | None:
    """Fraction of the light on the screen that lands where the target is `black`; (n_x, n_y), or (3, n_x, n_y) in colour.

    None if the target has no black region, or the image is black.
    """
    image, dark = _array(image), black(target)
    total = _sum(image)
    return _sum(image[dark]) / total if dark.any() and total > 0 else None


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

    Powers of rays, 1/N each, sum to 1 only to rounding; parts are therefore fractions of the sum of all parts, whose deviation from
    1 `retrace.require_energy_balance` checks.  An image without an account of losses, such as a wave image, is taken as it is.
    """
    image, lost = _array(exposure.image), {name: max(0.0, float(value)) for name, value in exposure.lost.items()}
    whole = math.fsum([_sum(image), *lost.values()]) if lost else 1.0
    if target is None:
        compared: dict = dict.fromkeys((*_FIGURES, "in_black", "on_target"))
    else:
        target, noise = _array(target), None if variance is None else _array(variance)
        colours = [(image, target, noise)]
        if image.ndim == 3:
            colours = list(zip(image, target, [None] * len(image) if noise is None else noise, strict=True))
        found = [[figure(*one) for one in colours if image.ndim == 2 or one[1].sum() > 0] for figure in _COMPARISONS]
        compared = {name: None if None in v else math.fsum(v) / len(v) for name, v in zip(_FIGURES, found, strict=True)}
        compared["in_black"] = in_black(image, target)
        compared["on_target"] = _sum(image[target > 0]) / whole
    return {
        **{name: compared[name] for name in (*_FIGURES, "in_black")},
        "on_screen": _sum(image) / whole,
        "on_target": compared["on_target"],
        "lost": {name: value / whole for name, value in lost.items()},
        "rays": int(exposure.rays),
    }


def _sum(a: np.ndarray) -> float:
    """The correctly rounded sum, so that no part exceeds the whole."""
    return math.fsum(a.ravel().tolist())


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
