"""Shares of a ray among pixels, and their derivatives, for the CPU kernels: the functions of `reconstruction.Filter`.

Notation, in pixels: v filter size, r = (v - 1) / 2, phi sub-pixel position, q = 1/2 - phi, d = k - r + q the distance from
the centre of pixel k = 0..v - 1.  A Gaussian on the integer lattice needs two exponentials, whatever v.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

BINCOUNT, GAUSSIAN, COSINE = 0, 1, 2
#: Below this alpha (v/2)^2 the Gaussian's shares come from Taylor series, without cancellation; above LARGE from plain
#: exponentials, because the recursion over pixels would overflow.
SMALL, LARGE = 0.05, 80.0
TINY = 1e-3  # and below this from shorter ones

_OPTIONS = {"cache": True, "error_model": "numpy", "fastmath": {"contract", "nsz"}}


@njit(inline="always", **_OPTIONS)
def _sine_cosine(x):
    """sin and cos for |x| <= pi / 3 by Taylor series: the first terms left out are 7e-16 and 5e-17."""
    y = x * x
    s = 1.0 - y * (1 / 110.0) * (1.0 - y * (1 / 156.0) * (1.0 - y * (1 / 210.0)))
    s = 1.0 - y * (1 / 20.0) * (1.0 - y * (1 / 42.0) * (1.0 - y * (1 / 72.0) * s))
    s = x * (1.0 - y * (1 / 6.0) * s)
    c = 1.0 - y * (1 / 132.0) * (1.0 - y * (1 / 182.0) * (1.0 - y * (1 / 240.0)))
    c = 1.0 - y * (1 / 30.0) * (1.0 - y * (1 / 56.0) * (1.0 - y * (1 / 90.0) * c))
    c = 1.0 - y * (1 / 2.0) * (1.0 - y * (1 / 12.0) * c)
    return s, c


@njit(inline="always", **_OPTIONS)
def _exp_small(x):
    """exp(x) for |x| <= 2: exp(x / 8)^8, relative error about 1e-14."""
    z = 0.125 * x
    e = 1.0 + z * (1.0 + z * (1 / 2 + z * (1 / 6 + z * (1 / 24 + z * (1 / 120 + z * (
        1 / 720 + z * (1 / 5040 + z * (1 / 40320 + z * (1 / 362880 + z / 3628800)))))))))
    e *= e
    e *= e
    return e * e


@njit(inline="always", **_OPTIONS)
def _gaussian(phi, v, alpha, constants, out, slope, sloping):
    """Shares, and with `sloping` their derivatives by phi, of a Gaussian truncated at v / 2; constants: see `table`."""
    r = (v - 1) // 2
    q = 0.5 - phi
    square = 0.25 * v * v
    total = 0.0
    if alpha * square < SMALL:  # both divided by alpha exp(-alpha (v/2)^2); every series' argument is below SMALL
        short = alpha * square < TINY
        for k in range(v):
            d = k - r + q
            room = max(square - d * d, 0.0)
            x = alpha * room
            y = alpha * d * d
            if short:
                e = 1.0 - y * (1.0 - y * (1 / 2.0) * (1.0 - y * (1 / 3.0)))
                p = 1.0 - x * (1 / 2.0) * (1.0 - x * (1 / 3.0) * (1.0 - x * (1 / 4.0)))
            else:
                e = 1.0 - y * (1 / 4.0) * (1.0 - y * (1 / 5.0) * (1.0 - y * (1 / 6.0)))
                e = 1.0 - y * (1.0 - y * (1 / 2.0) * (1.0 - y * (1 / 3.0) * e))
                p = 1.0 - x * (1 / 5.0) * (1.0 - x * (1 / 6.0) * (1.0 - x * (1 / 7.0)))
                p = 1.0 - x * (1 / 2.0) * (1.0 - x * (1 / 3.0) * (1.0 - x * (1 / 4.0) * p))
            out[k] = room * p * e
            total += out[k]
            if sloping:
                slope[k] = 2.0 * d * e
    elif alpha <= LARGE:  # both divided by exp(-alpha q^2): exp(-alpha (d^2 - q^2)) follows from pixel to pixel
        if alpha <= 2.0:
            edge = constants[0] * _exp_small(alpha * q * q)
            up = _exp_small(-2.0 * alpha * q)
        else:
            edge = math.exp(-alpha * (square - q * q))
            up = math.exp(-2.0 * alpha * q)
        ratio_up, ratio_down = up * constants[1], constants[1] / up
        rise, fall = 1.0, 1.0
        out[r] = 1.0 - edge
        total = out[r]
        if sloping:
            slope[r] = 2.0 * alpha * q
        for k in range(1, r + 1):
            rise *= ratio_up
            fall *= ratio_down
            ratio_up *= constants[2]
            ratio_down *= constants[2]
            out[r + k] = max(rise - edge, 0.0)
            out[r - k] = max(fall - edge, 0.0)
            total += out[r + k] + out[r - k]
            if sloping:
                slope[r + k] = 2.0 * alpha * (q + k) * rise
                slope[r - k] = 2.0 * alpha * (q - k) * fall
    else:
        for k in range(v):
            d = k - r + q
            e = math.exp(-alpha * (d * d - q * q))
            out[k] = -e * math.expm1(-alpha * max(square - d * d, 0.0))
            total += out[k]
            if sloping:
                slope[k] = 2.0 * alpha * d * e
    inverse = 1.0 / total
    for k in range(v):
        out[k] *= inverse
    if sloping:
        change = 0.0
        for k in range(v):
            change += slope[k]
        for k in range(v):
            slope[k] = (slope[k] - out[k] * change) * inverse


@njit(inline="always", **_OPTIONS)
def shares(kind, phi, v, alpha, constants, out, slope, sloping):
    """Shares of a ray at sub-pixel position phi among its v pixels, and with `sloping` their derivatives by phi."""
    if v == 1:
        out[0] = 1.0
        slope[0] = 0.0
    elif kind == COSINE:  # cos(theta (k - r + q)) by addition from one sine and cosine
        theta = 2.0 * math.pi / v
        s, c = _sine_cosine(theta * (0.5 - phi))
        each = 1.0 / v
        for k in range(v):
            out[k] = each + c * constants[k] - s * constants[v + k]
        if sloping:
            for k in range(v):
                slope[k] = theta * (s * constants[k] + c * constants[v + k])
    else:
        _gaussian(phi, v, alpha, constants, out, slope, sloping)


@njit(**_OPTIONS)
def table(kind, v, alpha):
    """Constants of an axis: cos and sin of 2 pi (k - r) / v over v, or exp(-alpha v^2 / 4), exp(-alpha), exp(-2 alpha)."""
    out = np.zeros(2 * v + 3)
    if kind == COSINE:
        for k in range(v):
            out[k] = math.cos(2.0 * math.pi * (k - (v - 1) // 2) / v) / v
            out[v + k] = math.sin(2.0 * math.pi * (k - (v - 1) // 2) / v) / v
    else:
        out[0], out[1], out[2] = math.exp(-0.25 * alpha * v * v), math.exp(-alpha), math.exp(-2.0 * alpha)
    return out
