"""Monte-Carlo noise of an image and standard errors of its figures, estimated from two independent halves of the rays.

Notation
    A, B        images of the two halves, (n_x, n_y), fractions of the source's power; M = (A + B) / 2 is the image
    T           target; a, b, m, t are A, B, M, T over their own means
    V           (A - B)^2 / 4, an unbiased estimate of the variance of M's pixels
    F           relative_rms corrected for noise: F^2 = mean((m - t)^2) - mean(V) / mean(M)^2 = mean((a - t) (b - t)), unbiased
                since the noises of A and B are independent

The standard error of F^2 follows from the difference of the halves.  With their squared errors E_A and E_B in a block of pixels,
over the number of all pixels, var(F^2) = sum over blocks of (E_A - E_B)^2 / 4: (E_A - E_B) / 2 is the contribution of the block to
mean((m - t) (a - b)), which has the same variance as F^2: noise times error, and the product of the noises of both halves.
Correlated neighbours, which exchange rays near their border, are mostly in one block.

Likewise for G, the fraction of light in black regions (`metrics.in_black`): R_A is the sum over a block of A (1 - G) in black
regions and of -A G elsewhere, over the sum of M, and var(G) = sum over blocks of (R_A - R_B)^2 / 4.
"""

from __future__ import annotations

import math

import numpy as np

from caustic_cli.studies.metrics import black

#: Pixels along the sides of a block.
BLOCK = 8


def variance_of(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """V of two images, (n_x, n_y) or (3, n_x, n_y) each."""
    return (one - other) ** 2 / 4.0


def image_noise(variance: np.ndarray, image: np.ndarray) -> float | None:
    """Relative RMS noise of an image, over its mean; None for a black one.  variance: an estimate, of any sign."""
    mean = float(image.mean())
    return math.sqrt(max(0.0, float(variance.mean()))) / mean if mean > 0 else None


def noise_bias(relative_rms: float, error: float) -> float:
    """Increase of relative_rms by the noise of an image, `error` of its mean, if it is not corrected for."""
    return relative_rms - math.sqrt(max(0.0, relative_rms**2 - error**2))


def standard_error(one: np.ndarray, other: np.ndarray, target: np.ndarray, relative_rms: float) -> float:
    """Standard error of F, `relative_rms`, of the mean of two images; in colour, (3, n_x, n_y), for fully correlated colours.

    With the standard error s of F^2 it is sqrt(F^2 + s) - F: s / (2 F) for small s, sqrt(s) where F = 0.
    """
    colours = [(one, other, target)] if target.ndim == 2 else [c for c in zip(one, other, target, strict=True) if c[2].sum() > 0]
    square = math.fsum(_of_square(*c) for c in colours) / max(1, len(colours))
    return math.sqrt(relative_rms**2 + square) - relative_rms


def black_error(one: np.ndarray, other: np.ndarray, target: np.ndarray, in_black: float | None) -> float | None:
    """Standard error of G, `in_black`, of the mean of two images, (n_x, n_y) or (3, n_x, n_y); None if G is None."""
    if in_black is None:
        return None
    apart = (black(target) - in_black) * (one - other) / (0.5 * (one.sum() + other.sum()))
    return 0.5 * float(np.sqrt(sum((_blocks(a) ** 2).sum() for a in (apart if apart.ndim == 3 else apart[None]))))


def _of_square(one: np.ndarray, other: np.ndarray, target: np.ndarray) -> float:
    """Standard error of F^2; 0 where an image is black."""
    if min(one.sum(), other.sum(), target.sum()) <= 0:
        return 0.0
    errors = [_blocks((a / a.mean() - target / target.mean()) ** 2) / target.size for a in (one, other)]
    return 0.5 * float(np.sqrt(np.sum((errors[0] - errors[1]) ** 2)))


def _blocks(a: np.ndarray) -> np.ndarray:
    """Sums of (n_x, n_y) over blocks; those at the upper borders may be smaller."""
    for axis in (0, 1):
        a = np.add.reduceat(a, np.arange(0, a.shape[axis], BLOCK), axis)
    return a
