"""A surface as a ball-nose tool has cut it: the lower envelope of its ball along the path, cusps and all.

It has no heights.  Turned over, for a part that was cut upside down or a mould that is pressed, it is the scene's z = -Z(x, -y).
Second derivatives are those of the ball, 1 / R across a pass: nothing smooths the edges between passes.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from torch import Tensor

from caustic_cli.errors import InputError
from caustic_cli.optics.envelope import Envelope
from caustic_cli.optics.surfaces.base import FIRST, Surface, SurfaceIntersection

#: Points along each axis from which bounds are found.
SURVEY = 801
#: By what part slopes may be larger between them.
BETWEEN = 1.2


@dataclass(frozen=True, eq=False)
class CutSurface(Surface[None]):
    """The least of some tools' envelopes over an aperture.

    Args:
        envelopes: of each tool, in the program's own coordinates.
        half_size: of the aperture, mm.
        base: the program's Z0 in the scene; turned: whether its Y and Z point the other way there.
    """

    envelopes: tuple[Envelope, ...]
    half_size: tuple[float, float]
    base: float = 0.0
    turned: bool = False

    @cached_property
    def _survey(self) -> tuple[tuple[float, float], tuple[float, float]]:
        """Bounds of the height, mm, and of both slopes."""
        lines = [np.linspace(-r, r, SURVEY) for r in self.half_size]
        x, y = (torch.from_numpy(c.ravel()) for c in np.meshgrid(*lines, indexing="ij"))
        z, gx, gy = self.at(None, x, y)
        wide = BETWEEN * 2.0 * max(self.half_size) / (SURVEY - 1) * float(torch.hypot(gx, gy).max())
        along, across = (BETWEEN * float(g.abs().max()) for g in (gx, gy))
        return (float(z.min()) - wide, float(z.max()) + wide), (along, across)

    def at(self, heights: None, x: Tensor, y: Tensor, orders=FIRST) -> list[Tensor]:
        """Height and slopes; of higher derivatives there are none.

        Raises:
            InputError: they are asked for.
        """
        if not set(orders) <= set(FIRST):
            raise InputError("a cut surface has edges, and no second derivatives")
        across = -1.0 if self.turned else 1.0
        px, py = x.detach().numpy(), across * y.detach().numpy()
        found = []
        for one in self.envelopes:
            z, cx, cy = one(px, py)
            found.append((z, *one.slopes(px, py, cx, cy)))
        z, gx, gy = found[0]
        for other in found[1:]:
            lower = other[0] < z
            z, gx, gy = (np.where(lower, b, a) for a, b in zip((z, gx, gy), other, strict=True))
        values = {(0, 0): self.base + across * z, (1, 0): across * gx, (0, 1): gy}
        return [torch.from_numpy(np.ascontiguousarray(values[order])) for order in orders]

    def hull(self, heights: None) -> tuple[float, float]:
        """From a survey of points, widened by what may lie between them."""
        return self._survey[0]

    def slope_bounds(self, heights: None) -> tuple[float, float]:
        """From the same survey."""
        return self._survey[1]

    def intersect(self, heights: None, origin, direction, side: float) -> SurfaceIntersection:
        """As of any surface; rays along the axis without a search."""
        if side > 0 and not any(isinstance(c, Tensor) for c in direction) and tuple(direction) == (0.0, 0.0, 1.0):
            x, y, oz = torch.broadcast_tensors(*(torch.as_tensor(c, dtype=torch.float64) for c in origin))
            z, gx, gy = self.at(None, x, y)
            found = (x.abs() <= self.half_size[0]) & (y.abs() <= self.half_size[1]) & (z >= oz)
            return SurfaceIntersection(z - oz, gx, gy, found)
        return super().intersect(heights, origin, direction, side)
