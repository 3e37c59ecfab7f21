"""Ray integration in a medium whose index is a polynomial of one variable, with the adjoint: the
index of a `flow`.

Notation, beside that of `integrator`
    s       r^2 = x^2 + y^2, or z;  e = grad s, (2 x, 2 y, 0) or (0, 0, 1)
    v(s)    polynomial, which n is, or n^2
    G(s)    half the derivative of n^2 by s, so that F = G e: n v', or v' / 2

    (dF/dq)^T l = G' (e . l) e + G (2 l_x, 2 l_y, 0), the last for s = r^2
"""

from __future__ import annotations

import math

from caustic_cli.optics.kernels.flow import IndexFlow
from caustic_cli.optics.kernels.jit import FAST, njit


@njit(inline="always", **FAST)
def _medium(s, terms, squared, least):
    """n^2, n, G and G'; n^2 is cut off for n as in the reference."""
    v, slope, curve = 0.0, 0.0, 0.0
    for k in range(len(terms) - 1, -1, -1):
        curve = curve * s + 2.0 * slope
        slope = slope * s + v
        v = v * s + terms[k]
    if squared:
        return v, math.sqrt(max(v, least)), 0.5 * slope, 0.5 * curve
    return v * v, math.sqrt(max(v * v, least)), v * slope, slope * slope + v * curve


@njit(inline="always", **FAST)
def _index(terms, medium, x, y, z, _room):
    axial, squared, least = medium
    square, n, g, _ = _medium(z if axial else x * x + y * y, terms, squared, least)
    if axial:
        return square, n, 0.0, 0.0, g
    return square, n, 2.0 * g * x, 2.0 * g * y, 0.0


@njit(inline="always", **FAST)
def _adjoint(terms, medium, x, y, z, mx, my, mz, s, t, _b, _room, _by_c):
    axial, squared, least = medium
    square, n, g, slope = _medium(z if axial else x * x + y * y, terms, squared, least)
    ex, ey, ez = (0.0, 0.0, 1.0) if axial else (2.0 * x, 2.0 * y, 0.0)
    along = slope * (ex * mx + ey * my + ez * mz) + s * g + (t * g / n if square > least else 0.0)
    across = 0.0 if axial else 2.0 * g
    return square, n, g * ex, g * ey, g * ez, along * ex + across * mx, along * ey + across * my, along * ez


#: A function of the coefficients of v, the constant first, of (whether s = z, whether v is n^2, n^2 below which n is cut off), and
#: of what `IndexFlow` takes besides.
formula_flow = IndexFlow.of(_index, _adjoint)
