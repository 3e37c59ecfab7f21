"""B-spline height fields with fixed control heights, without free parameters."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor

from caustic_cli.optics.surfaces.base import FIRST, Surface, SurfaceIntersection
from caustic_cli.optics.surfaces.heightfield import HeightField


@dataclass(frozen=True, eq=False)
class Fixed(Surface[None]):
    """A height field with control heights (n, m) mm."""

    field: HeightField
    heights: Tensor

    @property
    def half_size(self) -> tuple[float, float]:  # type: ignore[override]  # read-only here
        """Half widths of the field, mm."""
        return self.field.half_size

    def at(self, heights: None, x: Tensor, y: Tensor, orders=FIRST) -> list[Tensor]:
        """As of the field."""
        return self.field.at(self.heights.to(x.device), x, y, orders)

    def hull(self, heights: None) -> tuple[float, float]:
        """As of the field."""
        return self.field.hull(self.heights)

    def slope_bounds(self, heights: None) -> tuple[float, float]:
        """As of the field."""
        return self.field.slope_bounds(self.heights)

    def intersect(self, heights: None, origin, direction, side: float) -> SurfaceIntersection:
        """As of the field, without derivatives by its heights."""
        device = next(c.device for c in (*origin, *direction) if isinstance(c, Tensor))
        return self.field.intersect(self.heights.to(device), origin, direction, side)
