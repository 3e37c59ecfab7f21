"""Filter weights of rays on pixels, and their derivatives, in batches: the functions of `reconstruction.Filter`.

Every loop writes one array from a few others, so that the compiler can vectorise it.

Notation, in pixels: v filter size, r = (v - 1) / 2, phi sub-pixel position, q = 1/2 - phi, d = k - r + q the distance from
the centre of pixel k = 0..v - 1.  A Gaussian on the integer lattice needs two exponentials, whatever v.
"""

from __future__ import annotations

import math

from caustic_cli.optics.kernels.jit import FAST, njit

BINCOUNT, GAUSSIAN, COSINE = 0, 1, 2
#: Filters of `reconstruction` by name.
KINDS = {"bincount": BINCOUNT, "gaussian": GAUSSIAN, "cosine": COSINE}
#: Below this alpha (v/2)^2 the Gaussian's weights come from Taylor series, without cancellation, which costs 200 ulp above.
SMALL = 5e-3
#: Up to this alpha exp(-2 alpha q) stays within the reach of `_exp` and the recursion over pixels; above, plain exponentials.
MODERATE = 2.0


@njit(inline="always", **FAST)
def _exp(x):
    """exp(x) for |x| <= 2: exp(x / 8)^8, relative error about 1e-14, without a branch."""
    z = 0.125 * x
    e = 1 / 5040 + z * (1 / 40320 + z * (1 / 362880 + z * (1 / 3628800)))
    e = 1.0 + z * (1.0 + z * (1 / 2 + z * (1 / 6 + z * (1 / 24 + z * (1 / 120 + z * (1 / 720 + z * e))))))
    e *= e
    e *= e
    return e * e


@njit(inline="always", **FAST)
def _sine(x):
    """sin(x) for |x| <= pi / 3 by its Taylor series: the first term left out is 4e-15."""
    y = x * x
    s = 1.0 - y * (1 / 110.0) * (1.0 - y * (1 / 156.0) * (1.0 - y * (1 / 210.0)))
    return x * (1.0 - y * (1 / 6.0) * (1.0 - y * (1 / 20.0) * (1.0 - y * (1 / 42.0) * (1.0 - y * (1 / 72.0) * s))))


@njit(inline="always", **FAST)
def _cosine(x):
    """cos(x) for |x| <= pi / 3 by its Taylor series: the first term left out is 3e-16."""
    y = x * x
    c = 1.0 - y * (1 / 132.0) * (1.0 - y * (1 / 182.0) * (1.0 - y * (1 / 240.0)))
    c = 1.0 - y * (1 / 56.0) * (1.0 - y * (1 / 90.0) * c)
    return 1.0 - y * (1 / 2.0) * (1.0 - y * (1 / 12.0) * (1.0 - y * (1 / 30.0) * c))


