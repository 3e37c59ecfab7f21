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

from caustic_cli.optics.kernels.shares import shares, table

NONE, SCHLICK, EXACT = 0, 1, 2
CRITICAL = 1e-16  # see interface.CRITICAL
FRESNEL, REFLECTED, OFF_SCREEN, LEAVING = 0, 1, 2, 3  # columns of the ledger

_OPTIONS = {"cache": True, "error_model": "numpy", "fastmath": {"contract", "nsz"}}


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


@njit(**_OPTIONS)
def _forward_row(sag, gx, gy, x, y, share, real, whole, tables, image, ledger, work):
    """Add the rays of one row to an image and a ledger.  Row arrays are (b,); work (4, longest v)."""
    n, height, half_x, half_y = real[0], real[1], real[2], real[3]
    pixel_x, pixel_y, alpha_x, alpha_y = real[4], real[5], real[6], real[7]
    fresnel, nx, ny, kind, vx, vy = whole[0], whole[1], whole[2], whole[3], whole[4], whole[5]
    entrance = _entrance(fresnel, n)
    sx, sy, dx, dy = work[0], work[1], work[2], work[3]
    rx, ry = (vx - 1) // 2, (vy - 1) // 2
    lost_fresnel, lost_reflected, lost_off, leaving = 0.0, 0.0, 0.0, 0.0
    for j in range(len(sag)):
        emitted = share[j]
        inside = emitted * (1.0 - entrance)
        passes, m, _, through, _ = _bend(fresnel, gx[j], gy[j], n)
        if not passes:
            lost_fresnel += emitted - inside
            lost_reflected += inside
            continue
        weight = inside * through
        lost_fresnel += emitted - weight
        leaving += weight
        h = height - sag[j]
        reach = h * m
        in_x, i0, phi_x = _pixel(x[j] + reach * gx[j], half_x, pixel_x, nx, rx)
        in_y, j0, phi_y = _pixel(y[j] + reach * gy[j], half_y, pixel_y, ny, ry)
        if not (in_x and in_y and h > 0.0):
            lost_off += weight
            continue
        if vx == 1 and vy == 1:
            image[i0, j0] += weight
            continue
        shares(kind, phi_x, vx, alpha_x, tables[0], sx, dx, False)
        shares(kind, phi_y, vy, alpha_y, tables[1], sy, dy, False)
        for a in range(vx):
            part = weight * sx[a]
            for b in range(vy):
                image[i0 + a, j0 + b] += part * sy[b]
    ledger[FRESNEL] += lost_fresnel
    ledger[REFLECTED] += lost_reflected
    ledger[OFF_SCREEN] += lost_off
    ledger[LEAVING] += leaving


@njit(**_OPTIONS)
def _backward_row(grad, grad_leaving, sag, gx, gy, x, y, share, real, whole, tables, by_sag, by_gx, by_gy, work):
    """Adjoint of `_forward_row`: derivatives by sag, gx, gy of one row, from those by the padded image and leaving power."""
    n, height, half_x, half_y = real[0], real[1], real[2], real[3]
    pixel_x, pixel_y, alpha_x, alpha_y = real[4], real[5], real[6], real[7]
    fresnel, nx, ny, kind, vx, vy = whole[0], whole[1], whole[2], whole[3], whole[4], whole[5]
    entrance = _entrance(fresnel, n)
    sx, sy, dx, dy = work[0], work[1], work[2], work[3]
    rx, ry = (vx - 1) // 2, (vy - 1) // 2
    for j in range(len(sag)):
        slope_x, slope_y = gx[j], gy[j]
        passes, m, dm, through, dthrough = _bend(fresnel, slope_x, slope_y, n)
        if not passes:
            by_sag[j], by_gx[j], by_gy[j] = 0.0, 0.0, 0.0
            continue
        inside = share[j] * (1.0 - entrance)
        weight = inside * through
        h = height - sag[j]
        reach = h * m
        in_x, i0, phi_x = _pixel(x[j] + reach * slope_x, half_x, pixel_x, nx, rx)
        in_y, j0, phi_y = _pixel(y[j] + reach * slope_y, half_y, pixel_y, ny, ry)
        by_weight, by_x, by_y = grad_leaving, 0.0, 0.0
        if in_x and in_y and h > 0.0:
            shares(kind, phi_x, vx, alpha_x, tables[0], sx, dx, True)
            shares(kind, phi_y, vy, alpha_y, tables[1], sy, dy, True)
            for a in range(vx):
                along, across = 0.0, 0.0
                for b in range(vy):
                    g = grad[i0 + a, j0 + b]
                    along += g * sy[b]
                    across += g * dy[b]
                by_weight += sx[a] * along
                by_x += dx[a] * along
                by_y += sx[a] * across
            by_x *= weight / pixel_x
            by_y *= weight / pixel_y
        dot = by_x * slope_x + by_y * slope_y
        by_a = h * dm * dot + by_weight * inside * dthrough
        by_sag[j] = -m * dot
        by_gx[j] = reach * by_x + 2.0 * slope_x * by_a
        by_gy[j] = reach * by_y + 2.0 * slope_y * by_a


