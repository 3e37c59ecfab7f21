"""A machined surface: the lower envelope of a ball or of a turning tool along its path, including the cusps between passes.

It has no free parameters.  For a part that was cut upside down, or a mould, it is turned over: the scene's z = -Z(x, -y).  Across a
pass the curvature is that of the ball, 1 / R; at the cusps the slope is discontinuous.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch

from caustic_cli.optics.envelope import Envelope
from caustic_cli.optics.nose_envelope import NoseEnvelope
from caustic_cli.optics.surfaces.base import MeasuredSurface

#: Points along each axis at which bounds are sampled.
SURVEY = 801
#: Safety factor for the slopes between these points.
BETWEEN = 1.2


@dataclass(frozen=True, eq=False)
class CutSurface(MeasuredSurface):
    """The minimum of the envelopes of one or several tools over an aperture."""

    #: Of each tool, in the program's coordinates.
    envelopes: tuple[Envelope | NoseEnvelope, ...]
    #: Half widths of the aperture, mm.
    half_size: tuple[float, float]
    #: z of the program's origin in the scene, mm.
    base: float = 0.0
    #: Whether its Y and Z axes are reversed there.
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

    def heights_and_slopes(self, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Of the lowest envelope at points (N,) mm."""
        across = -1.0 if self.turned else 1.0
        y, envelopes = across * y, []
        for one in self.envelopes:
            envelopes.append(one.surface(x, y))
        z, gx, gy = envelopes[0]
        for other in envelopes[1:]:
            lower = other[0] < z
            z, gx, gy = (np.where(lower, b, a) for a, b in zip((z, gx, gy), other, strict=True))
        return self.base + across * z, across * gx, gy

    def hull(self, heights: None) -> tuple[float, float]:
        """From sampled points, with a margin for the points in between."""
        return self._survey[0]

    def slope_bounds(self, heights: None) -> tuple[float, float]:
        """From the same points."""
        return self._survey[1]
