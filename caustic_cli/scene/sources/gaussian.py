"""The beam of a laser: an elliptical Gaussian beam, or a Gaussian Schell-model beam, whose beam quality factor M^2 is above 1.

Notation, along one transverse axis (Siegman, Lasers, 1986, chapter 17)
    w_0, w(D)   radius at which the irradiance is 1/e^2 of that on the axis, at the waist and at the distance D from it, mm
    z_R         Rayleigh range pi w_0^2 / lambda, mm
    theta       half-angle of divergence, w_0 / z_R

The complex beam parameter q = D + i z_R gives 1 / q = 1 / R - i lambda / (pi w^2) with

    1 / R = D / (D^2 + z_R^2),    w^2 = w_0^2 (1 + D^2 / z_R^2).

For a beam with M^2 > 1 the same holds with z_R = pi w_0^2 / (M^2 lambda).  On any plane a Gaussian Schell-model beam is an
incoherent superposition of coherent beams of its own radius w and curvature 1 / R, turned about the point where its axis meets the
plane by angles with a normal distribution, whose 1/e^2 half-angle is sqrt(M^4 - 1) lambda / (pi w) (Starikov and Wolf, J. Opt. Soc.
Am. 72, 923, 1982).  That plane is the entrance here.

The beam's axis passes through the centre of the entrance, decentred by errors of alignment only.  Points are arrays of NumPy or of
torch.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from caustic_cli.errors import InputError
from caustic_cli.scene.aperture import Pupil
from caustic_cli.scene.sources.base import Source
from caustic_cli.scene.sources.plane import direction
from caustic_cli.scene.sources.section import SourceType, Table
from caustic_cli.schema.table import check, check_all, default

#: Half width of the represented part of the distribution of angles of an M^2 beam, in 1/e^2 half-angles: 4e-6 of it lie beyond; and
#: cells of its table along each axis.
WITHIN, CELLS = 2.5, 240
#: Points along each axis of the pupil for the power through it.
POINTS = 200
#: Largest half-angle of divergence, rad: beyond it the paraxial formulas err by more than a percent.
PARAXIAL = 0.15


class Field(NamedTuple):
    """A beam at points of a plane: unit directions of its rays, three arrays; optical path from the centre of the pupil, mm; and
    irradiance on the plane over that at the centre of the waist, across the axis."""

    directions: tuple
    path: Any
    irradiance: Any


@dataclass(frozen=True, eq=False)
class Gaussian(Source):
    """A laser beam; see the module.

    Args:
        waist: w_0 along x and y, mm.
        wavelength: in vacuum, nm.
        waist_at: of both waists, mm behind the entrance.
        m2: M^2, at least 1, along both axes.
        tilt: of its axis, see `PlaneWave`.
        power: through the aperture, W.
        aside: decentre of its axis on the entrance, mm.

    Raises:
        InputError: a value is out of range, or the beam is not paraxial.
    """

    waist: tuple[float, float]
    wavelength: float
    waist_at: float = 0.0
    m2: float = 1.0
    tilt: tuple[float, float] = (0.0, 0.0)
    power: float = 1.0
    aside: tuple[float, float] = (0.0, 0.0)
    axis: tuple[float, float, float] = field(init=False, default=(0.0, 0.0, 1.0))

    kind = "gaussian"
    distant = True
    uneven = True
    sized = True

    def __post_init__(self):
        check_all("source", self, "waist", "m2", "power")
        check("source.waist_at", self.waist_at)
        if (widest := max(self.divergence)) > PARAXIAL:
            raise InputError(
                f"⟨source.waist⟩ of {min(self.waist):g} mm makes a beam that diverges by {math.degrees(widest):.3g} degrees to each"
                f" side, where {math.degrees(PARAXIAL):.2g} at most are paraxial; a wider waist diverges less"
            )
        object.__setattr__(self, "axis", direction(self.tilt, self.half_angle))

    # As of a source

    @property
    def flat(self) -> bool:
        """Whether its waist lies at the entrance, so that its wavefront is plane there."""
        return self.waist_at == 0.0

    @property
    def collimated(self) -> bool:
        """As of a source."""
        return self.parallel and not self.oblique

    @property
    def parallel(self) -> bool:
        """As of a source."""
        return self.flat and self.m2 == 1.0

    @property
    def half_angle(self) -> float:
        """As of a source: the largest angle of an axis to that of the whole beam."""
        return math.asin(max(self.frame))

    @property
    def frame(self) -> tuple[float, float]:
        """As of a source."""
        wide = WITHIN * math.sqrt(self.m2**2 - 1.0) * 1e-6 * self.wavelength / math.pi
        x, y = self.radii(-self.waist_at)
        return wide / x, wide / y

    @cached_property
    def brightness(self) -> np.ndarray | None:  # type: ignore[override]
        """As of a source: the distribution of the angles, None for M^2 = 1."""
        if self.m2 == 1.0:
            return None
        edges = np.linspace(-WITHIN, WITHIN, CELLS + 1)
        one = np.diff([math.erf(math.sqrt(2.0) * e) for e in edges])
        at = 0.5 * (edges[1:] + edges[:-1])
        return np.outer(one, one) * (np.hypot(at[:, None], at[None, :]) <= WITHIN)

    @property
    def emission(self) -> str:
        """As of a source."""
        return "plane" if self.collimated else self.kind

    @property
    def label(self) -> str:
        """As of a source."""
        return "the laser beam"

    def extent_words(self, z_in: float) -> str:
        """As of a source."""
        return f"M² = {self.m2:g} spreads its direction by {math.degrees(self.half_angle):.3g} degrees to each side"

    def emitted(self, pupil: Pupil) -> tuple[float, str]:
        """As of a source: the part of the beam that the aperture does not truncate."""
        whole = 0.5 * math.pi * self.waist[0] * self.waist[1]
        return min(1.0, self.passed(pupil) * pupil.aperture.area / whole), "in the whole beam"

    def incidence(self, pupil: Pupil) -> float:
        """As of a source."""
        curved = (abs(self.waist_at) / (self.waist_at**2 + z * z) for z in self.rayleigh)
        steepest = max(c * (r + abs(s)) for c, r, s in zip(curved, pupil.half_size, self.aside, strict=True))
        return min(self.half_angle + self.lean + math.asin(min(1.0, math.sqrt(2.0) * steepest)), math.pi / 2.0)

    def displaced(
        self,
        place: Callable[[Sequence[float]], tuple[float, float, float]],
        scale: float,
        axis: tuple[float, float, float] | None = None,
    ) -> Source:
        """The beam decentred, with a wider or narrower waist."""
        x, y, _ = place((*self.aside, 0.0))
        return replace(self, waist=(scale * self.waist[0], scale * self.waist[1]), aside=(x, y))

    def pointlike(self) -> Source:
        """The beam of the same waist with M^2 = 1."""
        return replace(self, m2=1.0)

    # The beam

    @cached_property
    def rayleigh(self) -> tuple[float, float]:
        """z_R along both axes, mm."""
        x, y = (math.pi * w * w / (1e-6 * self.wavelength * self.m2) for w in self.waist)
        return x, y

    @property
    def divergence(self) -> tuple[float, float]:
        """theta along both axes, rad."""
        return self.waist[0] / self.rayleigh[0], self.waist[1] / self.rayleigh[1]

    def radii(self, distance: float) -> tuple[float, float]:
        """w(D) along both axes, mm."""
        x, y = (w * math.hypot(1.0, distance / z) for w, z in zip(self.waist, self.rayleigh, strict=True))
        return x, y

    def beam(self, x, y, pupil: Pupil, across=0.0, along=0.0) -> Field:
        """One of its coherent beams, whose axis has these sines, numbers or arrays, to that of the whole, at points of the pupil's
        plane, mm."""
        e1, e2, e3 = _axes(self.axis)
        cosine = (1.0 - across * across - along * along) ** 0.5
        axes = _axes(tuple(across * a + along * b + cosine * c for a, b, c in zip(e1, e2, e3, strict=True)))
        p = x - self.aside[0], y - self.aside[1]
        path = _along(axes[2], p)
        distance, sines = path - self.waist_at, []
        irradiance = self._density(axes, p, distance)
        for axis, z in zip(axes[:2], self.rayleigh, strict=True):
            r = _along(axis, p)
            sine = r * distance / (distance * distance + z * z)
            path = path + 0.5 * r * sine
            sines.append(sine)
        forward = (1.0 - sines[0] ** 2 - sines[1] ** 2) ** 0.5
        directions = tuple(sines[0] * a + sines[1] * b + forward * c for a, b, c in zip(*axes, strict=True))
        return Field(directions, path, irradiance)

    def irradiance(self, x, y, pupil: Pupil) -> Any:
        """As of a source: of the whole beam."""
        axes, p = _axes(self.axis), (x - self.aside[0], y - self.aside[1])
        return self._density(axes, p, _along(axes[2], p) - self.waist_at)

    def _density(self, axes: tuple, p: tuple, distance: Any) -> Any:
        """Irradiance of a beam along the last of the axes at points of the pupil's plane, this far behind the waist."""
        density = axes[2][2]
        for axis, w, z in zip(axes[:2], self.waist, self.rayleigh, strict=True):
            r, stretch = _along(axis, p), 1.0 + (distance / z) ** 2
            density = density * math.e ** (r * r * (-2.0 / (w * w * stretch))) / stretch**0.5
        return density

    def passed(self, pupil: Pupil) -> float:
        """As of a source."""
        (rx, ry), (at, weights) = pupil.half_size, np.polynomial.legendre.leggauss(POINTS)
        if pupil.aperture.round:  # by circles
            turn = 2.0 * math.pi * np.arange(POINTS) / POINTS
            r, weights = rx * 0.5 * (at[:, None] + 1.0), weights * 0.5 * (at + 1.0)
            return float(weights @ self.irradiance(r * np.cos(turn), r * np.sin(turn), pupil).mean(1))
        return float(weights @ self.irradiance(rx * at[:, None], ry * at[None, :], pupil) @ weights) / 4.0


