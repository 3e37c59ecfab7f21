"""Batches of rays in front of the exit surface -> their powers behind it and landing points, with the adjoint, for the CPU kernels.

What lies in front of the exit differs, and each of these is compiled apart:

    rays of any direction       the surface is given by the distances along them and by slopes, see `ray_intersections`
    rays of a source point      through given points of the exit, see `optics.pencil`
    parallel rays               through given points of the exit, or of a mirror, see `optics.beam`
    rays along z                through given points of the exit

The notation is theirs.  Directions of the latter are (k_x, k_y, 1), so that nothing has to be normalised.  Refraction and landing
are one for all.  v are the vectors of `rows`.
"""

from __future__ import annotations

import math

from caustic_cli.optics.kernels import axial_refraction, refraction, rows, transfer
from caustic_cli.optics.kernels.jit import FAST, njit
from caustic_cli.optics.kernels.rows import AT, DX, DY, GX, GY, J_S, SAG, J, P, U, X, Y

# No array is passed on inside these loops, nor taken from a tuple: they would not be vectorised.


@njit(inline="always", **FAST)
def _slope(q, z, u, point):
    """c and 1 / (h + z n^2 c^3), one over the derivative of u (h + z c) by u."""
    n = point.n
    c = 1.0 / math.sqrt(n * n + (n - 1.0) * (n + 1.0) * q * u * u)
    return c, 1.0 / (point.distance + z * n * n * c * c * c)


@njit(inline="always", **FAST)
def _cross(v, count, start, point):
    """u of a batch, by Newton steps from the paraxial value, from which they increase to the root."""
    h, n = point.distance, point.n
    for j in range(count):
        v[AT, j], v[U, j] = v[X, j] * v[X, j] + v[Y, j] * v[Y, j], n / (n * h + v[SAG, j] - start)
    for _ in range(point.steps):
        for j in range(count):
            q, z, u = v[AT, j], v[SAG, j] - start, v[U, j]
            c, over = _slope(q, z, u, point)
            v[U, j] = u - (u * (h + z * c) - 1.0) * over


@njit(inline="always", **FAST)
def _emit(v, count, point, emission):
    """J of a batch and its derivative by s, by Horner's scheme in 2 s / s_max - 1."""
    for j in range(count):
        t = (v[X, j] * v[X, j] + v[Y, j] * v[Y, j]) * v[U, j] * v[U, j]
        v[AT, j], v[J, j], v[J_S, j] = point.scale * t / (1.0 + t) - 1.0, emission[0], 0.0
    for k in range(1, len(emission)):
        one = emission[k]
        for j in range(count):
            v[J_S, j] = v[J_S, j] * v[AT, j] + v[J, j]
            v[J, j] = v[J, j] * v[AT, j] + one
    for j in range(count):
        v[J_S, j] *= point.scale


# Of ray j: point, direction and power in front of the exit, and whether light arrives.  d . N > 0 wherever it does.


@njit(inline="always", **FAST)
def _met(v, j, start):
    """Rays of any direction from this height."""
    dx, dy, t = v[DX, j], v[DY, j], v[SAG, j]
    square = 1.0 - dx * dx - dy * dy
    dz = math.sqrt(square if square > 0.0 else 0.0)
    x, y, z = v[X, j] + t * dx, v[Y, j] + t * dy, start + t * dz
    return x, y, z, dx, dy, dz, v[P, j], t >= 0.0


@njit(inline="always", **FAST)
def _shone(v, j, start, light):
    """Parallel rays, through the aperture of an entrance at this height."""
    x, y, depth = v[X, j], v[Y, j], v[SAG, j] - start
    across, up = (x - light.kx * depth) * light.over_x, (y - light.ky * depth) * light.over_y
    inside = across * across + up * up <= 1.0 if light.round else (across * across <= 1.0) & (up * up <= 1.0)
    m = 1.0 - light.kx * v[GX, j] - light.ky * v[GY, j]
    lit = inside & (m > 0.0)
    return x, y, v[SAG, j], light.kx, light.ky, 1.0, v[P, j] * light.power * m if lit else 0.0, lit


