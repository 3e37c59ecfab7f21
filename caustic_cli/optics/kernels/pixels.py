"""Common functions of the scatter to and the gather from padded images, for the CPU kernels; the sum of partial images."""

from __future__ import annotations

import numpy as np

from caustic_cli.optics.kernels.jit import FAST, njit
from caustic_cli.optics.kernels.threads import ALL, on_threads

UINT = np.uintp  # an unsigned index is never taken to count from the end
ONE, TWO, THREE, FOUR = (UINT(k) for k in (1, 2, 3, 4))


@njit(inline="always", **FAST)
def limits(pixels_x, pixels_y, size_x, size_y):
    """r along x and y, and the least and the first too large coordinate of a ray that reaches into the frame."""
    rx, ry = (size_x - 1) // 2, (size_y - 1) // 2
    return rx, ry, float(-rx), float(-ry), float(pixels_x + rx), float(pixels_y + ry)


def total(images: np.ndarray) -> np.ndarray:
    """Sum over blocks, in order."""
    out = np.empty(images.shape[1:])
    sums(ALL, images, out)
    return out


@njit(entry=True, **FAST)
def sums(i, images, out):
    """Rows of `total`."""
    if on_threads(i, len(out), (images, out)):
        return
    for j in range(images.shape[2]):
        out[i, j] = images[0, i, j]
    for block in range(1, images.shape[0]):
        for j in range(images.shape[2]):
            out[i, j] += images[block, i, j]
