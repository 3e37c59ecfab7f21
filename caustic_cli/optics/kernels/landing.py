"""Rows of rays in front of the exit surface -> their powers behind it and landing points, with the adjoint, batch by batch, for the
CPU kernels.

What lies in front of the exit differs, and each of these is compiled apart:

    rays of any direction       the surface is given by the distances along them and by slopes, see `ray_intersections`
    rays of a source point      through given points of the exit, see `optics.pencil`
    parallel rays               through given points of the exit, or of a mirror, see `optics.beam`

The notation is theirs.  Directions of the latter two are (k_x, k_y, 1), so that nothing has to be normalised.  Refraction and
landing are one for all.
"""

from __future__ import annotations

import math

import numpy as np

from caustic_cli.optics.kernels import refraction, rows, transfer
from caustic_cli.optics.kernels.jit import FAST, njit
from caustic_cli.optics.kernels.stage import BATCH, load, store

# Rows of a batch's scratch: points of the exit and slopes, distances along rays of any direction and their directions, powers of
# these or areas; of a source point u, the variable of the emission J, it and its derivative; powers in front and behind and landing
# points, or derivatives by these; derivatives.
X, Y, Z, GX, GY, REACH, DX, DY, P, U, AT, J, J_S, FLUX, POWER, PX, PY, BY_Z, BY_GX, BY_GY, ROWS = range(21)

# No array is passed on inside these loops, nor taken from a tuple: they would not be vectorised.


@njit(inline="always", **FAST)
def _slope(q, z, u, point):
    """c and h + z n^2 c^3, the derivative of u (h + z c) by u."""
    n = point.n
    c = 1.0 / math.sqrt(n * n + (n - 1.0) * (n + 1.0) * q * u * u)
    return c, point.distance + z * n * n * c * c * c


@njit(inline="always", **FAST)
def _cross(w, count, start, point):
    """u of a batch, by Newton steps from the paraxial value, from which they increase to the root."""
    h, n = point.distance, point.n
    for j in range(count):
        w[AT, j], w[U, j] = w[X, j] * w[X, j] + w[Y, j] * w[Y, j], n / (n * h + w[Z, j] - start)
    for _ in range(point.steps):
        for j in range(count):
            q, z, u = w[AT, j], w[Z, j] - start, w[U, j]
            c, by_u = _slope(q, z, u, point)
            w[U, j] = u - (u * (h + z * c) - 1.0) / by_u


@njit(inline="always", **FAST)
def _emit(w, count, point, emission):
    """J of a batch and its derivative by s, by Horner's scheme in 2 s / s_max - 1."""
    for j in range(count):
        t = (w[X, j] * w[X, j] + w[Y, j] * w[Y, j]) * w[U, j] * w[U, j]
        w[AT, j], w[J, j], w[J_S, j] = point.scale * t / (1.0 + t) - 1.0, emission[0], 0.0
    for k in range(1, len(emission)):
        one = emission[k]
        for j in range(count):
            w[J_S, j] = w[J_S, j] * w[AT, j] + w[J, j]
            w[J, j] = w[J, j] * w[AT, j] + one
    for j in range(count):
        w[J_S, j] *= point.scale


# Of ray j: point, direction and power in front of the exit, and whether light arrives.


@njit(inline="always", **FAST)
def _met(w, j, start):
    """Rays of any direction from this height."""
    dx, dy, t = w[DX, j], w[DY, j], w[REACH, j]
    square = 1.0 - dx * dx - dy * dy
    dz = math.sqrt(square if square > 0.0 else 0.0)
    x, y, z = w[X, j] + t * dx, w[Y, j] + t * dy, start + t * dz
    return x, y, z, dx, dy, dz, w[P, j], t >= 0.0


@njit(inline="always", **FAST)
def _shone(w, j, start, light):
    """Parallel rays, through the aperture of an entrance at this height."""
    x, y, depth = w[X, j], w[Y, j], w[Z, j] - start
    u, v = (x - light.kx * depth) * light.over_x, (y - light.ky * depth) * light.over_y
    inside = u * u + v * v <= 1.0 if light.round else (u * u <= 1.0) & (v * v <= 1.0)
    m = 1.0 - light.kx * w[GX, j] - light.ky * w[GY, j]
    lit = inside & (m > 0.0)
    return x, y, w[Z, j], light.kx, light.ky, 1.0, w[P, j] * light.power * m if lit else 0.0, lit


