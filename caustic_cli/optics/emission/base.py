"""The base class of ray sampling on the pupil, the aperture that a source illuminates (thesis 4.2, 4.3.1).

Nothing here depends on the heights, so a design samples its rays once.
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
from caustic_cli.optics.pencil import Bundle
from caustic_cli.optics.rays import RayState
from caustic_cli.optics.sampling import SAMPLERS, TENSOR, Sample, numbers
from caustic_cli.scene import Pupil, Source
from caustic_cli.scene.sources.distribution import Distribution


class Illuminated(Protocol):
    """What a source illuminates: a scene or a system."""

    @property
    def source(self) -> Source:
        """The light source."""

    @property
    def pupil(self) -> Pupil:
        """The illuminated aperture."""


@dataclass(frozen=True, eq=False)
class Emission:
    """The rays of a source that is not collimated; subclasses implement the sampling.

    dimensions: of the unit cube that is sampled; the first two are stratified in the cells.
    """

    #: The illuminated scene or system, with a source of the matching type.
    scene: Illuminated
    #: Sampler, one of `sampling.SAMPLERS`.
    kind: str
    #: Cells (nu, nv) of each position, or of a distant source; all positions emit equally many rays.
    shape: tuple[int, int]
    #: As for `Sampler`.
    seed: int = 0
    device: str | torch.device = "cpu"

    dimensions: ClassVar[int] = 2

    def __post_init__(self):
        if self.kind not in SAMPLERS:
            raise InputError(f"sampler must be one of {', '.join(SAMPLERS)}, got {self.kind!r}")

    @classmethod
    def of_size(cls, scene: Illuminated, kind: str, rays: int, seed: int = 0, device: str | torch.device = "cpu") -> Self:
        """About `rays` rays in nearly square cells, at least one for each position."""
        aspect, each = scene.pupil.half_size[0] / scene.pupil.half_size[1], max(1, round(rays / _positions(scene)))
        nu = max(1, min(each, round(math.sqrt(each * aspect))))
        return cls(scene, kind, (nu, max(1, round(each / nu))), seed, device)

    @cached_property
    def count(self) -> int:
        """Number of rays."""
        return self.shape[0] * self.shape[1] * _positions(self.scene)

    def chunks(self, size: int = 1 << 20) -> Iterator[RayState]:
        """The rays in order, at most `size` per chunk; powers and losses sum to 1 over all chunks."""
        for start in range(0, self.count, size):
            stop = min(start + size, self.count)
            yield self._drawn(start, *numbers(self.kind, self.shape, self.seed, self.dimensions, start, stop, self.device))

    @property
    def tensor(self) -> bool:
        """Whether its samples have tensor-product structure."""
        return self.kind in TENSOR

    @property
    def homocentric(self) -> bool:
        """Whether its rays can be had as `pencils`."""
        return False

    def pencils(self, size: int = 1 << 20) -> Iterator[Bundle]:
        """The rays in `chunks` of whole rows, as pencils, or as beams where their vertex is at infinity."""
        raise NotImplementedError

    def _areas(self, sample: Sample) -> Tensor:
        """Area of the aperture, mm^2, for each point of a sample of its rectangle: a scalar, or of the sample's shape."""
        (rx, ry), aperture = self.scene.pupil.half_size, self.scene.pupil.aperture
        cell = 4.0 * rx * ry / (self.shape[0] * self.shape[1])
        if not aperture.round:
            return torch.tensor(cell, dtype=torch.float64)
        u, v = (sample.u[:, None], sample.v[None, :]) if sample.tensor else (sample.u, sample.v)
        return cell * aperture.covers(2.0 * u - 1.0, 2.0 * v - 1.0).double()

    def _drawn(self, start: int, *draws: Tensor) -> RayState:
        """Rays from number `start` on, from samples of the unit cube: `dimensions` tensors (N,)."""
        raise NotImplementedError

    def _at_pupil(self, x: Tensor, y: Tensor, direction: tuple[Tensor, Tensor, Tensor], power: Tensor, emitted: float) -> RayState:
        """Rays through points of the pupil, mm, with the power of each there; emitted: their total power at the source."""
        return RayState((x, y, self.scene.pupil.z), direction, power, lost={"missed_lens": emitted - float(power.sum())})


def intensity_of(source: Source, cone: float, secant: Tensor) -> Tensor | float:
    """Radiant intensity, 1/sr, of a near source of power 1 that emits into a cone of this half-angle, rad; secant: 1 / cos of the
    angle to the axis."""
    given, flux = source.intensity, relative_flux(source, cone)
    if isinstance(given, Distribution):
        return _by_table(given, torch.atan(torch.sqrt((secant * secant - 1.0).clamp_min(0.0)))) / flux
    return 1.0 / (flux * secant) if given == "lambertian" else 1.0 / flux


def relative_flux(source: Source, cone: float) -> float:
    """Flux of a near source into a cone of this half-angle, rad, where its relative intensity is as given: that of a table, cos
    theta of a Lambertian source, or 1."""
    given = source.intensity
    if isinstance(given, Distribution):
        return given.flux(cone)
    return math.pi * math.sin(cone) ** 2 if given == "lambertian" else 4.0 * math.pi * math.sin(cone / 2.0) ** 2


def _by_table(given: Distribution, angle: Tensor) -> Tensor:
    """Relative intensity at angles, rad."""
    angles = torch.deg2rad(torch.tensor(given.angles, dtype=torch.float64, device=angle.device))
    values = torch.tensor(given.values, dtype=torch.float64, device=angle.device)
    k = (torch.searchsorted(angles, angle.contiguous(), right=True) - 1).clamp(0, len(angles) - 2)
    found = values[k] + (values[k + 1] - values[k]) * (angle - angles[k]) / (angles[k + 1] - angles[k])
    return torch.where(angle <= angles[-1], found, torch.zeros_like(found))


def _positions(scene: Illuminated) -> int:
    """Number of positions of the source, 1 for a distant one."""
    return max(1, len(scene.source.points()[0]))