@njit(inline="always", **FAST)
def _raised_cosine(phi, v, out, slope, scratch):
    theta = 2.0 * math.pi / v
    for j in range(len(phi)):
        scratch[0, j] = _cosine(theta * (0.5 - phi[j])) / v
    for j in range(len(phi)):
        scratch[1, j] = _sine(theta * (0.5 - phi[j])) / v
    for k in range(v):  # cos(theta (k - r + q)) by addition
        c, s = math.cos(theta * (k - (v - 1) // 2)), math.sin(theta * (k - (v - 1) // 2))
        _mix(1.0 / v, c, -s, scratch[0], scratch[1], out[k][: len(phi)])
        if len(slope):
            _mix(0.0, theta * s, theta * c, scratch[0], scratch[1], slope[k][: len(phi)])


@njit(**FAST)
def _mix(constant, a, b, x, y, out):
    for j in range(len(out)):
        out[j] = constant + a * x[j] + b * y[j]


@njit(inline="always", **FAST)
def _decay(y):
    """exp(-y) for y below SMALL: the first term left out is 3e-14."""
    return 1.0 - y * (1.0 - y * (1 / 2.0) * (1.0 - y * (1 / 3.0) * (1.0 - y * (1 / 4.0))))


@njit(inline="always", **FAST)
def _series(phi, offset, square, alpha, out):
    """A pixel's weight of a very wide Gaussian, divided by alpha exp(-alpha (v/2)^2), by a series in arguments below SMALL."""
    for j in range(len(phi)):
        d = offset - phi[j]
        room = max(square - d * d, 0.0)
        x = alpha * room
        p = 1.0 - x * (1 / 2.0) * (1.0 - x * (1 / 3.0) * (1.0 - x * (1 / 4.0) * (1.0 - x * (1 / 5.0))))
        out[j] = room * p * _decay(alpha * d * d)


@njit(inline="always", **FAST)
def _series_slope(phi, offset, alpha, out):
    for j in range(len(phi)):
        d = offset - phi[j]
        out[j] = 2.0 * d * _decay(alpha * d * d)


@njit(inline="always", **FAST)
def _recursion(phi, v, alpha, out, slope, scratch):
    """Shares over exp(-alpha q^2): exp(-alpha (d^2 - q^2)) follows from pixel to pixel."""
    r = (v - 1) // 2
    edge, up, down, rise, fall = scratch[0], scratch[1], scratch[2], scratch[3][: len(phi)], scratch[4][: len(phi)]
    least = math.exp(-0.25 * alpha * v * v)
    for j in range(len(phi)):
        edge[j] = least * _exp(alpha * (0.5 - phi[j]) * (0.5 - phi[j]))
    for j in range(len(phi)):
        up[j] = _exp(-2.0 * alpha * (0.5 - phi[j]))
    for j in range(len(phi)):
        down[j] = 1.0 / up[j]
    rise[:] = 1.0
    fall[:] = 1.0
    for k in range(r + 1):
        if k:
            ratio = math.exp(-alpha * (2 * k - 1))
            for j in range(len(phi)):
                rise[j] *= ratio * up[j]
            for j in range(len(phi)):
                fall[j] *= ratio * down[j]
            _above(fall, edge, out[r - k])
            if len(slope):
                _lean(phi, -k, alpha, fall, slope[r - k])
        _above(rise, edge, out[r + k])
        if len(slope):
            _lean(phi, k, alpha, rise, slope[r + k])


@njit(**FAST)
def _above(value, edge, out):
    for j in range(len(value)):
        out[j] = max(value[j] - edge[j], 0.0)


@njit(**FAST)
def _lean(phi, k, alpha, value, out):
    for j in range(len(phi)):
        out[j] = 2.0 * alpha * (0.5 - phi[j] + k) * value[j]


@njit(inline="always", **FAST)
def _exponentials(phi, v, alpha, out, slope):
    """Shares over exp(-alpha q^2) of a narrow Gaussian, whose recursion would overflow."""
    for k in range(v):
        for j in range(len(phi)):
            q = 0.5 - phi[j]
            d = k - (v - 1) // 2 + q
            e = math.exp(-alpha * (d * d - q * q))
            out[k, j] = -e * math.expm1(-alpha * max(0.25 * v * v - d * d, 0.0))
            if len(slope):
                slope[k, j] = 2.0 * alpha * d * e


@njit(**FAST)
def _sum(rows, out):
    if len(rows) == 3:
        a, b, c = rows[0], rows[1], rows[2]
        for j in range(len(out)):
            out[j] = a[j] + b[j] + c[j]
        return
    out[:] = 0.0
    for k in range(len(rows)):
        row = rows[k]
        for j in range(len(out)):
            out[j] += row[j]


@njit(inline="always", **FAST)
def _level(value, over, lean, slope):
    for j in range(len(over)):
        slope[j] -= value[j] * over[j] * lean[j]


@njit(**FAST)
def pixel_weights(kind, v, alpha, phi, out, slope, over, lean, scratch):
    """Weights of rays at sub-pixel positions phi (b,), up to normalisation: out (v, at least b), the weight is out * over.

    Unless `slope` is empty, their derivatives by phi are (slope - out * lean) * over.  The normalisation by `over` is left to the
    caller, which needs one product per ray instead of one per pixel.

    scratch: (5, at least b).
    """
    over[:] = 1.0
    if len(slope):
        lean[:] = 0.0
    if v == 1:
        out[0][: len(phi)] = 1.0
        if len(slope):
            slope[0][: len(phi)] = 0.0
        return
    if kind == COSINE:
        _raised_cosine(phi, v, out, slope, scratch)
        return
    square = 0.25 * v * v
    if alpha * square < SMALL:
        for k in range(v):
            offset = k - (v - 1) // 2 + 0.5
            _series(phi, offset, square, alpha, out[k])
            if len(slope):
                _series_slope(phi, offset, alpha, slope[k])
    elif alpha <= MODERATE:
        _recursion(phi, v, alpha, out, slope, scratch)
    else:
        _exponentials(phi, v, alpha, out, slope)
    _sum(out, over)
    for j in range(len(over)):
        over[j] = 1.0 / over[j]
    if len(slope):
        _sum(slope, lean)
        if alpha > MODERATE:  # slopes of a narrow Gaussian all but cancel: before they are summed over pixels, not after
            for k in range(v):
                _level(out[k], over, lean, slope[k])
            lean[:] = 0.0
        for j in range(len(lean)):
            lean[j] *= over[j]
