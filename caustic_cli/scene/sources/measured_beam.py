"""A measured beam: its irradiance and its phase over the aperture of the entrance, as of a wavefront sensor.

Notation, at a point (x, y) of the entrance
    phi         phase of the field there, rad, increasing along the light; of a wave from a point at the distance R in front of the
                entrance pi (x^2 + y^2) / (lambda R)
    V           optical path, phi lambda / 2 pi, mm
    p           direction of the ray, a unit vector with the components dV/dx and dV/dy

V is a bicubic spline through the phase at the centres of its cells, and the irradiance is linear between those of its own.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from caustic_cli.errors import InputError
from caustic_cli.scene.aperture import Pupil
from caustic_cli.scene.sources.base import POINTS, Source
from caustic_cli.scene.sources.gaussian import Field
from caustic_cli.scene.sources.plane import picture_of
from caustic_cli.scene.sources.section import SourceType, Table, content
from caustic_cli.schema.table import check

#: Least number of values of the phase along an axis, for its spline; largest sine of a ray.
LEAST, STEEPEST = 4, 0.5
#: Degree of the polynomial in each coordinate; cells beside the aperture, over which the effect of its edge fades; pole of the
#: filter for cubic splines.
DEGREE, BESIDE, POLE = 3, 12, math.sqrt(3.0) - 2.0
FORM = "the phase in rad over the aperture, a 2-D .npy [i, j] of 4 values or more along each axis"


@dataclass(frozen=True, eq=False)
class MeasuredBeam(Source):
    """A coherent beam that fills the aperture; see the module.

    Args:
        phase: phi, (a, b) rad, not wrapped, over the aperture, [i, j] with i along +x and j along +y.
        wavelength: in vacuum, nm.
        profile: relative irradiance over the aperture, (c, d), None for an even one.
        power: through the aperture, W.
        aside: decentre, mm.
        over: half widths of what it was measured over, mm; None for those of the pupil.

    Raises:
        InputError: one is out of range, or the phase is wrapped.
    """

    phase: np.ndarray
    wavelength: float
    profile: np.ndarray | None = None
    power: float = 1.0
    aside: tuple[float, float] = (0.0, 0.0)
    over: tuple[float, float] | None = None

    kind = "measured"
    distant = True
    uneven = True
    emission = "gaussian"
    parallel = False
    label = "the measured beam"

    def __post_init__(self):
        check("source.power", self.power)
        phase = np.asarray(self.phase, dtype=np.float64)
        if phase.ndim != 2 or min(phase.shape) < LEAST or not np.isfinite(phase).all():
            raise InputError(f"⟨source.phase_file⟩ must be {FORM}, all of them finite, got {' x '.join(map(str, phase.shape))}")
        step = max(float(np.abs(np.diff(phase, axis=k)).max()) for k in (0, 1))
        if step > math.pi:
            raise InputError(
                f"⟨source.phase_file⟩ jumps by {step:.3g} rad between neighbours, and by pi at most it is resolved: it must not be"
                " wrapped, or needs more values"
            )
        object.__setattr__(self, "phase", phase)
        if self.profile is not None:
            object.__setattr__(self, "profile", picture_of(self.profile, "⟨source.file⟩"))

    def extent_words(self, z_in: float) -> str:
        """As of a source."""
        return "a measured beam is coherent"

    def displaced(self, place, scale: float, axis=None) -> Source:
        """The beam decentred."""
        x, y, _ = place((*self.aside, 0.0))
        return replace(self, aside=(x, y))

    def on(self, pupil: Pupil) -> Source:
        """As of a source."""
        return replace(self, over=self._half_size(pupil))

    def _half_size(self, pupil: Pupil) -> tuple[float, float]:
        return self.over or pupil.half_size

    def incidence(self, pupil: Pupil) -> float:
        """As of a source."""
        steepest = [np.abs(np.diff(self.phase, axis=k)).max() * n / (2.0 * h) for k, n, h in self._each(pupil)]
        sine = math.hypot(*(1e-6 * self.wavelength / (2.0 * math.pi) * s for s in steepest))
        if sine > STEEPEST:
            raise InputError(f"⟨source.phase_file⟩ turns the light by {math.degrees(math.asin(min(1.0, sine))):.3g} degrees")
        return min(math.asin(min(1.0, 2.0 * sine)), math.pi / 2.0)

    def _each(self, pupil: Pupil):
        return zip((0, 1), self.phase.shape, self._half_size(pupil), strict=True)

    @cached_property
    def _path(self) -> _Cubic:
        """V over [-1, 1]^2, mm."""
        return _Cubic.through(self.phase * (1e-6 * self.wavelength / (2.0 * math.pi)))

    def _places(self, x, y, pupil: Pupil) -> tuple[np.ndarray, np.ndarray]:
        """Points of the pupil's plane, mm, over [-1, 1]^2 of the beam, in arrays of one shape."""
        a, b = (np.asarray(c if isinstance(c, np.ndarray | float) else c.detach().cpu(), dtype=np.float64) for c in (x, y))
        a, b = ((c - s) / h for c, s, h in zip((a, b), self.aside, self._half_size(pupil), strict=True))
        u, v = np.broadcast_arrays(a, b)
        return u, v

    def beam(self, x, y, pupil: Pupil, across=0.0, along=0.0) -> Field:
        """As of `gaussian.Gaussian.beam`; it is one coherent beam along z."""
        path, *slopes = self._path.at(*self._places(x, y, pupil))
        p = [_like(x, slope / h) for slope, h in zip(slopes, self._half_size(pupil), strict=True)]
        return Field((*p, (1.0 - p[0] ** 2 - p[1] ** 2) ** 0.5), _like(x, path), self.irradiance(x, y, pupil))

    def irradiance(self, x, y, pupil: Pupil) -> Any:
        """As of a source."""
        u, v = self._places(x, y, pupil)
        return _like(x, np.ones_like(u) if self.profile is None else _linear(self.profile, u, v))

    def passed(self, pupil: Pupil) -> float:
        """As of a source."""
        line = (2.0 * np.arange(POINTS) + 1.0) / POINTS - 1.0
        u, v = np.meshgrid(line, line, indexing="ij")
        light = self.irradiance(u * pupil.half_size[0], v * pupil.half_size[1], pupil)
        return float(light[pupil.aperture.covers(u, v)].mean())


