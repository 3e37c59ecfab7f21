"""Splatting: accumulation of landing points on pixels, with adjoint.

The fused form of `reconstruction.splat` for float64 rays.  Each of a fixed number of blocks of rays accumulates its own image, and
these are added in order, so the result depends on the number of blocks (threads) but not on timing.  Only the scatter to and the
gather from pixels are per ray, four pixels at a time; the rest is vectorised over rows of rays.

Notation, in pixels (w = 1)
    p           landing coordinate, 0 at the frame's low edge, one for x and one for y;  phi = p - floor(p)
    v           filter size;  r = (v - 1) / 2
    a_k, o      from `filter_weights`: the weight of pixel floor(p) - r + k is a_k o, with sum 1
    a'_k, l     and its derivative by p is (a'_k - a_k l) o
    W           weight of a ray, its power;  G the derivatives by the padded image's pixels
    image       sum over rays of W o_x o_y a_i a_j on the frame padded by 2 r, less its padding

by_v is the derivative of whatever is differentiated by v.
"""

from __future__ import annotations

import math

import numpy as np
from torch import Tensor

from caustic_cli.optics.kernels import blocks
from caustic_cli.optics.kernels import rows as row
from caustic_cli.optics.kernels.arguments import ScreenFrame, Splat
from caustic_cli.optics.kernels.filter_weights import pixel_weights
from caustic_cli.optics.kernels.jit import FAST, njit
from caustic_cli.optics.kernels.pixels import FOUR, ONE, THREE, TWO, UINT, limits, total
from caustic_cli.optics.kernels.stage import KernelStage, load, store
from caustic_cli.optics.kernels.threads import ALL, on_threads
from caustic_cli.optics.reconstruction import Filter, padding
from caustic_cli.scene import Screen


@njit(**FAST)
def _fraction(p, out):
    for j in range(len(out)):
        out[j] = p[j] - math.floor(p[j])


@njit(inline="always", **FAST)
def share(v, count, splat, sx, sy, dx, dy):
    """Filter weights of a batch's rays, and their derivatives unless dx and dy are empty."""
    phi = v[row.PHI][:count]
    if splat.size_x > 1:
        _fraction(v[row.PX], phi)
    over, lean = v[row.OVER_X][:count], v[row.LEAN_X][:count]
    pixel_weights(splat.kind, splat.size_x, splat.alpha_x, phi, sx, dx, over, lean, v[row.VECTORS :])
    if splat.size_y > 1:
        _fraction(v[row.PY], phi)
    over, lean = v[row.OVER_Y][:count], v[row.LEAN_Y][:count]
    pixel_weights(splat.kind, splat.size_y, splat.alpha_y, phi, sy, dy, over, lean, v[row.VECTORS :])


@njit(**FAST)
def scatter(v, count, frame, splat, sx, sy, image, column):
    """Add one row's rays to the padded image; gives the power of those outside.  column: (longest v,) scratch."""
    # Everything the loop needs is a local: after a store to the image the compiler would have to read an array again.
    vx, vy = splat.size_x, splat.size_y
    rx, ry, low_x, low_y, high_x, high_y = limits(frame.pixels_x, frame.pixels_y, vx, vy)
    px, py, power, over_x, over_y = v[row.PX], v[row.PY], v[row.POWER], v[row.OVER_X], v[row.OVER_Y]
    outside = 0.0
    for j in range(count):
        x, y, weight = px[j], py[j], power[j]
        if not (x >= low_x and x < high_x and y >= low_y and y < high_y):  # False for NaN too
            outside += weight
            continue
        weight *= over_x[j] * over_y[j]
        i, k = UINT(math.floor(x) + rx), UINT(math.floor(y) + ry)
        if vx == 3 and vy == 3:
            b0, b1, b2 = sy[0, j], sy[1, j], sy[2, j]
            for a in range(3):
                part = weight * sx[a, j]
                image[i, k] += part * b0
                image[i, k + ONE] += part * b1
                image[i, k + TWO] += part * b2
                i += ONE
            continue
        if vx == 1 and vy == 1:
            image[i, k] += weight
            continue
        for b in range(vy):
            column[b] = weight * sy[b, j]
        for a in range(vx):
            part, at = sx[a, j], k
            for b in range(0, len(column), 4):
                b = UINT(b)
                c0, c1, c2, c3 = column[b], column[b + ONE], column[b + TWO], column[b + THREE]
                p0, p1, p2, p3 = image[i, at], image[i, at + ONE], image[i, at + TWO], image[i, at + THREE]
                image[i, at] = p0 + part * c0
                image[i, at + ONE] = p1 + part * c1
                image[i, at + TWO] = p2 + part * c2
                image[i, at + THREE] = p3 + part * c3
                at += FOUR
            i += ONE
    return outside


