"""A sequential optical system: sources, then surfaces in the order in which light meets them, then screens.

    System   = sources + (Element, ...) + screens
    Element  = Surface + Aperture + refract or reflect + Medium behind it + Pose

Lengths are mm, angles degrees.  An element's frame has its origin at `Pose.position` and its z axis along the nominal direction
of light, but for its tilt.  Light comes from air (`before`); behind an element that reflects lies the medium before it.

Heights that shape its surfaces are no part of a system: `trace` takes them as {name of the element: (n, m) tensor, mm}.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import torch
from torch import Tensor

from caustic_cli.config import checks
from caustic_cli.config.table import TABLE
from caustic_cli.errors import InputError
from caustic_cli.optics.bspline import SplineSpace
from caustic_cli.optics.frames import AxisSegment, Pose
from caustic_cli.optics.gradient.fields import IndexField, index_field_of
from caustic_cli.optics.surfaces import Fixed, HeightField, Plane, Sphere, Surface
from caustic_cli.optics.tolerances import PARALLEL
from caustic_cli.scene import Aperture, Component, FreeForm, Lens, Light, Pupil, Scene, Screen, Source
from caustic_cli.scene.elements import SIDES, surface_name
from caustic_cli.scene.materials import refractive_index

INTERACTIONS = ("refract", "reflect")
#: Names of the elements of a one-lens scene.
ENTRANCE, EXIT = "entrance", "exit"


@dataclass(frozen=True)
class Medium:
    """What light runs through.

    Args:
        index: refractive index; of a glass, that of rays without a wavelength.
        absorption: coefficient a, 1/mm: exp(-a t) passes t mm (Beer-Lambert).
        glass: a name of `materials`, whose index changes with the wavelength; None for `index` at every wavelength.
        gradient: how its index varies from place to place, in the frame of the element that it lies behind; at a wavelength where
            the glass has another index than `index`, that many times as large everywhere.  None where it does not.
    """

    index: float = 1.0
    absorption: float = 0.0
    glass: str | None = None
    gradient: IndexField | None = None

    def __post_init__(self):
        checks.number("index", self.index, 1.0, 5.0)
        checks.number("absorption", self.absorption, 0.0, 1e6)

    def index_at(self, wavelength: float | None) -> float:
        """Refractive index at a wavelength, nm."""
        return self.index if self.glass is None or wavelength is None else refractive_index(self.glass, wavelength)


AIR = Medium()


@dataclass(frozen=True)
class Element:
    """One surface of a system, see above.

    Args:
        name: of the element and of its surface's heights.
        interaction: refract or reflect.
        behind: the medium behind it; nothing where it reflects.
        fresnel: losses by reflection where it refracts: none, schlick or exact.
        roughness: standard deviation, along either axis, of the slopes of its microfacets about the surface's own.
    """

    name: str
    surface: Surface
    aperture: Aperture = field(default_factory=Aperture)
    interaction: str = "refract"
    behind: Medium = AIR
    pose: Pose = field(default_factory=Pose)
    fresnel: str = "exact"
    roughness: float = 0.0

    def __post_init__(self):
        checks.choice("interaction", self.interaction, INTERACTIONS)
        checks.choice("fresnel", self.fresnel, TABLE["lens.fresnel"].choices)
        checks.number("roughness", self.roughness, 0.0, 1.0)

    @property
    def reflects(self) -> bool:
        """Whether it is a mirror."""
        return self.interaction == "reflect"


def entrance_of(lens: Lens) -> Fixed:
    """The free-form entrance of a lens that has one."""
    assert lens.entrance is not None
    return fixed_surface(lens.entrance, lens.half_size)


def fixed_surface(front: FreeForm, half_size: tuple[float, float]) -> Fixed:
    """The surface with these heights over an aperture."""
    if front.knots is None:
        u, v = (SplineSpace.uniform(n, p) for n, p in zip(front.heights.shape, front.degree, strict=True))
    else:
        u, v = (SplineSpace(p, torch.as_tensor(t, dtype=torch.float64)) for p, t in zip(front.degree, front.knots, strict=True))
    return Fixed(HeightField((u, v), half_size), torch.from_numpy(front.heights))


def split_heights(scene: Scene, field: HeightField, heights: Tensor) -> tuple[Scene, Tensor]:
    """A scene and the heights (n, m) of its exit, from heights that may be those of all `shaped` surfaces, (k, n, m), which the
    scene then says."""
    if heights.ndim == 2:
        return scene, heights
    fronts = {name: freeform_of(field, h) for name, h in zip(scene.free_surfaces, heights[:-1], strict=False)}
    lens = replace(scene.lens, entrance=fronts[ENTRANCE]) if ENTRANCE in fronts else scene.lens
    elements = tuple(
        replace(e, surfaces=(fronts.get(surface_name(k, SIDES[0])), fronts.get(surface_name(k, SIDES[1])))) if e.free_sides else e
        for k, e in enumerate(scene.elements)
    )
    return replace(scene, lens=lens, elements=elements), heights[-1]


def trace_arguments(scene: Scene, field: HeightField, heights: Tensor) -> tuple[Scene, HeightField, Tensor]:
    """`sides_of`, with the exit's field: what a trace takes."""
    scene, exit = split_heights(scene, field, heights)
    return scene, field, exit