def _along(axis: tuple, p: tuple) -> Any:
    """Component of points of a plane along an axis: of a tensor product of points it remains one of their coordinates where the
    axis is along that, so that an upright beam is a product of two exponentials of lines."""
    return sum(a * c for a, c in zip(axis[:2], p, strict=True) if np.ndim(a) or a)


def _axes(axis: tuple) -> tuple[tuple, tuple, tuple]:
    """Unit vectors across an axis, whose components are numbers or arrays, by the rotation that takes +z to it without twist; and
    the axis."""
    a, b, c = axis
    k = 1.0 / (1.0 + c)
    return (1.0 - k * a * a, -k * a * b, -a), (-k * a * b, 1.0 - k * b * b, -b), axis


def _build(table: Table, _profile) -> Gaussian:
    if not table.get("waist"):
        raise InputError(
            "⟨source.type⟩ gaussian needs ⟨+source.waist⟩, the radius in mm at which the irradiance is 1/e² of its peak"
        )
    lines = list(table.get("wavelengths") or ())
    if len(lines) != 1:
        raise InputError(f"⟨source.type⟩ gaussian needs one of ⟨+source.wavelengths⟩, by which it diverges, got {len(lines)}")
    return Gaussian(
        tuple(table["waist"]),
        lines[0],
        table.get("waist_at", default("source.waist_at")),
        table.get("m2", default("source.m2")),
        tuple(table.get("tilt") or default("source.tilt")),
        table["power"],
    )


TYPES = (SourceType("gaussian", "gaussian (the beam of a laser)", ("waist", "waist_at", "m2", "tilt"), _build),)
