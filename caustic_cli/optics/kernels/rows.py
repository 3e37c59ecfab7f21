"""A row of the surface from nets contracted along v, and the adjoint, for the CPU kernels."""

from __future__ import annotations

from caustic_cli.optics.kernels.jit import FAST, njit


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
def combine(i, first, bu, du, net, net_x, net_y, sag, gx, gy):
    """Row i of the surface from the nets already contracted along v: sag, dz/dx, dz/dy (b,)."""
    _weighted(bu[i], net, first[i], sag)
    _weighted(du[i], net_x, first[i], gx)
    _weighted(bu[i], net_y, first[i], gy)


@njit(**FAST)
def spread(i, first, bu, du, by_sag, by_gx, by_gy, nets, apart):
    """Adjoint of `combine`: add the derivatives by row i to those by the nets (3, n, b)."""
    for a in range(bu.shape[1]):
        if apart:
            _add(bu[i, a], by_sag, nets[0, first[i] + a])
            _add(du[i, a], by_gx, nets[1, first[i] + a])
        else:
            value, slope, out = bu[i, a], du[i, a], nets[0, first[i] + a]
            for j in range(len(out)):
                out[j] += value * by_sag[j] + slope * by_gx[j]
        _add(bu[i, a], by_gy, nets[2, first[i] + a])
