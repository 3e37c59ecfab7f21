"""Snell's law and the Fresnel equations at one point of a surface.

Notation: as in `refraction`; c, s are cosines of incidence and refraction times |N|, eta the ratio of the indices.
"""

from __future__ import annotations

import math

from caustic_cli.optics.kernels.jit import FAST, njit
from caustic_cli.optics.tolerances import CRITICAL

NONE, SCHLICK, EXACT = 0, 1, 2
#: Kinds of Fresnel losses by name.
FRESNEL = {"none": NONE, "schlick": SCHLICK, "exact": EXACT}


@njit(inline="always", **FAST)
def cosine_behind(norm2, c, eta):
    """s, or 1 beyond the critical angle; and whether light passes."""
    radicand = norm2 + (eta * eta) * (c * c - norm2)
    passes = radicand > CRITICAL * norm2
    return math.sqrt(radicand if passes else 1.0), passes


@njit(inline="always", **FAST)
def reflectance(fresnel, eta, norm2, c, s, f):
    """R and its derivatives by c, s, |N|^2 and f."""
    if fresnel == EXACT:
        us, up = 1.0 / (eta * c + s), 1.0 / (c + eta * s)
        rs, rp = (eta * c - s) * us, (c - eta * s) * up
        by_ratio = 4.0 * eta * (f * rs * us * us + (1.0 - f) * rp * up * up)
        return f * rs * rs + (1.0 - f) * rp * rp, by_ratio * s, -by_ratio * c, 0.0, rs * rs - rp * rp
    if fresnel == SCHLICK:
        r0, front = (eta - 1.0) * (eta - 1.0) / ((eta + 1.0) * (eta + 1.0)), 0.0 if eta > 1.0 else 1.0
        over = 1.0 / math.sqrt(norm2)
        k = (front * c + (1.0 - front) * s) * over
        x = 1.0 - k
        x4 = x * x * x * x
        by_k = -5.0 * (1.0 - r0) * x4
        return r0 + (1.0 - r0) * x4 * x, front * by_k * over, (1.0 - front) * by_k * over, -0.5 * by_k * k * over * over, 0.0
    return 0.0, 0.0, 0.0, 0.0, 0.0
