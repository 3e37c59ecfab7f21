"""What diffraction lets a lens show: the width over which it blurs, how many details that leaves, and which light is meant.

The phase of a lens of local magnification M, thrown over L, blurs a point over about sqrt(lambda L M): the geometric mean of the
Fresnel scale and what M makes of it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from caustic_cli.optics.surfaces import HeightField
from caustic_cli.optics.surfaces.base import FIRST, SECOND
from caustic_cli.scene import Lens, Scene

#: nm: the wavelength at which light without one is judged, and the band of white light.
GREEN, BAND = 550.0, (450.0, 650.0)
#: Wavelengths that stand for white light in an image.
WHITE_LINES = 6
#: Diffraction matters where it widens what source and pixel blur anyway by more than this part.
WIDENED = 0.05
#: Points along each axis of the lens at which its local magnification is looked at.
POINTS = 128


def white(count: int) -> tuple[float, ...]:
    """Wavelengths, nm, for white light: the middles of so many equal parts of its band."""
    low, high = BAND
    return tuple(low + (k + 0.5) * (high - low) / count for k in range(count))


def diffraction_blur(wavelength: float, throw: float, magnification: float) -> float:
    """sqrt(lambda L M), mm, of a wavelength in nm."""
    return math.sqrt(wavelength * 1e-6 * abs(throw) * abs(magnification))


@dataclass(frozen=True)
class Resolution:
    """Widths, mm on the screen, over which diffraction and the source blur, of a pixel, and of the picture; that of the lens; and
    the wavelength that was judged by, nm, with whether the scene says it."""

    diffraction: float
    source: float
    pixel: float
    picture: float
    lens: float
    wavelength: float = GREEN
    said: bool = False

    @classmethod
    def of(cls, scene: Scene, picture: float, magnification: float) -> Resolution:
        """What holds in a scene whose picture is so many mm wide, by a lens of that (local) magnification."""
        lens, screen = scene.lens, scene.screen
        said = scene.light.wavelengths
        wavelength = sum(w * p for w, p in zip(said, scene.light.parts, strict=True)) if said else GREEN
        distance = abs(screen.z - lens.offset.thickness)
        return cls(
            diffraction_blur(wavelength, distance, magnification),
            scene.source.blur(_seen_from(lens), distance),
            max(screen.pixel),
            picture,
            lens.size[0],
            wavelength,
            bool(said),
        )

    @classmethod
    def before(cls, scene: Scene, picture: tuple[float, float]) -> Resolution:
        """What will hold of a lens for a picture of this width and height, mm, with the magnification that it, or each lenslet of
        an array, is to have."""
        (w, h), (lw, lh) = picture, (width / k for width, k in zip(scene.lens.size, scene.lens.array, strict=True))
        return cls.of(scene, w, math.sqrt(w * h / (lw * lh)))

    @classmethod
    def at(cls, scene: Scene, field: HeightField, heights: Tensor) -> Resolution:
        """The same of a lens with these heights (n, m) mm, by its own local magnification; the picture is the screen.  Of two
        free-form sides, or beside other elements, by that which it is to have."""
        if scene.two_sided or scene.elements:
            return cls.before(scene, scene.screen.size)
        return cls.of(scene, scene.screen.size[0], local_magnification(scene, field, heights))

    @property
    def blur(self) -> float:
        """Of diffraction and source."""
        return math.hypot(self.diffraction, self.source)

    @property
    def widened(self) -> float:
        """By what part diffraction widens what source and pixel blur anyway."""
        without = math.hypot(self.source, self.pixel)
        return math.hypot(self.diffraction, without) / without - 1.0

    @property
    def matters(self) -> bool:
        """Whether rays alone would show too much."""
        return self.widened > WIDENED

    @property
    def wanted(self) -> int:
        """Details across the picture that the pixels can show."""
        return max(1, round(self.picture / self.pixel))

    @property
    def resolvable(self) -> int:
        """Details across the picture that light carries, at most a pixel each."""
        return max(1, min(self.wanted, round(self.picture / self.blur))) if self.blur > 0 else self.wanted

    def lens_for_all(self) -> float | None:
        """Width of a lens, mm, at the same throw and magnification that would carry a detail for every pixel; None where this one
        does.  The picture grows with the lens, the blurs do not."""
        return None if self.resolvable >= self.wanted else self.lens * self.blur * self.wanted / self.picture

    def sentence(self) -> str:
        """What light carries here."""
        n = self.resolvable
        text = (
            f"light carries about {n} x {n} details here (diffraction {self.diffraction:.2g} mm, source {self.source:.2g} mm"
            f"{f' or {self.source / self.pixel:.2g} pixels' if self.source else ''}, pixel {self.pixel:.2g} mm)"
        )
        larger = self.lens_for_all()
        return text + (f"; a lens of {larger:{'.0f' if larger >= 100 else '.2g'}} mm would carry {self.wanted}" if larger else "")


@dataclass(frozen=True)
class Paraxial:
    """A lens to first order at even points of it: x, y (N,), mm; the surface's slopes gx, gy there and its second derivatives xx,
    xy, yy, 1/mm; throw, mm; straight, what light that is not turned at all is magnified by.

    Light that a slope g turns by c g lands at X = x straight + throw c g.
    """

    x: Tensor
    y: Tensor
    gx: Tensor
    gy: Tensor
    xx: Tensor
    xy: Tensor
    yy: Tensor
    throw: float
    straight: float


def _seen_from(lens: Lens) -> float:
    """z, mm, from which a source is as far away as a point of the exit sees it: through glass, which is index times thinner."""
    return lens.z_in + (lens.offset.thickness - lens.z_in) / lens.inside


def paraxial(scene: Scene, field: HeightField, heights: Tensor) -> Paraxial:
    """The lens of a scene with these heights (n, m) mm at POINTS^2 points, in light of its source's centre."""
    lens = scene.lens
    distance = abs(scene.screen.z - lens.offset.thickness)
    vergence = 0.0 if scene.source.distant else 1.0 / (_seen_from(lens) - scene.source.centre[2])
    line = (torch.arange(POINTS, dtype=torch.float64, device=heights.device) + 0.5) * (2.0 / POINTS) - 1.0
    x, y = (c.reshape(-1) * r for c, r in zip(torch.meshgrid(line, line, indexing="ij"), field.half_size, strict=True))
    gx, gy, xx, xy, yy = field.at(heights.detach(), x, y, (*FIRST[1:], *SECOND))
    return Paraxial(x, y, gx, gy, xx, xy, yy, distance, 1.0 + distance * vergence)


def local_magnification(scene: Scene, field: HeightField, heights: Tensor) -> float:
    """Root of the mean area over which a lens throws light, over its own: paraxial, from the surface's second derivatives.

    Light from s lands at X = s (1 + L / a) + L g grad h, a the distance of the source and g = n - 1, or 2 for a mirror.
    """
    light = paraxial(scene, field, heights)
    gain = light.throw * (2.0 if scene.lens.mirror else scene.lens.index - 1.0)
    xx, xy, yy = gain * light.xx, gain * light.xy, gain * light.yy
    return float(((light.straight + xx) * (light.straight + yy) - xy * xy).abs().mean().sqrt())
