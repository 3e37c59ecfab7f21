"""NURBS height fields: z = A / W, A = sum_ij w_ij P_ij N_i(u) N_j(v), W = sum_ij w_ij N_i(u) N_j(v) (eq. 2.4.8).

x and y are linear in u and v, as for a B-spline height field: the weights affect the height only, and rays are intersected in the
same way.

    Z_x = (A_x - z W_x) / W
    Z_xy = (A_xy - z W_xy - Z_x W_y - Z_y W_x) / W          (quotient rule, Piegl & Tiller eq. 4.20)
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from caustic_cli.errors import InputError
from caustic_cli.optics.surfaces.base import FIRST, Surface
from caustic_cli.optics.surfaces.heightfield import HeightField


@dataclass(frozen=True, eq=False)
class Nurbs(Surface[Tensor]):
    """A rational height field."""

    #: Spline spaces and half widths of numerator and denominator.
    field: HeightField
    #: (n, m), positive.
    weights: Tensor

    def __post_init__(self):
        if tuple(self.weights.shape) != self.field.shape:
            raise InputError(f"NURBS weights must have shape {self.field.shape}, got {tuple(self.weights.shape)}")
        if not bool((self.weights > 0).all()):
            raise InputError("NURBS weights must all be positive")
        object.__setattr__(self, "weights", self.weights.double())

    @property
    def shape(self) -> tuple[int, int]:
        """Control points (n, m)."""
        return self.field.shape

    @property
    def half_size(self) -> tuple[float, float]:  # type: ignore[override]  # read-only here
        """Half widths of the aperture, mm."""
        return self.field.half_size

    def at(self, heights: Tensor, x: Tensor, y: Tensor, orders=FIRST) -> list[Tensor]:
        """By the quotient rule, up to second order; linear in the heights."""
        need = sorted({(i, j) for a, b in orders for i in range(a + 1) for j in range(b + 1)}, key=sum)
        top = dict(zip(need, self.field.at(self.weights * heights.double(), x, y, need), strict=True))
        low = dict(zip(need, self.field.at(self.weights, x, y, need), strict=True))
        z: dict[tuple[int, int], Tensor] = {}
        for a, b in need:
            value = top[a, b]
            for i in range(a + 1):
                for j in range(b + 1):
                    if i or j:
                        times = (2.0 if (a == 2 and i == 1) else 1.0) * (2.0 if (b == 2 and j == 1) else 1.0)
                        value = value - times * low[i, j] * z[a - i, b - j]
            z[a, b] = value / low[0, 0]
        return [z[order] for order in orders]

    def hull(self, heights: Tensor) -> tuple[float, float]:
        """Least and largest control height, by the convex hull property for positive weights."""
        low, high = torch.aminmax(heights.detach())
        return float(low), float(high)

    def slope_bounds(self, heights: Tensor) -> tuple[float, float]:
        """|Z_x| <= (|(A - m W)_x| + |z - m| |W_x|) / W with m the midpoint of the hull, each term from its control net."""
        low, high = self.hull(heights)
        middle, half, least = 0.5 * (low + high), 0.5 * (high - low), float(self.weights.min())
        over = self.field.slope_bounds(self.weights * (heights.detach().double() - middle))
        under = self.field.slope_bounds(self.weights)
        x, y = ((a + half * w) / least for a, w in zip(over, under, strict=True))
        return x, y

    def centred(self, heights: Tensor) -> tuple[Tensor, float]:
        """Heights minus their mean, and the mean, mm: the rational basis is a partition of unity, so the surface shifts with its
        net."""
        middle = float(heights.detach().double().mean())
        return heights.double() - middle, middle
