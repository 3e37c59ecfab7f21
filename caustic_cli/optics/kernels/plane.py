"""Fused CPU kernel: refraction at the exit surface -> landing point -> splat, with its adjoint and its tangent.

The function of `tracing.trace_plane` followed by `reconstruction.splat`, a row of rays at a time without storing anything
between rows; both are the reference it is tested against.  Storage is float32 or float64, everything past the surface
float64.

Each of a fixed number of blocks of rows has an image of its own and they are added in order, so the result does not depend
on timing, only on the number of blocks (the number of threads).  Only the scatter and the gather of pixels go ray by ray; the
rest (`bend`, `shares`) goes a row at a time in vector instructions.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit, prange

from caustic_cli.optics.kernels.bend import (
    BY_POWER,
    BY_PX,
    BY_PY,
    GX,
    GY,
    PHI,
    POWER,
    PX,
    PY,
    REACH,
    SAG,
    SCRATCH,
    T_GX,
    T_GY,
    T_POWER,
    T_SAG,
    VECTORS,
    entrance,
    fraction,
    landing,
    powers,
    pull,
    push,
    reach,
)
from caustic_cli.optics.kernels.shares import OPTIONS, shares

FRESNEL, REFLECTED, OFF_SCREEN, LEAVING = 0, 1, 2, 3  # columns of the ledger


@njit(**OPTIONS)
def _aim(vectors, x, y, share, real, whole, sx, sy, dx, dy, sloping):
    """Powers, landing points and shares of one row, from its surface in `vectors`."""
    n, height, fresnel, kind = real[0], real[1], whole[0], whole[3]
    inside = 1.0 - entrance(fresnel, n)
    v, scratch = vectors, vectors[VECTORS:]
    powers(fresnel, v[GX], v[GY], share, n, inside, v[POWER])
    reach(v[SAG], v[GX], v[GY], n, height, v[REACH])
    landing(v[REACH], v[GX], x, real[2], real[4], v[PX])
    landing(v[REACH], v[GY], y, real[3], real[5], v[PY])
    if whole[4] > 1:
        fraction(v[PX], v[PHI])
    shares(kind, whole[4], real[6], v[PHI], sx, dx, scratch, sloping)
    if whole[5] > 1:
        fraction(v[PY], v[PHI])
    shares(kind, whole[5], real[7], v[PHI], sy, dy, scratch, sloping)


@njit(**OPTIONS)
def _scatter(vectors, share, real, whole, sx, sy, image, ledger, column):
    """Add one row's rays to the padded image and the ledger.  column: (longest v,) scratch."""
    # Everything the loop needs is a local: after a store to the image the compiler would have to read an array again.
    lost_before, vx, vy, height = entrance(whole[0], real[0]), whole[4], whole[5], real[1]
    rx, ry = (vx - 1) // 2, (vy - 1) // 2
    low_x, low_y, high_x, high_y = float(-rx), float(-ry), float(whole[1] + rx), float(whole[2] + ry)
    sag, power, px, py = vectors[SAG], vectors[POWER], vectors[PX], vectors[PY]
    lost_fresnel, lost_reflected, lost_off, leaving = 0.0, 0.0, 0.0, 0.0
    for j in range(len(power)):
        emitted, weight = share[j], power[j]
        if weight < 0.0:
            inside = emitted * (1.0 - lost_before)
            lost_fresnel += emitted - inside
            lost_reflected += inside
            continue
        lost_fresnel += emitted - weight
        leaving += weight
        x, y = px[j], py[j]
        if not (x >= low_x and x < high_x and y >= low_y and y < high_y and height > sag[j]):  # False for NaN too
            lost_off += weight
            continue
        i0, j0 = math.floor(x) + rx, math.floor(y) + ry
        if vx == 3 and vy == 3:
            b0, b1, b2 = sy[0, j], sy[1, j], sy[2, j]
            for a in range(3):
                part, row = weight * sx[a, j], image[i0 + a]
                row[j0] += part * b0
                row[j0 + 1] += part * b1
                row[j0 + 2] += part * b2
            continue
        for b in range(vy):
            column[b] = weight * sy[b, j]
        for a in range(vx):
            part, row = sx[a, j], image[i0 + a, j0 : j0 + vy]
            for b in range(vy):
                row[b] += part * column[b]
    ledger[FRESNEL] += lost_fresnel
    ledger[REFLECTED] += lost_reflected
    ledger[OFF_SCREEN] += lost_off
    ledger[LEAVING] += leaving