@njit(**_OPTIONS)
def _tangent_row(t_sag, t_gx, t_gy, sag, gx, gy, x, y, share, real, whole, tables, image, work):
    """Add the tangent of one row's image along (t_sag, t_gx, t_gy) to `image`; returns the leaving power's."""
    n, height, half_x, half_y = real[0], real[1], real[2], real[3]
    pixel_x, pixel_y, alpha_x, alpha_y = real[4], real[5], real[6], real[7]
    fresnel, nx, ny, kind, vx, vy = whole[0], whole[1], whole[2], whole[3], whole[4], whole[5]
    entrance = _entrance(fresnel, n)
    sx, sy, dx, dy = work[0], work[1], work[2], work[3]
    rx, ry = (vx - 1) // 2, (vy - 1) // 2
    leaving = 0.0
    for j in range(len(sag)):
        slope_x, slope_y = gx[j], gy[j]
        passes, m, dm, through, dthrough = _bend(fresnel, slope_x, slope_y, n)
        if not passes:
            continue
        inside = share[j] * (1.0 - entrance)
        weight = inside * through
        da = 2.0 * (slope_x * t_gx[j] + slope_y * t_gy[j])
        dw = inside * dthrough * da
        leaving += dw
        h = height - sag[j]
        reach = h * m
        d_reach = -t_sag[j] * m + h * dm * da
        in_x, i0, phi_x = _pixel(x[j] + reach * slope_x, half_x, pixel_x, nx, rx)
        in_y, j0, phi_y = _pixel(y[j] + reach * slope_y, half_y, pixel_y, ny, ry)
        if not (in_x and in_y and h > 0.0):
            continue
        shares(kind, phi_x, vx, alpha_x, tables[0], sx, dx, True)
        shares(kind, phi_y, vy, alpha_y, tables[1], sy, dy, True)
        move_x = weight * (d_reach * slope_x + reach * t_gx[j]) / pixel_x
        move_y = weight * (d_reach * slope_y + reach * t_gy[j]) / pixel_y
        for a in range(vx):
            along, across = dw * sx[a] + move_x * dx[a], move_y * sx[a]
            for b in range(vy):
                image[i0 + a, j0 + b] += along * sy[b] + across * dy[b]
    return leaving


@njit(inline="always", **_OPTIONS)
def _combine(i, first, bu, du, net, net_x, net_y, sag, gx, gy):
    """Row i of the surface from the nets already contracted along v: sag, dz/dx, dz/dy (b,)."""
    sag[:] = 0.0
    gx[:] = 0.0
    gy[:] = 0.0
    for a in range(bu.shape[1]):
        value, slope = bu[i, a], du[i, a]
        row, row_x, row_y = net[first[i] + a], net_x[first[i] + a], net_y[first[i] + a]
        for j in range(len(sag)):
            sag[j] += value * row[j]
            gx[j] += slope * row_x[j]
            gy[j] += value * row_y[j]


@njit(**_OPTIONS)
def _spread(i, first, bu, du, by_sag, by_gx, by_gy, nets):
    """Adjoint of `_combine`: add the derivatives by row i to those by the nets (3, n, b)."""
    for a in range(bu.shape[1]):
        value, slope, at = bu[i, a], du[i, a], first[i] + a
        out, out_x, out_y = nets[0, at], nets[1, at], nets[2, at]
        for j in range(len(by_sag)):
            out[j] += value * by_sag[j]
            out_x[j] += slope * by_gx[j]
            out_y[j] += value * by_gy[j]


@njit(**_OPTIONS)
def _entrance(fresnel, n):
    """Reflectance of the flat entrance at normal incidence."""
    return 0.0 if fresnel == NONE else (n - 1.0) * (n - 1.0) / ((n + 1.0) * (n + 1.0))


@njit(**_OPTIONS)
def _tables(real, whole):
    """Constants of the filter along x and y: (2, as many as the longer needs)."""
    out = np.zeros((2, 2 * max(whole[4], whole[5]) + 3))
    for axis in range(2):
        constants = table(whole[3], whole[4 + axis], real[6 + axis])
        out[axis, : len(constants)] = constants
    return out


@njit(parallel=True, **_OPTIONS)
def _total(images):
    """Sum over blocks, in order, into the first."""
    for i in prange(images.shape[1]):
        for block in range(1, images.shape[0]):
            for j in range(images.shape[2]):
                images[0, i, j] += images[block, i, j]
    return images[0]


