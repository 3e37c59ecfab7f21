"""What all rays have in common that are drawn on the pupil, the aperture that a source lights (thesis 4.2, 4.3.1).

Nothing here depends on the heights, so a design does it once.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar, Protocol, Self

import torch
from torch import Tensor

from caustic_cli.errors import InputError
from caustic_cli.optics.rays import RayState
from caustic_cli.optics.sampling import SAMPLERS, numbers
from caustic_cli.scene import Pupil, Source
from caustic_cli.scene.sources.distribution import Distribution


class Illuminated(Protocol):
    """What a source lights: a one-lens scene, or a system."""

    @property
    def source(self) -> Source:
        """Where the light comes from."""

    @property
    def pupil(self) -> Pupil:
        """The aperture that it is meant for."""


@dataclass(frozen=True, eq=False)
class Emission:
    """All rays of a source that is not collimated; a class of its own says how they are drawn.

    Args:
        scene: what is lit, by a source of the kind that the class draws.
        kind: sampler, one of `sampling.SAMPLERS`.
        shape: cells (nu, nv) for each of its points, or for a distant source; every one sends out as many rays.
        seed, device: as of a `Sampler`.

    dimensions: numbers in [0, 1] that a ray is drawn from; the first two fill the cells.
    """

    scene: Illuminated
    kind: str
    shape: tuple[int, int]
    seed: int = 0
    device: str | torch.device = "cpu"

    dimensions: ClassVar[int] = 2

    def __post_init__(self):
        if self.kind not in SAMPLERS:
            raise InputError(f"sampler must be one of {', '.join(SAMPLERS)}, got {self.kind!r}")

    @classmethod
    def of_size(cls, scene: Illuminated, kind: str, rays: int, seed: int = 0, device: str | torch.device = "cpu") -> Self:
        """About `rays` rays in cells as nearly square as whole numbers allow, at least one for each of its points."""
        aspect, each = scene.pupil.half_size[0] / scene.pupil.half_size[1], max(1, round(rays / _positions(scene)))
        nu = max(1, min(each, round(math.sqrt(each * aspect))))
        return cls(scene, kind, (nu, max(1, round(each / nu))), seed, device)

    @cached_property
    def count(self) -> int:
        """Number of rays."""
        return self.shape[0] * self.shape[1] * _positions(self.scene)

    def chunks(self, size: int = 1 << 20, first: int = 0, step: int = 1) -> Iterator[RayState]:
        """The rays in order, at most `size` at a time; their powers and what they lost sum to 1 over all chunks.

        With `step`, only every step-th chunk from number `first` on: the part of one of several processes.
        """
        for start in range(first * size, self.count, step * size):
            stop = min(start + size, self.count)
            yield self._drawn(start, *numbers(self.kind, self.shape, self.seed, self.dimensions, start, stop, self.device))

    def _drawn(self, start: int, *draws: Tensor) -> RayState:
        """Rays from number `start` on, one for each of the draws: `dimensions` tensors (N,)."""
        raise NotImplementedError

    def _at_pupil(self, x: Tensor, y: Tensor, direction: tuple[Tensor, Tensor, Tensor], power: Tensor, emitted: float) -> RayState:
        """Rays through points of the pupil, mm, with the power of each that arrives there; emitted: of all at their source."""
        return RayState((x, y, self.scene.pupil.z), direction, power, lost={"missed_lens": emitted - float(power.sum())})


def intensity_of(source: Source, cone: float, secant: Tensor) -> Tensor | float:
    """Power per solid angle, 1/sr, of a near source of power 1 that shines into a cone of this half-angle, rad; secant: 1 / cos of
    its light's angle to the axis."""
    given = source.intensity
    if isinstance(given, Distribution):
        return _by_table(given, torch.atan(torch.sqrt((secant * secant - 1.0).clamp_min(0.0)))) / given.flux(cone)
    if given == "lambertian":
        return 1.0 / (math.pi * math.sin(cone) ** 2 * secant)
    return 1.0 / (4.0 * math.pi * math.sin(cone / 2.0) ** 2)


def _by_table(given: Distribution, angle: Tensor) -> Tensor:
    """Relative intensity at angles, rad."""
    angles = torch.deg2rad(torch.tensor(given.angles, dtype=torch.float64, device=angle.device))
    values = torch.tensor(given.values, dtype=torch.float64, device=angle.device)
    k = (torch.searchsorted(angles, angle.contiguous(), right=True) - 1).clamp(0, len(angles) - 2)
    found = values[k] + (values[k + 1] - values[k]) * (angle - angles[k]) / (angles[k + 1] - angles[k])
    return torch.where(angle <= angles[-1], found, torch.zeros_like(found))


def _positions(scene: Illuminated) -> int:
    """Positions of the source; a distant one counts as one."""
    return max(1, len(scene.source.points()[0]))