@njit(inline="always", **FAST)
def _emitted(v, j, start, point):
    """Rays of a source point, through an entrance at this height: none arrives from above the surface."""
    x, y, u = v[X, j], v[Y, j], v[U, j]
    c, over = _slope(x * x + y * y, v[SAG, j] - start, u, point)
    dx, dy = u * c * x, u * c * y
    m = 1.0 - dx * v[GX, j] - dy * v[GY, j]
    return x, y, v[SAG, j], dx, dy, 1.0, v[P, j] * v[J, j] * u * over * m if m > 0.0 else 0.0, m > 0.0


@njit(inline="always", **FAST)
def _arriving(v, j, start, oblique, point, parallel):
    """Rays of whichever kind these are."""
    if oblique is not None:
        x, y, z, dx, dy, dz, power, arrives = _met(v, j, start)
    if point is not None:
        x, y, z, dx, dy, dz, power, arrives = _emitted(v, j, start, point)
    if parallel is not None:
        x, y, z, dx, dy, dz, power, arrives = _shone(v, j, start, parallel)
    return x, y, z, dx, dy, dz, power, arrives


@njit(inline="always", **FAST)
def _pull_emitted(v, j, start, point, by_dx, by_dy, by_p):
    """By height and slopes, by way of direction and power: k and u depend on z at fixed x and y."""
    x, y, z, u, n2 = v[X, j], v[Y, j], v[SAG, j] - start, v[U, j], point.n * point.n
    q = x * x + y * y
    c, over = _slope(q, z, u, point)
    k, across, part = u * c, x * v[GX, j] + y * v[GY, j], v[P, j] * u * over
    by_m = part * v[J, j] * by_p
    by_k = x * by_dx + y * by_dy - across * by_m
    c3, t = n2 * c * c * c, 1.0 + q * u * u
    u_z = -k * over
    c_z, s_z = -c * c * c * (n2 - 1.0) * q * u * u_z, 2.0 * q * u * u_z / (t * t)
    shrinks = (c + c3 + 3.0 * z * n2 * c * c * c_z) * over
    density_z = part * (v[J_S, j] * s_z - v[J, j] * shrinks)
    return by_k * u_z * c3 + by_p * (1.0 - k * across) * density_z, -k * x * by_m, -k * y * by_m


@njit(inline="always", **FAST)
def aim(v, i, begin, count, surface, rays, exit_, frame, oblique, point, parallel):
    """Powers in front of the exit and behind it, and landing points in pixels, of rays of row i: FLUX, POWER, PX, PY.

    Rays through given points of the exit have areas in place of fluxes, mm^2, but for those along z; exit_.start is the height of
    the entrance, for rays of any direction of their origins.
    """
    n, fresnel, start, height = exit_.eta, exit_.fresnel, exit_.start, exit_.height
    over_x, over_y, low_x, low_y = 1.0 / frame.pixel_x, 1.0 / frame.pixel_y, frame.low_x, frame.low_y
    rows.load(rays.x[i][begin : begin + count], v[X][:count])
    rows.load(rays.y[i][begin : begin + count], v[Y][:count])
    rows.load(rays.flux[i][begin : begin + count], v[P][:count])
    rows.combine(i, begin, surface, v[SAG][:count], v[GX][:count], v[GY][:count])
    if oblique is not None:
        rows.load(rays.along_x[i][begin : begin + count], v[DX][:count])
        rows.load(rays.along_y[i][begin : begin + count], v[DY][:count])
    if point is not None:
        _cross(v, count, start, point)
        _emit(v, count, point, point.emission)
    for j in range(count):
        gx, gy = v[GX, j], v[GY, j]
        if oblique is None and point is None and parallel is None:
            power, h = v[P, j], height - v[SAG, j]
            px, py, kept, passes = axial_refraction.arrive(v[X, j], v[Y, j], gx, gy, h, n, fresnel)
            on_way = h > 0.0
        else:
            x, y, z, dx, dy, dz, power, arrives = _arriving(v, j, start, oblique, point, parallel)
            long2, mirror = dx * dx + dy * dy + dz * dz, parallel is not None and n < 0.0
            tx, ty, tz, kept, passes = refraction.bend(dx, dy, dz, long2, gx, gy, 0.5, n, fresnel, 1.0, mirror)
            if parallel is None:
                px, py, on_way = transfer.arrive_upright(x, y, z, tx, ty, tz, height)
            if parallel is not None:
                px, py, on_way = transfer.arrive(x, y, z, tx, ty, tz, parallel.plane)
        behind = power * kept if passes else rows.REFLECTED_POWER
        if oblique is not None:
            behind = behind if arrives else rows.MISSED_POWER
        px, py = (px - low_x) * over_x if on_way else rows.BESIDE, (py - low_y) * over_y
        v[rows.FLUX, j], v[rows.POWER, j], v[rows.PX, j], v[rows.PY, j] = power, behind, px, py


