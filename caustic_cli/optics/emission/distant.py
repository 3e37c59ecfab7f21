"""Rays of an evenly bright disc at infinity, such as the sun: even over the aperture, and over the projected solid angle."""

from __future__ import annotations

import math
from typing import ClassVar

import torch
from torch import Tensor

from caustic_cli.optics.emission.base import Emission
from caustic_cli.optics.rays import RayState


class Distant(Emission):
    """Rays that lean from z by at most the source's half angle."""

    dimensions: ClassVar[int] = 4

    def _drawn(self, start: int, u: Tensor, v: Tensor, a: Tensor, b: Tensor) -> RayState:
        (rx, ry), half = self.scene.pupil.half_size, self.scene.source.half_angle
        sine = a.sqrt() * math.sin(half)  # even over the projected solid angle: an evenly bright disc
        dx, dy = sine * torch.cos(2 * math.pi * b), sine * torch.sin(2 * math.pi * b)
        share, x, y = torch.full_like(u, 1.0 / self.count), (2.0 * u - 1.0) * rx, (2.0 * v - 1.0) * ry
        if self.scene.pupil.round:  # even over the disc
            x, y = rx * u.sqrt() * torch.cos(2 * math.pi * v), rx * u.sqrt() * torch.sin(2 * math.pi * v)
        return self._at_pupil(x, y, (dx, dy, torch.sqrt(1.0 - dx * dx - dy * dy)), share, len(u) / self.count)


EMISSIONS = {"far disc": Distant.of_size}