@njit(parallel=True, **_OPTIONS)
def forward(first, bu, du, net, net_x, net_y, x, y, share, real, whole, blocks):
    """Padded image (n_x + 4 r_x, n_y + 4 r_y) and the ledger (4,): fresnel, reflected, off_screen, leaving.

    The surface comes by rows.  Row i of the sag is sum_k bu[i, k] net[first[i] + k], of dz/dx the same with du and net_x,
    of dz/dy with bu and net_y.  first (a,) int64; bu, du (a, p + 1); nets (n, b); x, y mm and share, parts of the
    source's power, (a, b).
    real: index, height of the screen above the sag's zero, half width and height of the screen and of a pixel (mm), alpha
    along x and y (per pixel squared).  whole: kind of Fresnel losses, pixels along x and y, kind of filter, its sizes.
    """
    tables, longest = _tables(real, whole), max(whole[4], whole[5])
    wide, high = whole[1] + 2 * (whole[4] - 1), whole[2] + 2 * (whole[5] - 1)
    rows, columns = x.shape
    images = np.zeros((blocks, wide, high))
    ledgers = np.zeros((blocks, 4))
    for block in prange(blocks):
        sag, gx, gy = np.empty(columns, net.dtype), np.empty(columns, net.dtype), np.empty(columns, net.dtype)
        work = np.empty((4, longest))
        for i in range(block * rows // blocks, (block + 1) * rows // blocks):
            _combine(i, first, bu, du, net, net_x, net_y, sag, gx, gy)
            _forward_row(sag, gx, gy, x[i], y[i], share[i], real, whole, tables, images[block], ledgers[block], work)
    ledger = np.zeros(4)
    for block in range(blocks):
        ledger += ledgers[block]
    return _total(images), ledger


@njit(parallel=True, **_OPTIONS)
def backward(grad, grad_leaving, apart, first, bu, du, net, net_x, net_y, x, y, share, real, whole, blocks):
    """Adjoint of `forward`: derivatives by the three nets (n, b) float64, from those by the padded image and leaving power.

    apart: no two rows share a row of the nets, so that one sum serves all blocks.
    """
    tables, longest = _tables(real, whole), max(whole[4], whole[5])
    rows, columns = x.shape
    nets = np.zeros((3, 1 if apart else blocks, net.shape[0], columns))
    for block in prange(blocks):
        sag, gx, gy = np.empty(columns, net.dtype), np.empty(columns, net.dtype), np.empty(columns, net.dtype)
        by_sag, by_gx, by_gy = np.empty(columns), np.empty(columns), np.empty(columns)
        work = np.empty((4, longest))
        for i in range(block * rows // blocks, (block + 1) * rows // blocks):
            _combine(i, first, bu, du, net, net_x, net_y, sag, gx, gy)
            _backward_row(grad, grad_leaving, sag, gx, gy, x[i], y[i], share[i], real, whole, tables,
                          by_sag, by_gx, by_gy, work)
            _spread(i, first, bu, du, by_sag, by_gx, by_gy, nets[:, np.int64(0) if apart else np.int64(block)])
    return _total(nets[0]), _total(nets[1]), _total(nets[2])


@njit(parallel=True, **_OPTIONS)
def tangent(t_net, t_net_x, t_net_y, first, bu, du, net, net_x, net_y, x, y, share, real, whole, blocks):
    """Derivative of `forward` along (t_net, t_net_x, t_net_y): the padded image's tangent, and the leaving power's."""
    tables, longest = _tables(real, whole), max(whole[4], whole[5])
    wide, high = whole[1] + 2 * (whole[4] - 1), whole[2] + 2 * (whole[5] - 1)
    rows, columns = x.shape
    images = np.zeros((blocks, wide, high))
    leaving = np.zeros(blocks)
    for block in prange(blocks):
        sag, gx, gy = np.empty(columns, net.dtype), np.empty(columns, net.dtype), np.empty(columns, net.dtype)
        t_sag, t_gx, t_gy = np.empty(columns, net.dtype), np.empty(columns, net.dtype), np.empty(columns, net.dtype)
        work = np.empty((4, longest))
        for i in range(block * rows // blocks, (block + 1) * rows // blocks):
            _combine(i, first, bu, du, net, net_x, net_y, sag, gx, gy)
            _combine(i, first, bu, du, t_net, t_net_x, t_net_y, t_sag, t_gx, t_gy)
            leaving[block] += _tangent_row(t_sag, t_gx, t_gy, sag, gx, gy, x[i], y[i], share[i], real, whole,
                                           tables, images[block], work)
    return _total(images), leaving.sum()