@njit(**OPTIONS)
def _gather(vectors, real, whole, sx, sy, dx, dy, grad, grad_leaving, column, tilt):
    """Derivatives by each ray's power and pixel coordinates, from those by the padded image."""
    vx, vy, height, scale_x, scale_y = whole[4], whole[5], real[1], 1.0 / real[4], 1.0 / real[5]
    rx, ry = (vx - 1) // 2, (vy - 1) // 2
    low_x, low_y, high_x, high_y = float(-rx), float(-ry), float(whole[1] + rx), float(whole[2] + ry)
    sag, power, px, py = vectors[SAG], vectors[POWER], vectors[PX], vectors[PY]
    by_power, by_px, by_py = vectors[BY_POWER], vectors[BY_PX], vectors[BY_PY]
    for j in range(len(power)):
        weight = power[j]
        value, along_x, along_y = grad_leaving, 0.0, 0.0
        x, y = px[j], py[j]
        if weight >= 0.0 and x >= low_x and x < high_x and y >= low_y and y < high_y and height > sag[j]:
            i0, j0 = math.floor(x) + rx, math.floor(y) + ry
            if vx == 3 and vy == 3:
                b0, b1, b2, d0, d1, d2 = sy[0, j], sy[1, j], sy[2, j], dy[0, j], dy[1, j], dy[2, j]
                for a in range(3):
                    row = grad[i0 + a]
                    g0, g1, g2 = row[j0], row[j0 + 1], row[j0 + 2]
                    along = g0 * b0 + g1 * b1 + g2 * b2
                    value += sx[a, j] * along
                    along_x += dx[a, j] * along
                    along_y += sx[a, j] * (g0 * d0 + g1 * d1 + g2 * d2)
            else:
                for b in range(vy):
                    column[b], tilt[b] = sy[b, j], dy[b, j]
                for a in range(vx):
                    along, across, row = 0.0, 0.0, grad[i0 + a, j0 : j0 + vy]
                    for b in range(vy):
                        along += row[b] * column[b]
                        across += row[b] * tilt[b]
                    value += sx[a, j] * along
                    along_x += dx[a, j] * along
                    along_y += sx[a, j] * across
        by_power[j], by_px[j], by_py[j] = value, along_x * weight * scale_x, along_y * weight * scale_y


@njit(**OPTIONS)
def _scatter_tangent(vectors, real, whole, sx, sy, dx, dy, image):
    """Add the tangent of one row's image; returns the leaving power's."""
    vx, vy = whole[4], whole[5]
    rx, ry = (vx - 1) // 2, (vy - 1) // 2
    low_x, low_y, high_x, high_y = float(-rx), float(-ry), float(whole[1] + rx), float(whole[2] + ry)
    v, leaving, height = vectors, 0.0, real[1]
    for j in range(v.shape[1]):
        weight, change = v[POWER, j], v[T_POWER, j]
        if weight < 0.0:
            continue
        leaving += change
        x, y = v[PX, j], v[PY, j]
        if not (x >= low_x and x < high_x and y >= low_y and y < high_y and height > v[SAG, j]):
            continue
        i0, j0 = math.floor(x) + rx, math.floor(y) + ry
        move_x, move_y = weight * v[BY_PX, j], weight * v[BY_PY, j]
        for a in range(vx):
            along, across = change * sx[a, j] + move_x * dx[a, j], move_y * sx[a, j]
            for b in range(vy):
                image[i0 + a, j0 + b] += along * sy[b, j] + across * dy[b, j]
    return leaving


@njit(**OPTIONS)
def _add(weight, row, out):
    for j in range(len(out)):
        out[j] += weight * row[j]


@njit(**OPTIONS)
def _weighted(weights, net, first, out):
    """Weighted sum of consecutive rows of a net, three at a time: a pass over `out` costs as much as the products."""
    out[:] = 0.0
    a, count = 0, len(weights)
    while a + 2 < count:
        p, q, r = net[first + a], net[first + a + 1], net[first + a + 2]
        for j in range(len(out)):
            out[j] += weights[a] * p[j] + weights[a + 1] * q[j] + weights[a + 2] * r[j]
        a += 3
    while a < count:
        _add(weights[a], net[first + a], out)
        a += 1


@njit(**OPTIONS)
def _combine(i, first, bu, du, net, net_x, net_y, sag, gx, gy):
    """Row i of the surface from the nets already contracted along v: sag, dz/dx, dz/dy (b,)."""
    _weighted(bu[i], net, first[i], sag)
    _weighted(du[i], net_x, first[i], gx)
    _weighted(bu[i], net_y, first[i], gy)


@njit(**OPTIONS)
def _spread(i, first, bu, du, by_sag, by_gx, by_gy, nets, apart):
    """Adjoint of `_combine`: add the derivatives by row i to those by the nets (3, n, b)."""
    for a in range(bu.shape[1]):
        if apart:
            _add(bu[i, a], by_sag, nets[0, first[i] + a])
            _add(du[i, a], by_gx, nets[1, first[i] + a])
        else:
            value, slope, out = bu[i, a], du[i, a], nets[0, first[i] + a]
            for j in range(len(out)):
                out[j] += value * by_sag[j] + slope * by_gx[j]
        _add(bu[i, a], by_gy, nets[2, first[i] + a])


