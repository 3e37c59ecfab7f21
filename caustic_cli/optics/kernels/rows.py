"""Batches of rays from the rows of a bundle: their vectors in a block's scratch memory, and the surface there from nets contracted
along v, with the adjoint.

The shape of the scratch is known at compile time, so loops over its vectors are vectorised without checks for overlap.  A batch is
long enough for its setting up not to count.
"""

from __future__ import annotations

import numpy as np
from numba import carray, types
from numba.extending import intrinsic

from caustic_cli.optics.kernels.arguments import Splat
from caustic_cli.optics.kernels.jit import FAST, njit

#: Most rays of a batch.  Vectors of a power of two would compete for the same places of the cache.
WIDE = 504
# Vectors of a batch: the surface (of rays of any direction distances along them in place of the sag), the rays' points, powers or
# areas and directions; of a source point u, its square's argument, the emission J and its derivative; powers in front and behind,
# landing points; sub-pixel positions, normalisation of the results of `filter_weights`; derivatives; then `SCRATCH` more for these.
SAG, GX, GY, X, Y, P, DX, DY, U, AT, J, J_S, FLUX, POWER, PX, PY = range(16)
PHI, OVER_X, OVER_Y, LEAN_X, LEAN_Y, BY_POWER, BY_PX, BY_PY, BY_SAG, BY_GX, BY_GY, VECTORS = range(16, 28)
SCRATCH = 5
#: Powers of rays that are totally reflected or miss the surface, and the pixel coordinate of those that never arrive at the screen.
REFLECTED_POWER, MISSED_POWER, BESIDE = -1.0, -2.0, -1e300


@intrinsic
def _data(_, array):
    """Pointer to an array's numbers."""

    def generate(context, builder, signature, arguments):
        return context.make_array(array)(context, builder, arguments[0]).data

    return types.CPointer(array.dtype)(array), generate


def room(splat: Splat, blocks: int) -> tuple[int, int, int]:
    """Shape of the scratch memory of all blocks."""
    return blocks, VECTORS + SCRATCH + 2 * (splat.size_x + splat.size_y), WIDE


@njit(inline="always", **FAST)
def cut(memory, splat):
    """A block's scratch: vectors, filter weights along x and y, their slopes; a column of each, in steps of four."""
    vx, vy, a = splat.size_x, splat.size_y, VECTORS + SCRATCH
    b, c, d = a + vx, a + vx + vy, a + 2 * vx + vy
    v = carray(_data(memory), (VECTORS + SCRATCH, WIDE))
    return v, memory[a:b], memory[b:c], memory[c:d], memory[d:], np.zeros(vy + -vy % 4), np.zeros(vy + -vy % 4)


@njit(**FAST)
def load(row, out):
    """Copy a row, possibly a repeated value, to contiguous memory, since only contiguous loops are vectorised."""
    if row.strides[0] == 0:
        out[:] = row[0]
    elif row.strides[0] == 8:  # a stride known at compile time: this copy is vectorised
        for j in range(len(out)):
            out[j] = row[j]
    else:
        for j in range(len(out)):
            out[j] = row[j]


@njit(**FAST)
def _add(weight, row, out):
    for j in range(len(row)):
        out[j] += weight * row[j]


@njit(**FAST)
def _weighted(weights, net, first, start, out):
    """Weighted sum of consecutive rows of a net, three at a time: a pass over `out` costs as much as the products."""
    out[:] = 0.0
    a, count = 0, len(weights)
    while a + 2 < count:
        p, q, r = net[first + a][start:], net[first + a + 1][start:], net[first + a + 2][start:]
        for j in range(len(out)):
            out[j] += weights[a] * p[j] + weights[a + 1] * q[j] + weights[a + 2] * r[j]
        a += 3
    while a < count:
        _add(weights[a], net[first + a][start : start + len(out)], out)
        a += 1


@njit(inline="always", **FAST)
def combine(i, start, surface, sag, gx, gy):
    """Part of row i of the surface, from this column on: sag, dz/dx, dz/dy (count,)."""
    first = surface.first[i]
    _weighted(surface.bu[i], surface.net, first, start, sag)
    _weighted(surface.du[i], surface.net_x, first, start, gx)
    _weighted(surface.bu[i], surface.net_y, first, start, gy)


@njit(**FAST)
def spread(i, start, surface, by_sag, by_gx, by_gy, nets, apart):
    """Adjoint of `combine`: add the derivatives by part of row i to those by the nets (3, n, b)."""
    bu, du, first = surface.bu, surface.du, surface.first
    for a in range(bu.shape[1]):
        if apart:
            _add(bu[i, a], by_sag, nets[0, first[i] + a][start:])
            _add(du[i, a], by_gx, nets[1, first[i] + a][start:])
        else:
            value, slope, out = bu[i, a], du[i, a], nets[0, first[i] + a][start:]
            for j in range(len(by_sag)):
                out[j] += value * by_sag[j] + slope * by_gx[j]
        _add(bu[i, a], by_gy, nets[2, first[i] + a][start:])
