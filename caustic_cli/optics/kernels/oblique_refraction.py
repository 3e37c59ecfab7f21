"""Refraction of a row of rays of any direction at the exit surface and transfer to an upright screen, with the adjoint, for the CPU
kernels: the batch functions of `refraction` and `transfer` one after another.

Input: distances along the rays to their intersections (mm; -1 for none), dz/dx and dz/dy there, x and y of the origins, transverse
components of unit directions, and powers.  Output, in `rows`' vectors: POWER, PX, PY, FLUX.
"""

from __future__ import annotations

import math

import numpy as np

from caustic_cli.optics.kernels import refraction, rows, transfer
from caustic_cli.optics.kernels.jit import FAST, njit
from caustic_cli.optics.kernels.refraction import AFTER, DX, DY, DZ, GX, GY, PASSES, TX, TY, TZ, P
from caustic_cli.optics.kernels.rows import BESIDE, MISSED_POWER, REFLECTED_POWER
from caustic_cli.optics.kernels.stage import BATCH, load, store

# Rows of a batch's scratch behind those of `refraction`: the distance and the origin; power and landing point, or derivatives by
# them; the derivative by the distance.  A second scratch has the rows of `transfer`.
REACH, X, Y, POWER, PX, PY, BY_REACH, ROWS = range(refraction.ROWS, refraction.ROWS + 8)
FLIGHT = transfer.ROWS


@njit(inline="always", **FAST)
def _leave(w, u, count, exit_):
    """Refraction, and the rays behind the surface; their origins are the intersections."""
    for j in range(count):
        w[DZ, j] = math.sqrt(max(1.0 - w[DX, j] * w[DX, j] - w[DY, j] * w[DY, j], 0.0))
    refraction.bend(w, count, refraction.Interface(exit_.index, exit_.fresnel, False))
    for j in range(count):
        t = w[REACH, j]
        u[transfer.OX, j], u[transfer.OY, j] = w[X, j] + t * w[DX, j], w[Y, j] + t * w[DY, j]
        u[transfer.OZ, j] = exit_.start + t * w[DZ, j]
        u[transfer.DX, j], u[transfer.DY, j], u[transfer.DZ, j] = w[TX, j], w[TY, j], w[TZ, j]


@njit(inline="always", **FAST)
def _screen(exit_):
    return transfer.TargetPlane(0.0, 0.0, exit_.height, 1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0, 1.0)


@njit(inline="always", **FAST)
def aim_batch(w, u, count, exit_, frame):
    """Powers and landing points, in pixels, from distances, origins, directions, slopes and P."""
    over_x, over_y = 1.0 / frame.pixel_x, 1.0 / frame.pixel_y
    _leave(w, u, count, exit_)
    transfer.reach_plane(u, count, _screen(exit_))
    for j in range(count):
        power = w[AFTER, j] if w[PASSES, j] > 0.0 else REFLECTED_POWER
        w[POWER, j] = power if w[REACH, j] >= 0.0 else MISSED_POWER
        w[PX, j] = (u[transfer.X, j] - frame.low_x) * over_x if u[transfer.ON_WAY, j] > 0.0 else BESIDE
        w[PY, j] = (u[transfer.Y, j] - frame.low_y) * over_y


@njit(inline="always", **FAST)
def pull_batch(w, u, count, exit_):
    """Derivatives by distances and slopes in BY_REACH, BY_GX, BY_GY, from those by powers and landing points, per mm."""
    _leave(w, u, count, exit_)
    for j in range(count):
        u[transfer.X, j], u[transfer.Y, j] = w[PX, j], w[PY, j]
    transfer.pull(u, count, _screen(exit_))
    for j in range(count):
        w[TX, j], w[TY, j], w[TZ, j] = u[transfer.BY_DX, j], u[transfer.BY_DY, j], u[transfer.BY_DZ, j]
        w[AFTER, j] = w[POWER, j]
    refraction.pull(w, count, exit_.index)
    for j in range(count):
        by_x, by_y, by_z, lit = u[transfer.BY_OX, j], u[transfer.BY_OY, j], u[transfer.BY_OZ, j], w[REACH, j] >= 0.0
        w[BY_REACH, j] = by_x * w[DX, j] + by_y * w[DY, j] + by_z * w[DZ, j] if lit else 0.0
        w[refraction.BY_GX, j] = w[refraction.BY_GX, j] if lit else 0.0
        w[refraction.BY_GY, j] = w[refraction.BY_GY, j] if lit else 0.0


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
    w, u = np.empty((ROWS, BATCH)), np.empty((FLIGHT, BATCH))
    for start in range(0, v.shape[1], BATCH):
        count = min(BATCH, v.shape[1] - start)
        _load(w, start, count, i, surface, rays)
        aim_batch(w, u, count, exit_, frame)
        store(w[POWER], start, count, v[rows.POWER])
        store(w[PX], start, count, v[rows.PX])
        store(w[PY], start, count, v[rows.PY])
        store(w[P], start, count, v[rows.FLUX])


@njit(**FAST)
def pull(v, i, surface, rays, exit_, nets):
    """Derivatives by row i of distances and slopes into `nets` (3, a, b).  BY_PX, BY_PY of v: per mm."""
    w, u = np.empty((ROWS, BATCH)), np.empty((FLIGHT, BATCH))
    for start in range(0, v.shape[1], BATCH):
        count = min(BATCH, v.shape[1] - start)
        _load(w, start, count, i, surface, rays)
        load(v[rows.BY_POWER], start, count, w[POWER])
        load(v[rows.BY_PX], start, count, w[PX])
        load(v[rows.BY_PY], start, count, w[PY])
        pull_batch(w, u, count, exit_)
        store(w[BY_REACH], start, count, nets[0, i])
        store(w[refraction.BY_GX], start, count, nets[1, i])
        store(w[refraction.BY_GY], start, count, nets[2, i])
