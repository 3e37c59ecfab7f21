"""Plane surfaces, z = 0."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from caustic_cli.optics.surfaces.base import FIRST, Surface, SurfaceIntersection
from caustic_cli.optics.tolerances import PARALLEL


@dataclass(frozen=True)
class Plane(Surface[None]):
    """The plane z = 0 of its element's frame."""

    flat = True

    def at(self, heights: None, x: Tensor, y: Tensor, orders=FIRST) -> list[Tensor]:
        """Zeros."""
        return [torch.zeros_like(x) for _ in orders]

    def hull(self, heights: None) -> tuple[float, float]:
        """(0, 0)."""
        return 0.0, 0.0

    def slope_bounds(self, heights: None) -> tuple[float, float]:
        """(0, 0)."""
        return 0.0, 0.0

    def intersect(self, heights: None, origin, direction, side: float) -> SurfaceIntersection:
        """t = -o_z / d_z; the slopes are the number 0."""
        like = next(c for c in (*origin, *direction) if isinstance(c, Tensor))
        oz, dz = (torch.as_tensor(c, dtype=like.dtype, device=like.device) for c in (origin[2], direction[2]))
        ahead = side * dz > PARALLEL
        t = torch.where(ahead, -oz / torch.where(ahead, dz, torch.ones_like(dz)), torch.zeros_like(like))
        valid = ahead & (t >= 0)
        return SurfaceIntersection(torch.where(valid, t, torch.zeros_like(t)), 0.0, 0.0, valid)