def freeform_of(field: HeightField, heights: Tensor) -> FreeForm:
    """A surface with these heights (n, m), counted from its vertex' plane, mm."""
    u, v = field.spaces
    return FreeForm(heights.detach().cpu().double().numpy(), (u.degree, v.degree), (u.knots.tolist(), v.knots.tolist()))


def _elements_of(
    component: Component, number: int, leg: AxisSegment, scene: Scene, spaces: tuple[SplineSpace, SplineSpace]
) -> list[Element]:
    """The surfaces of a lens or a mirror on a straight part of the axis; a free one without heights is on these spline spaces."""
    found, glass = [], Medium(component.index, component.absorption, component.glass)
    for side in component.sides:
        front, radius = component.surfaces[SIDES.index(side)], component.radius[SIDES.index(side)]
        surface: Surface
        if front is not None:
            surface = fixed_surface(front, component.half_size)
        elif side in component.free_sides:
            surface = HeightField(spaces, component.half_size)
        else:
            surface = Sphere(radius, component.reach) if math.isfinite(radius) else Plane()
        pose = leg.pose(component.vertex(side), component.tilt)
        name, opening = surface_name(number, side), component.opening
        if component.mirror:
            found.append(Element(name, surface, opening, "reflect", pose=pose))
        else:
            behind = glass if side == "front" else AIR
            found.append(Element(name, surface, opening, behind=behind, pose=pose, fresnel=scene.lens.fresnel))
    return found


@dataclass(frozen=True)
class PlacedScreen:
    """A screen anywhere: `screen` says its size, pixels and shift, `pose` where its middle stands and which way it looks."""

    screen: Screen
    pose: Pose


