"""Ray integration through a B-spline volume of refractive index, with the adjoint: the index of a `flow`.

Notation and formulas are those of `integrator`; with n a spline, F = n grad n and

    (dF/dq)^T l = grad n (grad n . l) + n H l,    H the second derivatives of n
    d(F . l)/dc = (grad n . l) B + n (grad B . l),    B(q) the product of three basis functions

An axis of a spline space has pieces, on each of which a basis function is a polynomial (`spline.Axis`); one along which the field
does not change has a single piece and the function 1.  Outside the box basis functions are extrapolated linearly.
"""

from __future__ import annotations

import numpy as np

from caustic_cli.optics.bspline import SplineSpace
from caustic_cli.optics.kernels.flow import IndexFlow
from caustic_cli.optics.kernels.jit import FAST, njit
from caustic_cli.optics.kernels.spline import axis, piece


def volume_axis(space: SplineSpace | None, middle: float, half: float) -> tuple[np.ndarray, ...]:
    """Kernel data of one axis: breaks, middles and one over widths of its pieces, first basis functions there and their
    polynomials, and the map x -> u = (x - low) / width."""
    place = np.array([middle - half, 1.0 / (2.0 * half)])
    if space is None:
        return np.array([0.0, 1.0]), np.array([0.5]), np.array([1.0]), np.zeros(1, np.int64), np.ones((1, 1, 1)), place
    return *axis(space).geometry, axis(space).first, axis(space).matrices, place


@njit(inline="always", **FAST)
def _along(x, axis, out):
    """First basis function at x, and into out (3, p + 1) the values, first and second derivatives by mm."""
    breaks, middles, over, first, matrices, place = axis
    v = (x - place[0]) * place[1]
    u = min(max(v, 0.0), 1.0)
    beyond = v - u
    i = piece(u, breaks)
    xi, by = (u - middles[i]) * over[i], over[i] * place[1]
    count = matrices.shape[1]
    for k in range(count):
        value, slope, curve = 0.0, 0.0, 0.0
        for a in range(count - 1, -1, -1):
            curve = curve * xi + 2.0 * slope
            slope = slope * xi + value
            value = value * xi + matrices[i, a, k]
        out[0, k], out[1, k] = value + slope * over[i] * beyond, slope * by
        out[2, k] = curve * by * by if beyond == 0.0 else 0.0
    return first[i]


@njit(inline="always", **FAST)
def _curve(c, i, j, k, room, nu, nv, nw):
    """n, grad n and the six second derivatives."""
    bu, bv, bw = room
    n, nx, ny, nz = 0.0, 0.0, 0.0, 0.0
    xx, xy, xz, yy, yz, zz = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for a in range(nu):
        r, ry, rz, ryy, ryz, rzz = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
        for b in range(nv):
            s, sz, szz = 0.0, 0.0, 0.0
            for d in range(nw):
                value = c[i + a, j + b, k + d]
                s += value * bw[0, d]
                sz += value * bw[1, d]
                szz += value * bw[2, d]
            r += bv[0, b] * s
            ry += bv[1, b] * s
            rz += bv[0, b] * sz
            ryy += bv[2, b] * s
            ryz += bv[1, b] * sz
            rzz += bv[0, b] * szz
        n += bu[0, a] * r
        nx += bu[1, a] * r
        ny += bu[0, a] * ry
        nz += bu[0, a] * rz
        xx += bu[2, a] * r
        xy += bu[1, a] * ry
        xz += bu[1, a] * rz
        yy += bu[0, a] * ryy
        yz += bu[0, a] * ryz
        zz += bu[0, a] * rzz
    return n, nx, ny, nz, xx, xy, xz, yy, yz, zz


@njit(inline="always", **FAST)
def _bases(axes, x, y, z, room):
    """The basis functions at a point, into the three of `room`: the first along each axis, and their numbers."""
    u, v, w = axes
    bu, bv, bw = room
    i, j, k = _along(x, u, bu), _along(y, v, bv), _along(z, w, bw)
    return i, j, k, u[4].shape[1], v[4].shape[1], w[4].shape[1]


@njit(inline="always", **FAST)
def _index(c, axes, x, y, z, room):
    i, j, k, nu, nv, nw = _bases(axes, x, y, z, room)
    n, nx, ny, nz, _, _, _, _, _, _ = _curve(c, i, j, k, room, nu, nv, nw)  # inlined: what is not used is not computed
    return n * n, n, n * nx, n * ny, n * nz


@njit(inline="always", **FAST)
def _adjoint(c, axes, x, y, z, mx, my, mz, s, t, b, room, by_c):
    i, j, k, nu, nv, nw = _bases(axes, x, y, z, room)
    n, nx, ny, nz, xx, xy, xz, yy, yz, zz = _curve(c, i, j, k, room, nu, nv, nw)
    whole = nx * mx + ny * my + nz * mz + s * n + t
    if by_c.size > 0:
        bu, bv, bw = room
        gx, gy, gz, g = b * n * mx, b * n * my, b * n * mz, b * whole
        for p in range(nu):
            for q in range(nv):
                level = g * bu[0, p] * bv[0, q] + gx * bu[1, p] * bv[0, q] + gy * bu[0, p] * bv[1, q]
                along = gz * bu[0, p] * bv[0, q]
                for r in range(nw):
                    by_c[i + p, j + q, k + r] += level * bw[0, r] + along * bw[1, r]
    lx = nx * whole + n * (xx * mx + xy * my + xz * mz)
    ly = ny * whole + n * (xy * mx + yy * my + yz * mz)
    lz = nz * whole + n * (xz * mx + yz * my + zz * mz)
    return n * n, n, n * nx, n * ny, n * nz, lx, ly, lz


#: A function of coefficients (n, m, k), of the axes as of `volume_axis`, and what `IndexFlow` takes besides.
volume_flow = IndexFlow.of(_index, _adjoint)
