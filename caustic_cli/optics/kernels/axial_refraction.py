"""Refraction of a row of axial rays at the exit surface and transfer to the screen, with derivatives, for the CPU kernels.

Every loop writes one array from a few others, so that the compiler can vectorise it.

Notation, a ray with slopes g = (z_x, z_y) at the exit surface, a = |g|^2, index n
    s       sqrt(1 - (n^2 - 1) a), cosine of refraction times |N|
    m       (n^2 - 1) / (1 + n s), so that the ray lands at x + h m g with h the height of the screen above the surface
    R       reflectance of the exit surface
"""

from __future__ import annotations

import math

from caustic_cli.optics.kernels.jit import FAST, njit
from caustic_cli.optics.tolerances import CRITICAL

NONE, SCHLICK, EXACT = 0, 1, 2
#: Kinds of Fresnel losses by name.
FRESNEL = {"none": NONE, "schlick": SCHLICK, "exact": EXACT}
# Rows of a block's scratch vectors: the surface, powers, landing points, derivatives, normalisation of the results of
# `filter_weights`, the rays' points and powers; five more for internal use.
SAG, GX, GY, POWER, PX, PY, PHI, BY_POWER, BY_PX, BY_PY, BY_A, BY_SAG, BY_GX, BY_GY, REACH = range(15)
OVER_X, OVER_Y, LEAN_X, LEAN_Y, X, Y, FLUX, VECTORS = range(15, 23)
SCRATCH = 5


@njit(inline="always", **FAST)
def _s(a, n):
    """s, or 1 beyond the critical angle; and whether the ray passes."""
    radicand = 1.0 - (n - 1.0) * (n + 1.0) * a
    passes = radicand > CRITICAL * (1.0 + a)
    return math.sqrt(radicand if passes else 1.0), passes


@njit(inline="always", **FAST)
def _m(a, n):
    """m and dm/da."""
    s, _ = _s(a, n)
    under = 1.0 / (1.0 + n * s)
    m = (n - 1.0) * (n + 1.0) * under
    return m, 0.5 * (n - 1.0) * (n + 1.0) / s * n * m * under


@njit(inline="always", **FAST)
def _reflected(fresnel, a, n):
    """R and dR/da."""
    s, _ = _s(a, n)
    ds = -0.5 * (n - 1.0) * (n + 1.0) / s
    if fresnel == EXACT:
        us, up = 1.0 / (n + s), 1.0 / (1.0 + n * s)
        rs, rp = (n - s) * us, (1.0 - n * s) * up
        return 0.5 * (rs * rs + rp * rp), -2.0 * n * (rs * us * us + rp * up * up) * ds
    if fresnel == SCHLICK:
        r0 = (n - 1.0) * (n - 1.0) / ((n + 1.0) * (n + 1.0))
        inverse = 1.0 / math.sqrt(1.0 + a)
        x = 1.0 - s * inverse
        x4 = x * x * x * x
        return r0 + (1.0 - r0) * x4 * x, -5.0 * (1.0 - r0) * x4 * (ds - 0.5 * s / (1.0 + a)) * inverse
    return 0.0, 0.0


@njit(**FAST)
def load(row, out):
    """Copy a row, possibly a repeated value, to contiguous memory, since only contiguous loops are vectorised."""
    if row.strides[0] == 0:
        out[:] = row[0]
    elif row.strides[0] == 8:  # a stride known at compile time: this copy is vectorised
        for j in range(len(out)):
            out[j] = row[j]
    else:
        for j in range(len(out)):
            out[j] = row[j]


@njit(**FAST)
def powers(fresnel, gx, gy, flux, n, out):
    """Power of each ray behind the lens; -1 where it is totally reflected."""
    for j in range(len(out)):
        a = gx[j] * gx[j] + gy[j] * gy[j]
        _, passes = _s(a, n)
        reflected, _ = _reflected(fresnel, a, n)
        out[j] = flux[j] * (1.0 - reflected) if passes else -1.0


@njit(**FAST)
def reach(sag, gx, gy, n, height, out):
    """h m: displacement of a ray of unit slope on the screen, mm."""
    for j in range(len(out)):
        m, _ = _m(gx[j] * gx[j] + gy[j] * gy[j], n)
        out[j] = (height - sag[j]) * m


@njit(**FAST)
def landing(reach, slope, x, low, pixel, out):
    """Landing points in pixels along the axis of `slope`."""
    inverse = 1.0 / pixel
    for j in range(len(out)):
        out[j] = (x[j] + reach[j] * slope[j] - low) * inverse


@njit(**FAST)
def fraction(p, out):
    for j in range(len(out)):
        out[j] = p[j] - math.floor(p[j])


@njit(**FAST)
def _by_a(fresnel, sag, gx, gy, flux, by_power, by_px, by_py, n, height, out):
    """Derivative by a = |g|^2, by way of the landing point and of the reflectance; 0 where totally reflected."""
    for j in range(len(out)):
        a = gx[j] * gx[j] + gy[j] * gy[j]
        _, passes = _s(a, n)
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