@njit(inline="always", **FAST)
def pull(v, count, exit_, oblique, point, parallel):
    """Adjoint of `aim`: BY_SAG, BY_GX, BY_GY, derivatives by height and slopes, of rays of any direction by distance and slopes.
    BY_PX, BY_PY: per mm."""
    n, fresnel, start, height = exit_.eta, exit_.fresnel, exit_.start, exit_.height
    for j in range(count):
        gx, gy, by_power, by_px, by_py = v[GX, j], v[GY, j], v[rows.BY_POWER, j], v[rows.BY_PX, j], v[rows.BY_PY, j]
        if oblique is None and point is None and parallel is None:
            h = height - v[SAG, j]
            by_z, by_gx, by_gy = axial_refraction.pull(gx, gy, h, v[P, j], n, fresnel, by_px, by_py, by_power)
        else:
            x, y, z, dx, dy, dz, power, arrives = _arriving(v, j, start, oblique, point, parallel)
            long2, mirror = dx * dx + dy * dy + dz * dz, parallel is not None and n < 0.0
            tx, ty, tz, _, _ = refraction.bend(dx, dy, dz, long2, gx, gy, 0.5, n, fresnel, 1.0, mirror)
            if parallel is not None:
                by_x, by_y, by_z, by_tx, by_ty, by_tz = transfer.pull(x, y, z, tx, ty, tz, parallel.plane, by_px, by_py)
            else:
                by_x, by_y, by_z, by_tx, by_ty, by_tz = transfer.pull_upright(x, y, z, tx, ty, tz, height, by_px, by_py)
            by_dx, by_dy, _, by_gx, by_gy, by_p, _, by_long2 = refraction.pull(
                dx, dy, dz, long2, gx, gy, 0.5, power, n, fresnel, 1.0, mirror, by_tx, by_ty, by_tz, by_power
            )
            if oblique is not None:
                by_z = by_x * dx + by_y * dy + by_z * dz
            if point is not None:
                by_dx, by_dy = by_dx + 2.0 * dx * by_long2, by_dy + 2.0 * dy * by_long2
                more_z, more_gx, more_gy = _pull_emitted(v, j, start, point, by_dx, by_dy, by_p)
                by_z, by_gx, by_gy = by_z + more_z, by_gx + more_gx, by_gy + more_gy
            if parallel is not None:
                by_m = v[P, j] * parallel.power * by_p
                by_gx, by_gy = by_gx - dx * by_m, by_gy - dy * by_m
            by_z, by_gx, by_gy = by_z if arrives else 0.0, by_gx if arrives else 0.0, by_gy if arrives else 0.0
        v[rows.BY_SAG, j], v[rows.BY_GX, j], v[rows.BY_GY, j] = by_z, by_gx, by_gy
