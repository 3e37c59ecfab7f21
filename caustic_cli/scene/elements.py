"""Spherical lenses and fold mirrors on the axis of the free-form lens.

Notation
    z       position of the first vertex along the axis, mm; behind a mirror it is measured along the folded axis
    R       radius of curvature, mm: positive if the centre lies behind the surface in the direction of the light; inf for a plane
    sag     R - sign(R) sqrt(R^2 - r^2), height of a sphere above its vertex at distance r from the axis

A mirror with R > 0 is convex and diverges the light; one with R < 0 is concave and converges it.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, ClassVar

from caustic_cli.errors import InputError, at_least
from caustic_cli.scene.aperture import Aperture, Pupil, aperture_of, larger
from caustic_cli.scene.freeform import FreeForm, SecondTarget
from caustic_cli.scene.interaction import Reflecting, Refracting
from caustic_cli.scene.materials import nearest_index
from caustic_cli.scene.screen import Screen, Vector, Window, tilted
from caustic_cli.scene.traits import Capability
from caustic_cli.schema.table import check, default

#: Largest semi-aperture of a sphere, as a fraction of its radius: beyond it light arrives near grazing incidence.
STEEPEST = 0.95
#: Least tilt of a fold mirror, degrees: one perpendicular to the axis sends the light back into the lens.
LEAST_TILT = 5.0
#: Thickness of the plate that carries a mirror in exported solids, mm.
PLATE = 3.0
SIDES = ("front", "back")


@dataclass(frozen=True)
class Component:
    """A singlet lens; see the module.

    Args:
        z: of its first vertex, mm.
        size: full width and height of its aperture, mm.
        thickness: centre thickness, mm.
        radius: radii of curvature (front, back), mm.
        index: refractive index.
        absorption: absorption coefficient of its glass, 1/mm.
        glass: a dispersive material, by its name in `materials`; None for `index` at every wavelength.
        aperture: rectangle, or circle, the largest that fits into size.
        tilt: rotations of a mirror about x or about y, degrees.
        free: which of its surfaces a design optimises: none, front, back or both.
        surfaces: the optimised (front, back), heights above the vertex planes; None for a sphere.

    Raises:
        InputError: a value is out of range, the surfaces cross within the aperture, or a mirror does not fold the axis.
    """

    z: float
    size: tuple[float, float]
    thickness: float = default("element.thickness")
    radius: tuple[float, float] = (math.inf, math.inf)
    index: float = default("element.index")
    absorption: float = default("element.absorption")
    glass: str | None = None
    aperture: str = default("element.aperture")
    tilt: tuple[float, float] = (0.0, 0.0)
    free: str = default("element.free")
    surfaces: tuple[FreeForm | None, FreeForm | None] = (None, None)

    #: What its surfaces do with light; their names, and those of the refracting ones.
    interaction: ClassVar[Refracting | Reflecting] = Refracting()
    sides: ClassVar[tuple[str, ...]] = SIDES
    refracting: ClassVar[tuple[str, ...]] = SIDES

    def __post_init__(self):
        for key in ("z", "size", "aperture", "free", "tilt"):
            check(f"element.{key}", getattr(self, key))
        for r in self.radius:
            if isinstance(r, bool) or not isinstance(r, int | float) or math.isnan(r) or r == 0:
                raise InputError(f"⟨element.radius⟩ must be non-zero numbers of mm or inf, got {list(self.radius)}")
        _ = self.opening
        for side, r in zip(self.sides, self.radius, strict=False):
            if self.reach > STEEPEST * abs(r):
                raise InputError(
                    f"⟨element.radius⟩ of the {side} of the {self.kind} at z = {self.z:g} mm must be at least"
                    f" {self.reach / STEEPEST:.4g} mm either way for its aperture to lie on the sphere, got {r:g} mm"
                )
        self._check()

    def _check(self) -> None:
        for key in ("thickness", "index", "absorption"):
            check(f"element.{key}", getattr(self, key))
        if any(self.tilt):
            raise InputError("⟨element.tilt⟩ is for mirrors: lenses are perpendicular to the axis")
        rim = self.thickness + self.sag("back") - self.sag("front")
        if rim <= 0:
            raise InputError(
                f"⟨element.thickness⟩ of the lens at z = {self.z:g} mm must be more than"
                f" {at_least(self.thickness - rim, 4)} mm for glass at the rim of its aperture, got {self.thickness:g} mm"
            )

    def check_place(self, lens: tuple[float, float]) -> None:
        """Check that it may stand where it does beside a lens with this z of the entrance and of the centre of the exit, mm."""

    @property
    def kind(self) -> str:
        """lens or mirror."""
        return self.interaction.kind

    @property
    def free_sides(self) -> tuple[str, ...]:
        """Names of the surfaces that a design optimises."""
        return tuple(side for side in self.sides if self.free in (side, "both"))

    @property
    def half_size(self) -> tuple[float, float]:
        """Half widths of the aperture, mm."""
        return self.opening.half_size

    @cached_property
    def opening(self) -> Aperture:
        """Clear aperture of each of its surfaces."""
        return aperture_of(self.aperture, self.size, "element.size")

    @property
    def pupil(self) -> Pupil:
        """Its aperture at the first vertex."""
        return Pupil(self.opening, self.z)

    @property
    def reach(self) -> float:
        """Semi-aperture: largest distance of the aperture from the axis, mm."""
        return self.opening.reach

    def sag(self, side: str) -> float:
        """Sag of a side at the edge of the aperture, mm."""
        k = 1.0 / self.radius[SIDES.index(side)]
        return k * self.reach**2 / (1.0 + math.sqrt(1.0 - (k * self.reach) ** 2))

    def vertex(self, side: str) -> float:
        """z of a side's vertex, mm."""
        return self.z if side == "front" else self.z + self.thickness

    @property
    def extent(self) -> tuple[float, float]:
        """Range of z that it occupies, mm."""
        low, high = (
            self.sag(side) if f is None else float(f.heights.min() if side == "front" else f.heights.max())
            for side, f in zip(SIDES, self.surfaces, strict=True)
        )
        return self.z + min(0.0, low), self.z + self.thickness + max(0.0, high)

    @property
    def thinnest(self) -> float:
        """Least thickness of its glass without designed surfaces, mm; infinite without glass."""
        return self.thickness + min(0.0, self.sag("back") - self.sag("front"))

    def sent(self, d: Vector) -> Vector:
        """Direction along the axes behind it, undeviated by refraction, of light along those in front of it."""
        return d

    def axis_behind(self, leg: Any) -> Any:
        """The segment of the axis (`optics.frames.AxisSegment`) behind it, from that in front of it."""
        return leg

    def scaled(self, factor: float) -> Component:
        """The component larger by a factor, at as many times the distance."""
        own, other = (None if surface is None else surface.scaled(factor) for surface in self.surfaces)
        return replace(
            self,
            z=factor * self.z,
            size=larger(self.size, factor),
            thickness=factor * self.thickness,
            radius=larger(self.radius, factor),
            absorption=self.absorption / factor,
            surfaces=(own, other),
        )

    @property
    def power(self) -> float:
        """Refractive power of its spheres as a thin lens in air, 1/mm."""
        return (self.index - 1.0) * (1.0 / self.radius[0] - 1.0 / self.radius[1])

    def at(self, wavelength: float) -> Component:
        """The component with its index evaluated at a wavelength, nm."""
        return self if self.glass is None else replace(self, index=nearest_index(self.glass, wavelength))


