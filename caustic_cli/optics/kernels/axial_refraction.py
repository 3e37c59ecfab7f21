"""Refraction of axial rays at the exit surface and transfer to an upright screen, with adjoint: `refraction` and `transfer` without
their products with zeros, which the compiler must keep, and with one division less.

Notation, a ray with slopes g = (z_x, z_y) at the exit surface, a = |g|^2, index n
    s       sqrt(1 - (n^2 - 1) a), cosine of refraction times |N|
    m       (n^2 - 1) / (1 + n s), so that the ray lands at x + h m g with h the height of the screen above the surface
    R       reflectance of the exit surface
"""

from __future__ import annotations

from caustic_cli.optics.kernels.fresnel import cosine_behind, reflectance
from caustic_cli.optics.kernels.jit import FAST, njit


@njit(inline="always", **FAST)
def arrive(x, y, gx, gy, h, n, fresnel):
    """Landing point and 1 - R of one ray, and whether it passes."""
    norm2 = 1.0 + gx * gx + gy * gy
    s, passes = cosine_behind(norm2, 1.0, n)
    r, _, _, _, _ = reflectance(fresnel, n, norm2, 1.0, s, 0.5)
    reach = h * ((n - 1.0) * (n + 1.0) / (1.0 + n * s))
    return x + reach * gx, y + reach * gy, 1.0 - r, passes


@njit(inline="always", **FAST)
def pull(gx, gy, h, power, n, fresnel, by_x, by_y, by_after):
    """Adjoint of `arrive`: derivatives by z and g, from those by the landing point and the power behind."""
    norm2, bends = 1.0 + gx * gx + gy * gy, (n - 1.0) * (n + 1.0)
    s, passes = cosine_behind(norm2, 1.0, n)
    _, _, r_s, r_norm2, _ = reflectance(fresnel, n, norm2, 1.0, s, 0.5)
    under, toward, by_r = 1.0 / (1.0 + n * s), by_x * gx + by_y * gy, -power * by_after
    m = bends * under
    by_s = by_r * r_s - h * toward * m * n * under
    by_a = by_r * r_norm2 - 0.5 * bends * by_s / s if passes else 0.0
    return -m * toward, h * m * by_x + 2.0 * gx * by_a, h * m * by_y + 2.0 * gy * by_a
