"""CPU kernels for reflection at a smooth surface, with adjoint.

Rays are float64 components, see `stage`; the reference is `interface.reflect`.

Notation, a ray with unit direction d and slopes g of the surface at its hit; N = (-g_x, -g_y, 1)
    h       1 / |N|^2
    m       2 (d . N) h
    t       d - m N, the same from both sides of the surface

by_v is the derivative of whatever is differentiated by v.
"""

from __future__ import annotations

from caustic_cli.optics.kernels.jit import FAST, njit
from caustic_cli.optics.kernels.stage import RayStage, load, store, store_flags

DX, DY, DZ, GX, GY, BY_TX, BY_TY, BY_TZ, BY_DX, BY_DY, BY_DZ, BY_GX, BY_GY, ROWS = range(14)


@njit(inline="always", **FAST)
def _m(v, j):
    """h and m of ray j."""
    gx, gy = v[GX, j], v[GY, j]
    h = 1.0 / (1.0 + gx * gx + gy * gy)
    return h, 2.0 * (v[DZ, j] - v[DX, j] * gx - v[DY, j] * gy) * h


@njit(inline="always", **FAST)
def _reflect(v, start, count, ray, _parameters, _given, out):
    """t from d and g."""
    t, passes = out
    for i in range(5):
        load(ray[i], start, count, v[i])
    for j in range(count):
        h, m = _m(v, j)
        v[BY_TX, j], v[BY_TY, j], v[BY_TZ, j] = v[DX, j] + m * v[GX, j], v[DY, j] + m * v[GY, j], v[DZ, j] - m
        v[BY_DX, j] = h
    for i in range(3):
        store(v[BY_TX + i], start, count, t[i])
    store_flags(v[BY_DX], start, count, passes)


@njit(inline="always", **FAST)
def _pull(v, start, count, ray, _parameters, given, out):
    """The adjoint."""
    for i in range(5):
        load(ray[i], start, count, v[i])
    for i in range(3):
        load(given[i], start, count, v[BY_TX + i])
    for j in range(count):
        (h, m), gx, gy, tx, ty = _m(v, j), v[GX, j], v[GY, j], v[BY_TX, j], v[BY_TY, j]
        # t
        by_m = gx * tx + gy * ty - v[BY_TZ, j]
        # m
        by_c, by_norm2 = 2.0 * h * by_m, -m * h * by_m
        # d . N and |N|^2
        v[BY_DX, j], v[BY_DY, j], v[BY_DZ, j] = tx - by_c * gx, ty - by_c * gy, v[BY_TZ, j] + by_c
        v[BY_GX, j] = m * tx - by_c * v[DX, j] + 2.0 * gx * by_norm2
        v[BY_GY, j] = m * ty - by_c * v[DY, j] + 2.0 * gy * by_norm2
    for i in range(5):
        store(v[BY_DX + i], start, count, out[i])


REFLECT = RayStage.of(_reflect, _pull, ROWS, 3)
