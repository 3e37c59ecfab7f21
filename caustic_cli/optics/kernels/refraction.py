"""CPU kernels for refraction at a smooth surface: Snell's law and the Fresnel equations, with adjoint.

Rays are float64 components, see `stage`; the reference is `interface` with `polarisation.s_fraction`.  For rays with d . N < 0 the
normal is reversed.

Notation, a ray with unit direction d, power P, and slopes g of the surface at its hit; N = (-g_x, -g_y, 1), eta = n_in / n_out
    sigma   1 where d . N >= 0, else -1;  sigma N is the normal along which light passes
    c       sigma (d . N) >= 0
    s       sqrt(|N|^2 + eta^2 (c^2 - |N|^2)), the same product behind; 1, without derivatives, where light is totally reflected
    gamma   sigma (1 - eta^2) / (s + eta c)
    t       eta d + gamma N, the direction behind
    w, q    d x N and |w|^2;  a = E . w for the field's unit vector E
    f       a^2 / q, the s-polarised part; 1/2 in normal incidence and for light without polarisation
    R       f R_s + (1 - f) R_p with R_s = ((eta c - s) / (eta c + s))^2, R_p = ((c - eta s) / (c + eta s))^2 (exact), or
            R_0 + (1 - R_0) (1 - k)^5 with k = s / |N| if eta > 1, else c / |N| (schlick)
    P'      P (1 - R); 0 where light is totally reflected

by_v is the derivative of whatever is differentiated by v.
"""

from __future__ import annotations

from typing import NamedTuple

from caustic_cli.optics.kernels.fresnel import cosine_behind, reflectance
from caustic_cli.optics.kernels.jit import FAST, njit
from caustic_cli.optics.kernels.stage import Stage, load, store, store_flags
from caustic_cli.optics.tolerances import NORMAL

# Rows of a batch's scratch: the ray, intermediate results, R and its derivatives; t and P', or in the adjoint derivatives by them;
# and derivatives by f and by the ray.
DX, DY, DZ, GX, GY, P, EX, EY, EZ = range(9)
NORM2, C, SIDE, S, PASSES, F, R, R_C, R_S, R_NORM2, R_F = range(9, 20)
TX, TY, TZ, AFTER, BY_F, BY_DX, BY_DY, BY_DZ, BY_GX, BY_GY, BY_P, BY_EX, BY_EY, BY_EZ, ROWS = range(20, 35)


class Interface(NamedTuple):
    """Parameters of an interface: n_in / n_out, kind of Fresnel losses, and whether the polarisation is used."""

    eta: float
    fresnel: int
    polarised: bool


@njit(inline="always", **FAST)
def _load(ray, start, count, v):
    for i in range(9):
        load(ray[i], start, count, v[i])


@njit(inline="always", **FAST)
def _snell(v, count, eta):
    """|N|^2, c, sigma, s, and 1 or 0 for whether light passes."""
    for j in range(count):
        gx, gy = v[GX, j], v[GY, j]
        norm2 = 1.0 + gx * gx + gy * gy
        along = v[DZ, j] - v[DX, j] * gx - v[DY, j] * gy
        c = abs(along)
        s, passes = cosine_behind(norm2, c, eta)
        v[NORM2, j], v[C, j], v[SIDE, j], v[S, j] = norm2, c, 1.0 if along >= 0.0 else -1.0, s
        v[PASSES, j] = 1.0 if passes else 0.0


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
def _reflectance(v, count, eta, fresnel):
    for j in range(count):
        r, by_c, by_s, by_norm2, by_f = reflectance(fresnel, eta, v[NORM2, j], v[C, j], v[S, j], v[F, j])
        v[R, j], v[R_C, j], v[R_S, j], v[R_NORM2, j], v[R_F, j] = r, by_c, by_s, by_norm2, by_f


@njit(inline="always", **FAST)
def _prepare(v, count, surface):
    _snell(v, count, surface.eta)
    _part(v, count, surface.polarised)
    _reflectance(v, count, surface.eta, surface.fresnel)


@njit(inline="always", **FAST)
def bend(v, count, surface):
    """t in TX, TY, TZ and P' in AFTER."""
    eta = surface.eta
    _prepare(v, count, surface)
    for j in range(count):
        gamma = v[SIDE, j] * (1.0 - eta) * (1.0 + eta) / (v[S, j] + eta * v[C, j])
        v[TX, j] = eta * v[DX, j] - gamma * v[GX, j]
        v[TY, j] = eta * v[DY, j] - gamma * v[GY, j]
        v[TZ, j] = eta * v[DZ, j] + gamma
        v[AFTER, j] = v[P, j] * (1.0 - v[R, j]) if v[PASSES, j] > 0.0 else 0.0


@njit(inline="always", **FAST)
def _refract(v, start, count, ray, surface, _given, out):
    """t, P' and whether light passes, from d, g, P and E."""
    results, passes = out
    _load(ray, start, count, v)
    bend(v, count, surface)
    for i in range(4):
        store(v[TX + i], start, count, results[i])
    store_flags(v[PASSES], start, count, passes)


@njit(inline="always", **FAST)
def pull(v, count, eta):
    """Adjoint but for f, whose derivative is left in BY_F."""
    for j in range(count):
        passes, side, c, s, gx, gy = v[PASSES, j], v[SIDE, j], v[C, j], v[S, j], v[GX, j], v[GY, j]
        tx, ty, tz, by_after = v[TX, j], v[TY, j], v[TZ, j], passes * v[AFTER, j]
        # P'
        by_r = -v[P, j] * by_after
        v[BY_P, j] = (1.0 - v[R, j]) * by_after
        # R
        v[BY_F, j], by_c, by_s, by_norm2 = by_r * v[R_F, j], by_r * v[R_C, j], by_r * v[R_S, j], by_r * v[R_NORM2, j]
        # t
        under = 1.0 / (s + eta * c)
        gamma = side * (1.0 - eta) * (1.0 + eta) * under
        by_gamma = tz - gx * tx - gy * ty
        # gamma
        by_s -= gamma * by_gamma * under
        by_c -= eta * gamma * by_gamma * under
        # s
        by_radicand = 0.5 * passes * by_s / s
        by_norm2 += by_radicand * (1.0 - eta) * (1.0 + eta)
        by_c += by_radicand * 2.0 * eta * eta * c
        # c and |N|^2
        by_c *= side
        v[BY_DX, j] = eta * tx - by_c * gx
        v[BY_DY, j] = eta * ty - by_c * gy
        v[BY_DZ, j] = eta * tz + by_c
        v[BY_GX, j] = 2.0 * gx * by_norm2 - by_c * v[DX, j] - gamma * tx
        v[BY_GY, j] = 2.0 * gy * by_norm2 - by_c * v[DY, j] - gamma * ty


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
def _refract_adjoint(v, start, count, ray, surface, given, out):
    """Derivatives by d, g, P and E, from those by t and P'."""
    _load(ray, start, count, v)
    for i in range(4):
        load(given[i], start, count, v[TX + i])
    _prepare(v, count, surface)
    pull(v, count, surface.eta)
    if surface.polarised:
        _pull_part(v, count)
    for i in range(9):
        store(v[BY_DX + i], start, count, out[i])


REFRACT = Stage.of(_refract, _refract_adjoint, ROWS, 4)