def _like(x, values: np.ndarray) -> Any:
    """Values as an array, or as a tensor where x is one."""
    return values if isinstance(x, np.ndarray | float) else x.new_tensor(values)


def _linear(values: np.ndarray, u: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Values (a, b) at the centres of the cells of [-1, 1]^2, linear between them and constant beyond, at points."""
    (s, t) = (np.clip(0.5 * (c + 1.0) * n - 0.5, 0.0, n - 1.0) for c, n in zip((u, v), values.shape, strict=True))
    (i, j), (k, m) = (s.astype(int), t.astype(int)), (np.ceil(s).astype(int), np.ceil(t).astype(int))
    a, b = s - i, t - j
    return (1.0 - b) * ((1.0 - a) * values[i, j] + a * values[k, j]) + b * ((1.0 - a) * values[i, m] + a * values[k, m])


@dataclass(frozen=True, eq=False)
class _Cubic:
    """A polynomial of u and v plus the bicubic spline through what it leaves of values at the centres of the cells of [-1, 1]^2.

    terms: coefficients of u^i v^j; spline: of the cubic B-splines on the cells, BESIDE more on each side.
    """

    terms: np.ndarray
    spline: np.ndarray

    @classmethod
    def through(cls, values: np.ndarray) -> _Cubic:
        """Through values (a, b)."""
        u, v = ((2.0 * np.arange(n) + 1.0) / n - 1.0 for n in values.shape)
        of = [np.polynomial.polynomial.polyvander(c, DEGREE) for c in (u, v)]
        left, right = (np.linalg.pinv(c) for c in of)
        terms = left @ values @ right.T
        rest = values - of[0] @ terms @ of[1].T
        return cls(terms, _filtered(_beside(_filtered(_beside(rest)).T)).T)

    def at(self, u: np.ndarray, v: np.ndarray) -> list[np.ndarray]:
        """Value, and derivatives by u and by v, at points; linear beyond the cells."""
        a, b = np.clip(u, -1.0, 1.0), np.clip(v, -1.0, 1.0)
        found = []
        for order in ((0, 0), (1, 0), (0, 1)):
            terms = self.terms
            for axis, k in enumerate(order):
                terms = np.polynomial.polynomial.polyder(terms, k, axis=axis) if k else terms
            found.append(np.polynomial.polynomial.polyval2d(a, b, terms) + self._spline(a, b, order))
        found[0] = found[0] + found[1] * (u - a) + found[2] * (v - b)
        return found

    def _spline(self, u: np.ndarray, v: np.ndarray, order: tuple[int, int]) -> np.ndarray:
        cells, weights = [], []
        for c, n, k in zip((u, v), self.spline.shape, order, strict=True):
            n = n - 2 * BESIDE
            t = 0.5 * (c + 1.0) * n - 0.5 + BESIDE
            i = np.floor(t).astype(int)
            cells.append(i)
            weights.append([w * (0.5 * n) ** k for w in _weights(t - i, k)])
        return sum(
            a * b * self.spline[cells[0] + p - 1, cells[1] + q - 1]
            for p, a in enumerate(weights[0])
            for q, b in enumerate(weights[1])
        )


def _weights(t: np.ndarray, order: int) -> tuple:
    """The four cubic B-splines that are not zero at a place t between two cells, or their derivatives."""
    if order:
        return -0.5 * (1.0 - t) ** 2, 0.5 * t * (3.0 * t - 4.0), 0.5 * (1.0 - t) * (1.0 + 3.0 * t), 0.5 * t * t
    return (1.0 - t) ** 3 / 6.0, (4.0 - 3.0 * t * t * (2.0 - t)) / 6.0, (4.0 - 3.0 * (1.0 - t) ** 2 * (1.0 + t)) / 6.0, t**3 / 6.0


def _beside(values: np.ndarray) -> np.ndarray:
    """Values with BESIDE more at both ends of the first axis, by cubic extrapolation."""
    for _ in range(2):
        rows = list(values)
        for _ in range(BESIDE):
            rows.append(4.0 * (rows[-1] + rows[-3]) - 6.0 * rows[-2] - rows[-4])
        values = np.array(rows[::-1])
    return values


def _filtered(values: np.ndarray) -> np.ndarray:
    """Coefficients of the cubic B-splines along the first axis through values (Unser, IEEE Signal Process. Mag. 16, 22, 1999)."""
    found = 6.0 * values
    found[0] = found[0] / (1.0 - POLE)
    for k in range(1, len(found)):
        found[k] += POLE * found[k - 1]
    found[-1] = -POLE / (1.0 - POLE) * found[-1]
    for k in range(len(found) - 2, -1, -1):
        found[k] = POLE * (found[k + 1] - found[k])
    return found


def _build(table: Table, _profile) -> MeasuredBeam:
    phase, light = (content(table, key, np.ndarray) for key in ("phase_file", "file"))
    if phase is None:
        raise InputError(f"⟨source.type⟩ measured needs ⟨+source.phase_file⟩, {FORM}")
    if light is None and table.get("file"):
        raise InputError("⟨source.file⟩ of a measured beam must be a picture of its irradiance, an image or a 2-D .npy")
    lines = list(table.get("wavelengths") or ())
    if len(lines) != 1:
        raise InputError(f"⟨source.type⟩ measured needs one of ⟨+source.wavelengths⟩, that of its phase, got {len(lines)}")
    return MeasuredBeam(phase, lines[0], light, table["power"])


TYPES = (SourceType("measured", "measured (a beam by its phase and its irradiance)", ("phase_file", "file"), _build),)
