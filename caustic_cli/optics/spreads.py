"""The point-spread function of several sources: the sum of those of each, by power, about the images of their centres.

Light of all of them through the same point of the lens lands displaced by the same shifts wherever that point is, as for one
extended source (`spread`), if the sources are all at infinity or all at one distance: the wavefronts of a near source and of one
farther away differ in curvature at the lens, so that no shift takes the image of one to that of the other.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, cast

import numpy as np
import torch
from torch import Tensor

from caustic_cli.optics.emission import Rays, rays_of
from caustic_cli.optics.emission.coherent import offset
from caustic_cli.optics.emission.several import of_one
from caustic_cli.optics.spread import MOST_CUT, Convolution, Spread, alike, displacements, landing_of, point_source, spread_at
from caustic_cli.optics.surfaces import HeightField
from caustic_cli.optics.system import System
from caustic_cli.scene import Scene


@dataclass(frozen=True)
class Spreads:
    """The point-spread function of several sources on the screen."""

    #: Of each, about the image of its centre.
    members: tuple[Spread, ...]
    #: Fraction of the power of each, and displacement of the image of its centre from that of all, mm.
    fractions: tuple[float, ...]
    shifts: tuple[tuple[float, float], ...]
    #: As of a `Spread`.
    usual: float

    def reach(self) -> tuple[float, float]:
        """Radius of the point-spread function along x and y, mm."""
        each = zip(self.members, self.shifts, strict=True)
        x, y = np.max([np.abs(shift) + one.reach() for one, shift in each], axis=0).tolist()
        return x, y

    def on(self, pixel: tuple[float, float], most: int = MOST_CUT) -> Convolution:
        """As of a `Spread`."""
        kernels, cut = self._kernels(pixel, self.shifts, most)
        mean = sum(part * kernel for part, kernel in zip(self.fractions, kernels, strict=True))
        return Convolution(torch.from_numpy(mean), cut)

    #: As of a `Spread`, of each source.
    points = 1

    def rays(
        self, scene: Scene, sampler: str, count: int, most: int, seed: int, device: str | torch.device
    ) -> tuple[Scene, Sequence[Rays], list[Convolution]]:
        """As of a `Spread`: from the centre of each source, with kernels of one shape and of sum 1."""
        centres = [replace(one, source=point_source(one)) for one in scene.by_source]
        points = replace(cast(Any, scene.source), members=tuple(one.source for one in centres))
        each = max(1, count // len(centres))
        rays = [of_one(rays_of(c, sampler, each, seed + k, device), k, points) for k, c in enumerate(centres)]
        kernels, cut = self._kernels(scene.screen.pixel, ((0.0, 0.0),) * len(self.members), most)
        return replace(scene, source=points), rays, [Convolution(torch.from_numpy(kernel), cut) for kernel in kernels]

    def _kernels(
        self, pixel: tuple[float, float], shifts: Sequence[tuple[float, float]], most: int
    ) -> tuple[list[np.ndarray], int]:
        """Kernels of all members, of one shape, each moved by its shift, mm, and the subdivision of a pixel that they need."""
        cut = max(one.on(pixel, most).cut for one in self.members)
        cell = (pixel[0] / cut, pixel[1] / cut)
        moved = [
            replace(one, shifts=tuple((x + dx, y + dy, part) for x, y, part in one.shifts))
            for one, (dx, dy) in zip(self.members, shifts, strict=True)
        ]
        return alike([one.kernel(cell) for one in moved]), cut


def spreads_at(scene: Scene, field: HeightField, heights: Tensor) -> Spread | Spreads | None:
    """Point-spread function of the source of a scene, or of all its sources, on the screen for a lens with heights (n, m) mm; None
    if there is none, see `spread_of`, or for sources at several distances."""
    source = scene.source
    if len(source.members) == 1:
        return spread_at(scene, field, heights)
    if len({one.distant for one in source.members}) > 1 or any(one.rays is not None or one.beam for one in source.members):
        return None
    found = displacements(System.of(scene, field), landing_of(scene, field, heights), heights.device)
    if found is None:
        return None
    by, error, usual = found
    return Spreads(
        tuple(Spread.of(one, by, error, usual) for one in source.members),
        source.fractions,
        tuple((by @ offset(source, one.axis if one.distant else one.centre)).tolist() for one in source.members),
        usual,
    )
