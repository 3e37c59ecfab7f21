"""Refraction and reflection at a smooth surface: Snell in vector form, Fresnel, Schlick (thesis 2.1.3).

A height field z(x, y) has the normal N = (-z_x, -z_y, 1), which can never vanish.  With a unit direction d, the
ratio eta = n_in / n_out and c = d . N, the refracted unit direction is

    t = eta d + gamma N,    gamma = (1 - eta^2) / (s + eta c),    s = t . N = sqrt(|N|^2 (1 - eta^2) + eta^2 c^2),

Snell's law (eq. 2.1.10) without any normalisation; a negative radicand means total internal reflection.  This form of gamma avoids
the cancellation in (s - eta c) / |N|^2 for indices close to 1.
For a plane wave along +z inside a lens it is the closed form of 3.2 (erratum E1) with s = S.

Light from above the surface (side -1) is treated as light from below at the surface mirrored in z = 0.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from torch import Tensor

from caustic_cli.optics.polarisation import s_fraction
from caustic_cli.optics.tolerances import CRITICAL


class OutgoingRays(NamedTuple):
    """Rays behind a surface: unit directions, power, and whether they are transmitted (False: total internal reflection, with power
    0 and a finite but meaningless direction).  For a mirror all are."""

    direction: tuple
    power: Tensor
    passes: Tensor


def interact(
    direction, slopes, power: Tensor, *, eta: float | Tensor, reflects: bool, fresnel: str, polarised=None, side: float = 1.0
) -> OutgoingRays:
    """Refract or reflect rays of N at a height field.

    Args:
        direction: unit directions, three tensors (N,) or plain floats, with side d . N > 0.
        slopes: z_x, z_y at the hits, tensors or plain floats.
        power: (N,).
        eta: n_in / n_out, a number, or (N,) of media whose index varies.
        reflects: whether the surface is a mirror, of reflectance 1; otherwise light is refracted, less the Fresnel loss.
        fresnel: none, schlick or exact.
        polarised: unit vectors of the field of linearly polarised light, as `direction`; None for unpolarised light.
        side: +1 for rays from below the surface, -1 from above.
    """
    if side < 0:
        flipped = interact(
            (direction[0], direction[1], -direction[2]),
            [-g for g in slopes],
            power,
            eta=eta,
            reflects=reflects,
            fresnel=fresnel,
            polarised=None if polarised is None else (polarised[0], polarised[1], -polarised[2]),
        )
        tx, ty, tz = flipped.direction
        return OutgoingRays((tx, ty, -tz), flipped.power, flipped.passes)
    gx, gy = slopes
    if reflects:
        return OutgoingRays(reflect(direction, gx, gy)[0], power, torch.ones_like(power, dtype=torch.bool))
    if isinstance(gx, float) and gx == 0.0 and gy == 0.0:
        return _flat(direction, power, eta, fresnel, polarised)
    out, passes, c, s = refract(direction, gx, gy, eta)
    reflected = _reflected(direction, (-gx, -gy, 1.0), c, s, eta, fresnel, polarised)
    return OutgoingRays(out, torch.where(passes, power * (1.0 - reflected), torch.zeros_like(power)), passes)


def _flat(direction, power: Tensor, eta: float | Tensor, fresnel: str, polarised) -> OutgoingRays:
    """At z = const Snell's law keeps n (d_x, d_y)."""
    dx, dy, dz = direction
    tx, ty = (d / (1.0 / eta) for d in (dx, dy))
    square = 1.0 - tx * tx - ty * ty
    if not isinstance(square, Tensor):
        square = torch.tensor(square, dtype=power.dtype, device=power.device)
    passes = square > CRITICAL
    tz = torch.where(passes, square, torch.ones_like(square)).sqrt()
    dz_ = dz if isinstance(dz, Tensor) else torch.tensor(dz, dtype=power.dtype, device=power.device)
    reflected = _reflected(direction, (0.0, 0.0, 1.0), dz_, tz, eta, fresnel, polarised)
    if not any(isinstance(c, Tensor) for c in direction):  # one direction for all rays stays one
        return OutgoingRays((tx, ty, float(tz)), torch.where(passes, power * (1.0 - reflected), torch.zeros_like(power)), passes)
    return OutgoingRays((tx, ty, tz), torch.where(passes, power - reflected * power, torch.zeros_like(power)), passes)


