"""CPU kernels for refraction at a smooth surface: Snell's law and the Fresnel equations, with adjoint.

Rays are float64 components, see `stage`; the reference is `interface` with `polarisation.s_fraction`.  For rays with d . N < 0 the
normal is reversed.

Notation, a ray along d, power P, and slopes g of the surface at its hit; N = (-g_x, -g_y, 1), eta = n_in / n_out, -1 for a mirror
    sigma   1 where d . N >= 0, else -1;  sigma N is the normal along which light passes
    c       sigma (d . N) >= 0
    s       sqrt(|N|^2 |d|^2 + eta^2 (c^2 - |N|^2 |d|^2)), the same product behind; 1, without derivatives, where light is totally
            reflected
    gamma   (1 - eta^2) |d|^2 / (s + eta c), or (s - eta c) / |N|^2, which is 2 c / |N|^2 for a mirror
    t       eta d + sigma gamma N, the direction behind, as long as d; for a mirror it is the negative of this
    w, q    d x N and |w|^2;  a = E . w for the field's unit vector E
    f       a^2 / q, the s-polarised part; 1/2 in normal incidence and for light without polarisation
    R       f R_s + (1 - f) R_p with R_s = ((eta c - s) / (eta c + s))^2, R_p = ((c - eta s) / (c + eta s))^2 (exact), or
            R_0 + (1 - R_0) (1 - k)^5 with k = s / |N| if eta > 1, else c / |N| (schlick)
    P'      P (1 - R); 0 where light is totally reflected

by_v is the derivative of whatever is differentiated by v.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from torch import Tensor

from caustic_cli.optics.kernels.fresnel import FRESNEL, cosine_behind, reflectance
from caustic_cli.optics.kernels.jit import FAST, njit
from caustic_cli.optics.kernels.stage import load, ray_stage, store, store_flags
from caustic_cli.optics.tolerances import NORMAL

# Rows of a batch's scratch: the ray, f; t and P', or in the adjoint derivatives by them, and whether light passes; derivatives by
# f and by the ray.
DX, DY, DZ, GX, GY, P, EX, EY, EZ, F = range(10)
TX, TY, TZ, AFTER, PASSES, BY_F, BY_DX, BY_DY, BY_DZ, BY_GX, BY_GY, BY_P, BY_EX, BY_EY, BY_EZ, ROWS = range(10, 26)


class Interface(NamedTuple):
    """Parameters of an interface: n_in / n_out, kind of Fresnel losses, and whether the polarisation is used."""

    eta: float
    fresnel: int
    polarised: bool


# side is sigma, and mirror whether the surface reflects: callers that know them give constants, which the compiler folds.


@njit(inline="always", **FAST)
def _meet(dx, dy, dz, long2, gx, gy, eta, side, mirror):
    """|N|^2, c, s, whether light passes, |gamma|, and one over its denominator."""
    norm2, c = 1.0 + gx * gx + gy * gy, side * (dz - dx * gx - dy * gy)
    s, passes = cosine_behind(norm2 * long2, c, eta)
    under = 1.0 / (norm2 if mirror else s + eta * c)
    gamma = (2.0 * c if mirror else (1.0 - eta) * (1.0 + eta) * long2) * under
    return norm2, c, s, passes, gamma, under


@njit(inline="always", **FAST)
def bend(dx, dy, dz, long2, gx, gy, f, eta, fresnel, side, mirror):
    """t, 1 - R and whether light passes, of one ray; long2: |d|^2."""
    norm2, c, s, passes, gamma, _ = _meet(dx, dy, dz, long2, gx, gy, eta, side, mirror)
    r, _, _, _, _ = reflectance(fresnel, eta, norm2 * long2, c, s, f)
    n, gamma = -eta if mirror else eta, (-side if mirror else side) * gamma
    return n * dx - gamma * gx, n * dy - gamma * gy, n * dz + gamma, 1.0 - r, passes


@njit(inline="always", **FAST)
def pull(dx, dy, dz, long2, gx, gy, f, power, eta, fresnel, side, mirror, tx, ty, tz, by_after):
    """Adjoint of `bend`: derivatives by d, g, P, f and |d|^2 of one ray, from those by t and P'."""
    norm2, c, s, passes, gamma, under = _meet(dx, dy, dz, long2, gx, gy, eta, side, mirror)
    r, r_c, r_s, r_both, r_f = reflectance(fresnel, eta, norm2 * long2, c, s, f)
    # P'
    by_after = by_after if passes else 0.0
    by_r = -power * by_after
    # t
    n, toward = (-eta, -side) if mirror else (eta, side)
    by_gamma = toward * (tz - gx * tx - gy * ty) * under
    toward *= gamma
    # gamma, R and s
    bent = 0.0 if mirror else by_gamma
    by_radicand = 0.5 * (by_r * r_s - gamma * bent) / s if passes else 0.0
    by_both = by_r * r_both + by_radicand * (1.0 - eta) * (1.0 + eta)
    by_c = by_r * r_c + 2.0 * eta * eta * by_radicand * c + (2.0 * by_gamma if mirror else -eta * gamma * by_gamma)
    # c and |N|^2
    by_along, by_norm2 = side * by_c, by_both * long2 - gamma * (by_gamma - bent)
    by_gx, by_gy = 2.0 * gx * by_norm2 - by_along * dx - toward * tx, 2.0 * gy * by_norm2 - by_along * dy - toward * ty
    by_dx, by_dy, by_dz = n * tx - by_along * gx, n * ty - by_along * gy, n * tz + by_along
    return by_dx, by_dy, by_dz, by_gx, by_gy, (1.0 - r) * by_after, by_r * r_f, by_both * norm2 + (1.0 - eta) * (1.0 + eta) * bent