@dataclass(frozen=True)
class System:
    """A sequential system; see above.

    Args:
        sources: all shine at once, each with its own power.
        elements: in the order in which light meets them.
        screens: each collects all light that gets to its plane, as if the others were not there.
        before: the medium before the first element.
        lit: the pupil that the sources light; None for the first element's aperture.
        leg: the straight part of a folded axis that a `Screen` stands on; None where no mirror folds it.

    Raises:
        InputError: no element or source, two of one name, a first aperture that is infinite, or an element along the axis.
    """

    sources: tuple[Source, ...]
    elements: tuple[Element, ...]
    screens: tuple[Screen | PlacedScreen, ...] = ()
    light: Light = field(default_factory=Light)
    before: Medium = AIR
    lit: Pupil | None = None
    leg: AxisSegment | None = None

    def __post_init__(self):
        if self.before.gradient is not None:
            raise InputError("the medium before a system has no element whose frame its gradient could have; put one before it")
        if not self.elements or not self.sources:
            raise InputError("a system needs at least one source and one element")
        names = [e.name for e in self.elements]
        if len(set(names)) < len(names):
            raise InputError(f"elements must have names of their own, got {', '.join(names)}")
        if not all(map(math.isfinite, self.pupil.half_size)):
            raise InputError(f"the first element, {names[0]}, must have an aperture: sources shine into it")
        for name, cosine in zip(names, self._along()[0], strict=True):
            if abs(cosine) < PARALLEL:
                raise InputError(f"element {name} must face the light: the axis runs along its surface")

    @classmethod
    def of(cls, scene: Scene, surface: HeightField | None = None) -> System:
        """A scene: a lens of flat entrance and B-spline exit, or a B-spline mirror, between other lenses and folding mirrors.  What
        is free beside the exit is on its spline spaces, unless the scene says its heights: of two free-form sides the entrance."""
        lens = scene.lens
        surface = surface or HeightField.of(lens)
        entrance = Plane() if not scene.two_sided else surface if lens.entrance is None else entrance_of(lens)
        aperture = Aperture(lens.half_size, lens.round)
        elements: tuple[Element, ...]
        if lens.mirror:
            elements = (Element(EXIT, surface, aperture, "reflect", roughness=lens.roughness),)
        else:
            elements = (
                Element(
                    ENTRANCE,
                    entrance,
                    aperture,
                    behind=Medium(lens.index, lens.absorption, lens.glass, index_field_of(lens)),
                    pose=Pose((0.0, 0.0, lens.z_in)),
                    fresnel=lens.fresnel,
                ),
                Element(EXIT, surface, aperture, fresnel=lens.fresnel, roughness=lens.roughness),
            )
        lit, leg = None if scene.two_sided or scene.before else scene.pupil, AxisSegment()
        if scene.elements:
            first, number = elements, len(scene.before)
            elements = tuple(e for k, c in enumerate(scene.before) for e in _elements_of(c, k, leg, scene, surface.spaces)) + first
            for k, component in enumerate(scene.behind, number):
                elements += tuple(_elements_of(component, k, leg, scene, surface.spaces))
                leg = leg.folded(component.z, component.tilt) if component.mirror else leg
        return cls((scene.source,), elements, (scene.screen,), scene.light, lit=lit, leg=leg if leg != AxisSegment() else None)

    def placed(self, screen: Screen) -> PlacedScreen:
        """A screen on the folded axis: its own tilt, shift and shape are those that it would have on a straight one."""
        assert self.leg is not None
        (sx, sy), turned = screen.shift, Pose(tilt=screen.tilt, frame=self.leg.frame)
        middle = self.leg.at(sx, sy, screen.z)  # about which a tilted one is turned; its coordinates are counted from the axis
        x, y, z = (m - sx * a - sy * b for m, a, b in zip(middle, *turned.axes[:2], strict=True))
        return PlacedScreen(screen, replace(turned, position=(x, y, z)))

    @property
    def pupil(self) -> Pupil:
        """What the sources light."""
        if self.lit is not None:
            return self.lit
        first = self.elements[0]
        return Pupil(first.aperture.half_size, first.pose.position[2], first.aperture.round)

    @property
    def free(self) -> dict[str, tuple[int, int]]:
        """Shapes of the heights of every surface that has some, by name."""
        return {e.name: e.surface.shape for e in self.elements if e.surface.shape is not None}

    def media(self) -> tuple[Medium, ...]:
        """The medium before each element, and behind the last."""
        media = [self.before]
        for element in self.elements:
            media.append(media[-1] if element.reflects else element.behind)
        return tuple(media)

    def owners(self) -> tuple[int | None, ...]:
        """Of each of `media` the element that it lies behind, None before the first."""
        found: list[int | None] = [None]
        for k, element in enumerate(self.elements):
            found.append(found[-1] if element.reflects else k)
        return tuple(found)

    def _along(self) -> tuple[list[float], tuple[float, float, float]]:
        """Cosines between the axis and each element's own z, and the axis' direction behind the last.

        The axis goes along +z, straight on at every refraction, and off every mirror as a ray at its vertex.
        """
        axis, cosines = (0.0, 0.0, 1.0), []
        for element in self.elements:
            normal = element.pose.axes[2]
            cosine = sum(a * b for a, b in zip(axis, normal, strict=True))
            cosines.append(cosine)
            if element.reflects:
                x, y, z = (a - 2.0 * cosine * b for a, b in zip(axis, normal, strict=True))
                axis = x, y, z
        return cosines, axis

    def sides(self) -> tuple[float, ...]:
        """From which side the axis meets each element: +1 from below, -1 from above."""
        return tuple(math.copysign(1.0, cosine) for cosine in self._along()[0])

    @property
    def axis(self) -> tuple[float, float, float]:
        """Direction of the axis behind the last element."""
        return self._along()[1]

    @property
    def parts(self) -> tuple[float, ...]:
        """Each source's part of all power."""
        total = math.fsum(s.power for s in self.sources)
        return tuple(s.power / total for s in self.sources)

    @property
    def source(self) -> Source:
        """The first source."""
        return self.sources[0]

    def with_source(self, source: Source) -> System:
        """The same system in another light."""
        return replace(self, sources=(source,))
