"""Fused CPU kernel: refraction at the exit surface -> landing point -> splat, with its adjoint.

It combines the stages of `optics.trace`, row by row of rays without intermediate storage; the plain-torch backend is its reference.
Everything is float64, since float32 was no faster.

Each of a fixed number of blocks of rows accumulates an image of its own, and these are added in order, so the result depends on the
number of blocks (threads) but not on timing.  Only the scatter to and the gather from pixels are per ray, four pixels at a time;
the rest (`rows`, `axial_refraction`, `filter_weights`) is vectorised over rows.
"""

from __future__ import annotations

import math

import numpy as np

from caustic_cli.optics.kernels import oblique_refraction
from caustic_cli.optics.kernels.arguments import Splat
from caustic_cli.optics.kernels.axial_refraction import (
    BY_GX,
    BY_GY,
    BY_POWER,
    BY_PX,
    BY_PY,
    BY_SAG,
    FLUX,
    GX,
    GY,
    LEAN_X,
    LEAN_Y,
    OVER_X,
    OVER_Y,
    PHI,
    POWER,
    PX,
    PY,
    REACH,
    SAG,
    SCRATCH,
    VECTORS,
    X,
    Y,
    fraction,
    landing,
    load,
    powers,
    pull,
    reach,
)
from caustic_cli.optics.kernels.filter_weights import pixel_weights
from caustic_cli.optics.kernels.jit import FAST, njit
from caustic_cli.optics.kernels.pixels import FOUR, ONE, THREE, TWO, UINT, limits
from caustic_cli.optics.kernels.rows import combine, spread
from caustic_cli.optics.kernels.threads import ALL, on_threads

FRESNEL, REFLECTED, OFF_SCREEN, LEAVING, MISSED, COLUMNS = range(6)  # of the ledger


@njit(inline="always", **FAST)
def carry(v, exit_, frame):
    """Powers and landing points of a row of rays along z, from SAG, GX, GY, FLUX, X and Y."""
    n, height, fresnel = exit_.index, exit_.height, exit_.fresnel
    powers(fresnel, v[GX], v[GY], v[FLUX], n, v[POWER])
    reach(v[SAG], v[GX], v[GY], n, height, v[REACH])
    landing(v[REACH], v[GX], v[X], frame.low_x, frame.pixel_x, v[PX])
    landing(v[REACH], v[GY], v[Y], frame.low_y, frame.pixel_y, v[PY])


@njit(inline="always", **FAST)
def _bend(v, i, surface, rays, exit_, frame):
    """The surface, powers and landing points of row i, of rays along z."""
    (first, bu, du, net, net_x, net_y), (x, y, _, _, flux) = surface, rays
    combine(i, first, bu, du, net, net_x, net_y, v[SAG], v[GX], v[GY])
    load(flux[i], v[FLUX])
    load(x[i], v[X])
    load(y[i], v[Y])
    carry(v, exit_, frame)


@njit(inline="always", **FAST)
def _oblique(i, surface, rays):
    """Row i in the format of `oblique_refraction`: each oblique ray has its own distance and slopes, without a contraction."""
    (_, _, _, net, net_x, net_y), (_, _, along_x, along_y, flux) = surface, rays
    return net[i], net_x[i], net_y[i], along_x[i], along_y[i], flux[i]


@njit(inline="always", **FAST)
def share(v, splat, sx, sy, dx, dy):
    """Filter weights of one row's rays, and their derivatives unless dx and dy are empty."""
    scratch = v[VECTORS:]
    if splat.size_x > 1:
        fraction(v[PX], v[PHI])
    pixel_weights(splat.kind, splat.size_x, splat.alpha_x, v[PHI], sx, dx, v[OVER_X], v[LEAN_X], scratch)
    if splat.size_y > 1:
        fraction(v[PY], v[PHI])
    pixel_weights(splat.kind, splat.size_y, splat.alpha_y, v[PHI], sy, dy, v[OVER_Y], v[LEAN_Y], scratch)


