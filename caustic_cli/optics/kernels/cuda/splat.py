"""CUDA kernel for splatting: accumulation of landing points on pixels, with adjoint.

The functions of `kernels.splat`, with their notation; a row of one ray at a time.
"""

from __future__ import annotations

import math
from functools import cache

import torch
from numba import cuda, float64
from torch import Tensor
from torch.autograd.function import once_differentiable

from caustic_cli.optics.kernels import pixels, splat
from caustic_cli.optics.kernels.cuda import sums
from caustic_cli.optics.kernels.cuda.launch import device, start
from caustic_cli.optics.kernels.cuda.scatter import scatter, units
from caustic_cli.optics.kernels.filter_weights import KINDS
from caustic_cli.optics.kernels.splat import BY_W, BY_X, BY_Y, OVER_X, OVER_Y, PX, PY, PixelFrame, W
from caustic_cli.optics.reconstruction import Filter, padding
from caustic_cli.scene import Screen

limits, aim, gather = device(pixels.limits), device(splat._aim), device(splat._gather)
VECTORS = splat.VECTORS + splat.SCRATCH


def splat_rays(x: Tensor, y: Tensor, weight: Tensor, screen: Screen, filter: Filter) -> tuple[Tensor, Tensor]:
    """`kernels.splat.splat_rays` of tensors on the device."""
    (nx, ny), (rx, ry) = screen.resolution, filter.reach
    (low_x, low_y), (wide_x, wide_y), (alpha_x, alpha_y) = (map(float, pair) for pair in (screen.low, screen.pixel, filter.alpha))
    kernel = KINDS[filter.kind], 2 * rx + 1, 2 * ry + 1
    frame = PixelFrame(int(nx), int(ny), low_x, low_y, wide_x, wide_y, *kernel, alpha_x, alpha_y)
    padded, outside = _Splat.apply(x, y, weight, frame)
    padded = padded[:, : ny + 4 * ry]  # beyond lies what rounds the gather's steps up to four pixels
    return padded[2 * rx : 2 * rx + nx, 2 * ry : 2 * ry + ny], outside + padding(padded, filter.reach)


@device
def lands(v, frame):
    """Whether a ray reaches into the frame, and the first of its pixels; False for NaN too."""
    rx, ry, low_x, low_y, high_x, high_y = limits(frame.pixels_x, frame.pixels_y, frame.size_x, frame.size_y)
    x, y = v[PX, 0], v[PY, 0]
    inside = x >= low_x and x < high_x and y >= low_y and y < high_y
    return (True, math.floor(x) + rx, math.floor(y) + ry) if inside else (False, 0, 0)


@cache
def _kernels(kind: int, vx: int, vy: int):
    """Forward and adjoint for a filter."""
    room = vy + -vy % 4

    @cuda.jit
    def forward(rays, any_frame, unit, image, outside):
        (x, y, weight), f = rays, any_frame
        frame = PixelFrame(f.pixels_x, f.pixels_y, f.low_x, f.low_y, f.wide_x, f.wide_y, kind, vx, vy, f.alpha_x, f.alpha_y)
        v, none = cuda.local.array((VECTORS, 1), float64), cuda.local.array((1, 1), float64)
        sx, sy, total = cuda.local.array((vx, 1), float64), cuda.local.array((vy, 1), float64), 0
        for k in range(cuda.grid(1), len(x), cuda.gridsize(1)):
            aim(x, y, weight, k, 1, frame, v, sx, sy, none[:0], none[:0])
            inside, i, j = lands(v, frame)
            if inside:
                scatter(image, i, j, v[W, 0] * v[OVER_X, 0] * v[OVER_Y, 0], sx, sy, unit[0])
            else:
                total += units(v[W, 0], unit[0])
        cuda.atomic.add(outside, 0, total)

    @cuda.jit
    def adjoint(rays, any_frame, grad, by_outside, out):
        (x, y, weight), (by_x, by_y, by_w), f = rays, out, any_frame
        frame = PixelFrame(f.pixels_x, f.pixels_y, f.low_x, f.low_y, f.wide_x, f.wide_y, kind, vx, vy, f.alpha_x, f.alpha_y)
        v = cuda.local.array((VECTORS, 1), float64)
        sx, dx = cuda.local.array((vx, 1), float64), cuda.local.array((vx, 1), float64)
        sy, dy = cuda.local.array((vy, 1), float64), cuda.local.array((vy, 1), float64)
        column, tilt = cuda.local.array(room, float64), cuda.local.array(room, float64)
        for b in range(room):
            column[b], tilt[b] = 0.0, 0.0
        for k in range(cuda.grid(1), len(x), cuda.gridsize(1)):
            aim(x, y, weight, k, 1, frame, v, sx, sy, dx, dy)
            gather(v, 1, frame, sx, sy, dx, dy, grad, by_outside[0], column, tilt)
            by_x[k], by_y[k], by_w[k] = v[BY_X, 0], v[BY_Y, 0], v[BY_W, 0]

    return forward, adjoint


def _shape(frame: PixelFrame) -> tuple[int, int]:
    """Of a padded image, with room for the gather's last step of four pixels."""
    return frame.pixels_x + 2 * (frame.size_x - 1), frame.pixels_y + 2 * (frame.size_y - 1) + -frame.size_y % 4


def _whole(values) -> tuple[Tensor, ...]:
    return tuple(v.detach().double().contiguous() for v in values)


class _Splat(torch.autograd.Function):
    """x, y, weight and the frame -> padded image, the weight outside ()."""

    @staticmethod
    def forward(x: Tensor, y: Tensor, weight: Tensor, frame: PixelFrame):
        rays, image = _whole((x, y, weight)), torch.zeros(_shape(frame), dtype=torch.int64, device=x.device)
        unit, outside = sums.unit_of(rays[2].abs().sum()), image.new_zeros(1)
        start(_kernels(*frame[6:9])[0], len(x), rays, frame, unit, image, outside)
        return sums.value_of(image, unit), sums.value_of(outside, unit)[0].clone()

    @staticmethod
    def setup_context(ctx, inputs, output):
        *rays, ctx.frame = inputs
        ctx.save_for_backward(*rays)

    @staticmethod
    @once_differentiable
    def backward(ctx, by_image, by_outside):
        rays, frame = _whole(ctx.saved_tensors), ctx.frame
        out = tuple(torch.empty_like(rays[0]) for _ in range(3))
        start(_kernels(*frame[6:9])[1], len(rays[0]), rays, frame, by_image.contiguous(), by_outside.reshape(1), out)
        return *(a.to(r.dtype) if w else None for a, r, w in zip(out, ctx.saved_tensors, ctx.needs_input_grad, strict=False)), None
