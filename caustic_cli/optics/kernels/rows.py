"""Rows of rays: the vectors of a row in a block's scratch, and the surface there from nets contracted along v, with the adjoint."""

from __future__ import annotations

from caustic_cli.optics.kernels.jit import FAST, njit

# Vectors of a row: the surface, powers, landing points, derivatives, normalisation of the results of `filter_weights`, the rays'
# points and powers; then `SCRATCH` more for internal use.
SAG, GX, GY, POWER, PX, PY, PHI, BY_POWER, BY_PX, BY_PY, BY_A, BY_SAG, BY_GX, BY_GY, REACH = range(15)
OVER_X, OVER_Y, LEAN_X, LEAN_Y, X, Y, FLUX, VECTORS = range(15, 23)
SCRATCH = 5
#: Powers of rays that are totally reflected or miss the surface, and the pixel coordinate of those that never arrive at the screen.
REFLECTED_POWER, MISSED_POWER, BESIDE = -1.0, -2.0, -1e300


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
    for j in range(len(out)):
        out[j] += weight * row[j]


@njit(**FAST)
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


@njit(inline="always", **FAST)
def combine(i, surface, sag, gx, gy):
    """Row i of the surface: sag, dz/dx, dz/dy (b,)."""
    first = surface.first[i]
    _weighted(surface.bu[i], surface.net, first, sag)
    _weighted(surface.du[i], surface.net_x, first, gx)
    _weighted(surface.bu[i], surface.net_y, first, gy)


@njit(**FAST)
def spread(i, surface, by_sag, by_gx, by_gy, nets, apart):
    """Adjoint of `combine`: add the derivatives by row i to those by the nets (3, n, b)."""
    bu, du, first = surface.bu, surface.du, surface.first
    for a in range(bu.shape[1]):
        if apart:
            _add(bu[i, a], by_sag, nets[0, first[i] + a])
            _add(du[i, a], by_gx, nets[1, first[i] + a])
        else:
            value, slope, out = bu[i, a], du[i, a], nets[0, first[i] + a]
            for j in range(len(out)):
                out[j] += value * by_sag[j] + slope * by_gx[j]
        _add(bu[i, a], by_gy, nets[2, first[i] + a])
