"""Resolution limit of a lens: the blur by diffraction and source extent, and the number of resolvable details.

At local magnification M and distance L, diffraction blurs a point to a width of about sqrt(lambda L M), the geometric mean of the
Fresnel scale sqrt(lambda L) and M times that scale.  Through elements behind the lens the displacement on the screen by the tangent
of a ray takes the place of L (B of their ABCD matrix, as in the diffraction integral of Collins, J. Opt. Soc. Am. 60, 1970).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from caustic_cli.loading import OnDemand
from caustic_cli.optics.surfaces import HeightField
from caustic_cli.optics.surfaces.base import FIRST, SECOND
from caustic_cli.scene import Lens, Scene

traced = OnDemand("caustic_cli.optics.traced_map")

#: Wavelength, nm, that represents light of unspecified wavelength.
GREEN = 550.0
#: Relative increase of the blur of source and pixel from which on diffraction matters.
WIDENED = 0.05
#: Points along each axis of the lens at which the local magnification is evaluated.
POINTS = 128


def diffraction_blur(wavelength: float, throw: float, magnification: float) -> float:
    """Blur by diffraction, sqrt(lambda L M), mm; wavelength in nm, throw L in mm."""
    return math.sqrt(wavelength * 1e-6 * abs(throw) * abs(magnification))


@dataclass(frozen=True)
class Resolution:
    """Widths on the screen, mm: blur by diffraction and by the source, pixel, picture; width of the lens, mm; and the wavelength
    assumed, nm, with whether the scene specifies it."""

    diffraction: float
    source: float
    pixel: float
    picture: float
    lens: float
    wavelength: float = GREEN
    said: bool = False
    #: Of widths on the screen.
    unit: str = "mm"

    @classmethod
    def of(cls, scene: Scene, picture: float, magnification: float) -> Resolution:
        """Of a scene with a picture of this width, mm, and a lens of this (local) magnification."""
        lens, screen = scene.lens, scene.screen
        wavelength = scene.light.mean
        distance = (traced.distance(scene) if scene.unfolded.behind else None) or abs(screen.z - lens.offset.thickness)
        return cls(
            diffraction_blur(wavelength, distance, magnification),
            scene.source.blur(_seen_from(lens), distance),
            max(screen.pixel),
            picture,
            lens.size[0],
            wavelength,
            bool(scene.light.wavelengths),
            screen.unit,
        )

    @classmethod
    def before(cls, scene: Scene, picture: tuple[float, float]) -> Resolution:
        """Of a lens to be designed, for a picture of this width and height, mm, from the nominal magnification of the lens or of
        each lenslet."""
        (w, h), (lw, lh) = picture, (width / k for width, k in zip(scene.lens.size, scene.lens.array, strict=True))
        return cls.of(scene, w, math.sqrt(w * h / (lw * lh)))

    @classmethod
    def at(cls, scene: Scene, field: HeightField, heights: Tensor) -> Resolution:
        """Of a lens with heights (n, m) mm, from its local magnification, with the screen for the picture; from the nominal
        magnification where other surfaces have no heights yet."""
        magnification = local_magnification(scene, field, heights)
        if magnification is None:
            return cls.before(scene, scene.screen.size)
        return cls.of(scene, scene.screen.size[0], magnification)

    @property
    def blur(self) -> float:
        """Combined blur of diffraction and source, mm."""
        return math.hypot(self.diffraction, self.source)

    @property
    def widened(self) -> float:
        """Relative increase of the blur of source and pixel by diffraction."""
        without = math.hypot(self.source, self.pixel)
        return math.hypot(self.diffraction, without) / without - 1.0

    @property
    def matters(self) -> bool:
        """Whether diffraction is significant."""
        return self.widened > WIDENED

    @property
    def wanted(self) -> int:
        """Number of details across the picture that the pixels can represent."""
        return max(1, round(self.picture / self.pixel))

    @property
    def resolvable(self) -> int:
        """Number of details across the picture that are resolved, at most one per pixel."""
        return max(1, min(self.wanted, round(self.picture / self.blur))) if self.blur > 0 else self.wanted

    def lens_for_all(self) -> float | None:
        """Width of a lens, mm, that would resolve every pixel at the same throw and magnification; None if this one does.  The
        picture scales with the lens, the blurs do not."""
        return None if self.resolvable >= self.wanted else self.lens * self.blur * self.wanted / self.picture

    def sentence(self) -> str:
        """The resolution limit as a sentence."""
        n = self.resolvable
        text = (
            f"about {n} x {n} details are resolved (diffraction {self.diffraction:.2g} {self.unit}, source"
            f" {self.source:.2g} {self.unit}{f' or {self.source / self.pixel:.2g} pixels' if self.source else ''}, pixel"
            f" {self.pixel:.2g} {self.unit})"
        )
        larger = self.lens_for_all()
        return text + (f"; a lens of {larger:{'.0f' if larger >= 100 else '.2g'}} mm would resolve {self.wanted}" if larger else "")


@dataclass(frozen=True)
class Paraxial:
    """A lens to first order at points of a uniform grid: x, y (N,), mm; slopes gx, gy of the surface and second derivatives xx, xy,
    yy, 1/mm; throw, mm; straight, the magnification of undeflected light by its divergence.

    Light that is deflected by c times the slope g lands at X = x straight + throw c g.
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
    """z, mm, from which the apparent distance of a source at the exit is measured: glass appears thinner by the factor n."""
    return lens.z_in + (lens.offset.thickness - lens.z_in) / lens.inside


def follows_from_exit(scene: Scene) -> bool:
    """Whether the slopes of the exit alone determine to first order where light lands: near the axis, behind a flat entrance, in
    glass of one index, without other elements."""
    return not (scene.two_sided or scene.unfolded.elements or scene.source.oblique or scene.lens.gradient is not None)


def paraxial(scene: Scene, field: HeightField, heights: Tensor) -> Paraxial:
    """Paraxial data of a scene's lens with heights (n, m) mm at POINTS^2 points, for light from the source's centre, where it
    `follows_from_exit`."""
    lens = scene.lens
    distance = abs(scene.screen.z - lens.offset.thickness)
    vergence = 0.0 if scene.source.distant else 1.0 / (_seen_from(lens) - scene.source.centre[2])
    line = (torch.arange(POINTS, dtype=torch.float64, device=heights.device) + 0.5) * (2.0 / POINTS) - 1.0
    x, y = (c.reshape(-1) * r for c, r in zip(torch.meshgrid(line, line, indexing="ij"), field.half_size, strict=True))
    gx, gy, xx, xy, yy = field.at(heights.detach(), x, y, (*FIRST[1:], *SECOND))
    return Paraxial(x, y, gx, gy, xx, xy, yy, distance, float(not scene.screen.far) + distance * vergence)


def local_magnification(scene: Scene, field: HeightField, heights: Tensor) -> float | None:
    """Square root of the mean areal magnification |det dX/ds|: paraxial, from the surface's second derivatives, or by neighbouring
    rays where it does not follow from these; None where other surfaces have no heights yet.

    Light from s lands at X = s (1 + L / a) + L g grad h, a the distance of the source and g = n - 1, or 2 for a mirror.
    """
    if not follows_from_exit(scene):
        return traced.local_magnification(scene, field, heights) if traced.is_known(scene, field) else None
    light = paraxial(scene, field, heights)
    gain = light.throw * abs(scene.lens.effective_index - 1.0)
    xx, xy, yy = gain * light.xx, gain * light.xy, gain * light.yy
    return float(((light.straight + xx) * (light.straight + yy) - xy * xy).abs().mean().sqrt())
