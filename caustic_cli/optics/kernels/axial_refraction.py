"""Refraction of a row of axial rays at the exit surface and transfer to the screen, with derivatives, for the CPU kernels.

Every loop writes one array from a few others, so that the compiler can vectorise it.

Notation, a ray with slopes g = (z_x, z_y) at the exit surface, a = |g|^2, index n
    s       sqrt(1 - (n^2 - 1) a), cosine of refraction times |N|
    m       (n^2 - 1) / (1 + n s), so that the ray lands at x + h m g with h the height of the screen above the surface
    R       reflectance of the exit surface
"""

from __future__ import annotations

from caustic_cli.optics.kernels.fresnel import cosine_behind, reflectance
from caustic_cli.optics.kernels.jit import FAST, njit
from caustic_cli.optics.kernels.rows import (
    BESIDE,
    BY_A,
    BY_GX,
    BY_GY,
    BY_POWER,
    BY_PX,
    BY_PY,
    BY_SAG,
    FLUX,
    GX,
    GY,
    POWER,
    PX,
    PY,
    REACH,
    REFLECTED_POWER,
    SAG,
    X,
    Y,
)


@njit(inline="always", **FAST)
def _m(a, n):
    """m and dm/da."""
    s, _ = cosine_behind(1.0 + a, 1.0, n)
    under = 1.0 / (1.0 + n * s)
    m = (n - 1.0) * (n + 1.0) * under
    return m, 0.5 * (n - 1.0) * (n + 1.0) / s * n * m * under


@njit(inline="always", **FAST)
def _reflected(fresnel, a, n):
    """R and dR/da."""
    s, _ = cosine_behind(1.0 + a, 1.0, n)
    r, _, by_s, by_norm2, _ = reflectance(fresnel, n, 1.0 + a, 1.0, s, 0.5)
    return r, by_norm2 - 0.5 * (n - 1.0) * (n + 1.0) / s * by_s


@njit(**FAST)
def _powers(fresnel, gx, gy, flux, n, out):
    """Power of each ray behind the lens; REFLECTED_POWER where it is totally reflected."""
    for j in range(len(out)):
        a = gx[j] * gx[j] + gy[j] * gy[j]
        _, passes = cosine_behind(1.0 + a, 1.0, n)
        reflected, _ = _reflected(fresnel, a, n)
        out[j] = flux[j] * (1.0 - reflected) if passes else REFLECTED_POWER


@njit(**FAST)
def _reach(sag, gx, gy, n, height, out):
    """h m: displacement of a ray of unit slope on the screen, mm."""
    for j in range(len(out)):
        m, _ = _m(gx[j] * gx[j] + gy[j] * gy[j], n)
        out[j] = (height - sag[j]) * m


@njit(**FAST)
def _landing(reach, slope, x, low, pixel, out):
    """Landing points in pixels along the axis of `slope`."""
    inverse = 1.0 / pixel
    for j in range(len(out)):
        out[j] = (x[j] + reach[j] * slope[j] - low) * inverse


@njit(**FAST)
def _arrive(sag, height, out):
    """Put landing points beside the screen where the surface is beyond it."""
    for j in range(len(out)):
        out[j] = out[j] if height > sag[j] else BESIDE


@njit(inline="always", **FAST)
def aim(v, exit_, frame):
    """Powers and landing points of a row of rays along z, from SAG, GX, GY, FLUX, X and Y."""
    n, height, fresnel = exit_.index, exit_.height, exit_.fresnel
    _powers(fresnel, v[GX], v[GY], v[FLUX], n, v[POWER])
    _reach(v[SAG], v[GX], v[GY], n, height, v[REACH])
    _landing(v[REACH], v[GX], v[X], frame.low_x, frame.pixel_x, v[PX])
    _landing(v[REACH], v[GY], v[Y], frame.low_y, frame.pixel_y, v[PY])
    _arrive(v[SAG], height, v[PX])


@njit(**FAST)
def _by_a(fresnel, sag, gx, gy, flux, by_power, by_px, by_py, n, height, out):
    """Derivative by a = |g|^2, by way of the landing point and of the reflectance; 0 where totally reflected."""
    for j in range(len(out)):
        a = gx[j] * gx[j] + gy[j] * gy[j]
        _, passes = cosine_behind(1.0 + a, 1.0, n)
        _, dm = _m(a, n)
        _, dr = _reflected(fresnel, a, n)
        value = (height - sag[j]) * dm * (by_px[j] * gx[j] + by_py[j] * gy[j]) - by_power[j] * flux[j] * dr
        out[j] = value if passes else 0.0


@njit(**FAST)
def _by_slope(reach, slope, by_p, by_a, out):
    for j in range(len(out)):
        out[j] = reach[j] * by_p[j] + 2.0 * slope[j] * by_a[j]


@njit(**FAST)
def _by_sag(reach, sag, gx, gy, by_px, by_py, height, out):
    for j in range(len(out)):  # reach / h = m; nothing lands where h is not positive
        h = height - sag[j]
        out[j] = -reach[j] / (h if h > 0.0 else 1.0) * (by_px[j] * gx[j] + by_py[j] * gy[j])


@njit(inline="always", **FAST)
def pull(vectors, exit_):
    """Adjoint: derivatives by sag and slopes, in BY_SAG, BY_GX, BY_GY, from those by power and pixel coordinates."""
    n, height, v = exit_.index, exit_.height, vectors
    _by_a(exit_.fresnel, v[SAG], v[GX], v[GY], v[FLUX], v[BY_POWER], v[BY_PX], v[BY_PY], n, height, v[BY_A])
    _by_slope(v[REACH], v[GX], v[BY_PX], v[BY_A], v[BY_GX])
    _by_slope(v[REACH], v[GY], v[BY_PY], v[BY_A], v[BY_GY])
    _by_sag(v[REACH], v[SAG], v[GX], v[GY], v[BY_PX], v[BY_PY], height, v[BY_SAG])
