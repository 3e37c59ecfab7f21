"""Fused CPU kernel for parallel rays through points of the exit, or of a mirror, onto a screen of any orientation: see
`optics.beam`, whose notation this is, and which is its plain-torch reference.

Height and slopes come from `rows`.  With L^2 = |D|^2, M = D . N and n the ratio of the indices at the exit, -1 for a mirror,

    S = sqrt(n^2 M^2 - (n^2 - 1) |N|^2 L^2),    Gamma = (S - n M) / |N|^2,    W = n D + Gamma N,

the ray leaves along W, or against it from a mirror, and lands at p + t W, at the screen's coordinates (p + t W - c) . e1 and . e2,
with t = (c - p) . e3 / W . e3, from its point p of the exit, where c is a point of the screen and e1, e2, e3 its axes, with
W . e3 > 0.
"""

from __future__ import annotations

import math

import numpy as np

from caustic_cli.optics.kernels import rows
from caustic_cli.optics.kernels.fresnel import reflectance
from caustic_cli.optics.kernels.jit import FAST, njit
from caustic_cli.optics.kernels.stage import BATCH, load, store
from caustic_cli.optics.tolerances import CRITICAL, PARALLEL

# Rows of a batch's scratch: the surface, cell areas, x, y, outputs and derivatives by them.
Z, ZX, ZY, AREA, X, Y, OUT_FLUX, OUT_POWER, OUT_PX, OUT_PY, OUT_Z, OUT_ZX, OUT_ZY, ROWS = range(14)


@njit(inline="always", **FAST)
def _within(x, y, beam):
    """Whether a point is inside the aperture of the entrance."""
    u, v = x * beam.over_x, y * beam.over_y
    return u * u + v * v <= 1.0 if beam.round else (u * u <= 1.0) & (v * v <= 1.0)


@njit(inline="always", **FAST)
def _bend(w, j, beam, n, start):
    """Of ray j: |N|^2, M, S, and whether it is lit and passes (S is 1 where it does not pass)."""
    zx, zy, depth = w[ZX, j], w[ZY, j], w[Z, j] - start
    norm2 = 1.0 + zx * zx + zy * zy
    m = 1.0 - beam.kx * zx - beam.ky * zy
    radicand = n * n * m * m - (n - 1.0) * (n + 1.0) * norm2 * beam.long2
    passes = radicand > CRITICAL * norm2 * beam.long2
    lit = _within(w[X, j] - beam.kx * depth, w[Y, j] - beam.ky * depth, beam) & (m > 0.0)
    return norm2, m, math.sqrt(radicand if passes else 1.0), lit, passes


@njit(inline="always", **FAST)
def _along(gamma, zx, zy, n, e, on):
    """W . e from D . e."""
    return n * on + gamma * (e.z - zx * e.x - zy * e.y)


@njit(inline="always", **FAST)
def _aim(w, count, exit_, frame, beam):
    n, e1, e2, e3 = exit_.eta, beam.e1, beam.e2, beam.e3
    for j in range(count):
        x, y, z, zx, zy = w[X, j], w[Y, j], w[Z, j], w[ZX, j], w[ZY, j]
        norm2, m, s, lit, passes = _bend(w, j, beam, n, exit_.start)
        reflected, _, _, _, _ = reflectance(exit_.fresnel, n, norm2 * beam.long2, m, s, 0.5)
        flux = w[AREA, j] * beam.power * m if lit else 0.0
        gamma = (s - n * m) / norm2
        down = _along(gamma, zx, zy, n, e3, beam.on3)
        away = beam.c3 - x * e3.x - y * e3.y - z * e3.z
        arrives = (down > PARALLEL) & (n * away > 0.0)
        t = away / (down if arrives else 1.0)
        px = (x * e1.x + y * e1.y + z * e1.z - beam.c1 + t * _along(gamma, zx, zy, n, e1, beam.on1) - frame.low_x) / frame.pixel_x
        w[OUT_FLUX, j] = flux
        w[OUT_POWER, j] = flux * (1.0 - reflected) if passes or not lit else rows.REFLECTED_POWER
        w[OUT_PX, j] = px if arrives else rows.BESIDE
        w[OUT_PY, j] = (
            x * e2.x + y * e2.y + z * e2.z - beam.c2 + t * _along(gamma, zx, zy, n, e2, beam.on2) - frame.low_y
        ) / frame.pixel_y


@njit(inline="always", **FAST)
def _take(w, v, start, count, i, rays):
    """A batch of the surface, points and cell areas of row i."""
    load(v[rows.SAG], start, count, w[Z])
    load(v[rows.GX], start, count, w[ZX])
    load(v[rows.GY], start, count, w[ZY])
    rows.load(rays.x[i][start : start + count], w[X][:count])
    rows.load(rays.y[i][start : start + count], w[Y][:count])
    rows.load(rays.flux[i][start : start + count], w[AREA][:count])


