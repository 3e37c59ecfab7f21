"""Splatting: accumulation of landing points on pixels, with adjoint.

The fused form of `reconstruction.splat` for float64 rays.  Each of a fixed number of blocks of rays accumulates its own image, and
these are added in order, so the result depends on the number of blocks (threads) but not on timing.  Only the scatter to and the
gather from pixels are per ray; the rest is vectorised over rows of rays.

Notation, in pixels (w = 1)
    p           landing coordinate, 0 at the frame's low edge, one for x and one for y;  phi = p - floor(p)
    v           filter size;  r = (v - 1) / 2
    a_k, o      from `filter_weights`: the weight of pixel floor(p) - r + k is a_k o, with sum 1
    a'_k, l     and its derivative by p is (a'_k - a_k l) o
    W           weight of a ray;  G the derivatives by the padded image's pixels
    image       sum over rays of W o_x o_y a_i a_j on the frame padded by 2 r, less its padding

by_v is the derivative of whatever is differentiated by v.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from caustic_cli.optics.kernels import blocks
from caustic_cli.optics.kernels.axial_refraction import fraction
from caustic_cli.optics.kernels.filter_weights import KINDS, pixel_weights
from caustic_cli.optics.kernels.jit import FAST, njit
from caustic_cli.optics.kernels.pixels import FOUR, ONE, THREE, TWO, UINT, limits, total
from caustic_cli.optics.kernels.stage import component, components, given, keep, kept, load, store, wanted
from caustic_cli.optics.kernels.threads import ALL, on_threads
from caustic_cli.optics.reconstruction import Filter, padding
from caustic_cli.scene import Screen

#: Rays in a row.
ROW = 512
# Rows of a block's scratch; then the scratch of `filter_weights`, then weights and slopes along x and y.
PX, PY, W, PHI, OVER_X, OVER_Y, LEAN_X, LEAN_Y, BY_X, BY_Y, BY_W, VECTORS = range(12)
SCRATCH = 5


class PixelFrame(NamedTuple):
    """Parameters of screen and filter: pixels, lower edges and pixel sizes in mm; kind, sizes and alphas."""

    pixels_x: int
    pixels_y: int
    low_x: float
    low_y: float
    wide_x: float
    wide_y: float
    kind: int
    size_x: int
    size_y: int
    alpha_x: float
    alpha_y: float


def splat_rays(x: Tensor, y: Tensor, weight: Tensor, screen: Screen, filter: Filter) -> tuple[Tensor, Tensor]:
    """Accumulate rays into an image.

    Args:
        x, y: landing points on the screen's plane, mm, (N,) float64; a bincount's derivative by them is 0.
        weight: power of each ray, (N,) float64.

    Returns:
        image (n_x, n_y), power per pixel; off_screen, the power that fell outside the frame; both float64 and differentiable.
    """
    (low_x, low_y), (wide_x, wide_y), (alpha_x, alpha_y) = (map(float, pair) for pair in (screen.low, screen.pixel, filter.alpha))
    size_x, size_y = (2 * r + 1 for r in filter.reach)
    frame = PixelFrame(*screen.resolution, low_x, low_y, wide_x, wide_y, KINDS[filter.kind], size_x, size_y, alpha_x, alpha_y)
    padded, outside = _Splat.apply(x, y, weight, frame)
    (nx, ny), (rx, ry) = screen.resolution, filter.reach
    padded = padded[:, : ny + 4 * ry]  # beyond lies what rounds the scatter's steps up to four pixels
    return padded[2 * rx : 2 * rx + nx, 2 * ry : 2 * ry + ny], outside + padding(padded, filter.reach)


@njit(**FAST)
def _cut(frame):
    """A block's scratch: vectors, filter weights along x and y, their slopes; a column of each, in steps of four."""
    v = np.zeros((VECTORS + SCRATCH, ROW))
    vx, vy = frame.size_x, frame.size_y
    long = vy + -vy % 4
    return v, np.empty((vx, ROW)), np.empty((vy, ROW)), np.empty((vx, ROW)), np.empty((vy, ROW)), np.zeros(long), np.zeros(long)


@njit(**FAST)
def _pixels(x, low, wide, count, out):
    for j in range(count):
        out[j] = (x[j] - low) / wide


@njit(**FAST)
def _aim(x, y, weight, start, count, frame, v, sx, sy, dx, dy):
    """Pixel coordinates, powers and filter weights of one row of rays, with their slopes unless dx and dy are empty."""
    load(x, start, count, v[PX])
    load(y, start, count, v[PY])
    load(weight, start, count, v[W])
    _pixels(v[PX], frame.low_x, frame.wide_x, count, v[PX])
    _pixels(v[PY], frame.low_y, frame.wide_y, count, v[PY])
    fraction(v[PX], v[PHI])
    pixel_weights(frame.kind, frame.size_x, frame.alpha_x, v[PHI], sx, dx, v[OVER_X], v[LEAN_X], v[VECTORS:])
    fraction(v[PY], v[PHI])
    pixel_weights(frame.kind, frame.size_y, frame.alpha_y, v[PHI], sy, dy, v[OVER_Y], v[LEAN_Y], v[VECTORS:])


