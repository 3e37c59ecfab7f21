"""What a surface is to light: a height field z = Z(x, y) in its own frame, which rays meet from either side.

Notation, in the frame of the surface
    o, d    a ray's origin and unit direction
    side    +1 for rays that meet the surface from below (d_z > 0), -1 from above
    f(t)    side (o_z + t d_z - Z(o_x + t d_x, o_y + t d_y)), negative before the ray has crossed the surface
    g       (Z_x, Z_y), slopes;  N = (-g_x, -g_y, 1)

A new kind of surface is one file with a subclass of `Surface` that says where the surface is (`at`) and between which bounds
(`hull`, `slope_bounds`); intersections and their derivatives then come from `intersection`.  One with a closed form, or with
kernels, overrides `meet`.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import Generic, NamedTuple, TypeVar

import torch
from torch import Tensor

from caustic_cli.optics.backends import backend_for

#: Orders of derivatives by (x, y): value and slopes, and second derivatives.
FIRST, SECOND = ((0, 0), (1, 0), (0, 1)), ((2, 0), (1, 1), (0, 2))
#: What a surface takes for heights: a tensor, or None where nothing is free.
Heights = TypeVar("Heights", bound=Tensor | None)


class SurfaceIntersection(NamedTuple):
    """Where rays meet a surface: distance t along them (mm, 0 where they do not), slopes there, and whether they do; (N,) each.

    Slopes are plain floats where they are the same for every ray.
    """

    t: Tensor
    gx: Tensor | float
    gy: Tensor | float
    found: Tensor


class Surface(ABC, Generic[Heights]):
    """A surface z = Z(x, y) over the plane, or over a rectangle of half widths `half_size` mm about the origin.

    shape: of the heights that shape it, (n, m), or None where nothing is free; methods take None for heights then.
    """

    half_size: tuple[float, float] = (math.inf, math.inf)
    #: Whether all of it lies in one plane z = const: light along the axis then goes straight on.
    flat = False

    @property
    def shape(self) -> tuple[int, int] | None:
        """Of its heights; None where nothing is free."""
        return None

    @abstractmethod
    def at(self, heights: Heights, x: Tensor, y: Tensor, orders: Sequence[tuple[int, int]] = FIRST) -> list[Tensor]:
        """Derivatives of these orders by x and y at points (N,) mm within `half_size`: (N,) float64 each, mm^(1 - a - b)."""

    @abstractmethod
    def hull(self, heights: Heights) -> tuple[float, float]:
        """Heights between which the whole surface lies, mm."""

    @abstractmethod
    def slope_bounds(self, heights: Heights) -> tuple[float, float]:
        """Upper bounds of |Z_x| and |Z_y|."""

    def evaluate(self, heights: Heights, x: Tensor, y: Tensor) -> list[Tensor]:
        """Z, Z_x, Z_y at points (N,) mm that no derivative goes to: (N,) float64 each."""
        return self.at(heights, x, y)

    def centred(self, heights: Heights) -> tuple[Heights, float]:
        """Heights of the same surface moved to where its numbers are small, and by how far it was higher, mm."""
        return heights, 0.0

    def intersect(self, heights: Heights, origin, direction, side: float) -> SurfaceIntersection:
        """First intersections of rays (N,), mm, unit directions with side d_z > 0; differentiable by all three."""
        (device,) = {c.device for c in (*origin, *direction) if isinstance(c, Tensor)} or {torch.device("cpu")}
        return backend_for(device).intersect(self, heights, origin, direction, side)