@njit(**FAST)
def aim(v, i, rays, exit_, frame, beam):
    """Flux in front of the exit, power behind it and landing points in pixels of row i of rays, from SAG, GX, GY.

    rays: points (x, y), mm, each for an area in place of a flux, mm^2; exit_: `start` is the height of the entrance.
    """
    w = np.empty((ROWS, BATCH))
    for start in range(0, v.shape[1], BATCH):
        count = min(BATCH, v.shape[1] - start)
        _take(w, v, start, count, i, rays)
        _aim(w, count, exit_, frame, beam)
        store(w[OUT_FLUX], start, count, v[rows.FLUX])
        store(w[OUT_POWER], start, count, v[rows.POWER])
        store(w[OUT_PX], start, count, v[rows.PX])
        store(w[OUT_PY], start, count, v[rows.PY])


@njit(inline="always", **FAST)
def _pull(w, count, exit_, beam):
    n, e1, e2, e3, long2 = exit_.eta, beam.e1, beam.e2, beam.e3, beam.long2
    for j in range(count):
        x, y, z, zx, zy = w[X, j], w[Y, j], w[Z, j], w[ZX, j], w[ZY, j]
        norm2, m, s, lit, passes = _bend(w, j, beam, n, exit_.start)
        reflected, r_m, r_s, r_norm2, _ = reflectance(exit_.fresnel, n, norm2 * long2, m, s, 0.5)
        density = w[AREA, j] * beam.power
        by_power, by_x, by_y = w[OUT_POWER, j], w[OUT_PX, j], w[OUT_PY, j]
        # power = density M (1 - R)
        loss = -by_power * density * m
        by_m, by_s, by_both = by_power * density * (1.0 - reflected) + loss * r_m, loss * r_s, loss * r_norm2  # both: |N|^2 L^2
        # landing point
        over_norm2 = 1.0 / norm2
        gamma = (s - n * m) * over_norm2
        down = _along(gamma, zx, zy, n, e3, beam.on3)
        away = beam.c3 - x * e3.x - y * e3.y - z * e3.z
        arrives = (down > PARALLEL) & (n * away > 0.0)
        over = 1.0 / (down if arrives else 1.0)
        by_x, by_y = by_x if arrives else 0.0, by_y if arrives else 0.0
        t = away * over
        by_t = by_x * _along(gamma, zx, zy, n, e1, beam.on1) + by_y * _along(gamma, zx, zy, n, e2, beam.on2)
        by_1, by_2, by_3, by_away = t * by_x, t * by_y, -by_t * t * over, by_t * over
        # W . e = n D . e + Gamma N . e
        by_nx, by_ny = by_1 * e1.x + by_2 * e2.x + by_3 * e3.x, by_1 * e1.y + by_2 * e2.y + by_3 * e3.y
        by_gamma = by_1 * e1.z + by_2 * e2.z + by_3 * e3.z - zx * by_nx - zy * by_ny
        # Gamma and S
        by_gamma *= over_norm2
        by_s = (by_s + by_gamma) / s
        by_m += n * (by_s * n * m - by_gamma)
        by_norm2 = (by_both + by_s * (1.0 - n) * (1.0 + n) * 0.5) * long2 - gamma * by_gamma
        meets = lit & passes
        w[OUT_Z, j] = by_x * e1.z + by_y * e2.z - by_away * e3.z if meets else 0.0
        w[OUT_ZX, j] = 2.0 * zx * by_norm2 - beam.kx * by_m - gamma * by_nx if meets else 0.0
        w[OUT_ZY, j] = 2.0 * zy * by_norm2 - beam.ky * by_m - gamma * by_ny if meets else 0.0


@njit(**FAST)
def pull(v, i, rays, exit_, beam):
    """Adjoint of `aim`: derivatives by height and slopes, in BY_SAG, BY_GX, BY_GY.  BY_PX, BY_PY: per mm."""
    w = np.empty((ROWS, BATCH))
    for start in range(0, v.shape[1], BATCH):
        count = min(BATCH, v.shape[1] - start)
        _take(w, v, start, count, i, rays)
        load(v[rows.BY_POWER], start, count, w[OUT_POWER])
        load(v[rows.BY_PX], start, count, w[OUT_PX])
        load(v[rows.BY_PY], start, count, w[OUT_PY])
        _pull(w, count, exit_, beam)
        store(w[OUT_Z], start, count, v[rows.BY_SAG])
        store(w[OUT_ZX], start, count, v[rows.BY_GX])
        store(w[OUT_ZY], start, count, v[rows.BY_GY])
