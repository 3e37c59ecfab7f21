"""Fused CPU kernel: refraction at the exit surface -> landing point -> splat, with its adjoint and its tangent.

The function of `tracing.trace_plane` followed by `reconstruction.splat`, computed ray by ray without storing anything
between; both are the reference it is tested against.  Storage is float32 or float64, arithmetic in registers and the
image always float64.

Notation, a ray with slopes g = (z_x, z_y) at the exit surface, a = |g|^2, index n
    s       sqrt(1 - (n^2 - 1) a), cosine of refraction times |N|
    m       (n - s) / (n a + s), so that the ray lands at x + h m g with h the height of the screen above the surface
    R       reflectance of the exit surface
    sx, sy  shares among the v_x x v_y pixels around the landing point; dx, dy their derivatives by sub-pixel position

Each of a fixed number of blocks of rays has an image of its own and they are added in order, so the result does not
depend on timing, only on the number of blocks (the number of threads).
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit, prange

NONE, SCHLICK, EXACT = 0, 1, 2
BINCOUNT, GAUSSIAN, COSINE = 0, 1, 2
#: Below this alpha (v/2)^2 the Gaussian's shares come from Taylor series, without cancellation; above LARGE from plain
#: exponentials, because the recursion over pixels would overflow.
SMALL, LARGE = 0.05, 80.0
CRITICAL, PARALLEL = 1e-16, 1e-9  # see interface.CRITICAL and tracing.PARALLEL
FRESNEL, REFLECTED, OFF_SCREEN, LEAVING = 0, 1, 2, 3  # columns of the ledger

_OPTIONS = {"cache": True, "error_model": "numpy", "fastmath": {"contract", "nsz"}}


@njit(inline="always", **_OPTIONS)
def _sine_cosine(x):
    """sin and cos for |x| <= pi / 3 by Taylor series: the first terms left out are 7e-16 and 5e-17."""
    y = x * x
    s = 1.0 - y * (1 / 42.0) * (1.0 - y * (1 / 72.0) * (1.0 - y * (1 / 110.0) * (1.0 - y * (1 / 156.0) * (1.0 - y * (1 / 210.0)))))
    s = x * (1.0 - y * (1 / 6.0) * (1.0 - y * (1 / 20.0) * s))
    c = 1.0 - y * (1 / 56.0) * (1.0 - y * (1 / 90.0) * (1.0 - y * (1 / 132.0) * (1.0 - y * (1 / 182.0) * (1.0 - y * (1 / 240.0)))))
    c = 1.0 - y * (1 / 2.0) * (1.0 - y * (1 / 12.0) * (1.0 - y * (1 / 30.0) * c))
    return s, c


@njit(inline="always", **_OPTIONS)
def _exp_small(x):
    """exp(x) for |x| <= 2: exp(x / 8)^8, relative error about 1e-14."""
    z = 0.125 * x
    e = 1.0 + z * (1.0 + z * (1 / 2 + z * (1 / 6 + z * (1 / 24 + z * (1 / 120 + z * (
        1 / 720 + z * (1 / 5040 + z * (1 / 40320 + z * (1 / 362880 + z / 3628800)))))))))
    e *= e
    e *= e
    return e * e


@njit(**_OPTIONS)
def _gaussian(phi, v, alpha, table, out, slope):
    """Shares and their derivatives by phi of a Gaussian truncated at v / 2: see reconstruction.Filter and `_table`."""
    r = (v - 1) // 2
    q = 0.5 - phi
    square = 0.25 * v * v
    total = 0.0
    change = 0.0
    if alpha * square < SMALL:  # both divided by alpha exp(-alpha (v/2)^2); every series' argument is below SMALL
        for k in range(v):
            d = k - r + q
            x = alpha * max(square - d * d, 0.0)
            y = alpha * d * d
            e = 1.0 - y * (1.0 - y * (1 / 2.0) * (1.0 - y * (1 / 3.0) * (1.0 - y * (1 / 4.0) * (1.0 - y * (1 / 5.0) * (1.0 - y * (1 / 6.0))))))
            p = 1.0 - x * (1 / 2.0) * (1.0 - x * (1 / 3.0) * (1.0 - x * (1 / 4.0) * (1.0 - x * (1 / 5.0) * (1.0 - x * (1 / 6.0) * (1.0 - x * (1 / 7.0))))))
            out[k] = max(square - d * d, 0.0) * p * e
            slope[k] = 2.0 * d * e
            total += out[k]
            change += slope[k]
    elif alpha <= LARGE:  # both divided by exp(-alpha q^2): exp(-alpha (d^2 - q^2)) follows from pixel to pixel
        if alpha <= 2.0:
            edge = table[0] * _exp_small(alpha * q * q)
            up = _exp_small(-2.0 * alpha * q)
        else:
            edge = math.exp(-alpha * (square - q * q))
            up = math.exp(-2.0 * alpha * q)
        down = 1.0 / up
        rise, fall, ratio_up, ratio_down = 1.0, 1.0, up * table[1], down * table[1]
        out[r] = 1.0 - edge
        slope[r] = 2.0 * alpha * q
        for k in range(1, r + 1):
            rise *= ratio_up
            fall *= ratio_down
            ratio_up *= table[2]
            ratio_down *= table[2]
            out[r + k] = max(rise - edge, 0.0)
            out[r - k] = max(fall - edge, 0.0)
            slope[r + k] = 2.0 * alpha * (q + k) * rise
            slope[r - k] = 2.0 * alpha * (q - k) * fall
        for k in range(v):
            total += out[k]
            change += slope[k]
    else:
        for k in range(v):
            d = k - r + q
            e = math.exp(-alpha * (d * d - q * q))
            out[k] = -e * math.expm1(-alpha * max(square - d * d, 0.0))
            slope[k] = 2.0 * alpha * d * e
            total += out[k]
            change += slope[k]
    inverse = 1.0 / total
    for k in range(v):
        out[k] *= inverse
        slope[k] = (slope[k] - out[k] * change) * inverse


@njit(**_OPTIONS)
def _shares(kind, phi, v, alpha, table, out, slope):
    """Shares of a ray at sub-pixel position phi among its v pixels, and their derivatives by phi."""
    if v == 1:
        out[0] = 1.0
        slope[0] = 0.0
    elif kind == COSINE:  # cos(theta (k - r + q)) by addition from one sine and cosine
        theta = 2.0 * math.pi / v
        s, c = _sine_cosine(theta * (0.5 - phi))
        each = 1.0 / v
        for k in range(v):
            out[k] = each + c * table[k] - s * table[v + k]
            slope[k] = theta * (s * table[k] + c * table[v + k])
    else:
        _gaussian(phi, v, alpha, table, out, slope)


@njit(**_OPTIONS)
def _table(kind, v, alpha):
    """Constants of an axis: cos and sin of 2 pi (k - r) / v over v, or exp(-alpha v^2 / 4), exp(-alpha), exp(-2 alpha)."""
    out = np.zeros(2 * v + 3)
    if kind == COSINE:
        for k in range(v):
            out[k] = math.cos(2.0 * math.pi * (k - (v - 1) // 2) / v) / v
            out[v + k] = math.sin(2.0 * math.pi * (k - (v - 1) // 2) / v) / v
    else:
        out[0], out[1], out[2] = math.exp(-0.25 * alpha * v * v), math.exp(-alpha), math.exp(-2.0 * alpha)
    return out


@njit(inline="always", **_OPTIONS)
def _bend(fresnel, gx, gy, n):
    """passes, m, dm/da, transmittance, its derivative by a."""
    a = gx * gx + gy * gy
    radicand = 1.0 - (n * n - 1.0) * a
    if not radicand > CRITICAL * (1.0 + a):
        return False, 0.0, 0.0, 0.0, 0.0
    s = math.sqrt(radicand)
    ds = -0.5 * (n * n - 1.0) / s
    under = 1.0 / (n * a + s)
    m = (n - s) * under
    dm = -(ds + m * (n + ds)) * under
    if fresnel == EXACT:
        us, up = 1.0 / (n + s), 1.0 / (1.0 + n * s)
        rs, rp = (n - s) * us, (1.0 - n * s) * up
        reflected = 0.5 * (rs * rs + rp * rp)
        dr = -2.0 * n * (rs * us * us + rp * up * up) * ds
    elif fresnel == SCHLICK:
        r0 = (n - 1.0) * (n - 1.0) / ((n + 1.0) * (n + 1.0))
        inverse = 1.0 / math.sqrt(1.0 + a)
        x = 1.0 - s * inverse
        x4 = x * x * x * x
        reflected = r0 + (1.0 - r0) * x4 * x
        dr = -5.0 * (1.0 - r0) * x4 * (ds - 0.5 * s / (1.0 + a)) * inverse
    else:
        reflected, dr = 0.0, 0.0
    return True, m, dm, 1.0 - reflected, -dr


@njit(inline="always", **_OPTIONS)
def _pixel(at, half, pixel, n, r):
    """inside the frame grown by r pixels, index of the first share on the padded frame, sub-pixel position."""
    p = (at + half) / pixel
    if not (p >= -r and p < n + r):  # False for NaN and infinity too
        return False, 0, 0.0
    i0 = math.floor(p)
    return True, int(i0) + r, p - i0


@njit(parallel=True, **_OPTIONS)
def forward(sag, gx, gy, x, y, share, n, fresnel, height, half, pixel, resolution, kind, size, alpha, blocks):
    """Padded image (n_x + 4 r_x, n_y + 4 r_y) and the ledger (4,): fresnel, reflected, off_screen, leaving.

    sag, gx, gy, x, y mm, share parts of the source's power: (a, b), the last three broadcast views; height: of the screen above the sag's zero, mm; half, pixel (2,) mm; size, alpha (2,) of the filter, alpha
    per pixel squared.
    """
    rows, columns = sag.shape
    vx, vy = size
    rx, ry = (vx - 1) // 2, (vy - 1) // 2
    nx, ny = resolution
    images = np.zeros((blocks, nx + 4 * rx, ny + 4 * ry))
    ledgers = np.zeros((blocks, 4))
    entrance = 0.0 if fresnel == NONE else (n - 1.0) * (n - 1.0) / ((n + 1.0) * (n + 1.0))
    table_x, table_y = _table(kind, vx, alpha[0]), _table(kind, vy, alpha[1])
    for block in prange(blocks):
        image = images[block]
        sx, dx, sy, dy = np.empty(vx), np.empty(vx), np.empty(vy), np.empty(vy)
        lost_fresnel, lost_reflected, lost_off, leaving = 0.0, 0.0, 0.0, 0.0
        for i in range(block * rows // blocks, (block + 1) * rows // blocks):
            for j in range(columns):
                emitted = share[i, j]
                inside = emitted * (1.0 - entrance)
                passes, m, _, through, _ = _bend(fresnel, gx[i, j], gy[i, j], n)
                if not passes:
                    lost_fresnel += emitted - inside
                    lost_reflected += inside
                    continue
                weight = inside * through
                lost_fresnel += emitted - weight
                leaving += weight
                h = height - sag[i, j]
                reach = h * m
                in_x, i0, phi_x = _pixel(x[i, j] + reach * gx[i, j], half[0], pixel[0], nx, rx)
                in_y, j0, phi_y = _pixel(y[i, j] + reach * gy[i, j], half[1], pixel[1], ny, ry)
                if not (in_x and in_y and h > 0.0):
                    lost_off += weight
                    continue
                if vx == 1 and vy == 1:
                    image[i0, j0] += weight
                    continue
                _shares(kind, phi_x, vx, alpha[0], table_x, sx, dx)
                _shares(kind, phi_y, vy, alpha[1], table_y, sy, dy)
                for a in range(vx):
                    part = weight * sx[a]
                    for b in range(vy):
                        image[i0 + a, j0 + b] += part * sy[b]
        ledgers[block, 0], ledgers[block, 1], ledgers[block, 2], ledgers[block, 3] = (
            lost_fresnel, lost_reflected, lost_off, leaving)
    for i in prange(images.shape[1]):
        for block in range(1, blocks):
            for j in range(images.shape[2]):
                images[0, i, j] += images[block, i, j]
    ledger = np.zeros(4)
    for block in range(blocks):
        ledger += ledgers[block]
    return images[0], ledger


@njit(parallel=True, **_OPTIONS)
def backward(grad, grad_leaving, sag, gx, gy, x, y, share, n, fresnel, height, half, pixel, resolution, kind, size, alpha,
             blocks):
    """Adjoint of `forward`: derivatives by sag, gx, gy (a, b), from those by the padded image and by the leaving power."""
    rows, columns = sag.shape
    vx, vy = size
    rx, ry = (vx - 1) // 2, (vy - 1) // 2
    nx, ny = resolution
    out_sag, out_x, out_y = np.empty_like(sag), np.empty_like(sag), np.empty_like(sag)
    entrance = 0.0 if fresnel == NONE else (n - 1.0) * (n - 1.0) / ((n + 1.0) * (n + 1.0))
    table_x, table_y = _table(kind, vx, alpha[0]), _table(kind, vy, alpha[1])
    for block in prange(blocks):
        sx, dx, sy, dy = np.empty(vx), np.empty(vx), np.empty(vy), np.empty(vy)
        for i in range(block * rows // blocks, (block + 1) * rows // blocks):
            for j in range(columns):
                slope_x, slope_y = gx[i, j], gy[i, j]
                passes, m, dm, through, dthrough = _bend(fresnel, slope_x, slope_y, n)
                if not passes:
                    out_sag[i, j], out_x[i, j], out_y[i, j] = 0.0, 0.0, 0.0
                    continue
                inside = share[i, j] * (1.0 - entrance)
                weight = inside * through
                h = height - sag[i, j]
                reach = h * m
                in_x, i0, phi_x = _pixel(x[i, j] + reach * slope_x, half[0], pixel[0], nx, rx)
                in_y, j0, phi_y = _pixel(y[i, j] + reach * slope_y, half[1], pixel[1], ny, ry)
                by_weight, by_x, by_y = grad_leaving, 0.0, 0.0
                if in_x and in_y and h > 0.0:
                    _shares(kind, phi_x, vx, alpha[0], table_x, sx, dx)
                    _shares(kind, phi_y, vy, alpha[1], table_y, sy, dy)
                    for a in range(vx):
                        along, across = 0.0, 0.0
                        for b in range(vy):
                            g = grad[i0 + a, j0 + b]
                            along += g * sy[b]
                            across += g * dy[b]
                        by_weight += sx[a] * along
                        by_x += dx[a] * along
                        by_y += sx[a] * across
                    by_x *= weight / pixel[0]
                    by_y *= weight / pixel[1]
                dot = by_x * slope_x + by_y * slope_y
                by_a = h * dm * dot + by_weight * inside * dthrough
                out_sag[i, j] = -m * dot
                out_x[i, j] = reach * by_x + 2.0 * slope_x * by_a
                out_y[i, j] = reach * by_y + 2.0 * slope_y * by_a
    return out_sag, out_x, out_y


@njit(parallel=True, **_OPTIONS)
def tangent(t_sag, t_gx, t_gy, sag, gx, gy, x, y, share, n, fresnel, height, half, pixel, resolution, kind, size, alpha,
            blocks):
    """Derivative of `forward` along (t_sag, t_gx, t_gy): the padded image's tangent, and the leaving power's."""
    rows, columns = sag.shape
    vx, vy = size
    rx, ry = (vx - 1) // 2, (vy - 1) // 2
    nx, ny = resolution
    images = np.zeros((blocks, nx + 4 * rx, ny + 4 * ry))
    leavings = np.zeros(blocks)
    entrance = 0.0 if fresnel == NONE else (n - 1.0) * (n - 1.0) / ((n + 1.0) * (n + 1.0))
    table_x, table_y = _table(kind, vx, alpha[0]), _table(kind, vy, alpha[1])
    for block in prange(blocks):
        image = images[block]
        sx, dx, sy, dy = np.empty(vx), np.empty(vx), np.empty(vy), np.empty(vy)
        for i in range(block * rows // blocks, (block + 1) * rows // blocks):
            for j in range(columns):
                slope_x, slope_y = gx[i, j], gy[i, j]
                passes, m, dm, through, dthrough = _bend(fresnel, slope_x, slope_y, n)
                if not passes:
                    continue
                inside = share[i, j] * (1.0 - entrance)
                weight = inside * through
                da = 2.0 * (slope_x * t_gx[i, j] + slope_y * t_gy[i, j])
                dw = inside * dthrough * da
                leavings[block] += dw
                h = height - sag[i, j]
                reach = h * m
                d_reach = -t_sag[i, j] * m + h * dm * da
                in_x, i0, phi_x = _pixel(x[i, j] + reach * slope_x, half[0], pixel[0], nx, rx)
                in_y, j0, phi_y = _pixel(y[i, j] + reach * slope_y, half[1], pixel[1], ny, ry)
                if not (in_x and in_y and h > 0.0):
                    continue
                _shares(kind, phi_x, vx, alpha[0], table_x, sx, dx)
                _shares(kind, phi_y, vy, alpha[1], table_y, sy, dy)
                move_x = weight * (d_reach * slope_x + reach * t_gx[i, j]) / pixel[0]
                move_y = weight * (d_reach * slope_y + reach * t_gy[i, j]) / pixel[1]
                for a in range(vx):
                    along, across = dw * sx[a] + move_x * dx[a], move_y * sx[a]
                    for b in range(vy):
                        image[i0 + a, j0 + b] += along * sy[b] + across * dy[b]
    for i in prange(images.shape[1]):
        for block in range(1, blocks):
            for j in range(images.shape[2]):
                images[0, i, j] += images[block, i, j]
    return images[0], leavings.sum()
