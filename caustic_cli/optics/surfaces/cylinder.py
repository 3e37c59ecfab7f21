"""Cylindrical surfaces, by their curvature at the line of contact with the plane z = 0.

Notation
    k       1 / R, curvature along the coordinate b, x or y; the cylinder's axis is at z = +R for R > 0
    sag     Z = k b^2 / (1 + sqrt(1 - k^2 b^2)), the half next to the line of contact

Projected along the axis, the intersection is that of a ray, not of unit length, with a circle: t = F / (G + side sqrt(G^2 - k A
F)), F = k (b_o^2 + o_z^2) - 2 o_z, G = d_z - k (b_o b_d + o_z d_z), A = b_d^2 + d_z^2, as in `sphere`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from caustic_cli.errors import InputError
from caustic_cli.optics.surfaces.base import FIRST, Surface, SurfaceIntersection
from caustic_cli.optics.surfaces.sphere import EQUATOR


@dataclass(frozen=True)
class Cylinder(Surface[None]):
    """A cylindrical surface of signed radius R, mm, finite and not 0; bent: the coordinate with curvature, 0 for x, 1 for y."""

    radius: float
    bent: int = 0

    def __post_init__(self):
        if not math.isfinite(self.radius) or self.radius == 0:
            raise InputError(f"radius of a cylinder must be a finite non-zero number, got {self.radius!r}")

    @property
    def curvature(self) -> float:
        """k, 1/mm."""
        return 1.0 / self.radius

    def at(self, heights: None, x: Tensor, y: Tensor, orders=FIRST) -> list[Tensor]:
        """Sag and its derivatives up to second order; beyond the equator those of points on it."""
        k, b = self.curvature, (x, y)[self.bent]
        cosine = (1.0 - k * k * b * b).clamp_min(1.0 - EQUATOR**2).sqrt()
        slope = k * b / cosine
        along = {0: k * b * b / (1.0 + cosine), 1: slope, 2: k * (1.0 + slope * slope) / cosine}
        return [torch.zeros_like(b) if order[1 - self.bent] else along[order[self.bent]] for order in orders]

    def hull(self, heights: None) -> tuple[float, float]:
        """From the line of contact to the equator."""
        return min(0.0, self.radius), max(0.0, self.radius)

    def slope_bounds(self, heights: None) -> tuple[float, float]:
        """The slope near the equator, along the curved coordinate."""
        steepest = EQUATOR / math.sqrt(1.0 - EQUATOR**2)
        return (0.0, steepest) if self.bent else (steepest, 0.0)

    def intersect(self, heights: None, origin, direction, side: float) -> SurfaceIntersection:
        """The closed form, from either side."""
        k, (bo, oz), (bd, dz) = self.curvature, (origin[self.bent], origin[2]), (direction[self.bent], direction[2])
        big_f = k * (bo * bo + oz * oz) - 2.0 * oz
        big_g = dz - k * (bo * bd + oz * dz)
        square = big_g * big_g - k * (bd * bd + dz * dz) * big_f
        met = square > 0
        root = torch.where(met, square, torch.ones_like(square)).sqrt()
        t = big_f / (big_g + side * root)
        b, z = bo + t * bd, oz + t * dz
        cosine = 1.0 - k * z
        valid = met & (t >= 0) & (cosine > math.sqrt(1.0 - EQUATOR**2)) & (side * (dz * cosine - k * b * bd) > 0)
        none = torch.zeros_like(t)
        slope = torch.where(valid, k * b / torch.where(valid, cosine, torch.ones_like(t)), none)
        slopes = (none, slope) if self.bent else (slope, none)
        return SurfaceIntersection(torch.where(valid, t, none), *slopes, valid)
