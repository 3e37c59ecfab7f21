"""Sampling of a disc at infinity, such as the sun: uniform over the aperture, and over projected solid angle or by its
brightness."""

from __future__ import annotations

import math
from typing import ClassVar

import torch
from torch import Tensor

from caustic_cli.optics.emission.base import Emission
from caustic_cli.optics.emission.brightness import points_by_brightness
from caustic_cli.optics.rays import RayState


class Distant(Emission):
    """Rays at angles to z of at most the source's half-angle."""

    dimensions: ClassVar[int] = 4

    def _drawn(self, start: int, *draws: Tensor) -> RayState:
        (u, v, a, b), source = draws, self.scene.source
        if source.brightness is None:
            sine = a.sqrt() * math.sin(source.half_angle)  # uniform over projected solid angle: a disc of uniform radiance
            dx, dy = sine * torch.cos(2 * math.pi * b), sine * torch.sin(2 * math.pi * b)
        else:
            dx, dy = (w * c for w, c in zip(source.frame, points_by_brightness(source.brightness, a, b), strict=True))
        flux, (x, y) = torch.full_like(u, 1.0 / self.count), self.scene.pupil.aperture.spread(u, v)
        return self._at_pupil(x, y, (dx, dy, torch.sqrt(1.0 - dx * dx - dy * dy)), flux, len(u) / self.count)


EMISSIONS = {"far disc": Distant.of_size}
