"""Refraction of a row of rays of any direction at the exit surface and transfer to the screen, with derivatives, for the CPU
kernels.

The same physics as `axial_refraction`, which is specialised to rays parallel to z.  Rays are copied in batches to rows of a small
scratch array, for the reason given in `stage`; invalid rays are masked instead of branched around.

Notation, a ray with unit direction d inside the lens, slopes g at the hit, N = (-g_x, -g_y, 1), index n
    c, s    d . N and t . N with t the refracted unit direction; s = sqrt(|N|^2 (1 - n^2) + n^2 c^2), 1 if light is reflected
    gamma   (1 - n^2) / (s + n c), so that t = n d + gamma N
    R       reflectance of the exit surface
    q       (h - sag) / t_z, length of the path to the screen

Input, besides the directions: distances along the rays to their intersections (mm; -1 for none), dz/dx and dz/dy there, x and y of
the origins, and powers.  Output, in rows of `axial_refraction`'s vectors: SAG, POWER, PX, PY, FLUX.
"""

from __future__ import annotations

import math

import numpy as np

from caustic_cli.optics.kernels.axial_refraction import (
    BY_POWER,
    BY_PX,
    BY_PY,
    EXACT,
    FLUX,
    POWER,
    PX,
    PY,
    SAG,
    SCHLICK,
    load,
)
from caustic_cli.optics.kernels.jit import FAST, njit
from caustic_cli.optics.kernels.stage import BATCH
from caustic_cli.optics.tolerances import CRITICAL, PARALLEL

REFLECTED_POWER, MISSED_POWER = -1.0, -2.0
# Rows of a batch's scratch: the ray, outputs, derivatives by the outputs, and derivatives by the intersection.
REACH, GX, GY, DX, DY, PART, X, Y, OUT_SAG, OUT_POWER, OUT_PX, OUT_PY, BY_REACH, BY_GX, BY_GY, ROWS = range(16)


@njit(inline="always", **FAST)
def _copy(row, start, count, out):
    """A batch of a row of consecutive numbers."""
    batch = row[start : start + count]
    for j in range(count):
        out[j] = batch[j]


@njit(inline="always", **FAST)
def _put(row, start, count, out):
    """A batch back into such a row."""
    batch = out[start : start + count]
    for j in range(count):
        batch[j] = row[j]


@njit(inline="always", **FAST)
def _load(w, start, count, ray):
    """Distances, slopes, directions and powers of a batch."""
    reach, gx, gy, dx, dy, flux = ray
    _copy(reach, start, count, w[REACH])
    _copy(gx, start, count, w[GX])
    _copy(gy, start, count, w[GY])
    load(dx[start : start + count], w[DX][:count])
    load(dy[start : start + count], w[DY][:count])
    load(flux[start : start + count], w[PART][:count])


@njit(inline="always", **FAST)
def _refract(dx, dy, gx, gy, n):
    """d_z, |N|^2, c, s, and whether the ray passes (s is 1 where it does not)."""
    dz = math.sqrt(max(1.0 - dx * dx - dy * dy, 0.0))
    norm2 = 1.0 + gx * gx + gy * gy
    c = dz - dx * gx - dy * gy
    radicand = n * n * (c * c) - (n - 1.0) * (n + 1.0) * norm2
    passes = radicand > CRITICAL * norm2
    return dz, norm2, c, math.sqrt(radicand if passes else 1.0), passes


@njit(inline="always", **FAST)
def _reflected(fresnel, c, s, norm2, n):
    """R and its derivatives by c, s and |N|^2."""
    if fresnel == EXACT:
        us, up = 1.0 / (n * c + s), 1.0 / (c + n * s)
        rs, rp = (n * c - s) * us, (c - n * s) * up
        factor = 2.0 * n * (rs * us * us + rp * up * up)
        return 0.5 * (rs * rs + rp * rp), factor * s, -factor * c, 0.0
    if fresnel == SCHLICK:
        r0 = (n - 1.0) * (n - 1.0) / ((n + 1.0) * (n + 1.0))
        inverse = 1.0 / math.sqrt(norm2)
        x = 1.0 - s * inverse
        x4 = x * x * x * x
        by_x = 5.0 * (1.0 - r0) * x4
        return r0 + (1.0 - r0) * x4 * x, 0.0, -by_x * inverse, 0.5 * by_x * s * inverse / norm2
    return 0.0, 0.0, 0.0, 0.0