@dataclass(frozen=True)
class FoldMirror(Component):
    """A tilted mirror, which folds the axis and uses the first radius only."""

    interaction: ClassVar[Refracting | Reflecting] = Reflecting()
    sides: ClassVar[tuple[str, ...]] = SIDES[:1]
    refracting: ClassVar[tuple[str, ...]] = ()

    @property
    def power(self) -> float:
        """As of a lens, for light along its axis."""
        return -2.0 / self.radius[0]

    def _check(self) -> None:
        if self.free in ("back", "both"):
            raise InputError(f"⟨element.free⟩ of a mirror must be none or front, its only surface, got {self.free}")
        turned = [abs(t) for t in self.tilt if t]
        if len(turned) != 1 or turned[0] < LEAST_TILT:
            raise InputError(
                "⟨element.tilt⟩ of a mirror must turn it about x or about y, one of them, by at least"
                f" {LEAST_TILT:g} degrees, such as [45, 0], got {list(self.tilt)}"
            )

    def check_place(self, lens: tuple[float, float]) -> None:
        """As of a component.

        Raises:
            InputError: it is in front of the lens.
        """
        if self.z < lens[0]:
            raise InputError(
                f"⟨element.z⟩ of a mirror must lie behind the lens (beyond {lens[1]:g} mm), got {self.z:g} mm: the lens stands on"
                " its source's axis, so that a mirror in front of it is equivalent to a rotated source"
            )

    @property
    def extent(self) -> tuple[float, float]:
        """That of its vertex."""
        return self.z, self.z

    @property
    def thinnest(self) -> float:
        """It has no glass."""
        return math.inf

    def axis_behind(self, leg: Any) -> Any:
        """Folded."""
        return leg.folded(self.z, self.tilt)

    def sent(self, d: Vector) -> Vector:
        """As of a component: the axis in the plane of the fold is reversed."""
        about_x, about_y = map(bool, self.tilt)
        return (-d[0] if about_y else d[0]) + 0.0, (-d[1] if about_x else d[1]) + 0.0, d[2]

    @property
    def flat(self) -> bool:
        """Whether folding the axis is all that it does."""
        return math.isinf(self.radius[0]) and self.free == "none"

    def shows_target(self, target: SecondTarget) -> SecondTarget:
        """What the light must do behind a screen, as seen in it."""
        about_x, about_y = map(bool, self.tilt)
        screen, focus = target.screen, target.focus
        if focus is not None:
            focus = (-focus[0] if about_y else focus[0], -focus[1] if about_x else focus[1], focus[2])
        return SecondTarget(None if screen is None else self.shows(screen), focus)

    def shows(self, screen: Screen) -> Screen:
        """A screen as seen in it, from one as seen in the mirrors in front of it."""
        x, y, normal = map(screen.in_space, tilted(self.tilt))
        window = Window(screen.in_space((0.0, 0.0, self.z)), (x, y, normal), self.opening)
        about_x, about_y = map(bool, self.tilt)  # the axis in the plane of the fold is reversed
        mirrored = screen.mirrored[0] != about_y, screen.mirrored[1] != about_x
        return replace(screen, mirrored=mirrored, windows=(*screen.windows, window))