@njit(**FAST)
def gather(v, count, frame, splat, sx, sy, dx, dy, grad, by_inside, by_outside, column, tilt):
    """Derivatives by each ray's landing point (per mm) and power, from those by the padded image, and by whatever the power of rays
    inside and outside the frame adds to.

    sum G a_i a_j, sum G a'_i a_j and sum G a_i a'_j over the pixels first; then what normalises the weights; then W and p.
    """
    vx, vy, per_x, per_y = splat.size_x, splat.size_y, 1.0 / frame.pixel_x, 1.0 / frame.pixel_y
    rx, ry, low_x, low_y, high_x, high_y = limits(frame.pixels_x, frame.pixels_y, vx, vy)
    px, py, power, by_px, by_py, by_power = v[row.PX], v[row.PY], v[row.POWER], v[row.BY_PX], v[row.BY_PY], v[row.BY_POWER]
    over_x, over_y, lean_x, lean_y = v[row.OVER_X], v[row.OVER_Y], v[row.LEAN_X], v[row.LEAN_Y]
    for j in range(count):
        x, y = px[j], py[j]
        if not (x >= low_x and x < high_x and y >= low_y and y < high_y):
            by_px[j], by_py[j], by_power[j] = 0.0, 0.0, by_outside
            continue
        value, along_x, along_y = 0.0, 0.0, 0.0
        i, k = UINT(math.floor(x) + rx), UINT(math.floor(y) + ry)
        if vx == 3 and vy == 3:
            b0, b1, b2, d0, d1, d2 = sy[0, j], sy[1, j], sy[2, j], dy[0, j], dy[1, j], dy[2, j]
            for a in range(3):
                g0, g1, g2 = grad[i, k], grad[i, k + ONE], grad[i, k + TWO]
                i += ONE
                along = g0 * b0 + g1 * b1 + g2 * b2
                value += sx[a, j] * along
                along_x += dx[a, j] * along
                along_y += sx[a, j] * (g0 * d0 + g1 * d1 + g2 * d2)
        elif vx == 1 and vy == 1:
            value = grad[i, k]
        else:
            for b in range(vy):
                column[b], tilt[b] = sy[b, j], dy[b, j]
            for a in range(vx):
                at = k
                a0, a1, a2, a3, t0, t1, t2, t3 = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
                for b in range(0, len(column), 4):
                    b = UINT(b)
                    g0, g1, g2, g3 = grad[i, at], grad[i, at + ONE], grad[i, at + TWO], grad[i, at + THREE]
                    a0 += g0 * column[b]
                    a1 += g1 * column[b + ONE]
                    a2 += g2 * column[b + TWO]
                    a3 += g3 * column[b + THREE]
                    t0 += g0 * tilt[b]
                    t1 += g1 * tilt[b + ONE]
                    t2 += g2 * tilt[b + TWO]
                    t3 += g3 * tilt[b + THREE]
                    at += FOUR
                i += ONE
                along, across = (a0 + a2) + (a1 + a3), (t0 + t2) + (t1 + t3)
                value += sx[a, j] * along
                along_x += dx[a, j] * along
                along_y += sx[a, j] * across
        over = over_x[j] * over_y[j]
        by_px[j] = per_x * power[j] * over * (along_x - value * lean_x[j])
        by_py[j] = per_y * power[j] * over * (along_y - value * lean_y[j])
        by_power[j] = by_inside + over * value