@njit(**FAST)
def _scatter(vectors, exit_, frame, splat, sx, sy, image, ledger, column):
    """Add one row's rays to the padded image and the ledger.  column: (longest v,) scratch."""
    # Everything the loop needs is a local: after a store to the image the compiler would have to read an array again.
    vx, vy, height = splat.size_x, splat.size_y, exit_.height
    rx, ry, low_x, low_y, high_x, high_y = limits(frame.pixels_x, frame.pixels_y, vx, vy)
    sag, flux, power, px, py = vectors[SAG], vectors[FLUX], vectors[POWER], vectors[PX], vectors[PY]
    over_x, over_y = vectors[OVER_X], vectors[OVER_Y]
    lost_fresnel, lost_reflected, lost_off, lost_missed, leaving = 0.0, 0.0, 0.0, 0.0, 0.0
    for j in range(len(power)):
        emitted, weight = flux[j], power[j]
        if weight < 0.0:
            if weight == oblique_refraction.MISSED_POWER:
                lost_missed += emitted
            else:
                lost_reflected += emitted
            continue
        lost_fresnel += emitted - weight
        leaving += weight
        x, y = px[j], py[j]
        if not (x >= low_x and x < high_x and y >= low_y and y < high_y and height > sag[j]):  # False for NaN too
            lost_off += weight
            continue
        weight *= over_x[j] * over_y[j]
        i0, j0 = math.floor(x) + rx, math.floor(y) + ry
        if vx == 3 and vy == 3:
            i, k, b0, b1, b2 = UINT(i0), UINT(j0), sy[0, j], sy[1, j], sy[2, j]
            for a in range(3):
                part = weight * sx[a, j]
                image[i, k] += part * b0
                image[i, k + ONE] += part * b1
                image[i, k + TWO] += part * b2
                i += ONE
            continue
        for b in range(vy):
            column[b] = weight * sy[b, j]
        i = UINT(i0)
        for a in range(vx):
            part, k = sx[a, j], UINT(j0)
            for b in range(0, len(column), 4):
                b = UINT(b)
                c0, c1, c2, c3 = column[b], column[b + ONE], column[b + TWO], column[b + THREE]
                p0, p1, p2, p3 = image[i, k], image[i, k + ONE], image[i, k + TWO], image[i, k + THREE]
                image[i, k] = p0 + part * c0
                image[i, k + ONE] = p1 + part * c1
                image[i, k + TWO] = p2 + part * c2
                image[i, k + THREE] = p3 + part * c3
                k += FOUR
            i += ONE
    ledger[FRESNEL] += lost_fresnel
    ledger[REFLECTED] += lost_reflected
    ledger[OFF_SCREEN] += lost_off
    ledger[LEAVING] += leaving
    ledger[MISSED] += lost_missed


@njit(**FAST)
def gather(vectors, exit_, frame, splat, sx, sy, dx, dy, grad, grad_leaving, column, tilt):
    """Derivatives by each ray's power and pixel coordinates, from those by the padded image."""
    vx, vy, height, scale_x, scale_y = splat.size_x, splat.size_y, exit_.height, 1.0 / frame.pixel_x, 1.0 / frame.pixel_y
    rx, ry, low_x, low_y, high_x, high_y = limits(frame.pixels_x, frame.pixels_y, vx, vy)
    sag, power, px, py = vectors[SAG], vectors[POWER], vectors[PX], vectors[PY]
    by_power, by_px, by_py = vectors[BY_POWER], vectors[BY_PX], vectors[BY_PY]
    over_x, over_y, lean_x, lean_y = vectors[OVER_X], vectors[OVER_Y], vectors[LEAN_X], vectors[LEAN_Y]
    for j in range(len(power)):
        weight = power[j]
        value, along_x, along_y = 0.0, 0.0, 0.0
        x, y = px[j], py[j]
        if weight >= 0.0 and x >= low_x and x < high_x and y >= low_y and y < high_y and height > sag[j]:
            i0, j0 = math.floor(x) + rx, math.floor(y) + ry
            if vx == 3 and vy == 3:
                i, k = UINT(i0), UINT(j0)
                b0, b1, b2, d0, d1, d2 = sy[0, j], sy[1, j], sy[2, j], dy[0, j], dy[1, j], dy[2, j]
                for a in range(3):
                    g0, g1, g2 = grad[i, k], grad[i, k + ONE], grad[i, k + TWO]
                    i += ONE
                    along = g0 * b0 + g1 * b1 + g2 * b2
                    value += sx[a, j] * along
                    along_x += dx[a, j] * along
                    along_y += sx[a, j] * (g0 * d0 + g1 * d1 + g2 * d2)
            else:
                for b in range(vy):
                    column[b], tilt[b] = sy[b, j], dy[b, j]
                i = UINT(i0)
                for a in range(vx):
                    k = UINT(j0)
                    a0, a1, a2, a3, t0, t1, t2, t3 = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
                    for b in range(0, len(column), 4):
                        b = UINT(b)
                        g0, g1, g2, g3 = grad[i, k], grad[i, k + ONE], grad[i, k + TWO], grad[i, k + THREE]
                        a0 += g0 * column[b]
                        a1 += g1 * column[b + ONE]
                        a2 += g2 * column[b + TWO]
                        a3 += g3 * column[b + THREE]
                        t0 += g0 * tilt[b]
                        t1 += g1 * tilt[b + ONE]
                        t2 += g2 * tilt[b + TWO]
                        t3 += g3 * tilt[b + THREE]
                        k += FOUR
                    i += ONE
                    along, across = (a0 + a2) + (a1 + a3), (t0 + t2) + (t1 + t3)
                    value += sx[a, j] * along
                    along_x += dx[a, j] * along
                    along_y += sx[a, j] * across
            over = over_x[j] * over_y[j]
            along_x, along_y = over * (along_x - value * lean_x[j]), over * (along_y - value * lean_y[j])
            value *= over
        by_power[j], by_px[j], by_py[j] = grad_leaving + value, along_x * weight * scale_x, along_y * weight * scale_y


def scratch_rows(splat: Splat) -> int:
    """Number of rows of a block's scratch memory."""
    return VECTORS + SCRATCH + 2 * (splat.size_x + splat.size_y)


