"""Refraction of a row of axial rays at the exit surface and transfer to the screen, with derivatives, for the CPU kernels.

Every loop writes one array from a few others, so that the compiler can vectorise it.

Notation, a ray with slopes g = (z_x, z_y) at the exit surface, a = |g|^2, index n
    s       sqrt(1 - (n^2 - 1) a), cosine of refraction times |N|
    m       (n^2 - 1) / (1 + n s), so that the ray lands at x + h m g with h the height of the screen above the surface
    R       reflectance of the exit surface
"""

from __future__ import annotations

from caustic_cli.optics.kernels import rows as row
from caustic_cli.optics.kernels.fresnel import cosine_behind, reflectance
from caustic_cli.optics.kernels.jit import FAST, njit


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
    """Power of each ray behind the lens; row.REFLECTED_POWER where it is totally reflected."""
    for j in range(len(out)):
        a = gx[j] * gx[j] + gy[j] * gy[j]
        _, passes = cosine_behind(1.0 + a, 1.0, n)
        reflected, _ = _reflected(fresnel, a, n)
        out[j] = flux[j] * (1.0 - reflected) if passes else row.REFLECTED_POWER


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
        out[j] = out[j] if height > sag[j] else row.BESIDE


@njit(inline="always", **FAST)
def aim(v, exit_, frame):
    """Powers and landing points of a row of rays along z, from SAG, GX, GY, FLUX, X and Y."""
    n, height, fresnel = exit_.eta, exit_.height, exit_.fresnel
    _powers(fresnel, v[row.GX], v[row.GY], v[row.FLUX], n, v[row.POWER])
    _reach(v[row.SAG], v[row.GX], v[row.GY], n, height, v[row.REACH])
    _landing(v[row.REACH], v[row.GX], v[row.X], frame.low_x, frame.pixel_x, v[row.PX])
    _landing(v[row.REACH], v[row.GY], v[row.Y], frame.low_y, frame.pixel_y, v[row.PY])
    _arrive(v[row.SAG], height, v[row.PX])


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
    n, height, v = exit_.eta, exit_.height, vectors
    sag, gx, gy, flux, by_px, by_py = v[row.SAG], v[row.GX], v[row.GY], v[row.FLUX], v[row.BY_PX], v[row.BY_PY]
    _by_a(exit_.fresnel, sag, gx, gy, flux, v[row.BY_POWER], by_px, by_py, n, height, v[row.BY_A])
    _by_slope(v[row.REACH], gx, by_px, v[row.BY_A], v[row.BY_GX])
    _by_slope(v[row.REACH], gy, by_py, v[row.BY_A], v[row.BY_GY])
    _by_sag(v[row.REACH], sag, gx, gy, by_px, by_py, height, v[row.BY_SAG])
