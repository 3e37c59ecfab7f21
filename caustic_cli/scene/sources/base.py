"""The interface of light sources.  All emit towards +z.

A source is one of three kinds:
    collimated   all rays are parallel to +z, so they can be sampled on the surface itself
    distant      at infinity: it has no position, and its rays make an angle of at most half_angle with its axis (0 if they are
    parallel)
    near         at a finite distance in front of the lens: one or several positions, each with an extent, emitting into a cone
    about +z, or about another axis

A subclass defines `kind` and `power`; a near source also `points`, and `extent` if it has one; a distant one `half_angle`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from caustic_cli.scene.aperture import Pupil
from caustic_cli.scene.sources.distribution import Distribution

if TYPE_CHECKING:
    from caustic_cli.scene.sources.rayset import RaySet
    from caustic_cli.scene.spectrum import Measure

#: Relative margin of a cone that just covers the aperture, so that rounding leaves no corner dark.
SLACK = 1e-9
#: Points along each axis for the mean of a profile over a round aperture.
POINTS = 1000


def looked_up(profile: np.ndarray, u, v) -> Any:
    """Values of a picture (a, b), constant on each cell, at points of [-1, 1]^2, arrays of NumPy or of torch that can be
    broadcast."""
    numpy = isinstance(u, np.ndarray)
    table = profile if numpy else u.new_tensor(profile)
    i, j = (0.5 * (c + 1.0) * n for c, n in zip((u, v), profile.shape, strict=True))
    i, j = (c.astype(int) if numpy else c.long() for c in (i, j))
    return table[i.clip(0, profile.shape[0] - 1), j.clip(0, profile.shape[1] - 1)]


class Source:
    """A light source: plain data, validated on construction.  Lengths in mm, powers in W, angles in rad unless stated otherwise.

    kind: name of its type in [source] type; power: emitted into the cone, or through the aperture for a distant source; profile:
    relative irradiance over the aperture, (a, b), or None if uniform; tilt: of the axis of light from infinity, degrees, see
    `PlaneWave`; cone: half-angle of the emission cone as given, degrees, or None for the narrowest that covers the lens; intensity:
    uniform in solid angle, lambertian, or tabulated; aimed: rays are sampled over the lens instead of over the whole cone; axis: a
    unit vector, the direction of light from infinity, or the axis of the cone of a near source and of its intensity, +z except
    where errors of alignment tilt it; collimated: see the module; rays: ray set of a file, None for a source that is sampled;
    brightness: relative radiance over `frame`, (a, b) [i, j], or None if uniform over an ellipse; spectra: of several sources,
    wavelengths, nm, and relative powers of each; measures: and the continuous spectrum that these are samples of, or None; beam:
    its field on the pupil where that is no plane wave's, as of `gaussian.Gaussian.beam`.
    """

    kind: str
    profile: np.ndarray | None = None
    tilt: tuple[float, float] = (0.0, 0.0)
    cone: float | None = None
    intensity: str | Distribution = "uniform"
    aimed: bool = True
    axis: tuple[float, float, float] = (0.0, 0.0, 1.0)
    rays: RaySet | None = None
    brightness: np.ndarray | None = None
    spectra: tuple[tuple[tuple[float, ...], tuple[float, ...]], ...] = ()
    measures: tuple[Measure | None, ...] = ()
    beam: Callable[..., Any] | None = None

    if TYPE_CHECKING:  # values of some types and properties of others: all that can be said of any is that they are read

        @property
        def power(self) -> float: ...

        @property
        def collimated(self) -> bool: ...
    else:
        collimated = False

    @property
    def uneven(self) -> bool:
        """Whether a distant source lights the aperture unevenly, see `irradiance`."""
        return self.profile is not None

    def irradiance(self, x, y, pupil: Pupil) -> Any:
        """Relative irradiance of an uneven distant source at points of the pupil's plane, mm, arrays of NumPy or of torch that can
        be broadcast."""
        assert self.profile is not None
        return looked_up(self.profile, x / pupil.half_size[0], y / pupil.half_size[1])

    def passed(self, pupil: Pupil) -> float:
        """Power of an uneven distant source through the pupil over the pupil's area, in the unit of `irradiance`."""
        assert self.profile is not None
        if not pupil.aperture.round:
            return float(self.profile.mean())
        line = (2.0 * np.arange(POINTS) + 1.0) / POINTS - 1.0
        u, v = np.meshgrid(line, line, indexing="ij")
        return float(looked_up(self.profile, u, v)[pupil.aperture.covers(u, v)].mean())

    @property
    def members(self) -> tuple[Source, ...]:
        """The individual sources: itself, or the members of a `Several`."""
        return (self,)

    @property
    def fractions(self) -> tuple[float, ...]:
        """Fraction of the total power of each member."""
        return (1.0,)

    @property
    def even(self) -> bool:
        """Whether it is a single source of uniform radiance over the ellipse of its extent."""
        return len(self.members) == 1 and self.brightness is None and self.rays is None

    def batch(self, k: int, of: int) -> Source:
        """The k-th of `of` equivalent sources without common rays: itself, unless its rays are those of a file."""
        return self

    @property
    def distant(self) -> bool:
        """Whether it is at infinity."""
        return self.collimated

    @property
    def parallel(self) -> bool:
        """Whether all its rays are parallel."""
        return self.collimated or (len(self.members) == 1 and self.distant and self.half_angle == 0)

    @property
    def oblique(self) -> bool:
        """Whether it is at infinity, and not in the direction of z."""
        return self.distant and any(self.tilt)

    @property
    def in_turn(self) -> bool:
        """Whether it is several sources that shine one after another, each for a lenslet of its own."""
        return False

    @property
    def by_lenslet(self) -> bool:
        """Whether it is several sources, each for a lenslet of its own, in their order."""
        return self.in_turn

    @property
    def behind_each(self) -> bool:
        """Whether they stand behind their lenslets and shine at once."""
        return self.by_lenslet and not self.in_turn

    @property
    def half_angle(self) -> float:
        """Largest angle of a distant source's rays to its axis."""
        return 0.0

    def points(self) -> tuple[np.ndarray, np.ndarray]:
        """Positions (k, 3) of a near source and the fractions (k,) of its power emitted there; empty for a distant one."""
        if self.distant:
            return np.zeros((0, 3)), np.zeros(0)
        raise NotImplementedError(f"the near source type {self.kind} must define its points")

    @property
    def powers(self) -> tuple[float, ...]:
        """Power of each position, W; of a distant source its whole power."""
        return (self.power,) if self.distant else tuple(self.power * float(fraction) for fraction in self.points()[1])

    @property
    def extent(self) -> tuple[float, float]:
        """Half widths about each position along x and y; 0 for point sources and distant sources."""
        return 0.0, 0.0

    @property
    def frame(self) -> tuple[float, float]:
        """Half widths of the rectangle over which `brightness` is defined: mm, or direction sines for a distant source."""
        return (math.sin(self.half_angle),) * 2 if self.distant else self.extent

    @property
    def nearest(self) -> float:
        """z of the position nearest to the lens; minus infinity for a distant source."""
        return -math.inf if self.distant else float(self.points()[0][:, 2].max())

    @property
    def centre(self) -> tuple[float, float, float]:
        """Power-weighted mean position; z is minus infinity for a distant source."""
        if self.distant:
            return 0.0, 0.0, -math.inf
        x, y, z = np.average(self.points()[0], axis=0, weights=self.powers)
        return float(x), float(y), float(z)

    @property
    def several(self) -> bool:
        """Whether it has several positions."""
        return len(self.points()[0]) > 1

    @property
    def extended(self) -> bool:
        """Whether it is extended: some point of the lens receives light from more than one direction."""
        return self.several or max(self.extent) > 0 or self.half_angle > 0

    @property
    def apart(self) -> bool:
        """Whether it consists of separate sources that a single source at their centre cannot represent."""
        return False

    @property
    def sharp(self) -> bool:
        """Whether its type is that of a point source or plane wave, so that no detail of a picture is blurred."""
        return not self.extended

    @property
    def emission(self) -> str:
        """Name under which `optics.emission` registers the sampling of its rays."""
        return self.kind

    @property
    def label(self) -> str:
        """Noun phrase for messages."""
        return f"the {self.kind}"

    @property
    def sized(self) -> bool:
        """Whether it has a size."""
        return False

    def on(self, pupil: Pupil) -> Source:
        """The source whose light does not depend on the pupil that it is given, as if that were always this one."""
        return self

    def each(self, change: Callable[[Source], Source]) -> Source:
        """The source with each of its members changed."""
        return change(self)

    def displaced(
        self,
        place: Callable[[Sequence[float]], tuple[float, float, float]],
        scale: float,
        axis: tuple[float, float, float] | None = None,
    ) -> Source:
        """The source with its positions mapped by `place`, (x, y, z) mm, its size scaled, and another axis, if given, of a near
        source's emission; a distant source is only scaled."""
        return self

    def pointlike(self) -> Source:
        """The point source or plane wave of the same power at its centre."""
        if self.extended:
            raise NotImplementedError(f"the extended source type {self.kind} must define its point-like equivalent")
        return self

    def apparent_angle(self, z_in: float) -> float:
        """Full angle subtended by the source at a lens with its entrance at z_in, degrees."""
        if self.distant:
            return math.degrees(2.0 * self.half_angle)
        return 2.0 * math.degrees(math.atan2(self._width() / 2.0, z_in - self.nearest))

    def extent_words(self, z_in: float) -> str:
        """The apparent angle as a clause for messages."""
        return f"the lens sees the source under {self.apparent_angle(z_in):.3g} degrees"

    def blur(self, z_in: float, throw: float) -> float:
        """Width in mm, on a screen `throw` mm beyond the entrance, of the image of each point: the blur of an extended source.

        To first order it is the throw times the angle that the source subtends at the lens, which bounds the resolution.
        """
        if self.distant:
            return throw / math.cos(self.lean) * 2.0 * self.half_angle
        return throw * self._width() / (z_in - self.nearest)

    def cone_over(self, pupil: Pupil) -> float:
        """Half-angle of the emission cone about the axis: as given, or the least that covers the pupil from every
        point."""
        if self.distant:
            return self.half_angle
        if self.cone is not None:
            return math.radians(self.cone)
        return min(self._covering(pupil) + self.lean, math.pi / 2.0)

    def _covering(self, pupil: Pupil) -> float:
        """Largest angle to z, rad, between a point of the source and one of the aperture."""
        x, y, z = self.points()[0].T
        far = pupil.aperture.farthest(self._farthest, x, y)
        return min((1.0 + SLACK) * float(np.arctan2(far, pupil.z - z).max()), math.pi / 2.0)

    def _farthest(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """Largest distance from the origin, mm, of the points of a source about (x, y), (k,): of the rectangle of its extent."""
        wide, high = self.extent
        return np.hypot(np.abs(x) + wide, np.abs(y) + high)

    def power_words(self, pupil: Pupil) -> str:
        """What its power, of which all fractions are taken, is: a noun phrase for messages."""
        if self.distant:
            return "the power through the aperture"
        return f"the power within the cone of {math.degrees(self.cone_over(pupil)):.3g} degrees"

    def emitted(self, pupil: Pupil) -> tuple[float, str]:
        """Fraction that its power is of all the light it emits, and what that is, in words: through the aperture for a distant
        source; else its distribution in all directions, except that a uniform one ends at the edge of a cone that is given."""
        if self.distant:
            return 1.0, "through the aperture"
        cone = self.cone_over(pupil)
        if isinstance(self.intensity, Distribution):
            return self.intensity.flux(cone) / self.intensity.flux(math.pi), "in all directions of its table"
        if self.intensity == "lambertian":
            return math.sin(cone) ** 2, "in all directions, Lambertian"
        if self.cone is not None:
            return 1.0, "in its cone"
        return math.sin(0.5 * cone) ** 2, "in all directions, uniform"

    def incidence(self, pupil: Pupil) -> float:
        """Upper bound of the angle to z of its rays into the aperture, rad."""
        if self.distant:
            return min(self.half_angle + self.lean, math.pi / 2.0)
        return min(self.cone_over(pupil) + self.lean, self._covering(pupil))

    @property
    def lean(self) -> float:
        """Angle of the axis to +z, rad."""
        return math.atan2(math.hypot(self.axis[0], self.axis[1]), self.axis[2])

    def _width(self) -> float:
        """Full width of a near source along the wider axis, mm."""
        return float((np.ptp(self.points()[0][:, :2], axis=0) + 2.0 * np.array(self.extent)).max())
