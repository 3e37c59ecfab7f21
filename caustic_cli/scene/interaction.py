"""What the free-form surface, or another element, does with light: the exit of a lens refracts it, a mirror reflects it.

Notation
    n       refractive index in front of the surface: of the glass, or 1
    d, N    unit direction of the light in front of it, and unit normal, (..., 3)
    s       side of the surface, along z, to which light leaves: 1 behind a lens, -1 before a mirror
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import ClassVar, TypeVar

import numpy as np

from caustic_cli.errors import InputError

Met = TypeVar("Met")


@dataclass(frozen=True)
class Interior:
    """What light crosses in front of a free-form surface, as of `Lens`: glass, or air in front of a mirror."""

    index: float = 1.0
    absorption: float = 0.0
    fresnel: str = "none"
    glass: str | None = None


@dataclass(frozen=True)
class Refracting:
    """Light enters a body of glass at its entrance and is refracted out of it at the surface."""

    kind: ClassVar[str] = "lens"
    #: As of an element of a system.
    name: ClassVar[str] = "refract"
    #: s: the side to which light leaves, and from which a tool machines the surface; and where its screen lies, in words.
    side: ClassVar[int] = 1
    beyond: ClassVar[str] = "behind"
    #: Effects and errors that do not apply, by their names, with the reason.
    lacks: ClassVar[Mapping[str, str]] = {}
    #: What rays inside do with the body, and the side from which its picture is seen, in words.
    way: ClassVar[str] = "cross the lens"
    seen_from: ClassVar[str] = "from behind, as through a translucent one"
    #: Why there is no dispersion although there are several wavelengths.
    achromatic: ClassVar[str] = "the lens' index is the same at all wavelengths"

    def interior(self, glass: Interior) -> Interior:
        """What light crosses in front of the surface of a body of glass."""
        return glass

    def extent(self, lowest: float, top: float) -> tuple[float, float]:
        """Range of z of the body at its centre, mm, for that of the entrance and the surface."""
        return lowest, max(lowest, top)

    def base(self, z_in: float) -> float:
        """z that the surface must not fall below, mm: of the flat face where light enters."""
        return z_in

    def first(self, entrance: Met, surface: Callable[[], Met]) -> Met:
        """Something of the side that light meets first: of the entrance, or of the surface."""
        return entrance

    def entered(self, z_in: float, z: np.ndarray) -> np.ndarray:
        """z at which light enters the body on its way to points of the surface at z, mm."""
        return np.full(z.shape, z_in)

    def effective_index(self, n: float) -> float:
        """n of the paraxial deflection (n - 1) times the slope."""
        return n

    def largest_deflection(self, n: float) -> float:
        """Upper bound of the angle between light in front of the surface and behind it, rad."""
        return math.acos(1.0 / n)

    def leaving_bounds(self, inside: float, lean: float, n: float) -> tuple[float, float]:
        """Bounds of n sin i and of the angle of leaving light to z, rad, for light at `inside` to z and normals at `lean`, rad."""
        i = inside + lean
        critical = n * math.sin(min(i, math.pi / 2.0))
        return critical, inside + math.asin(critical) - i if critical < 1.0 else math.pi / 2.0

    def reaches(self, n: float, cosine: np.ndarray) -> np.ndarray:
        """Whether a surface can deflect light by angles of these cosines, (...)."""
        return cosine * n > 1.0

    def leaving(self, d: np.ndarray, normal: np.ndarray, n: float) -> tuple[np.ndarray, np.ndarray]:
        """Unit directions behind the surface, and where there are any, (...): beyond total reflection there are none."""
        along = (d * normal).sum(-1, keepdims=True)
        square = 1.0 - n * n * (1.0 - along * along)
        side = np.where(along < 0, -1.0, 1.0)
        return n * (d - along * normal) + side * np.sqrt(np.maximum(square, 0.0)) * normal, square[..., 0] > 0

    def sent(self, d: tuple[float, float, float]) -> tuple[float, float, float]:
        """Direction behind a surface without slopes of light that arrives along d."""
        return d[0], d[1], self.side * d[2]

    def check_screen(self, z: float, z_in: float) -> None:
        """Check that a screen at z is on the side to which light leaves.

        Raises:
            InputError: it is not.
        """
        if z <= z_in:
            raise InputError(f"⟨screen.z⟩ must lie behind the lens (beyond z_in = {z_in:g} mm), got {z:g} mm")

    def check_room(self, z: float, lowest: float, highest: float) -> None:
        """Check that a screen at z is beyond every height of the surface, from lowest to highest.

        Raises:
            InputError: it is not.
        """
        if z <= highest:
            raise InputError(f"⟨screen.z⟩ must lie behind the lens, which is up to {highest:.4g} mm thick, got {z:g} mm")


@dataclass(frozen=True)
class Reflecting(Refracting):
    """Light is reflected in air, with a reflectance of 1, to the side from which it comes."""

    kind: ClassVar[str] = "mirror"
    name: ClassVar[str] = "reflect"
    side: ClassVar[int] = -1
    beyond: ClassVar[str] = "before"
    lacks: ClassVar[Mapping[str, str]] = {
        "fresnel": "mirrors have a reflectance of 1",
        "total-reflection": "a mirror has no critical angle",
        "polarisation": "a mirror reflects all light alike",
        "ghosts": "there is no glass",
        "index": "a mirror has no index",
    }
    way: ClassVar[str] = "meet the mirror"
    seen_from: ClassVar[str] = "from the mirror’s side"
    achromatic: ClassVar[str] = "a mirror treats all wavelengths alike"

    def interior(self, glass: Interior) -> Interior:
        """Air."""
        return Interior()

    def extent(self, lowest: float, top: float) -> tuple[float, float]:
        """That of the surface."""
        return top, top

    def base(self, z_in: float) -> float:
        """None."""
        return -math.inf

    def first(self, entrance: Met, surface: Callable[[], Met]) -> Met:
        """Of the surface."""
        return surface()

    def entered(self, z_in: float, z: np.ndarray) -> np.ndarray:
        """At the surface itself."""
        return z

    def effective_index(self, n: float) -> float:
        """Snell's law with index -1."""
        return -1.0

    def largest_deflection(self, n: float) -> float:
        """Light is turned by any angle."""
        return math.pi

    def leaving_bounds(self, inside: float, lean: float, n: float) -> tuple[float, float]:
        """By the law of reflection."""
        return 0.0, inside + 2.0 * lean

    def reaches(self, n: float, cosine: np.ndarray) -> np.ndarray:
        """By any angle."""
        return np.ones(cosine.shape, dtype=bool)

    def leaving(self, d: np.ndarray, normal: np.ndarray, n: float) -> tuple[np.ndarray, np.ndarray]:
        """By the law of reflection."""
        along = (d * normal).sum(-1, keepdims=True)
        return d - 2.0 * along * normal, np.ones(along.shape[:-1], dtype=bool)

    def check_screen(self, z: float, z_in: float) -> None:
        """The surface itself decides, see `optics.trace.check_clearance`."""

    def check_room(self, z: float, lowest: float, highest: float) -> None:
        """As for a lens, on the other side."""
        if z >= lowest:
            raise InputError(f"⟨screen.z⟩ must lie before the mirror, which begins at {lowest:.4g} mm, got {z:g} mm")


def interaction_of(mirror: bool) -> Refracting | Reflecting:
    """What the free-form surface of a lens, or of a mirror, does with light."""
    return Reflecting() if mirror else Refracting()
