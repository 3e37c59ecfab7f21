"""Fused CPU kernel for the rays of a source point through a tensor product of points of the exit: see `optics.pencil`, whose
notation this is, and which is its plain-torch reference.

A row of rays shares x.  Height and slopes come from `rows`, direction and flux in front of the exit from one-dimensional Newton
steps; refraction, transfer and splat are those of `oblique_refraction` and `fused`, with directions D = (k X, k Y, 1) of length L
instead of unit vectors, so that nothing has to be normalised:

    M = D . N = 1 - k (X z_x + Y z_y),    S = sqrt(n^2 M^2 - (n^2 - 1) |N|^2 L^2),    Gamma = (1 - n^2) L^2 / (S + n M),

and the ray leaves along n D + Gamma N, here with n the ratio of the indices at the exit.
"""

from __future__ import annotations

import math

import numpy as np

from caustic_cli.optics.kernels import rows
from caustic_cli.optics.kernels.fresnel import reflectance
from caustic_cli.optics.kernels.jit import FAST, njit
from caustic_cli.optics.kernels.stage import BATCH, load, store
from caustic_cli.optics.tolerances import CRITICAL, PARALLEL

# Rows of a batch's scratch: the surface, cell areas, Y, u, the emission J and its derivative by s, outputs and derivatives by them.
Z, ZX, ZY, AREA, Y, U, AT, J, J_S, OUT_FLUX, OUT_POWER, OUT_PX, OUT_PY, OUT_Z, OUT_ZX, OUT_ZY, ROWS = range(17)


@njit(inline="always", **FAST)
def _slope(q, z, u, h, n):
    """c and h + z n^2 c^3, the derivative of u (h + z c) by u."""
    c = 1.0 / math.sqrt(n * n + (n - 1.0) * (n + 1.0) * q * u * u)
    return c, h + z * n * n * c * c * c


@njit(inline="always", **FAST)
def _cross(w, count, x, depth, point):
    """u of a batch, by Newton steps from the paraxial value, from which they increase to the root."""
    h, n = point.distance, point.n
    for j in range(count):
        w[U, j] = n / (n * h + depth + w[Z, j])
    for _ in range(point.steps):
        for j in range(count):
            q, z, u = x * x + w[Y, j] * w[Y, j], depth + w[Z, j], w[U, j]
            c, by_u = _slope(q, z, u, h, n)
            w[U, j] = u - (u * (h + z * c) - 1.0) / by_u


@njit(inline="always", **FAST)
def _emit(w, count, x, point, emission):
    """J of a batch and its derivative by s, by Horner's scheme in 2 s / s_max - 1."""
    for j in range(count):
        t = (x * x + w[Y, j] * w[Y, j]) * w[U, j] * w[U, j]
        w[AT, j], w[J, j], w[J_S, j] = point.scale * t / (1.0 + t) - 1.0, emission[0], 0.0
    for k in range(1, len(emission)):
        one = emission[k]
        for j in range(count):
            w[J_S, j] = w[J_S, j] * w[AT, j] + w[J, j]
            w[J, j] = w[J, j] * w[AT, j] + one
    for j in range(count):
        w[J_S, j] *= point.scale


@njit(inline="always", **FAST)
def _bend(w, j, x, depth, point, n):
    """Of ray j: q, z, c, dF/du, k, L^2, M, |N|^2, S, and whether it passes (S is 1 where it does not)."""
    y, zx, zy = w[Y, j], w[ZX, j], w[ZY, j]
    q, z = x * x + y * y, depth + w[Z, j]
    c, by_u = _slope(q, z, w[U, j], point.distance, point.n)
    k = w[U, j] * c
    long2, norm2 = 1.0 + k * k * q, 1.0 + zx * zx + zy * zy
    m = 1.0 - k * (x * zx + y * zy)
    radicand = n * n * m * m - (n - 1.0) * (n + 1.0) * norm2 * long2
    passes = radicand > CRITICAL * norm2 * long2
    return q, z, c, by_u, k, long2, m, norm2, math.sqrt(radicand if passes else 1.0), passes


@njit(inline="always", **FAST)
def _aim(w, count, x, point, exit_, frame):
    n, height, fresnel, depth = exit_.eta, exit_.height, exit_.fresnel, -exit_.start
    over_x, over_y = 1.0 / frame.pixel_x, 1.0 / frame.pixel_y
    for j in range(count):
        _, _, _, by_u, k, long2, m, norm2, s, passes = _bend(w, j, x, depth, point, n)
        reflected, _, _, _, _ = reflectance(fresnel, n, norm2 * long2, m, s, 0.5)
        flux = w[AREA, j] * w[J, j] * w[U, j] / by_u * max(m, 0.0)  # none arrives from above the surface
        gamma = (1.0 - n) * (1.0 + n) * long2 / (s + n * m)
        down = n + gamma
        path = (height - w[Z, j]) / down
        power = flux * (1.0 - reflected) if passes else rows.REFLECTED_POWER
        w[OUT_FLUX, j] = flux
        w[OUT_POWER, j] = power if m > 0.0 else 0.0
        px = (point.x + x + path * (n * k * x - gamma * w[ZX, j]) - frame.low_x) * over_x
        w[OUT_PX, j] = px if down > PARALLEL else rows.BESIDE
        w[OUT_PY, j] = (point.y + w[Y, j] + path * (n * k * w[Y, j] - gamma * w[ZY, j]) - frame.low_y) * over_y


