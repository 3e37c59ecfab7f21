"""Linearly polarised light at an interface, decomposed into s and p components.

Notation
    d, t    unit directions in front of and behind the interface;  N the normal of a height field, (-z_x, -z_y, 1)
    E       unit vector of the electric field, perpendicular to d
    s, p    s = d x N / |d x N|, normal to the plane of incidence;  p = s x d within it

The transmitted amplitudes are t_s E_s and t_p E_p; without retardation the light stays linearly polarised.  At normal incidence s
and p are equivalent, and any plane of incidence will do.  Born and Wolf, Principles of Optics, 1.5.2.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from caustic_cli.optics.tolerances import NORMAL


def polarisation_vector(angle: float, d):
    """E of light in direction d, polarised along `angle` (degrees from +x) on the axis: rotated with d by parallel transport."""
    a = math.radians(angle)
    ax, ay = math.cos(a), math.sin(a)
    along = (ax * d[0] + ay * d[1]) / (1.0 + d[2])
    return ax - along * d[0], ay - along * d[1], -along * (1.0 + d[2])


def s_fraction(e, d, normal):
    """Fraction of the power that is s-polarised at an interface, (N,); 1/2 at normal incidence."""
    s, square = _across(d, normal)
    across = _dot(e, s)
    return torch.where(square > NORMAL, across * across / square.clamp_min(NORMAL), torch.full_like(square, 0.5))


def transmitted_field(e, d, t, normal, c, s, eta: float):
    """E behind an interface, a unit vector; c, s as for `interface.refract`."""
    sx, square = _across(d, normal)
    length = square.clamp_min(NORMAL).sqrt()
    unit = tuple(v / length for v in sx)
    es, ep = _dot(e, unit) * (2.0 * eta * c) / (eta * c + s), _dot(e, _cross(unit, d)) * (2.0 * eta * c) / (c + eta * s)
    after = tuple(es * a + ep * b for a, b in zip(unit, _cross(unit, t), strict=True))
    size = _dot(after, after).clamp_min(NORMAL).sqrt()
    before = (torch.as_tensor(b, dtype=size.dtype, device=size.device) for b in e)
    return tuple(torch.where(square > NORMAL, a / size, b) for a, b in zip(after, before, strict=True))


def _across(d, normal):
    s = _cross(d, normal)
    square = _dot(s, s)
    return s, square if isinstance(square, Tensor) else torch.tensor(square, dtype=torch.float64)


def _cross(a, b):
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


def _dot(a, b):
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