@njit(**FAST)
def _scatter(v, count, frame, sx, sy, image, column):
    """Add one row's rays to the padded image; returns the weight of those outside."""
    # Everything the loop needs is a local: after a store to the image the compiler would have to read an array again.
    vx, vy = frame.size_x, frame.size_y
    rx, ry, low_x, low_y, high_x, high_y = limits(frame.pixels_x, frame.pixels_y, vx, vy)
    px, py, weights, over_x, over_y = v[PX], v[PY], v[W], v[OVER_X], v[OVER_Y]
    outside = 0.0
    for j in range(count):
        x, y, weight = px[j], py[j], weights[j]
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


@njit(entry=True, **FAST)
def _splat(block, x, y, weight, frame, images, outside):
    """Blocks' images, whose `total` is the padded one, and weights outside (blocks,): both are overwritten."""
    rows, blocks = -(-len(x) // ROW), len(images)
    if block == ALL:
        on_threads(blocks, (x, y, weight, frame, images, outside))
        return
    images[block], outside[block] = 0.0, 0.0
    v, sx, sy, dx, dy, column, _ = _cut(frame)
    for i in range(block * rows // blocks, (block + 1) * rows // blocks):
        count = min(ROW, len(x) - i * ROW)
        _aim(x, y, weight, i * ROW, count, frame, v, sx, sy, dx[:0], dy[:0])
        outside[block] += _scatter(v, count, frame, sx, sy, images[block], column)


@njit(**FAST)
def _gather(v, count, frame, sx, sy, dx, dy, grad, by_outside, column, tilt):
    """Derivatives by each ray's landing point (per mm) and weight, from those by the padded image and the weight outside.

    sum G a_i a_j, sum G a'_i a_j and sum G a_i a'_j over the pixels first; then what normalises the weights; then W and p.
    """
    vx, vy, per_x, per_y = frame.size_x, frame.size_y, 1.0 / frame.wide_x, 1.0 / frame.wide_y
    rx, ry, low_x, low_y, high_x, high_y = limits(frame.pixels_x, frame.pixels_y, vx, vy)
    px, py, weights, by_x, by_y, by_w = v[PX], v[PY], v[W], v[BY_X], v[BY_Y], v[BY_W]
    over_x, over_y, lean_x, lean_y = v[OVER_X], v[OVER_Y], v[LEAN_X], v[LEAN_Y]
    for j in range(count):
        x, y = px[j], py[j]
        if not (x >= low_x and x < high_x and y >= low_y and y < high_y):
            by_x[j], by_y[j], by_w[j] = 0.0, 0.0, by_outside
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
        by_x[j] = per_x * weights[j] * over * (along_x - value * lean_x[j])
        by_y[j] = per_y * weights[j] * over * (along_y - value * lean_y[j])
        by_w[j] = over * value


@njit(entry=True, **FAST)
def _splat_adjoint(block, x, y, weight, frame, grad, by_outside, out, blocks):
    """Derivatives by x, y and weight into `out`, from those by the padded image and the weight outside."""
    if block == ALL:
        on_threads(blocks, (x, y, weight, frame, grad, by_outside, out, blocks))
        return
    rows = -(-len(x) // ROW)
    v, sx, sy, dx, dy, column, tilt = _cut(frame)
    for i in range(block * rows // blocks, (block + 1) * rows // blocks):
        count = min(ROW, len(x) - i * ROW)
        _aim(x, y, weight, i * ROW, count, frame, v, sx, sy, dx, dy)
        _gather(v, count, frame, sx, sy, dx, dy, grad, by_outside, column, tilt)
        for k in range(3):
            store(v[BY_X + k], i * ROW, count, out[k])


def _shape(frame: PixelFrame) -> tuple[int, int]:
    """Of a padded image, with room for the scatter's last step of four pixels."""
    return frame.pixels_x + 2 * (frame.size_x - 1), frame.pixels_y + 2 * (frame.size_y - 1) + -frame.size_y % 4


def _room(frame: PixelFrame) -> tuple[np.ndarray, np.ndarray]:
    """For blocks' images and weights outside."""
    return np.empty((blocks(), *_shape(frame))), np.empty(blocks())


class _Splat(torch.autograd.Function):
    """x, y, weight and the frame -> padded image, the weight outside ()."""

    @staticmethod
    def forward(x, y, weight, frame: PixelFrame):
        images, outside = _room(frame)
        _splat(ALL, *components((x, y, weight)), frame, images, outside)
        return torch.from_numpy(total(images)), torch.tensor(outside.sum(), dtype=torch.float64)

    @staticmethod
    def setup_context(ctx, inputs, output):
        *rays, ctx.frame = inputs
        keep(ctx, rays)

    @staticmethod
    @once_differentiable
    def backward(ctx, by_image, by_outside):
        rays, frame = components(kept(ctx)), ctx.frame
        out = wanted(ctx, 3, len(rays[0]))
        grad = np.zeros(_shape(frame)) if by_image is None else component(by_image)
        _splat_adjoint(ALL, *rays, frame, grad, 0.0 if by_outside is None else float(by_outside), out, blocks())
        return *given(ctx, out), None