@njit(inline="always", **FAST)
def _take(w, v, start, count, i, rays):
    """A batch of the surface, Y and cell areas of row i."""
    load(v[rows.SAG], start, count, w[Z])
    load(v[rows.GX], start, count, w[ZX])
    load(v[rows.GY], start, count, w[ZY])
    rows.load(rays.y[i][start : start + count], w[Y][:count])
    rows.load(rays.flux[i][start : start + count], w[AREA][:count])


@njit(**FAST)
def aim(v, i, rays, exit_, frame, point):
    """Flux in front of the exit, power behind it and landing points in pixels of row i of rays, from SAG, GX, GY; u into X.

    rays: points (x, y), mm from the source's projection, each for an area in place of a flux, mm^2; exit_: `start` is the height of
    the entrance.
    """
    w, x = np.empty((ROWS, BATCH)), rays.x[i, 0]
    for start in range(0, v.shape[1], BATCH):
        count = min(BATCH, v.shape[1] - start)
        _take(w, v, start, count, i, rays)
        _cross(w, count, x, -exit_.start, point)
        _emit(w, count, x, point, point.emission)
        _aim(w, count, x, point, exit_, frame)
        store(w[U], start, count, v[rows.X])
        store(w[OUT_FLUX], start, count, v[rows.FLUX])
        store(w[OUT_POWER], start, count, v[rows.POWER])
        store(w[OUT_PX], start, count, v[rows.PX])
        store(w[OUT_PY], start, count, v[rows.PY])


@njit(inline="always", **FAST)
def _pull(w, count, x, point, exit_):
    n, height, fresnel, depth, ratio2 = exit_.eta, exit_.height, exit_.fresnel, -exit_.start, point.n * point.n
    for j in range(count):
        y, zx, zy, u = w[Y, j], w[ZX, j], w[ZY, j], w[U, j]
        q, z, c, by_u, k, long2, m, norm2, s, passes = _bend(w, j, x, depth, point, n)
        reflected, r_m, r_s, r_norm2, _ = reflectance(fresnel, n, norm2 * long2, m, s, 0.5)
        density = w[AREA, j] * w[J, j] * u / by_u
        by_power, by_x, by_y = w[OUT_POWER, j], w[OUT_PX, j], w[OUT_PY, j]
        # power = density M (1 - R)
        loss = -by_power * density * m
        by_density, by_m = by_power * m * (1.0 - reflected), by_power * density * (1.0 - reflected) + loss * r_m
        by_s, by_both = loss * r_s, loss * r_norm2  # by |N|^2 L^2
        # landing point = (x, y) + path (n D + Gamma N), path = (height - z) / (n + Gamma)
        under = 1.0 / (s + n * m)
        gamma = (1.0 - n) * (1.0 + n) * long2 * under
        down = n + gamma
        arrives = down > PARALLEL
        over = 1.0 / (down if arrives else 1.0)
        by_x, by_y = by_x if arrives else 0.0, by_y if arrives else 0.0
        path = (height - w[Z, j]) * over
        by_path = by_x * (n * k * x - gamma * zx) + by_y * (n * k * y - gamma * zy)
        by_gamma = -path * (zx * by_x + zy * by_y) - by_path * path * over
        by_k = path * n * (x * by_x + y * by_y)
        # Gamma and S
        by_s -= gamma * by_gamma * under
        by_m -= n * gamma * by_gamma * under
        by_s /= s
        by_m += by_s * n * n * m
        by_both += by_s * (1.0 - n) * (1.0 + n) * 0.5
        by_long2 = by_both * norm2 + by_gamma * (1.0 - n) * (1.0 + n) * under
        by_norm2 = by_both * long2
        # M, L^2, and the dependence of k and the density on z at fixed x and y
        by_k += 2.0 * k * q * by_long2 - (x * zx + y * zy) * by_m
        c3, t = ratio2 * c * c * c, 1.0 + q * u * u
        u_z = -k / by_u
        c_z, s_z = -c * c * c * (ratio2 - 1.0) * q * u * u_z, 2.0 * q * u * u_z / (t * t)
        shrinks = (c + c3 + 3.0 * z * ratio2 * c * c * c_z) / by_u
        density_z = w[AREA, j] * u / by_u * (w[J_S, j] * s_z - w[J, j] * shrinks)
        lit = passes and m > 0.0
        w[OUT_Z, j] = -by_path * over + by_k * u_z * c3 + by_density * density_z if lit else 0.0
        w[OUT_ZX, j] = 2.0 * zx * by_norm2 - gamma * path * by_x - k * x * by_m if lit else 0.0
        w[OUT_ZY, j] = 2.0 * zy * by_norm2 - gamma * path * by_y - k * y * by_m if lit else 0.0


@njit(**FAST)
def pull(v, i, rays, exit_, point):
    """Adjoint of `aim`: derivatives by height and slopes, in BY_SAG, BY_GX, BY_GY.  BY_PX, BY_PY: per mm."""
    w, x = np.empty((ROWS, BATCH)), rays.x[i, 0]
    for start in range(0, v.shape[1], BATCH):
        count = min(BATCH, v.shape[1] - start)
        _take(w, v, start, count, i, rays)
        load(v[rows.X], start, count, w[U])
        _emit(w, count, x, point, point.emission)
        load(v[rows.BY_POWER], start, count, w[OUT_POWER])
        load(v[rows.BY_PX], start, count, w[OUT_PX])
        load(v[rows.BY_PY], start, count, w[OUT_PY])
        _pull(w, count, x, point, exit_)
        store(w[OUT_Z], start, count, v[rows.BY_SAG])
        store(w[OUT_ZX], start, count, v[rows.BY_GX])
        store(w[OUT_ZY], start, count, v[rows.BY_GY])
