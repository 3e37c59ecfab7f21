"""Several simultaneous sources, each with its own power and wavelengths."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from caustic_cli.errors import InputError
from caustic_cli.loading import OnDemand
from caustic_cli.scene.aperture import Pupil
from caustic_cli.scene.light import RAY_NODES, Light
from caustic_cli.scene.sources.base import Source
from caustic_cli.scene.sources.section import Table, content

if TYPE_CHECKING:
    from caustic_cli.scene.spectrum import Measure

spectra = OnDemand("caustic_cli.scene.spectrum")

#: Largest number of sources of a scene.
MOST = 64


@dataclass(frozen=True, eq=False)
class Several(Source):
    """Mutually incoherent sources; each is traced separately, see `Scene.bands`.

    Raises:
        InputError: there are too few or too many, or only some of them have wavelengths.
    """

    #: Two or more sources, none of them a `Several`.
    members: tuple[Source, ...] = ()
    #: Wavelengths, nm, and relative powers of each; empty if not given.
    spectra: tuple[tuple[tuple[float, ...], tuple[float, ...]], ...] = ()
    #: The continuous spectrum that these are samples of, of each, or None; empty if no source has one.
    measures: tuple[Measure | None, ...] = ()
    #: Luminous efficacy of each, lm/W, where the eye sees them and their powers are in W; empty elsewhere.
    efficacies: tuple[float, ...] = ()
    #: Whether each stands behind a lenslet of its own, in their order, and all shine at once.
    behind: bool = False

    kind = "several"

    def __post_init__(self):
        if not 2 <= len(self.members) <= MOST:
            raise InputError(f"[[source]] must be 1 to {MOST} sources, got {len(self.members)}")
        if len({bool(wavelengths) for wavelengths, _ in self.spectra}) > 1:
            raise InputError("⟨source.also.wavelengths⟩ must be given for every source, or for none")

    @property
    def power(self) -> float:
        """Total power, W."""
        return math.fsum(member.power for member in self.members)

    @property
    def fractions(self) -> tuple[float, ...]:
        """Fraction of the total power of each, of luminous power where the eye sees it."""
        amounts = [m.power * e for m, e in zip(self.members, self.efficacies or (1.0,) * len(self.members), strict=True)]
        return tuple(amount / math.fsum(amounts) for amount in amounts)

    @property
    def collimated(self) -> bool:
        """Whether all of them are, with uniform profiles."""
        return all(member.collimated and member.profile is None for member in self.members)

    @property
    def distant(self) -> bool:
        """Whether all of them are."""
        return all(member.distant for member in self.members)

    @property
    def axis(self) -> tuple[float, float, float]:  # type: ignore[override]  # a property instead of an attribute
        """Mean direction of the light of sources at infinity, weighted by power."""
        if not self.distant:
            return super().axis
        mean = np.average([member.axis for member in self.members], axis=0, weights=[member.power for member in self.members])
        x, y, z = (mean / np.linalg.norm(mean)).tolist()
        return x, y, z

    @property
    def tilt(self) -> tuple[float, float]:  # type: ignore[override]
        """That of the mean direction."""
        x, y, z = self.axis
        return (math.degrees(-math.asin(y)), math.degrees(math.atan2(x, z))) if self.oblique else (0.0, 0.0)

    @property
    def oblique(self) -> bool:
        """Whether the light of one is."""
        return any(member.oblique for member in self.members)

    @property
    def in_turn(self) -> bool:
        """Whether they shine one after another, as the sun at several times: at infinity, not all in the direction of z."""
        return self.distant and self.oblique

    @property
    def by_lenslet(self) -> bool:
        """Whether they shine in turn, or stand behind lenslets."""
        return self.in_turn or self.behind

    @property
    def half_angle(self) -> float:
        """The largest."""
        return max(member.half_angle for member in self.members)

    def each(self, change: Callable[[Source], Source]) -> Source:
        """As of a source, of each."""
        return replace(self, members=tuple(change(member) for member in self.members))

    def batch(self, k: int, of: int) -> Source:
        """As of a source, of each."""
        return replace(self, members=tuple(member.batch(k, of) for member in self.members))

    @property
    def _near(self) -> list[Source]:
        return [member for member in self.members if not member.distant]

    def points(self) -> tuple[np.ndarray, np.ndarray]:
        """Positions of all near members, weighted by power."""
        if self.distant:
            return super().points()
        places, fractions = zip(*(member.points() for member in self._near), strict=True)
        fractions = np.concatenate([member.power * p for member, p in zip(self._near, fractions, strict=True)])
        return np.concatenate(places), fractions / fractions.sum()

    @property
    def extent(self) -> tuple[float, float]:
        """The largest along each axis."""
        x, y = (max((member.extent[k] for member in self._near), default=0.0) for k in (0, 1))
        return x, y

    @property
    def nearest(self) -> float:
        """Of all."""
        return max(member.nearest for member in self.members)

    @property
    def extended(self) -> bool:
        """Whether some point of the lens receives light from more than one direction."""
        return self.apart or any(member.extended for member in self.members)

    @property
    def apart(self) -> bool:
        """Whether their centres differ, or a member is `apart` itself."""
        return len({member.centre for member in self.members}) > 1 or any(member.apart for member in self.members)

    @property
    def sharp(self) -> bool:
        """Whether all are, at a common position."""
        return not self.apart and all(member.sharp for member in self.members)

    @property
    def label(self) -> str:
        """As of a source."""
        return f"{len(self.members)} sources"

    def extent_words(self, z_in: float) -> str:
        """As of a source."""
        return f"{len(self.members)} sources shine {'in turn' if self.in_turn else 'at once'}"

    def pointlike(self) -> Source:
        """Each without its extent."""
        return replace(self, members=tuple(member.pointlike() for member in self.members))

    def apparent_angle(self, z_in: float) -> float:
        """The largest."""
        return max(member.apparent_angle(z_in) for member in self.members)

    def blur(self, z_in: float, throw: float) -> float:
        """The largest; sources at different positions form a picture each."""
        return max(member.blur(z_in, throw) for member in self.members)

    def cone_over(self, pupil: Pupil) -> float:
        """The widest; a hemisphere where some are distant and others not."""
        if self._near and len(self._near) < len(self.members):
            return math.pi / 2.0
        return max(member.cone_over(pupil) for member in self.members)

    def power_words(self, pupil: Pupil) -> str:
        """The sum of all."""
        return "the power of all sources"

    def emitted(self, pupil: Pupil) -> tuple[float, str]:
        """Of all together."""
        emitted = math.fsum(member.power / member.emitted(pupil)[0] for member in self.members)
        return self.power / emitted, "by all sources, each in all its directions"

    def incidence(self, pupil: Pupil) -> float:
        """The greatest."""
        return max(member.incidence(pupil) for member in self.members)


def together(members: Sequence[Source], lights: Sequence[Light]) -> Several:
    """Sources at once, each with its own light."""
    samples = tuple((light.wavelengths, light.weights) for light in lights)
    return Several(tuple(members), samples, tuple(light.measure for light in lights), efficacies(lights))


def behind_lenslets(one: Source, light: Light, centres: Sequence[tuple[float, float]], pupil: Pupil) -> Source:
    """One such source behind each lenslet of an array, displaced to its centre, (x, y) mm.

    Their cone is that which is given, or the narrowest that covers the pupil of the array from all of them, so that equal powers
    are equal intensities.

    Raises:
        InputError: the source is not a single one nearby, or there are too many lenslets.
    """
    if one.distant or one.rays is not None or one.apart:
        where = ", which is at infinity" if one.distant else ""
        raise InputError(f"⟨source.each⟩ is for one point, grid or disc nearby, got {one.label}{where}")
    if len(centres) > MOST:
        raise InputError(f"⟨source.each⟩ is for arrays of up to {MOST} lenslets, got {len(centres)}")
    if len(centres) == 1:
        return one
    placed = [one.displaced(partial(_moved, by), 1.0) for by in centres]
    cone = math.degrees(max(source.cone_over(pupil) for source in placed))
    members = [replace(cast(Any, source), cone=cone) for source in placed]
    return replace(together(members, [light] * len(members)), behind=True)


def _moved(by: tuple[float, float], at: Sequence[float]) -> tuple[float, float, float]:
    """A position, mm, moved along x and y."""
    return at[0] + by[0], at[1] + by[1], at[2]


def efficacies(lights: Sequence[Light]) -> tuple[float, ...]:
    """Luminous efficacies, lm/W, of lights that the eye sees and whose power is in W; empty where one is not, or its is unknown."""
    found = [light.efficacy or 0.0 for light in lights if light.unit == "W" and light.white is not None]
    return tuple(found) if len(found) == len(lights) and all(found) else ()


def lights_of(section: Table, color: bool = False) -> list[Light]:
    """The `Light` of each source of a [source] section: its own wavelengths, with the first's polarisation and unit of power."""
    state, unit = section.get("polarisation"), section.get("power_unit", "W")
    tables = (section, *section.get("also", ()))
    return [replace(light_of(table, unit, color), polarisation=state) for table in tables]


