"""Refraction of a row of rays of any direction at the exit surface and transfer to an upright screen, with the adjoint, for the CPU
kernels: `refraction.bend` and the transfer one after another.

Input: distances along the rays to their intersections (mm; -1 for none), dz/dx and dz/dy there, x and y of the origins, transverse
components of unit directions, and powers.  Output, in `rows`' vectors: POWER, PX, PY, FLUX.
"""

from __future__ import annotations

import math

import numpy as np

from caustic_cli.optics.kernels import rows
from caustic_cli.optics.kernels.jit import FAST, njit
from caustic_cli.optics.kernels.refraction import bend
from caustic_cli.optics.kernels.refraction import pull as pull_refraction
from caustic_cli.optics.kernels.rows import BESIDE, MISSED_POWER, REFLECTED_POWER
from caustic_cli.optics.kernels.stage import BATCH, load, store
from caustic_cli.optics.tolerances import PARALLEL

# Rows of a batch's scratch: the ray; power and landing point, or in the adjoint derivatives by them; derivatives by the input.
REACH, GX, GY, DX, DY, P, X, Y, POWER, PX, PY, BY_REACH, BY_GX, BY_GY, ROWS = range(15)


@njit(inline="always", **FAST)
def _path(z, tz, height):
    """k of `transfer` to an upright screen, 1 / v, and whether the ray is on its way: products with the plane's zeros and ones take
    time, since the compiler must keep them."""
    arrives = tz > PARALLEL
    over = 1.0 / (tz if arrives else 1.0)
    k = (height - z) * over
    on_way = arrives & (k > 0.0)
    return k if on_way else 0.0, over, on_way


# No array is passed on inside these loops, nor taken from a tuple: they would not be vectorised.


@njit(inline="always", **FAST)
def aim_batch(w, count, exit_, frame):
    """Powers and landing points, in pixels."""
    n, fresnel, begin, height = exit_.eta, exit_.fresnel, exit_.start, exit_.height
    over_x, over_y, low_x, low_y = 1.0 / frame.pixel_x, 1.0 / frame.pixel_y, frame.low_x, frame.low_y
    for j in range(count):
        t, gx, gy, dx, dy = w[REACH, j], w[GX, j], w[GY, j], w[DX, j], w[DY, j]
        dz = math.sqrt(max(1.0 - dx * dx - dy * dy, 0.0))
        tx, ty, tz, kept, passes = bend(dx, dy, dz, gx, gy, 0.5, n, fresnel)
        k, _, on_way = _path(begin + t * dz, tz, height)
        power = w[P, j] * kept if passes else REFLECTED_POWER
        w[POWER, j] = power if t >= 0.0 else MISSED_POWER
        w[PX, j] = (w[X, j] + t * dx + k * tx - low_x) * over_x if on_way else BESIDE
        w[PY, j] = (w[Y, j] + t * dy + k * ty - low_y) * over_y


@njit(inline="always", **FAST)
def pull_batch(w, count, exit_):
    """Derivatives by distances and slopes, from those by powers and landing points, per mm."""
    n, fresnel, begin, height = exit_.eta, exit_.fresnel, exit_.start, exit_.height
    for j in range(count):
        t, gx, gy, dx, dy, power, by_power = w[REACH, j], w[GX, j], w[GY, j], w[DX, j], w[DY, j], w[P, j], w[POWER, j]
        dz = math.sqrt(max(1.0 - dx * dx - dy * dy, 0.0))
        tx, ty, tz, _, _ = bend(dx, dy, dz, gx, gy, 0.5, n, fresnel)
        k, over, on_way = _path(begin + t * dz, tz, height)
        by_x, by_y = w[PX, j], w[PY, j]
        by_z = -(by_x * tx + by_y * ty) * over if on_way else 0.0
        by_tx, by_ty, by_tz = k * by_x, k * by_y, k * by_z
        _, _, _, by_gx, by_gy, _, _ = pull_refraction(dx, dy, dz, gx, gy, 0.5, power, n, fresnel, by_tx, by_ty, by_tz, by_power)
        by_reach, lit = by_x * dx + by_y * dy + by_z * dz, t >= 0.0
        w[BY_REACH, j], w[BY_GX, j], w[BY_GY, j] = by_reach if lit else 0.0, by_gx if lit else 0.0, by_gy if lit else 0.0


@njit(inline="always", **FAST)
def _load(w, start, count, i, surface, rays):
    """A batch of row i."""
    load(surface.net[i], start, count, w[REACH])
    load(surface.net_x[i], start, count, w[GX])
    load(surface.net_y[i], start, count, w[GY])
    rows.load(rays.along_x[i][start : start + count], w[DX][:count])
    rows.load(rays.along_y[i][start : start + count], w[DY][:count])
    rows.load(rays.flux[i][start : start + count], w[P][:count])
    rows.load(rays.x[i][start : start + count], w[X][:count])
    rows.load(rays.y[i][start : start + count], w[Y][:count])


@njit(**FAST)
def aim(v, i, surface, rays, exit_, frame):
    """Powers and landing points of row i in pixels, and the rays' powers in front, in FLUX."""
    w = np.empty((ROWS, BATCH))
    for start in range(0, v.shape[1], BATCH):
        count = min(BATCH, v.shape[1] - start)
        _load(w, start, count, i, surface, rays)
        aim_batch(w, count, exit_, frame)
        store(w[POWER], start, count, v[rows.POWER])
        store(w[PX], start, count, v[rows.PX])
        store(w[PY], start, count, v[rows.PY])
        store(w[P], start, count, v[rows.FLUX])


@njit(**FAST)
def pull(v, i, surface, rays, exit_, nets):
    """Derivatives by row i of distances and slopes into `nets` (3, a, b).  BY_PX, BY_PY of v: per mm."""
    w = np.empty((ROWS, BATCH))
    for start in range(0, v.shape[1], BATCH):
        count = min(BATCH, v.shape[1] - start)
        _load(w, start, count, i, surface, rays)
        load(v[rows.BY_POWER], start, count, w[POWER])
        load(v[rows.BY_PX], start, count, w[PX])
        load(v[rows.BY_PY], start, count, w[PY])
        pull_batch(w, count, exit_)
        store(w[BY_REACH], start, count, nets[0, i])
        store(w[BY_GX], start, count, nets[1, i])
        store(w[BY_GY], start, count, nets[2, i])
