"""Light scattered by heights of a surface that are small against a wavelength: 1 - exp(-phi^2) of it, phi the standard deviation of
the phase, 2 pi |n - 1| sigma / lambda, for Gaussian or small heights of standard deviation sigma (Beckmann and Spizzichino, The
Scattering of Electromagnetic Waves from Rough Surfaces, 1963).

bend: |n - 1|, 2 for a mirror; wavelength: nm.
"""

from __future__ import annotations

import math


def scattered(sigma: float, bend: float, wavelength: float) -> float:
    """Fraction of the light, for heights of a standard deviation of `sigma` mm."""
    return -math.expm1(-((_phase(bend, wavelength) * sigma) ** 2))


def deviation_of(fraction: float, bend: float, wavelength: float) -> float:
    """The standard deviation of the heights, mm, that scatters this fraction."""
    return math.sqrt(-math.log1p(-fraction)) / _phase(bend, wavelength)


def _phase(bend: float, wavelength: float) -> float:
    """rad, of a height of 1 mm."""
    return 2.0 * math.pi * bend / (wavelength * 1e-6)
