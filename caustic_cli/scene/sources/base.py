"""What every part of the program asks of a light source, whatever its type.  All shine along +z.

A source is one of three:
    collimated   all rays run along +z, so they are sampled on the surface itself
    distant      light from infinity: it stands nowhere, and its rays lean from +z by at most half_angle (0 if collimated)
    near         it stands at points before the lens, each with an extent about it, and shines into a cone about +z

A type of its own says `kind` and `power`; a near one also `points`, and `extent` if it has one; a distant one `half_angle`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

import numpy as np

from caustic_cli.scene.sources.distribution import Distribution
from caustic_cli.scene.sources.rayset import RaySet

#: A cone that just covers the aperture is wider by this part, so that rounding leaves no corner dark.
SLACK = 1e-9


class Source:
    """A light source: plain data, validated on construction.  Lengths in mm, powers in W, angles in rad unless said otherwise.

    kind: its type, as [source] type names it; power: emitted into the cone, or through the aperture by a distant source;
    profile: relative irradiance over the aperture, (a, b), or None if even; cone: half-angle of the cone as the user said it,
    degrees, or None for the narrowest that covers the lens; intensity: uniform in solid angle, lambertian, or a table; aimed: rays
    are sampled on the lens instead of all over the cone; collimated: see above; rays: those of a file, None of a source that has as
    many as are asked for; brightness: relative radiance over `frame`, (a, b) [i, j], or None if even over an ellipse; spectra: of
    several sources, wavelengths, nm, and relative powers of each.
    """

    kind: str
    profile: np.ndarray | None = None
    cone: float | None = None
    intensity: str | Distribution = "uniform"
    aimed: bool = True
    rays: RaySet | None = None
    brightness: np.ndarray | None = None
    spectra: tuple[tuple[tuple[float, ...], tuple[float, ...]], ...] = ()

    if TYPE_CHECKING:  # values of some types and properties of others: all that can be said of any is that they are read

        @property
        def power(self) -> float: ...

        @property
        def collimated(self) -> bool: ...
    else:
        collimated = False

    @property
    def members(self) -> tuple[Source, ...]:
        """The sources that it is made of: itself, unless it is several."""
        return (self,)

    @property
    def fractions(self) -> tuple[float, ...]:
        """Part of all power of each of its members."""
        return (1.0,)

    @property
    def even(self) -> bool:
        """Whether it is one source, evenly bright over the ellipse of its extent about each of its positions."""
        return len(self.members) == 1 and self.brightness is None and self.rays is None

    def part(self, k: int, of: int) -> Source:
        """The k-th of so many sources that shine alike and share no ray: itself, unless its rays are counted."""
        return self

    @property
    def distant(self) -> bool:
        """Light from infinity."""
        return self.collimated

    @property
    def half_angle(self) -> float:
        """The most that rays of a distant source lean from z."""
        return 0.0

    def points(self) -> tuple[np.ndarray, np.ndarray]:
        """Positions (k, 3) of a near source, and the parts (k,) of its power that leave there; none of a distant one."""
        if self.distant:
            return np.zeros((0, 3)), np.zeros(0)
        raise NotImplementedError(f"a near source of type {self.kind} has to say where its points are")

    @property
    def powers(self) -> tuple[float, ...]:
        """W, of every position; of the whole for a distant source."""
        return (self.power,) if self.distant else tuple(self.power * float(part) for part in self.points()[1])

    @property
    def extent(self) -> tuple[float, float]:
        """Half widths about each position along x and y; 0 for points and for what is distant."""
        return 0.0, 0.0

    @property
    def frame(self) -> tuple[float, float]:
        """Half widths of the rectangle that `brightness` is laid over: mm, or sines of the angle to z of a distant source."""
        return (math.sin(self.half_angle),) * 2 if self.distant else self.extent

    @property
    def nearest(self) -> float:
        """z of what is nearest to the lens; minus infinity for a distant source."""
        return -math.inf if self.distant else float(self.points()[0][:, 2].max())

    @property
    def centre(self) -> tuple[float, float, float]:
        """Mean position, weighted by power; minus infinity along z for a distant source."""
        if self.distant:
            return 0.0, 0.0, -math.inf
        x, y, z = np.average(self.points()[0], axis=0, weights=self.powers)
        return float(x), float(y), float(z)

    @property
    def several(self) -> bool:
        """Whether light leaves from several positions."""
        return len(self.points()[0]) > 1

    @property
    def extended(self) -> bool:
        """Whether some place of the lens sees light from more than one direction."""
        return self.several or max(self.extent) > 0 or self.half_angle > 0

    @property
    def apart(self) -> bool:
        """Whether it is several sources in places of their own, which the light of their centre does not stand for."""
        return False

    @property
    def sharp(self) -> bool:
        """Whether each place of the lens sees one direction by the source's very type, so that no scale of a picture is blurred."""
        return not self.extended

    @property
    def emission(self) -> str:
        """Name under which `optics.emission` knows how its rays are drawn."""
        return self.kind

    @property
    def label(self) -> str:
        """What to call it in a sentence."""
        return f"the {self.kind}"

    @property
    def sized(self) -> bool:
        """Whether it has a width of its own."""
        return False

    def misplaced(self, place: Callable[[Sequence[float]], tuple[float, float, float]], scale: float) -> Source:
        """The source with its positions where `place` (x, y, z) mm has them, `scale` times as wide; from infinity, only that."""
        return self

    def pointlike(self) -> Source:
        """The source without its extent: of all its light, that of its centre."""
        if self.extended:
            raise NotImplementedError(f"an extended source of type {self.kind} has to say what it is without its extent")
        return self

    def apparent_angle(self, z_in: float) -> float:
        """Full angle under which a lens with its entrance at z_in sees the source, degrees."""
        if self.distant:
            return math.degrees(2.0 * self.half_angle)
        return 2.0 * math.degrees(math.atan2(self._width() / 2.0, z_in - self.nearest))

    def extent_words(self, z_in: float) -> str:
        """The same in a clause."""
        return f"the lens sees the source under {self.apparent_angle(z_in):.3g} degrees"

    def blur(self, z_in: float, throw: float) -> float:
        """Width in mm, on a screen `throw` mm beyond the entrance, over which an extended source blurs every point.

        To first order the throw times the angle under which the lens sees the source: a lens can show nothing finer.
        """
        return throw * 2.0 * self.half_angle if self.distant else throw * self._width() / (z_in - self.nearest)

    def cone_over(self, half_size: tuple[float, float], z_in: float, round: bool = False) -> float:
        """Half-angle of a near source: what it says, or the least that covers the aperture, `round` or not, from all of it."""
        if self.distant:
            return self.half_angle
        if self.cone is not None:
            return math.radians(self.cone)
        positions, extent = self.points()[0], self.extent
        across = [np.abs(positions[:, k]) + extent[k] + (0.0 if round else half_size[k]) for k in (0, 1)]
        farthest = np.hypot(*across) + (half_size[0] if round else 0.0)
        return min((1.0 + SLACK) * float(np.arctan2(farthest, z_in - positions[:, 2]).max()), math.pi / 2.0)

    def incidence(self, half_size: tuple[float, float], z_in: float, round: bool = False) -> float:
        """A bound of how far its rays to the aperture lean from z, rad."""
        if self.distant:
            return self.half_angle
        positions, extent = self.points()[0], self.extent
        far = np.hypot(*(np.abs(positions[:, k]) + extent[k] + half_size[k] for k in (0, 1)))
        steepest = float(np.arctan2(far, z_in - positions[:, 2]).max())
        return min(self.cone_over(half_size, z_in, round), steepest)

    def _width(self) -> float:
        """Full width of a near source along the axis where it is wider."""
        return float((np.ptp(self.points()[0][:, :2], axis=0) + 2.0 * np.array(self.extent)).max())