@njit(inline="always", **FAST)
def _aim(w, count, exit_, frame):
    n, fresnel, height, start = exit_.index, exit_.fresnel, exit_.height, exit_.start
    over_x, over_y = 1.0 / frame.pixel_x, 1.0 / frame.pixel_y
    for j in range(count):
        t, gx, gy, dx, dy = w[REACH, j], w[GX, j], w[GY, j], w[DX, j], w[DY, j]
        dz, norm2, c, s, passes = _refract(dx, dy, gx, gy, n)
        reflected, _, _, _ = _reflected(fresnel, c, s, norm2, n)
        gamma = (1.0 - n) * (1.0 + n) / (s + n * c)
        down = n * dz + gamma
        sag = start + t * dz
        path = (height - sag) / down
        power = w[PART, j] * (1.0 - reflected) if passes else REFLECTED_POWER
        w[OUT_SAG, j] = sag if down > PARALLEL else height  # never arrives
        w[OUT_POWER, j] = power if t >= 0.0 else MISSED_POWER
        w[OUT_PX, j] = (w[X, j] + t * dx + path * (n * dx - gamma * gx) - frame.low_x) * over_x
        w[OUT_PY, j] = (w[Y, j] + t * dy + path * (n * dy - gamma * gy) - frame.low_y) * over_y


@njit(**FAST)
def aim(v, ray, x, y, exit_, frame):
    """Heights of the hits above the reference, powers and landing points in pixels, and the rays' powers below, in FLUX.

    ray: distances, dz/dx, dz/dy, d_x, d_y and powers.
    """
    w = np.empty((ROWS, BATCH))
    for start in range(0, v.shape[1], BATCH):
        count = min(BATCH, v.shape[1] - start)
        _load(w, start, count, ray)
        load(x[start : start + count], w[X][:count])
        load(y[start : start + count], w[Y][:count])
        _aim(w, count, exit_, frame)
        _put(w[OUT_SAG], start, count, v[SAG])
        _put(w[OUT_POWER], start, count, v[POWER])
        _put(w[OUT_PX], start, count, v[PX])
        _put(w[OUT_PY], start, count, v[PY])
        _put(w[PART], start, count, v[FLUX])


@njit(inline="always", **FAST)
def _pull(w, count, exit_):
    n, fresnel, height, start = exit_.index, exit_.fresnel, exit_.height, exit_.start
    for j in range(count):
        t, gx, gy, dx, dy = w[REACH, j], w[GX, j], w[GY, j], w[DX, j], w[DY, j]
        dz, norm2, c, s, _ = _refract(dx, dy, gx, gy, n)
        _, r_c, r_s, r_norm2 = _reflected(fresnel, c, s, norm2, n)
        loss = -w[PART, j] * w[OUT_POWER, j]
        by_c, by_s, by_norm2 = loss * r_c, loss * r_s, loss * r_norm2
        under = 1.0 / (s + n * c)
        gamma = (1.0 - n) * (1.0 + n) * under
        down = n * dz + gamma
        arrives = down > PARALLEL
        over = 1.0 / (down if arrives else 1.0)
        by_x, by_y = w[OUT_PX, j] if arrives else 0.0, w[OUT_PY, j] if arrives else 0.0
        path = (height - start - t * dz) * over
        by_path = by_x * (n * dx - gamma * gx) + by_y * (n * dy - gamma * gy)
        by_gamma = -path * (gx * by_x + gy * by_y) - by_path * path * over
        by_s -= gamma * by_gamma * under
        by_c -= n * gamma * by_gamma * under
        by_s /= s
        by_norm2 += by_s * (1.0 - n) * (1.0 + n) * 0.5
        by_c += by_s * n * n * c
        lit = w[OUT_SAG, j] >= 0.0
        by_reach = by_x * dx + by_y * dy - by_path * dz * over
        by_gx = 2.0 * gx * by_norm2 - gamma * path * by_x - dx * by_c
        by_gy = 2.0 * gy * by_norm2 - gamma * path * by_y - dy * by_c
        w[BY_REACH, j], w[BY_GX, j], w[BY_GY, j] = by_reach if lit else 0.0, by_gx if lit else 0.0, by_gy if lit else 0.0


@njit(**FAST)
def pull(v, ray, exit_, by_reach, by_gx, by_gy):
    """Derivatives by the distance to the hit and the slopes there.  BY_PX, BY_PY of v: per mm."""
    w = np.empty((ROWS, BATCH))
    for start in range(0, v.shape[1], BATCH):
        count = min(BATCH, v.shape[1] - start)
        _load(w, start, count, ray)
        _copy(v[POWER], start, count, w[OUT_SAG])
        _copy(v[BY_POWER], start, count, w[OUT_POWER])
        _copy(v[BY_PX], start, count, w[OUT_PX])
        _copy(v[BY_PY], start, count, w[OUT_PY])
        _pull(w, count, exit_)
        _put(w[BY_REACH], start, count, by_reach)
        _put(w[BY_GX], start, count, by_gx)
        _put(w[BY_GY], start, count, by_gy)
