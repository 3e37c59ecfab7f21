"""Accumulation of filter weights on a CUDA device: atomic additions to an image in fixed point (`sums`).

Filter weights are non-negative and sum to 1, so the power of all rays bounds every pixel.
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