def _reflected(direction, normal, c, s, eta: float | Tensor, fresnel: str, polarised):
    """Part of the power reflected, of light polarised or not."""
    if polarised is not None and fresnel == "exact":
        (rs, rp), part = reflectances(c, s, eta), s_fraction(polarised, direction, normal)
        return part * rs + (1.0 - part) * rp
    length = 1.0
    if fresnel == "schlick":
        gx, gy = normal[0], normal[1]
        length = (1.0 + gx * gx + gy * gy) ** 0.5
    return reflectance(fresnel, c / length, s / length, eta)


def refract(d, slope_x: Tensor, slope_y: Tensor, eta: float | Tensor):
    """Refract unit directions at a height field.

    Args:
        d: (d_x, d_y, d_z), tensors or plain floats, unit length, d . N > 0.
        slope_x, slope_y: z_x, z_y at the hit.
        eta: n_in / n_out.

    Returns:
        t: (t_x, t_y, t_z) unit directions (finite but meaningless where totally reflected),
        passes: bool, False where the ray is totally reflected,
        c, s: d . N and t . N, both cosines times |N|, for the Fresnel terms.
    """
    norm2 = 1.0 + slope_x * slope_x + slope_y * slope_y
    c = d[2] - d[0] * slope_x - d[1] * slope_y
    # |N|^2 (1 - eta^2) + eta^2 c^2 in a form without cancellation where c = d_z = 1
    radicand = norm2 + (eta * eta) * (c * c - norm2)
    passes = radicand > CRITICAL * norm2
    s = torch.where(passes, radicand, torch.ones_like(radicand)).sqrt()  # a masked argument keeps NaN out of gradients
    gamma = (1.0 - eta) * (1.0 + eta) / (s + eta * c)
    return (eta * d[0] - gamma * slope_x, eta * d[1] - gamma * slope_y, eta * d[2] + gamma), passes, c, s


def reflect(d, slope_x: Tensor, slope_y: Tensor):
    """Unit directions reflected at a height field, d - 2 (d . N) / |N|^2 N (Snell's law with index -1), and c = d . N."""
    c = d[2] - d[0] * slope_x - d[1] * slope_y
    twice = 2.0 * c / (1.0 + slope_x * slope_x + slope_y * slope_y)
    return (d[0] + twice * slope_x, d[1] + twice * slope_y, d[2] - twice), c


def reflectances(c, s, eta: float | Tensor):
    """Fresnel reflectances (R_s, R_p) for s- and p-polarised light, from c and s of `refract`: r_s^2, r_p^2 of `reflectance`."""
    rs, rp = (eta * c - s) / (eta * c + s), (c - eta * s) / (c + eta * s)
    return rs * rs, rp * rp


def reflectance(kind: str, c, s, eta: float | Tensor):
    """Reflectance from c and s of `refract` (up to a common factor); kind: none, schlick or exact, for unpolarised light.

    Exact: (r_s^2 + r_p^2) / 2 with r_s = (eta c - s) / (eta c + s), r_p = (c - eta s) / (c + eta s).
    Schlick: R0 + (1 - R0) (1 - cos)^5 with the larger of the two angles; it needs true cosines.  Eqs. 2.1.13 and 2.1.14, errata
    E17 and E18.
    """
    if kind == "none":
        return torch.zeros_like(s) if isinstance(s, Tensor) else 0.0
    if kind == "schlick":
        r0 = ((eta - 1.0) / (eta + 1.0)) ** 2
        x = 1.0 - (torch.minimum(c, s) if isinstance(eta, Tensor) else s if eta > 1 else c)
        x2 = x * x
        return r0 + (1.0 - r0) * (x2 * x2 * x)
    rs, rp = reflectances(c, s, eta)
    return 0.5 * (rs + rp)


def slopes_inside(direction: tuple[Any, Any, Any], n: float) -> tuple[Any, Any]:
    """Slopes k_x, k_y to z of light along a unit vector, of numbers or of arrays, behind a flat entrance into n times the index."""
    x, y, _ = direction
    along = ((n - 1.0) * (n + 1.0) + direction[2] ** 2) ** 0.5
    return x / along, y / along