#: Components by their names among the settings.
COMPONENTS: dict[str, type[Component]] = {shape.interaction.kind: shape for shape in (Component, FoldMirror)}


def surface_name(number: int, side: str) -> str:
    """Name of a surface within a system; number: of its element, counted from 0."""
    return f"element-{number + 1}-{side}"


def check_positions(elements: Sequence[Component], lens: tuple[float, float], source: float, screen: float) -> None:
    """Check that elements are in order along the axis and overlap neither each other nor the free-form lens.

    Args:
        lens: z of the lens' entrance and of the centre of its exit, mm.
        source, screen: largest z of the source, and z of the screen, mm.

    Raises:
        InputError: naming the element and the accepted range.
    """
    bodies = [(f"the {e.kind} of [[element]] {k + 1}", *e.extent) for k, e in enumerate(elements)]
    for e in elements:
        e.check_place(lens)
    own = ("the free-form lens", *lens)
    before = [b for b in bodies if b[1] < lens[0]]
    sequence = [*before, own, *bodies[len(before) :]]
    for (name, _, high), (other, low, _) in itertools.pairwise(sequence):
        if low < high:
            raise InputError(
                f"⟨element.z⟩: {other} begins at {low:.4g} mm, before {name} ends at {high:.4g} mm; [[element]] tables must be in"
                " the order in which light reaches them, without overlap"
            )
    if before and source >= before[0][1]:
        raise InputError(
            f"⟨source.position⟩ must lie before {before[0][0]}, which begins at {before[0][1]:.4g} mm, got z = {source:g} mm"
        )
    if screen <= sequence[-1][2]:
        raise InputError(
            f"⟨screen.z⟩ must lie behind {sequence[-1][0]}, along the axis beyond {sequence[-1][2]:.4g} mm, got {screen:g} mm"
        )


BESIDE_ELEMENTS = Capability.because(
    "other elements",
    {"it sends light back through what stands before it, and elements are passed once": ("mirror",)},
    "⟨{{setting}}⟩ cannot be combined with ⟨element⟩: {reason}",
)
