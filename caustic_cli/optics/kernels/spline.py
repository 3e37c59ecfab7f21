"""CPU kernels for the height field at arbitrary points, with their adjoints: one polynomial for each knot-span product.

The functions of `heightfield`'s scattered evaluator (the reference they are tested against).  A ray at (u, v) in [0, 1]^2
finds its span product (i, j) and evaluates

    z = sum_ab c[i, j, a, b] xi^a eta^b,    xi = (u - u_i) / h_i in [-1/2, 1/2], u_i the span's middle, h_i its width,

by Horner's scheme.  The coefficients c follow from the control heights by small constant matrices, c = M_i P_local M_j^T, so
a point costs the same few products wherever it lies.  In a span's own centred variable the power basis is well conditioned;
in a global one it is not (degree 7 loses everything in single precision).
"""

from __future__ import annotations

import math
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
import torch

from caustic_cli.optics.bspline import SplineSpace
from caustic_cli.optics.kernels.jit import FAST, njit
from caustic_cli.optics.kernels.threads import on_threads


class Pieces(NamedTuple):
    """The polynomial pieces along u and v: breaks (I + 1,), middles (I,) and one over widths (I,), and du/dx and dv/dy, per mm."""

    breaks_u: Any
    middle_u: Any
    over_u: Any
    breaks_v: Any
    middle_v: Any
    over_v: Any
    scale_x: float
    scale_y: float


class Axis:
    """Kernel data of a spline space, by polynomial pieces.

    first (I,): first basis function that does not vanish on a piece; matrices (I, p + 1, p + 1): [i, a, k] is the
    coefficient of xi^a in basis function first + k; geometry: breaks (I + 1,), middles (I,), one over widths (I,).
    """

    def __init__(self, space: SplineSpace):
        breaks = space.breaks
        middle, width = (breaks[1:] + breaks[:-1]) / 2.0, breaks.diff()
        first, values = space.bases(middle, range(space.degree + 1))
        rows = [value * (width**a / math.factorial(a))[:, None] for a, value in values.items()]
        self.space, self.first, self.matrices = space, first.numpy(), torch.stack(rows, 1).contiguous().numpy()
        self.geometry = (breaks.numpy(), middle.numpy(), (1.0 / width).numpy())


@lru_cache(maxsize=16)
def axis(space: SplineSpace) -> Axis:
    """Kernel data of a space, cached since many surfaces share one."""
    return Axis(space)


@njit(entry=True, **FAST)
def coefficients(i, heights, first_u, mu, first_v, mv, out):
    """(n, m) control heights -> out (I, J, p + 1, q + 1)."""
    if on_threads(i, len(mu), (heights, first_u, mu, first_v, mv, out)):
        return
    p, q = mu.shape[1], mv.shape[1]
    part = np.zeros(heights.shape[1])
    for a in range(p):
        part[:] = 0.0
        for k in range(p):
            weight, row = mu[i, a, k], heights[first_u[i] + k]
            for j in range(len(part)):
                part[j] += weight * row[j]
        for j in range(len(mv)):
            found, local = out[i, j, a], part[first_v[j] :]
            for b in range(q):
                total = 0.0
                for k in range(q):
                    total += mv[j, b, k] * local[k]
                found[b] = total


@njit(entry=True, **FAST)
def pull_coefficients(i, grads, first_u, mu, first_v, mv, rows, out):
    """Adjoint of `coefficients`: derivatives (blocks, I, J, p + 1, q + 1), added in order of the blocks -> out (n, m).

    rows (I, p + 1, m): scratch, zero as `out` is.
    """
    if on_threads(i, len(mu), (grads, first_u, mu, first_v, mv, rows, out)):
        for k in range(len(mu)):
            for a in range(rows.shape[1]):
                for j in range(rows.shape[2]):
                    out[first_u[k] + a, j] += rows[k, a, j]
        return
    p, q = mu.shape[1], mv.shape[1]
    part = np.zeros(rows.shape[2])
    for a in range(p):
        part[:] = 0.0
        for j in range(len(mv)):
            local = part[first_v[j] :]
            for b in range(q):
                value = 0.0
                for block in range(len(grads)):
                    value += grads[block, i, j, a, b]
                for k in range(q):
                    local[k] += value * mv[j, b, k]
        for k in range(p):
            weight, row = mu[i, a, k], rows[i, k]
            for j in range(len(part)):
                row[j] += weight * part[j]


@njit(inline="always", **FAST)
def piece(x, breaks):
    """The piece that contains x; the outermost pieces extend to infinity."""
    last = len(breaks) - 2  # guess from equal spans, then walk: at once right on an equispaced knot vector
    i = min(max(int(x * (last + 1)), 0), last)
    while i > 0 and x < breaks[i]:
        i -= 1
    while i < last and x >= breaks[i + 1]:
        i += 1
    return i