def splat_rays(x: Tensor, y: Tensor, weight: Tensor, screen: Screen, filter: Filter) -> tuple[Tensor, Tensor]:
    """Accumulate rays into an image.

    Args:
        x, y: landing points on the screen's plane, mm, (N,) float64; a bincount's derivative by them is 0.
        weight: power of each ray, (N,) float64.

    Returns:
        image (n_x, n_y), power per pixel; off_screen, the power that fell outside the frame; both float64 and differentiable.
    """
    padded, outside = _SPLAT((ScreenFrame.of(screen), Splat.of(filter)), x, y, weight)
    image, beside = trimmed(padded, screen, filter)
    return image, outside + beside


def trimmed(padded: Tensor, screen: Screen, filter: Filter) -> tuple[Tensor, Tensor]:
    """The image (n_x, n_y) inside a padded one, and the power in its padding ()."""
    (nx, ny), (rx, ry) = screen.resolution, filter.reach
    padded = padded[:, : ny + 4 * ry]  # beyond lies what rounds the scatter's steps up to four pixels
    return padded[2 * rx : 2 * rx + nx, 2 * ry : 2 * ry + ny], padding(padded, filter.reach)


@njit(**FAST)
def _pixels(x, low, wide, out):
    for j in range(len(out)):
        out[j] = (x[j] - low) / wide


@njit(**FAST)
def aim(x, y, weight, start, count, frame, v):
    """Pixel coordinates and powers of a batch of rays."""
    _pixels(x[start:], frame.low_x, frame.pixel_x, v[row.PX][:count])
    _pixels(y[start:], frame.low_y, frame.pixel_y, v[row.PY][:count])
    load(weight, start, count, v[row.POWER])


@njit(entry=True, **FAST)
def _splat(block, x, y, weight, frame, splat, scratch, images, outside):
    """Blocks' images, whose `total` is the padded one, and weights outside (blocks,): both are overwritten."""
    rows, blocks = -(-len(x) // row.WIDE), len(images)
    if on_threads(block, blocks, (x, y, weight, frame, splat, scratch, images, outside)):
        return
    images[block], outside[block] = 0.0, 0.0
    v, sx, sy, dx, dy, column, _ = row.cut(scratch[block], splat)
    for i in range(block * rows // blocks, (block + 1) * rows // blocks):
        count = min(row.WIDE, len(x) - i * row.WIDE)
        aim(x, y, weight, i * row.WIDE, count, frame, v)
        share(v, count, splat, sx, sy, dx[:0], dy[:0])
        outside[block] += scatter(v, count, frame, splat, sx, sy, images[block], column)


@njit(entry=True, **FAST)
def _splat_adjoint(block, x, y, weight, frame, splat, scratch, grad, by_outside, out):
    """Derivatives by x, y and weight into `out`, from those by the padded image and the weight outside."""
    if on_threads(block, len(scratch), (x, y, weight, frame, splat, scratch, grad, by_outside, out)):
        return
    rows, blocks = -(-len(x) // row.WIDE), len(scratch)
    v, sx, sy, dx, dy, column, tilt = row.cut(scratch[block], splat)
    for i in range(block * rows // blocks, (block + 1) * rows // blocks):
        count = min(row.WIDE, len(x) - i * row.WIDE)
        aim(x, y, weight, i * row.WIDE, count, frame, v)
        share(v, count, splat, sx, sy, dx, dy)
        gather(v, count, frame, splat, sx, sy, dx, dy, grad, 0.0, by_outside, column, tilt)
        store(v[row.BY_PX], i * row.WIDE, count, out[0])
        store(v[row.BY_PY], i * row.WIDE, count, out[1])
        store(v[row.BY_POWER], i * row.WIDE, count, out[2])


def _forward(parameters: tuple[ScreenFrame, Splat], x, y, weight):
    """Padded image, the weight outside ()."""
    frame, splat = parameters
    images, outside = np.empty((blocks(), *splat.padded(frame))), np.empty(blocks())
    _splat(ALL, x, y, weight, frame, splat, np.empty(row.room(splat, len(images))), images, outside)
    return total(images), outside.sum()


def _adjoint(parameters: tuple[ScreenFrame, Splat], rays, _kept, by, wanted):
    out = tuple(np.empty(len(rays[0]) if w else 0) for w in wanted)
    _splat_adjoint(ALL, *rays, *parameters, np.empty(row.room(parameters[1], blocks())), by[0], float(by[1]), out)
    return out


_SPLAT = KernelStage(_forward, _adjoint, 2)