@njit(inline="always", **FAST)
def _cut(scratch, vx, vy):
    """A block's scratch as vectors, weights along x and y, their slopes."""
    a = VECTORS + SCRATCH
    b, c, d = a + vx, a + vx + vy, a + 2 * vx + vy
    return scratch[:a], scratch[a:b], scratch[b:c], scratch[c:d], scratch[d:]


@njit(entry=True, **FAST)
def forward(
    block, images, ledgers, scratch, first, bu, du, net, net_x, net_y, x, y, along_x, along_y, flux, exit_, frame, splat, oblique
):
    """Ledgers (blocks, COLUMNS) of the losses, and partial images, whose `pixels.total` is the padded image.

    The surface comes by rows.  Row i of the sag is sum_k bu[i, k] net[first[i] + k], of dz/dx the same with du and net_x,
    of dz/dy with bu and net_y.  first (a,) int64; bu, du (a, p + 1); nets (n, b); x, y mm and flux, parts of the
    source's power, (a, b).

    images (blocks, n_x + 4 r_x, n_y + 4 r_y, and -v_y % 4 more), ledgers and scratch (blocks, `scratch_rows`, b) are overwritten;
    they set the number of blocks.

    exit_, frame, splat: an `Exit`, a `ScreenFrame` and a `Splat`.  Of oblique rays `along_x` and `along_y` (a, b) are their
    directions' components, and instead of the sag comes the distance along them to the surface; each has a net's number to
    itself, (a, b), whatever first, bu and du are.  oblique: True for them, None for rays along z, which are compiled apart.
    """
    if block == ALL:
        on_threads(
            len(images),
            (
                images,
                ledgers,
                scratch,
                first,
                bu,
                du,
                net,
                net_x,
                net_y,
                x,
                y,
                along_x,
                along_y,
                flux,
                exit_,
                frame,
                splat,
                oblique,
            ),
        )
        return
    rows, blocks = len(x), len(images)
    vx, vy = splat.size_x, splat.size_y
    images[block] = 0.0
    ledgers[block] = 0.0
    v, sx, sy, dx, dy = _cut(scratch[block], vx, vy)
    column = np.zeros(vy + -vy % 4)
    for i in range(block * rows // blocks, (block + 1) * rows // blocks):
        surface, rays = (first, bu, du, net, net_x, net_y), (x, y, along_x, along_y, flux)
        if oblique is None:
            _bend(v, i, surface, rays, exit_, frame)
        else:
            oblique_refraction.aim(v, _oblique(i, surface, rays), x[i], y[i], exit_, frame)
        share(v, splat, sx, sy, dx[:0], dy[:0])
        _scatter(v, exit_, frame, splat, sx, sy, images[block], ledgers[block], column)


@njit(entry=True, **FAST)
def backward(
    block,
    grad,
    grad_leaving,
    apart,
    nets,
    scratch,
    first,
    bu,
    du,
    net,
    net_x,
    net_y,
    x,
    y,
    along_x,
    along_y,
    flux,
    exit_,
    frame,
    splat,
    oblique,
):
    """Adjoint of `forward`: derivatives by the three nets, from those by the padded image and leaving power.

    nets (3, 1 if apart else blocks, n, b) are overwritten: the `pixels.total` of each is the derivative by a net (n, b).

    apart: no two rows share a row of the nets, so that a single sum suffices for all blocks.  Otherwise net_x is taken to be net
    itself, and the sum of both derivatives comes as the first.  scratch: overwritten, as in `forward`.
    """
    if block == ALL:
        if apart and oblique is None:
            nets[:] = 0.0
        on_threads(
            len(scratch),
            (
                grad,
                grad_leaving,
                apart,
                nets,
                scratch,
                first,
                bu,
                du,
                net,
                net_x,
                net_y,
                x,
                y,
                along_x,
                along_y,
                flux,
                exit_,
                frame,
                splat,
                oblique,
            ),
        )
        return
    rows, blocks = len(x), len(scratch)
    vx, vy = splat.size_x, splat.size_y
    if not apart:
        nets[:, block] = 0.0
    v, sx, sy, dx, dy = _cut(scratch[block], vx, vy)
    column, tilt = np.zeros(vy + -vy % 4), np.zeros(vy + -vy % 4)
    for i in range(block * rows // blocks, (block + 1) * rows // blocks):
        surface, rays = (first, bu, du, net, net_x, net_y), (x, y, along_x, along_y, flux)
        if oblique is None:
            _bend(v, i, surface, rays, exit_, frame)
        else:
            oblique_refraction.aim(v, _oblique(i, surface, rays), x[i], y[i], exit_, frame)
        share(v, splat, sx, sy, dx, dy)
        gather(v, exit_, frame, splat, sx, sy, dx, dy, grad, grad_leaving, column, tilt)
        if oblique is not None:
            oblique_refraction.pull(v, _oblique(i, surface, rays), exit_, nets[0, 0, i], nets[1, 0, i], nets[2, 0, i])
            continue
        pull(v, exit_)
        spread(i, first, bu, du, v[BY_SAG], v[BY_GX], v[BY_GY], nets[:, 0 if apart else block], apart)