@njit(inline="always", **FAST)
def place(u, v, pieces):
    """The span product (i, j) of a point, and xi, eta there."""
    i, j = piece(u, pieces.breaks_u), piece(v, pieces.breaks_v)
    return i, j, (u - pieces.middle_u[i]) * pieces.over_u[i], (v - pieces.middle_v[j]) * pieces.over_v[j]


@njit(inline="always", **FAST)
def jet(c, i, j, xi, eta):
    """z, its derivatives by xi and eta, and the second by xi xi, xi eta, eta eta; inlined: what is not used is not computed."""
    p, q = c.shape[2], c.shape[3]
    z, z_xi, half_xi, z_eta, mixed, half_eta = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for a in range(p - 1, -1, -1):
        row, slope, half = c[i, j, a, q - 1], 0.0, 0.0
        for b in range(q - 2, -1, -1):
            half = half * eta + slope
            slope = slope * eta + row
            row = row * eta + c[i, j, a, b]
        half_xi = half_xi * xi + z_xi
        z_xi = z_xi * xi + z
        z = z * xi + row
        mixed = mixed * xi + z_eta
        z_eta = z_eta * xi + slope
        half_eta = half_eta * xi + half
    return z, z_xi, z_eta, 2.0 * half_xi, mixed, 2.0 * half_eta


@njit(inline="always", **FAST)
def push_powers(grad, i, j, xi, eta, by_z, by_xi, by_eta, powers):
    """Adjoint of `jet`: add to the derivatives (I, J, p + 1, q + 1) by the coefficients.  powers: scratch (2, q + 1)."""
    p, q = grad.shape[2], grad.shape[3]
    power, slope = 1.0, 0.0
    for b in range(q):
        powers[0, b], powers[1, b] = power, slope
        slope = slope * eta + power
        power *= eta
    power, slope = 1.0, 0.0
    for a in range(p):
        value, along = by_z * power + by_xi * slope, by_eta * power
        row = grad[i, j, a]
        for b in range(q):
            row[b] += value * powers[0, b] + along * powers[1, b]
        slope = slope * xi + power
        power *= xi


@njit(entry=True, **FAST)
def evaluate(block, u, v, c, pieces, z, zx, zy, blocks):
    """Height and slopes at points (u, v) (N,) into z, zx, zy (N,)."""
    if on_threads(block, blocks, (u, v, c, pieces, z, zx, zy, blocks)):
        return
    count = len(u)
    for k in range(block * count // blocks, (block + 1) * count // blocks):
        i, j, xi, eta = place(u[k], v[k], pieces)
        value, along, across, _, _, _ = jet(c, i, j, xi, eta)
        z[k], zx[k], zy[k] = value, along * pieces.over_u[i] * pieces.scale_x, across * pieces.over_v[j] * pieces.scale_y


@njit(entry=True, **FAST)
def evaluate_net(block, u, v, net, linear, pieces, z, zx, zy, blocks):
    """`evaluate` from the control heights (n, m) themselves, with the polynomial of one piece at a time."""
    if on_threads(block, blocks, (u, v, net, linear, pieces, z, zx, zy, blocks)):
        return
    (fu, tu, fv, tv), count = linear, len(u)
    p, q = tu.shape[1], tv.shape[1]
    c, rows = np.empty((1, 1, p, q)), np.empty((p, q))
    for k in range(block * count // blocks, (block + 1) * count // blocks):
        i, j, xi, eta = place(u[k], v[k], pieces)
        for a in range(p):
            for b in range(q):
                rows[a, b] = 0.0
                for n in range(q):
                    rows[a, b] += tv[j, b, n] * net[fu[i] + a, fv[j] + n]
        for a in range(p):
            for b in range(q):
                c[0, 0, a, b] = 0.0
                for n in range(p):
                    c[0, 0, a, b] += tu[i, a, n] * rows[n, b]
        value, along, across, _, _, _ = jet(c, 0, 0, xi, eta)
        z[k], zx[k], zy[k] = value, along * pieces.over_u[i] * pieces.scale_x, across * pieces.over_v[j] * pieces.scale_y


@njit(entry=True, **FAST)
def pull_back(block, u, v, gz, gx, gy, pieces, grads):
    """Adjoint of `evaluate`: derivatives by the coefficients into grads (blocks, I, J, p + 1, q + 1), overwritten."""
    count, blocks = len(u), len(grads)
    if on_threads(block, blocks, (u, v, gz, gx, gy, pieces, grads)):
        return
    grad = grads[block]
    grad[:] = 0.0
    powers = np.empty((2, grad.shape[3]))
    for k in range(block * count // blocks, (block + 1) * count // blocks):
        i, j, xi, eta = place(u[k], v[k], pieces)
        by_xi, by_eta = gx[k] * pieces.over_u[i] * pieces.scale_x, gy[k] * pieces.over_v[j] * pieces.scale_y
        push_powers(grad, i, j, xi, eta, gz[k], by_xi, by_eta, powers)
