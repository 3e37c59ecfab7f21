"""The interface of optical surfaces: height fields z = Z(x, y) in their own frames, reached by rays from either side.

Notation, in the frame of the surface
    o, d    a ray's origin and unit direction
    side    +1 for rays that reach the surface from below (d_z > 0), -1 from above
    f(t)    side (o_z + t d_z - Z(o_x + t d_x, o_y + t d_y)), negative in front of the intersection
    g       (Z_x, Z_y), slopes;  N = (-g_x, -g_y, 1)

A new kind of surface is one file with a subclass of `Surface` that defines heights and derivatives (`at`) and bounds (`hull`,
`slope_bounds`); intersections and their derivatives are then computed by `intersection`.  A surface with a closed form, or with
kernels, overrides `intersect`.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import Generic, NamedTuple, TypeVar

import numpy as np
import torch
from torch import Tensor

from caustic_cli.errors import InputError
from caustic_cli.optics.backends import backend_for

#: Orders of derivatives by (x, y): value and slopes; second derivatives.
FIRST, SECOND = ((0, 0), (1, 0), (0, 1)), ((2, 0), (1, 1), (0, 2))
#: Type of a surface's heights: a tensor, or None if it has no free parameters.
Heights = TypeVar("Heights", bound=Tensor | None)


class SurfaceIntersection(NamedTuple):
    """Intersections of rays with a surface: distance t (mm, 0 without one), slopes there, and whether there is one; (N,) each.

    Slopes are plain floats if they are the same for all rays.
    """

    t: Tensor
    gx: Tensor | float
    gy: Tensor | float
    valid: Tensor


class Surface(ABC, Generic[Heights]):
    """A surface z = Z(x, y) over the plane, or over a rectangle of half widths `half_size` mm about the origin.

    shape: of its control heights, (n, m), or None if it has no free parameters; methods then take None for heights.
    """

    half_size: tuple[float, float] = (math.inf, math.inf)
    #: Whether it is a plane z = const, which does not deviate axial light.
    flat = False

    @property
    def shape(self) -> tuple[int, int] | None:
        """Shape of its control heights, None if it has none."""
        return None

    @abstractmethod
    def at(self, heights: Heights, x: Tensor, y: Tensor, orders: Sequence[tuple[int, int]] = FIRST) -> list[Tensor]:
        """Derivatives of these orders by x and y at points (N,) mm within `half_size`: (N,) float64 each, mm^(1 - a - b)."""

    @abstractmethod
    def hull(self, heights: Heights) -> tuple[float, float]:
        """Least and largest height bounding the whole surface, mm."""

    @abstractmethod
    def slope_bounds(self, heights: Heights) -> tuple[float, float]:
        """Upper bounds of |Z_x| and |Z_y|."""

    def evaluate(self, heights: Heights, x: Tensor, y: Tensor) -> list[Tensor]:
        """Z, Z_x, Z_y at points (N,) mm, not differentiable by the points: (N,) float64 each."""
        return self.at(heights, x, y)

    def centred(self, heights: Heights) -> tuple[Heights, float]:
        """Heights of the surface shifted towards z = 0, and the shift, mm: small numbers keep more digits."""
        return heights, 0.0

    def intersect(self, heights: Heights, origin, direction, side: float) -> SurfaceIntersection:
        """First intersections of rays (N,), origins in mm and unit directions with side d_z > 0; differentiable by heights and
        rays."""
        (device,) = {c.device for c in (*origin, *direction) if isinstance(c, Tensor)} or {torch.device("cpu")}
        return backend_for(device).intersect(self, heights, origin, direction, side)


class MeasuredSurface(Surface[None]):
    """A surface without free parameters of which heights and slopes alone are known, and which may have edges: as a tool left it,
    or as a mesh describes it."""

    @abstractmethod
    def heights_and_slopes(self, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Z, mm, Z_x and Z_y at points (N,) mm within `half_size`."""

    def at(self, heights: None, x: Tensor, y: Tensor, orders: Sequence[tuple[int, int]] = FIRST) -> list[Tensor]:
        """Height and slopes.

        Raises:
            InputError: higher derivatives are requested.
        """
        if not set(orders) <= set(FIRST):
            raise InputError("a surface with edges has no second derivatives")
        found = self.heights_and_slopes(*(c.detach().double().cpu().numpy() for c in (x, y)))
        return [torch.from_numpy(np.ascontiguousarray(found[FIRST.index(order)])) for order in orders]

    def intersect(self, heights: None, origin, direction, side: float) -> SurfaceIntersection:
        """As of any surface; axial rays need no search."""
        if side > 0 and not any(isinstance(c, Tensor) for c in direction) and tuple(direction) == (0.0, 0.0, 1.0):
            x, y, oz = torch.broadcast_tensors(*(torch.as_tensor(c, dtype=torch.float64) for c in origin))
            z, gx, gy = self.at(None, x, y)
            valid = (x.abs() <= self.half_size[0]) & (y.abs() <= self.half_size[1]) & (z >= oz)
            return SurfaceIntersection(z - oz, gx, gy, valid)
        return super().intersect(heights, origin, direction, side)