@njit(parallel=True, **OPTIONS)
def _total(images):
    """Sum over blocks, in order, into the first."""
    for i in prange(images.shape[1]):
        for block in range(1, images.shape[0]):
            for j in range(images.shape[2]):
                images[0, i, j] += images[block, i, j]
    return images[0]


@njit(parallel=True, **OPTIONS)
def forward(first, bu, du, net, net_x, net_y, x, y, share, real, whole, blocks):
    """Padded image (n_x + 4 r_x, n_y + 4 r_y) and the ledger (4,): fresnel, reflected, off_screen, leaving.

    The surface comes by rows.  Row i of the sag is sum_k bu[i, k] net[first[i] + k], of dz/dx the same with du and net_x,
    of dz/dy with bu and net_y.  first (a,) int64; bu, du (a, p + 1); nets (n, b); x, y mm and share, parts of the
    source's power, (a, b).

    real: index, height of the screen above the sag's zero, half width and height of the screen and of a pixel (mm), alpha
    along x and y (per pixel squared).  whole: kind of Fresnel losses, pixels along x and y, kind of filter, its sizes.
    """
    rows, columns = x.shape
    vx, vy = whole[4], whole[5]
    images = np.zeros((blocks, whole[1] + 2 * (vx - 1), whole[2] + 2 * (vy - 1)))
    ledgers = np.zeros((blocks, 4))
    for block in prange(blocks):
        v = np.zeros((VECTORS + SCRATCH, columns))
        sx, sy, column = np.empty((vx, columns)), np.empty((vy, columns)), np.empty(max(vx, vy))
        for i in range(block * rows // blocks, (block + 1) * rows // blocks):
            _combine(i, first, bu, du, net, net_x, net_y, v[SAG], v[GX], v[GY])
            _aim(v, x[i], y[i], share[i], real, whole, sx, sy, sx, sy, False)
            _scatter(v, share[i], real, whole, sx, sy, images[block], ledgers[block], column)
    ledger = np.zeros(4)
    for block in range(blocks):
        ledger += ledgers[block]
    return _total(images), ledger


@njit(parallel=True, **OPTIONS)
def backward(grad, grad_leaving, apart, first, bu, du, net, net_x, net_y, x, y, share, real, whole, blocks):
    """Adjoint of `forward`: derivatives by the three nets (n, b) float64, from those by the padded image and leaving power.

    apart: no two rows share a row of the nets, so that one sum serves all blocks.  Otherwise net_x is taken to be net
    itself, and the sum of both derivatives comes as the first.
    """
    rows, columns = x.shape
    vx, vy = whole[4], whole[5]
    nets = np.zeros((3, 1 if apart else blocks, net.shape[0], columns))
    for block in prange(blocks):
        v = np.zeros((VECTORS + SCRATCH, columns))
        sx, sy, dx, dy = np.empty((vx, columns)), np.empty((vy, columns)), np.empty((vx, columns)), np.empty((vy, columns))
        column, tilt = np.empty(max(vx, vy)), np.empty(max(vx, vy))
        for i in range(block * rows // blocks, (block + 1) * rows // blocks):
            _combine(i, first, bu, du, net, net_x, net_y, v[SAG], v[GX], v[GY])
            _aim(v, x[i], y[i], share[i], real, whole, sx, sy, dx, dy, True)
            _gather(v, real, whole, sx, sy, dx, dy, grad, grad_leaving, column, tilt)
            pull(v, share[i], real, whole)
            _spread(i, first, bu, du, v[T_SAG], v[T_GX], v[T_GY], nets[:, np.int64(0) if apart else np.int64(block)],
                    apart)
    return _total(nets[0]), _total(nets[1]), _total(nets[2])


@njit(parallel=True, **OPTIONS)
def tangent(t_net, t_net_x, t_net_y, first, bu, du, net, net_x, net_y, x, y, share, real, whole, blocks):
    """Derivative of `forward` along (t_net, t_net_x, t_net_y): the padded image's tangent, and the leaving power's."""
    rows, columns = x.shape
    vx, vy = whole[4], whole[5]
    images = np.zeros((blocks, whole[1] + 2 * (vx - 1), whole[2] + 2 * (vy - 1)))
    leaving = np.zeros(blocks)
    for block in prange(blocks):
        v = np.zeros((VECTORS + SCRATCH, columns))
        sx, sy, dx, dy = np.empty((vx, columns)), np.empty((vy, columns)), np.empty((vx, columns)), np.empty((vy, columns))
        for i in range(block * rows // blocks, (block + 1) * rows // blocks):
            _combine(i, first, bu, du, net, net_x, net_y, v[SAG], v[GX], v[GY])
            _combine(i, first, bu, du, t_net, t_net_x, t_net_y, v[T_SAG], v[T_GX], v[T_GY])
            _aim(v, x[i], y[i], share[i], real, whole, sx, sy, dx, dy, True)
            push(v, share[i], real, whole)
            leaving[block] += _scatter_tangent(v, real, whole, sx, sy, dx, dy, images[block])
    return _total(images), leaving.sum()
