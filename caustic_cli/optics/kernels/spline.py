"""CPU kernels at scattered points: where rays start, and the height field's value and slopes there.

The functions of `sampling.random_numbers` and of `heightfield`'s scattered evaluator (the references they are tested
against), ray by ray.  The triangular basis scheme is that of `bspline.SplineSpace.basis`.
"""

from __future__ import annotations

import numpy as np
from numba import njit, prange

_OPTIONS = {"cache": True, "error_model": "numpy"}
_M = np.uint64(0xFFFFFFFF)
MAX_ORDER = 16


@njit(inline="always", **_OPTIONS)
def _mix(x):
    x ^= x >> np.uint64(16)
    x = (x * np.uint64(0x7FEB352D)) & _M
    x ^= x >> np.uint64(15)
    x = (x * np.uint64(0x846CA68B)) & _M
    return x ^ (x >> np.uint64(16))


@njit(inline="always", **_OPTIONS)
def _number(key, salt, index):
    """A uniform number strictly inside (0, 1): see sampling.random_numbers."""
    return (float(_mix((_mix((index & _M) ^ key) + salt + (index >> np.uint64(32))) & _M)) + 0.5) * 2.0**-32


@njit(parallel=True, **_OPTIONS)
def scatter(keys, salts, start, stop, nu, nv, stratified):
    """Points u, v (stop - start,) of rays start..stop; stratified in nu x nv cells, or independent."""
    u, v = np.empty(stop - start), np.empty(stop - start)
    for k in prange(stop - start):
        index = np.uint64(start + k)
        a, b = _number(keys[0], salts[0], index), _number(keys[1], salts[1], index)
        if stratified:
            a, b = ((start + k) // nv + a) / nu, ((start + k) % nv + b) / nv
        u[k], v[k] = a, b
    return u, v


@njit(**_OPTIONS)
def _basis(x, t, breaks, spans, p, out, slope):
    """First non-vanishing function; the p + 1 values and first derivatives by x at x go to out and slope."""
    low, high = 0, len(breaks) - 2  # guess from equal spans, then walk: at once right on an equispaced knot vector
    piece = min(max(int(x * (high + 1)), low), high)
    while piece > low and x < breaks[piece]:
        piece -= 1
    while piece < high and x >= breaks[piece + 1]:
        piece += 1
    s = spans[piece]
    out[0] = 1.0
    for k in range(1, p + 1):
        saved, saved_slope = 0.0, 0.0
        last = k == p
        for r in range(k):
            right, left = t[s + r + 1], t[s + r + 1 - k]
            term = out[r] / (right - left)
            if last:
                change = k * term
                slope[r] = saved_slope - change
                saved_slope = change
            out[r] = saved + (right - x) * term
            saved = (x - left) * term
        out[k] = saved
        if last:
            slope[k] = saved_slope
    return s - p


@njit(parallel=True, **_OPTIONS)
def evaluate(u, v, heights, tu, bu, su, p, tv, bv, sv, q, scale_x, scale_y, z, zx, zy, blocks):
    """Height and slopes at points (u, v) (N,) into z, zx, zy (N,): t knots, b breaks, s span of each break."""
    count = len(u)
    for block in prange(blocks):
        nu, du, nv, dv = np.empty(MAX_ORDER), np.empty(MAX_ORDER), np.empty(MAX_ORDER), np.empty(MAX_ORDER)
        for k in range(block * count // blocks, (block + 1) * count // blocks):
            i = _basis(u[k], tu, bu, su, p, nu, du)
            j = _basis(v[k], tv, bv, sv, q, nv, dv)
            value, along, across = 0.0, 0.0, 0.0
            for a in range(p + 1):
                row, slope = 0.0, 0.0
                for b in range(q + 1):
                    h = heights[i + a, j + b]
                    row += h * nv[b]
                    slope += h * dv[b]
                value += nu[a] * row
                along += du[a] * row
                across += nu[a] * slope
            z[k], zx[k], zy[k] = value, along * scale_x, across * scale_y


@njit(parallel=True, **_OPTIONS)
def pull_back(u, v, gz, gx, gy, shape, tu, bu, su, p, tv, bv, sv, q, scale_x, scale_y, blocks):
    """Adjoint of `evaluate`: derivative by the heights (n, m) float64, added block by block in order."""
    nets = np.zeros((blocks, shape[0], shape[1]))
    count = len(u)
    for block in prange(blocks):
        net = nets[block]
        nu, du, nv, dv = np.empty(MAX_ORDER), np.empty(MAX_ORDER), np.empty(MAX_ORDER), np.empty(MAX_ORDER)
        for k in range(block * count // blocks, (block + 1) * count // blocks):
            i = _basis(u[k], tu, bu, su, p, nu, du)
            j = _basis(v[k], tv, bv, sv, q, nv, dv)
            for a in range(p + 1):
                row = gz[k] * nu[a] + gx[k] * scale_x * du[a]
                slope = gy[k] * scale_y * nu[a]
                for b in range(q + 1):
                    net[i + a, j + b] += row * nv[b] + slope * dv[b]
    for block in range(1, blocks):
        nets[0] += nets[block]
    return nets[0]