@njit(inline="always", **FAST)
def _across(v, j):
    """w, a and q of ray j."""
    dx, dy, dz, gx, gy = v[DX, j], v[DY, j], v[DZ, j], v[GX, j], v[GY, j]
    wx, wy, wz = dy + dz * gy, -dz * gx - dx, dy * gx - dx * gy
    return wx, wy, wz, v[EX, j] * wx + v[EY, j] * wy + v[EZ, j] * wz, wx * wx + wy * wy + wz * wz


@njit(inline="always", **FAST)
def _part(v, count, polarised):
    """f."""
    for j in range(count):
        v[F, j] = 0.5
    if polarised:
        for j in range(count):
            _, _, _, a, q = _across(v, j)
            v[F, j] = a * a / max(q, NORMAL) if q > NORMAL else 0.5


@njit(inline="always", **FAST)
def _pull_part(v, count):
    """Adjoint of f."""
    for j in range(count):
        wx, wy, wz, a, q = _across(v, j)
        over = 1.0 / max(q, NORMAL)
        # f
        by_a = 2.0 * a * over * v[BY_F, j] if q > NORMAL else 0.0
        by_q = -0.5 * by_a * a * over
        # a and q
        v[BY_EX, j], v[BY_EY, j], v[BY_EZ, j] = by_a * wx, by_a * wy, by_a * wz
        bx, by, bz = by_a * v[EX, j] + 2.0 * by_q * wx, by_a * v[EY, j] + 2.0 * by_q * wy, by_a * v[EZ, j] + 2.0 * by_q * wz
        # w
        v[BY_DX, j] -= by + v[GY, j] * bz
        v[BY_DY, j] += bx + v[GX, j] * bz
        v[BY_DZ, j] += v[GY, j] * bx - v[GX, j] * by
        v[BY_GX, j] += v[DY, j] * bz - v[DZ, j] * by
        v[BY_GY, j] += v[DZ, j] * bx - v[DX, j] * bz


@njit(inline="always", **FAST)
def _load(ray, start, count, v):
    for i in range(9):
        load(ray[i], start, count, v[i])


@njit(inline="always", **FAST)
def _refract(v, start, count, ray, surface, _given, out):
    """t, P' and whether light passes, from d, g, P and E."""
    results, passes = out
    _load(ray, start, count, v)
    _part(v, count, surface.polarised)
    for j in range(count):
        d_x, d_y, d_z, g_x, g_y, f = v[DX, j], v[DY, j], v[DZ, j], v[GX, j], v[GY, j], v[F, j]
        side = math.copysign(1.0, d_z - d_x * g_x - d_y * g_y)
        tx, ty, tz, kept, passing = bend(d_x, d_y, d_z, 1.0, g_x, g_y, f, surface.eta, surface.fresnel, side, False)
        v[TX, j], v[TY, j], v[TZ, j] = tx, ty, tz
        v[AFTER, j], v[PASSES, j] = v[P, j] * kept if passing else 0.0, 1.0 if passing else 0.0
    for i in range(4):
        store(v[TX + i], start, count, results[i])
    store_flags(v[PASSES], start, count, passes)


@njit(inline="always", **FAST)
def _refract_adjoint(v, start, count, ray, surface, given, out):
    """Derivatives by d, g, P and E, from those by t and P'."""
    eta, fresnel = surface.eta, surface.fresnel
    _load(ray, start, count, v)
    for i in range(4):
        load(given[i], start, count, v[TX + i])
    _part(v, count, surface.polarised)
    for j in range(count):
        d_x, d_y, d_z, g_x, g_y, f, power = v[DX, j], v[DY, j], v[DZ, j], v[GX, j], v[GY, j], v[F, j], v[P, j]
        side = math.copysign(1.0, d_z - d_x * g_x - d_y * g_y)
        by_dx, by_dy, by_dz, by_gx, by_gy, by_p, by_f, _ = pull(
            d_x, d_y, d_z, 1.0, g_x, g_y, f, power, eta, fresnel, side, False, v[TX, j], v[TY, j], v[TZ, j], v[AFTER, j]
        )
        v[BY_DX, j], v[BY_DY, j], v[BY_DZ, j], v[BY_GX, j], v[BY_GY, j] = by_dx, by_dy, by_dz, by_gx, by_gy
        v[BY_P, j], v[BY_F, j] = by_p, by_f
    if surface.polarised:
        _pull_part(v, count)
    for i in range(9):
        store(v[BY_DX + i], start, count, out[i])


REFRACT = ray_stage(_refract, _refract_adjoint, ROWS, 4)


def interact(direction, slopes, power: Tensor, *, eta: float, fresnel: str, field=None):
    """Direction and power behind a surface z(x, y).

    Args:
        direction: (d_x, d_y, d_z) of unit length, each a tensor (N,) float64 or a number for all rays.  It may run along the
            surface's normal (-z_x, -z_y, 1) or against it.
        slopes: (z_x, z_y) at the hits, (N,) float64.
        power: (N,) float64.
        eta: n_in / n_out.
        fresnel: none, schlick or exact.
        field: (E_x, E_y, E_z) of linearly polarised light, unit length, tensors or numbers; None for light without
            polarisation.  Only exact Fresnel losses heed it.

    Returns:
        direction: three tensors (N,), finite but meaningless where light is totally reflected.
        power: (N,), 0 where light is totally reflected.
        passes: (N,) bool, False where it is.
    """
    polarised = field is not None and fresnel == "exact"
    surface = Interface(float(eta), FRESNEL[fresnel], polarised)
    *t, after, passes = REFRACT(surface, *direction, *slopes, power, *(field if polarised else (0.0, 0.0, 0.0)))
    return tuple(t), after, passes
