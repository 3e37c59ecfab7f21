"""A row of rays of any direction, refracted at their hits and carried to the screen, with derivatives, for the CPU kernels.

The same physics as `bend`, which knows that a plane wave's rays all run along z.

Notation, a ray with unit direction d inside the lens, slopes g at the hit, N = (-g_x, -g_y, 1), index n
    c, s    d . N and t . N with t the refracted unit direction; s = sqrt(|N|^2 (1 - n^2) + n^2 c^2)
    gamma   (1 - n^2) / (s + n c), so that t = n d + gamma N
    R       reflectance of the exit surface
    q       (h - sag) / t_z, length of the path to the screen

Rows of the vectors, before: REACH, the distance along the ray to its hit (mm; -1 for none), GX, GY, X, Y, SHARE.
"""

from __future__ import annotations

import math

from caustic_cli.optics.kernels.bend import (
    BY_POWER,
    BY_PX,
    BY_PY,
    EXACT,
    GX,
    GY,
    POWER,
    PX,
    PY,
    REACH,
    SAG,
    SCHLICK,
    SHARE,
    T_GX,
    T_GY,
    T_POWER,
    T_SAG,
    X,
    Y,
)
from caustic_cli.optics.kernels.jit import FAST, njit
from caustic_cli.optics.tolerances import CRITICAL, PARALLEL

REFLECTED_POWER, MISSED_POWER = -1.0, -2.0


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


@njit(**FAST)
def aim(v, dx, dy, exit_, frame):
    """Heights of the hits above the reference, powers and landing points in pixels."""
    n, fresnel, height, start = exit_.index, exit_.fresnel, exit_.height, exit_.start
    over_x, over_y = 1.0 / frame.pixel_x, 1.0 / frame.pixel_y
    for j in range(v.shape[1]):
        t, gx, gy = v[REACH, j], v[GX, j], v[GY, j]
        dz, norm2, c, s, passes = _refract(dx[j], dy[j], gx, gy, n)
        reflected, _, _, _ = _reflected(fresnel, c, s, norm2, n)
        gamma = (1.0 - n) * (1.0 + n) / (s + n * c)
        down = n * dz + gamma
        sag = start + t * dz
        path = (height - sag) / down
        v[SAG, j] = sag if down > PARALLEL else height  # never arrives
        power = v[SHARE, j] * (1.0 - reflected) if passes else REFLECTED_POWER
        v[POWER, j] = power if t >= 0.0 else MISSED_POWER
        v[PX, j] = (v[X, j] + t * dx[j] + path * (n * dx[j] - gamma * gx) - frame.low_x) * over_x
        v[PY, j] = (v[Y, j] + t * dy[j] + path * (n * dy[j] - gamma * gy) - frame.low_y) * over_y


@njit(**FAST)
def pull(v, dx, dy, exit_):
    """Derivatives by the distance to the hit and the slopes there, left in T_SAG, T_GX, T_GY.  BY_PX, BY_PY: per mm."""
    n, fresnel, height, start = exit_.index, exit_.fresnel, exit_.height, exit_.start
    for j in range(v.shape[1]):
        v[T_SAG, j], v[T_GX, j], v[T_GY, j] = 0.0, 0.0, 0.0
        if v[POWER, j] < 0.0:
            continue
        t, gx, gy = v[REACH, j], v[GX, j], v[GY, j]
        dz, norm2, c, s, _ = _refract(dx[j], dy[j], gx, gy, n)
        _, r_c, r_s, r_norm2 = _reflected(fresnel, c, s, norm2, n)
        loss = -v[SHARE, j] * v[BY_POWER, j]
        by_c, by_s, by_norm2 = loss * r_c, loss * r_s, loss * r_norm2
        gamma = (1.0 - n) * (1.0 + n) / (s + n * c)
        down = n * dz + gamma
        by_x, by_y, by_t = v[BY_PX, j], v[BY_PY, j], 0.0
        by_gx, by_gy = 0.0, 0.0
        if down > PARALLEL:
            path = (height - start - t * dz) / down
            by_path = by_x * (n * dx[j] - gamma * gx) + by_y * (n * dy[j] - gamma * gy)
            by_t = by_x * dx[j] + by_y * dy[j] - by_path * dz / down
            by_gamma = -path * (gx * by_x + gy * by_y) - by_path * path / down
            by_gx, by_gy = -gamma * path * by_x, -gamma * path * by_y
            by_s -= gamma * by_gamma / (s + n * c)
            by_c -= n * gamma * by_gamma / (s + n * c)
        by_norm2 += by_s * (1.0 - n) * (1.0 + n) / (2.0 * s)
        by_c += by_s * n * n * c / s
        v[T_SAG, j] = by_t
        v[T_GX, j] = by_gx + 2.0 * gx * by_norm2 - dx[j] * by_c
        v[T_GY, j] = by_gy + 2.0 * gy * by_norm2 - dy[j] * by_c


@njit(**FAST)
def push(v, dx, dy, exit_, frame):
    """Tangents of power and pixel coordinates, left in T_POWER, BY_PX, BY_PY, along T_SAG (the distance), T_GX, T_GY."""
    n, fresnel, height, start = exit_.index, exit_.fresnel, exit_.height, exit_.start
    for j in range(v.shape[1]):
        t, gx, gy, dt, tx, ty = v[REACH, j], v[GX, j], v[GY, j], v[T_SAG, j], v[T_GX, j], v[T_GY, j]
        dz, norm2, c, s, _ = _refract(dx[j], dy[j], gx, gy, n)
        _, r_c, r_s, r_norm2 = _reflected(fresnel, c, s, norm2, n)
        d_norm2, dc = 2.0 * (gx * tx + gy * ty), -dx[j] * tx - dy[j] * ty
        ds = (d_norm2 * (1.0 - n) * (1.0 + n) / 2.0 + n * n * c * dc) / s
        gamma = (1.0 - n) * (1.0 + n) / (s + n * c)
        d_gamma = -gamma * (ds + n * dc) / (s + n * c)
        down = n * dz + gamma
        path = (height - start - t * dz) / down
        d_path = -(dt * dz + path * d_gamma) / down
        v[T_POWER, j] = -v[SHARE, j] * (r_c * dc + r_s * ds + r_norm2 * d_norm2)
        v[BY_PX, j] = (dt * dx[j] + d_path * (n * dx[j] - gamma * gx) - path * (d_gamma * gx + gamma * tx)) / frame.pixel_x
        v[BY_PY, j] = (dt * dy[j] + d_path * (n * dy[j] - gamma * gy) - path * (d_gamma * gy + gamma * ty)) / frame.pixel_y