@njit(inline="always", **FAST)
def _emitted(w, j, start, point):
    """Rays of a source point, through an entrance at this height: none arrives from above the surface."""
    x, y, u = w[X, j], w[Y, j], w[U, j]
    c, by_u = _slope(x * x + y * y, w[Z, j] - start, u, point)
    k = u * c
    m = 1.0 - k * (x * w[GX, j] + y * w[GY, j])
    return x, y, w[Z, j], k * x, k * y, 1.0, w[P, j] * w[J, j] * u / by_u * m if m > 0.0 else 0.0, m > 0.0


@njit(inline="always", **FAST)
def _pull_emitted(w, j, start, point, by_dx, by_dy, by_p):
    """By height and slopes, by way of direction and power: k and u depend on z at fixed x and y."""
    x, y, z, u, n2 = w[X, j], w[Y, j], w[Z, j] - start, w[U, j], point.n * point.n
    q = x * x + y * y
    c, by_u = _slope(q, z, u, point)
    k, across, part = u * c, x * w[GX, j] + y * w[GY, j], w[P, j] * u / by_u
    by_m = part * w[J, j] * by_p
    by_k = x * by_dx + y * by_dy - across * by_m
    c3, t = n2 * c * c * c, 1.0 + q * u * u
    u_z = -k / by_u
    c_z, s_z = -c * c * c * (n2 - 1.0) * q * u * u_z, 2.0 * q * u * u_z / (t * t)
    shrinks = (c + c3 + 3.0 * z * n2 * c * c * c_z) / by_u
    density_z = part * (w[J_S, j] * s_z - w[J, j] * shrinks)
    return by_k * u_z * c3 + by_p * (1.0 - k * across) * density_z, -k * x * by_m, -k * y * by_m


@njit(inline="always", **FAST)
def _take(w, v, start, count, i, surface, rays, oblique):
    """A batch of row i."""
    rows.load(rays.x[i][start : start + count], w[X][:count])
    rows.load(rays.y[i][start : start + count], w[Y][:count])
    rows.load(rays.flux[i][start : start + count], w[P][:count])
    if oblique is not None:
        load(surface.net[i], start, count, w[REACH])
        load(surface.net_x[i], start, count, w[GX])
        load(surface.net_y[i], start, count, w[GY])
        rows.load(rays.along_x[i][start : start + count], w[DX][:count])
        rows.load(rays.along_y[i][start : start + count], w[DY][:count])
    else:
        load(v[rows.SAG], start, count, w[Z])
        load(v[rows.GX], start, count, w[GX])
        load(v[rows.GY], start, count, w[GY])


@njit(inline="always", **FAST)
def _aim(w, count, exit_, frame, oblique, point, parallel):
    n, fresnel, start, height = exit_.eta, exit_.fresnel, exit_.start, exit_.height
    over_x, over_y, low_x, low_y = 1.0 / frame.pixel_x, 1.0 / frame.pixel_y, frame.low_x, frame.low_y
    for j in range(count):
        if oblique is not None:
            x, y, z, dx, dy, dz, power, arrives = _met(w, j, start)
        if point is not None:
            x, y, z, dx, dy, dz, power, arrives = _emitted(w, j, start, point)
        if parallel is not None:
            x, y, z, dx, dy, dz, power, arrives = _shone(w, j, start, parallel)
        tx, ty, tz, kept, passes = refraction.bend(dx, dy, dz, dx * dx + dy * dy + dz * dz, w[GX, j], w[GY, j], 0.5, n, fresnel)
        if parallel is None:
            px, py, on_way = transfer.arrive_upright(x, y, z, tx, ty, tz, height)
        if parallel is not None:
            px, py, on_way = transfer.arrive(x, y, z, tx, ty, tz, parallel.plane)
        w[FLUX, j], w[POWER, j] = power, power * kept if passes else rows.REFLECTED_POWER
        if oblique is not None:
            w[POWER, j] = w[POWER, j] if arrives else rows.MISSED_POWER
        w[PX, j] = (px - low_x) * over_x if on_way else rows.BESIDE
        w[PY, j] = (py - low_y) * over_y


