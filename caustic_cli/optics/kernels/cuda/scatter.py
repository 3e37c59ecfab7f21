"""Accumulation of filter weights on a CUDA device: atomic additions to an image in fixed point (`sums`).

Filter weights are non-negative and sum to 1, so the power of all rays bounds every pixel.  A tangent is bounded by

    |d image| <= sum over rays of |d W| sum a_i a_j + |W d p_x| sum |a'_i| a_j + |W d p_y| sum a_i |a'_j|

where W is the power of a ray, a its filter weights along x and y, and a' their derivatives by its landing point p
(`kernels.splat`).
"""

from __future__ import annotations

from numba import cuda

from caustic_cli.optics.kernels.cuda.launch import device
from caustic_cli.optics.kernels.cuda.sums import units as units_on_cpu

units = device(units_on_cpu)


@device
def scatter(image, i, k, weight, sx, sy, unit):
    """Add `weight` times filter weights (v_x, 1), (v_y, 1) to the pixels from (i, k) on."""
    for a in range(len(sx)):
        part = weight * sx[a, 0]
        for b in range(len(sy)):
            cuda.atomic.add(image, (i + a, k + b), units(part * sy[b, 0], unit))


@device
def scatter_tangent(image, i, k, change, move_x, move_y, sx, sy, dx, dy, unit):
    """Add a ray's tangent; change, move_x, move_y: d W and W d p, without the normalisation of the filter weights."""
    for a in range(len(sx)):
        along, across = change * sx[a, 0] + move_x * dx[a, 0], move_y * sx[a, 0]
        for b in range(len(sy)):
            cuda.atomic.add(image, (i + a, k + b), units(along * sy[b, 0] + across * dy[b, 0], unit))


@device
def size_of_tangent(change, move_x, move_y, sx, sy, dx, dy):
    """A ray's contribution to the bound, with the arguments of `scatter_tangent`."""
    total_x, total_y, slope_x, slope_y = 0.0, 0.0, 0.0, 0.0
    for a in range(len(sx)):
        total_x, slope_x = total_x + sx[a, 0], slope_x + abs(dx[a, 0])
    for b in range(len(sy)):
        total_y, slope_y = total_y + sy[b, 0], slope_y + abs(dy[b, 0])
    return abs(change) * total_x * total_y + abs(move_x) * slope_x * total_y + abs(move_y) * total_x * slope_y
