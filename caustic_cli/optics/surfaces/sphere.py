"""Spherical surfaces, by their curvature, with the vertex at the origin.

Notation
    k       1 / R, curvature; the centre is at z = +R
    sag     Z = k r^2 / (1 + sqrt(1 - k^2 r^2)),  r^2 = x^2 + y^2, the hemisphere next to the vertex

A ray from o along d intersects it at t = F / (G + side sqrt(G^2 - k F)), F = k o.o - 2 o_z, G = d_z - k o.d (Welford, Aberrations
of Optical Systems, 4.4), which also holds for a plane and loses no digits for large radii.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from caustic_cli.errors import InputError
from caustic_cli.optics.surfaces.base import FIRST, Surface, SurfaceIntersection

#: Largest distance from the axis relative to the radius: at the equator the slope is infinite.
EQUATOR = 1.0 - 1e-9


@dataclass(frozen=True)
class Sphere(Surface[None]):
    """A spherical surface of signed radius R, mm, not 0; infinite for a plane."""

    #: R.
    radius: float
    #: Semi-aperture for which its bounds hold, mm.
    reach: float = math.inf

    def __post_init__(self):
        if math.isnan(self.radius) or self.radius == 0:
            raise InputError(f"radius of a sphere must be a non-zero number or inf, got {self.radius!r}")

    @property
    def curvature(self) -> float:
        """k, 1/mm."""
        return 1.0 / self.radius

    def at(self, heights: None, x: Tensor, y: Tensor, orders=FIRST) -> list[Tensor]:
        """Sag and its derivatives up to second order; beyond the equator those of points on it."""
        k = self.curvature
        cosine = (1.0 - k * k * (x * x + y * y)).clamp_min(1.0 - EQUATOR**2).sqrt()
        zx, zy = k * x / cosine, k * y / cosine
        values = {
            (0, 0): k * (x * x + y * y) / (1.0 + cosine),
            (1, 0): zx,
            (0, 1): zy,
            (2, 0): k * (1.0 + zx * zx) / cosine,
            (1, 1): k * zx * zy / cosine,
            (0, 2): k * (1.0 + zy * zy) / cosine,
        }
        return [values[order] for order in orders]

    def hull(self, heights: None) -> tuple[float, float]:
        """From the vertex to the sag at the semi-aperture."""
        r = min(self.reach, EQUATOR * abs(self.radius)) if math.isfinite(self.radius) else 0.0
        sag = self.curvature * r * r / (1.0 + math.sqrt(1.0 - (self.curvature * r) ** 2))
        return min(0.0, sag), max(0.0, sag)

    def slope_bounds(self, heights: None) -> tuple[float, float]:
        """The slope at the semi-aperture, along either axis."""
        sine = min(self.reach * abs(self.curvature), EQUATOR) if math.isfinite(self.radius) else 0.0
        return (sine / math.sqrt(1.0 - sine * sine),) * 2

    def intersect(self, heights: None, origin, direction, side: float) -> SurfaceIntersection:
        """The closed form, from either side."""
        (ox, oy, oz), (dx, dy, dz), k = origin, direction, self.curvature
        big_f = k * (ox * ox + oy * oy + oz * oz) - 2.0 * oz
        big_g = dz - k * (ox * dx + oy * dy + oz * dz)
        square = big_g * big_g - k * big_f
        met = square > 0
        root = torch.where(met, square, torch.ones_like(square)).sqrt()
        t = big_f / (big_g + side * root)
        x, y, z = ox + t * dx, oy + t * dy, oz + t * dz
        cosine = 1.0 - k * z  # towards the vertex's half; 0 at the equator
        valid = met & (t >= 0) & (cosine > math.sqrt(1.0 - EQUATOR**2)) & (side * (dz * cosine - k * (x * dx + y * dy)) > 0)
        none, one = torch.zeros_like(t), torch.ones_like(t)
        cosine = torch.where(valid, cosine, one)
        return SurfaceIntersection(
            torch.where(valid, t, none), torch.where(valid, k * x / cosine, none), torch.where(valid, k * y / cosine, none), valid
        )
