"""Transparent media, which carry rays from surface to surface: refractive index by wavelength, and absorption.

A medium whose index varies with position is a subclass (`gradient.medium`): it curves the rays.
"""

from __future__ import annotations

from dataclasses import dataclass
from importlib import import_module
from typing import ClassVar

from torch import Tensor

from caustic_cli.optics.ray_transfer import meet
from caustic_cli.optics.rays import RayState
from caustic_cli.scene import Lens
from caustic_cli.scene.materials import nearest_index
from caustic_cli.schema import checks


@dataclass(frozen=True)
class Medium:
    """A homogeneous medium.

    varies: whether the index varies with position.
    """

    #: Refractive index; for a glass, that of rays without a wavelength.
    index: float = 1.0
    #: Absorption coefficient a, 1/mm; the transmittance of t mm is exp(-a t) (Beer-Lambert).
    absorption: float = 0.0
    #: A dispersive material, by its name in `materials`; None for `index` at every wavelength.
    glass: str | None = None

    varies: ClassVar[bool] = False

    def __post_init__(self):
        checks.number("index", self.index, 1.0, 5.0)
        checks.number("absorption", self.absorption, 0.0, 1e6)

    def index_at(self, wavelength: float | None) -> float:
        """Refractive index at a wavelength, nm."""
        return self.index if self.glass is None or wavelength is None else nearest_index(self.glass, wavelength)

    @property
    def effects(self) -> frozenset[str]:
        """Names of the effects on rays that it causes."""
        return frozenset({"absorption"} if self.absorption else ())

    def variation(self, half_size: tuple[float, float], depth: float) -> tuple[float, float, float]:
        """Bounds over a box of half widths `half_size` and of this depth, mm, behind its first surface: least and largest index,
        relative to `index`, and largest |grad n|, 1/mm."""
        return 1.0, 1.0, 0.0

    def check_first(self) -> None:
        """Check that it may lie in front of the first element of a system.

        Raises:
            InputError: it needs an element that defines its frame.
        """

    def entering(self, rays: RayState) -> RayState:
        """Rays in the form in which it takes them."""
        return rays

    def carry(self, tracer, m, heights: Tensor | None, parameters) -> None:
        """Transfer the rays of an `Interaction` through it to the surface, of these heights: along straight lines."""
        meet(tracer, m, heights)

    def relative_index(self, point: tuple) -> Tensor | float:
        """Refractive index at points (N,) in the frame of the element in front, over `index`."""
        return 1.0

    def onto_plane(self, point: tuple, direction: tuple, z: Tensor) -> tuple[tuple, tuple]:
        """Points and unit directions of rays (N,) within it where they reach z (N,), mm, in the frame of the element in front."""
        x, y, dz = *point[:2], z - point[2]
        return (x + dz / direction[2] * direction[0], y + dz / direction[2] * direction[1], point[2] + dz), direction

    def receive(self, tracer, m, parameters) -> None:
        """Set the refractive index behind the surface of an `Interaction` where it depends on the point of intersection."""


AIR = Medium()


def medium_of(lens: Lens) -> Medium:
    """The medium inside a lens."""
    if lens.gradient is None:
        return Medium(lens.index, lens.absorption, lens.glass)
    return import_module("caustic_cli.optics.gradient.medium").GradientMedium.of(lens)  # loaded where a lens has one