@njit(**FAST)
def aim(v, i, surface, rays, exit_, frame, oblique, point, parallel):
    """Powers in front of the exit and behind it, and landing points in pixels, of row i of rays: FLUX, POWER, PX, PY; of rays of a
    source point u into X.

    Rays through given points of the exit have areas in place of fluxes, mm^2, and height and slopes in SAG, GX, GY; exit_.start is
    then the height of the entrance, for others of their origins.
    """
    w = np.empty((ROWS, BATCH))
    for start in range(0, v.shape[1], BATCH):
        count = min(BATCH, v.shape[1] - start)
        _take(w, v, start, count, i, surface, rays, oblique)
        if point is not None:
            _cross(w, count, exit_.start, point)
            _emit(w, count, point, point.emission)
            store(w[U], start, count, v[rows.X])
        _aim(w, count, exit_, frame, oblique, point, parallel)
        store(w[FLUX], start, count, v[rows.FLUX])
        store(w[POWER], start, count, v[rows.POWER])
        store(w[PX], start, count, v[rows.PX])
        store(w[PY], start, count, v[rows.PY])


@njit(inline="always", **FAST)
def _pull(w, count, exit_, oblique, point, parallel):
    n, fresnel, start, height = exit_.eta, exit_.fresnel, exit_.start, exit_.height
    for j in range(count):
        if oblique is not None:
            x, y, z, dx, dy, dz, power, arrives = _met(w, j, start)
        if point is not None:
            x, y, z, dx, dy, dz, power, arrives = _emitted(w, j, start, point)
        if parallel is not None:
            x, y, z, dx, dy, dz, power, arrives = _shone(w, j, start, parallel)
        gx, gy, long2 = w[GX, j], w[GY, j], dx * dx + dy * dy + dz * dz
        tx, ty, tz, _, _ = refraction.bend(dx, dy, dz, long2, gx, gy, 0.5, n, fresnel)
        if parallel is not None:
            by_x, by_y, by_z, by_tx, by_ty, by_tz = transfer.pull(x, y, z, tx, ty, tz, parallel.plane, w[PX, j], w[PY, j])
        else:
            by_x, by_y, by_z, by_tx, by_ty, by_tz = transfer.pull_upright(x, y, z, tx, ty, tz, height, w[PX, j], w[PY, j])
        by_dx, by_dy, _, by_gx, by_gy, by_p, _, by_long2 = refraction.pull(
            dx, dy, dz, long2, gx, gy, 0.5, power, n, fresnel, by_tx, by_ty, by_tz, w[POWER, j]
        )
        if oblique is not None:
            by_z = by_x * dx + by_y * dy + by_z * dz
        if point is not None:
            by_dx, by_dy = by_dx + 2.0 * dx * by_long2, by_dy + 2.0 * dy * by_long2
            more_z, more_gx, more_gy = _pull_emitted(w, j, start, point, by_dx, by_dy, by_p)
            by_z, by_gx, by_gy = by_z + more_z, by_gx + more_gx, by_gy + more_gy
        if parallel is not None:
            by_m = w[P, j] * parallel.power * by_p
            by_gx, by_gy = by_gx - dx * by_m, by_gy - dy * by_m
        w[BY_Z, j], w[BY_GX, j], w[BY_GY, j] = by_z if arrives else 0.0, by_gx if arrives else 0.0, by_gy if arrives else 0.0


@njit(**FAST)
def pull(v, i, surface, rays, exit_, oblique, point, parallel, by_sag, by_gx, by_gy):
    """Adjoint of `aim`: derivatives by height and slopes, of rays of any direction by distance and slopes.  BY_PX, BY_PY: per
    mm."""
    w = np.empty((ROWS, BATCH))
    for start in range(0, v.shape[1], BATCH):
        count = min(BATCH, v.shape[1] - start)
        _take(w, v, start, count, i, surface, rays, oblique)
        if point is not None:
            load(v[rows.X], start, count, w[U])
            _emit(w, count, point, point.emission)
        load(v[rows.BY_POWER], start, count, w[POWER])
        load(v[rows.BY_PX], start, count, w[PX])
        load(v[rows.BY_PY], start, count, w[PY])
        _pull(w, count, exit_, oblique, point, parallel)
        store(w[BY_Z], start, count, by_sag)
        store(w[BY_GX], start, count, by_gx)
        store(w[BY_GY], start, count, by_gy)