def light_of(table: Table, unit: str, color: bool = False) -> Light:
    """The spectrum of a [source] table as its detector weights it: spectral lines, of which those of a coloured picture keep their
    power, or samples of a continuous spectrum.

    Raises:
        InputError: two settings contradict each other, or the detector measures no power.
    """
    wavelengths, weights = (tuple(table.get(key, ())) for key in ("wavelengths", "weights"))
    name, detector = table.get("spectrum"), table.get("detector")
    if name is None and wavelengths:
        given = Light(None, wavelengths, weights, color=color, unit=unit)
        return _lines_seen(given, detector or ("power" if unit == "W" else "eye"))
    if name is None and detector is None:
        return Light(None, wavelengths, weights, unit=unit)
    if weights:
        raise InputError("⟨source.weights⟩ follow from ⟨source.spectrum⟩: give one of them")
    measure = spectra.measure_of(content(table, "spectrum", spectra.Spectrum) or name or "equal", detector or "eye")
    if name is None:
        return Light(unit=unit, measure=measure)
    at, parts = Light(measure=measure).lines(wavelengths) if wavelengths else measure.rule(RAY_NODES)
    return Light(None, at, parts, unit=unit, measure=measure, efficacy=spectra.luminous_efficacy(measure.spectrum))


def _lines_seen(light: Light, detector: str) -> Light:
    """Light of spectral lines as a detector weights it."""
    by_eye = detector == "eye" and not light.color
    seen, efficacy = spectra.luminous(light.wavelengths, light.weights)
    if by_eye and not efficacy > 0:
        raise InputError("⟨source.wavelengths⟩: the eye sees none of them; ⟨+source.detector⟩ power measures their power")
    return replace(light, weights=seen if by_eye else light.weights, efficacy=efficacy)


def light_of_all(section: Table, color: bool = False) -> Light:
    """The combined `Light` of all sources: all their wavelengths, weighted by power."""
    lights = lights_of(section, color)
    if len(lights) == 1:
        return lights[0]
    powers = [table["power"] for table in (section, *section["also"])]
    amounts = [p * e for p, e in zip(powers, efficacies(lights) or (1.0,) * len(powers), strict=True)]
    wavelengths = tuple(w for light in lights for w in light.wavelengths)
    weights = tuple(amount * fraction for amount, light in zip(amounts, lights, strict=True) for fraction in light.fractions)
    each = [light.efficacy for light in lights if light.efficacy]
    whole = _together(powers, each, lights[0].unit) if len(each) == len(lights) else None
    return replace(lights[0], wavelengths=wavelengths, weights=weights, efficacy=whole)


def _together(powers: list[float], efficacies: list[float], unit: str) -> float:
    """Luminous efficacy, lm/W, of sources of given powers, in W or lm, and efficacies."""
    if unit == "W":
        return math.fsum(p * e for p, e in zip(powers, efficacies, strict=True)) / math.fsum(powers)
    return math.fsum(powers) / math.fsum(p / e for p, e in zip(powers, efficacies, strict=True))
