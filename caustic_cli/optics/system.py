"""Sequential optical systems: sources, then surfaces in the order in which light reaches them, then screens.

    System   = sources + (Element, ...) + screens
    Element  = Surface + Aperture + refract or reflect + Medium behind it + Pose

Lengths are mm, angles degrees.  An element's frame has its origin at `Pose.position` and, apart from its tilt, its z axis along the
nominal direction of light.  The object space is air (`object_space`); behind a mirror light is again in the medium in front of it.

Control heights of free-form surfaces are not part of a system: `trace` takes them as {name of the element: (n, m) tensor, mm}.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import torch
from torch import Tensor

from caustic_cli.errors import InputError
from caustic_cli.optics.bspline import SplineSpace
from caustic_cli.optics.frames import AxisSegment, Pose, carried, rotate_to_global, seen_from
from caustic_cli.optics.media import AIR, Medium, medium_of
from caustic_cli.optics.surfaces import Fixed, HeightField, Plane, Sphere, Surface
from caustic_cli.optics.tolerances import PARALLEL
from caustic_cli.scene import Aperture, Component, FreeForm, Lens, Light, Pupil, Scene, Screen, Source
from caustic_cli.scene.elements import SIDES, surface_name
from caustic_cli.schema import checks
from caustic_cli.schema.table import TABLE

INTERACTIONS = ("refract", "reflect")
#: Names of the elements of a one-lens scene.
ENTRANCE, EXIT = "entrance", "exit"


@dataclass(frozen=True)
class Element:
    """One surface of a system; see the module."""

    #: Of the element, and key of its surface's heights.
    name: str
    surface: Surface
    aperture: Aperture = field(default_factory=Aperture)
    #: refract or reflect.
    interaction: str = "refract"
    #: The medium behind it; ignored for a mirror.
    behind: Medium = AIR
    pose: Pose = field(default_factory=Pose)
    #: Reflection losses of a refracting surface: none, schlick or exact.
    fresnel: str = "exact"
    #: Standard deviation, along either axis, of the slopes of its microfacets relative to the smooth surface.
    roughness: float = 0.0

    def __post_init__(self):
        checks.choice("interaction", self.interaction, INTERACTIONS)
        checks.choice("fresnel", self.fresnel, TABLE["lens.fresnel"].choices)
        checks.number("roughness", self.roughness, 0.0, 1.0)

    @property
    def reflects(self) -> bool:
        """Whether it is a mirror."""
        return self.interaction == "reflect"

    @property
    def effects(self) -> frozenset[str]:
        """Names of the effects on rays that it causes beside refraction or reflection."""
        return frozenset({"roughness"} if self.roughness else ())


def entrance_of(lens: Lens) -> Fixed:
    """The surface of a lens' free-form entrance."""
    assert lens.entrance is not None
    return fixed_surface(lens.entrance, lens.half_size)


def fixed_surface(front: FreeForm, half_size: tuple[float, float]) -> Fixed:
    """The height field of a free-form surface over an aperture of half widths `half_size`, mm."""
    if front.knots is None:
        u, v = (SplineSpace.uniform(n, p) for n, p in zip(front.heights.shape, front.degree, strict=True))
    else:
        u, v = (SplineSpace(p, torch.as_tensor(t, dtype=torch.float64)) for p, t in zip(front.degree, front.knots, strict=True))
    return Fixed(HeightField((u, v), half_size), torch.from_numpy(front.heights))


def split_heights(scene: Scene, field: HeightField, heights: Tensor) -> tuple[Scene, Tensor]:
    """A scene and the heights (n, m) of its exit, from heights (n, m) of the exit or (k, n, m) of all `free_surfaces`, of which the
    scene then contains all but the exit."""
    if heights.ndim == 2:
        return scene, heights
    fronts = {name: freeform_of(field, h) for name, h in zip(scene.free_surfaces, heights[:-1], strict=False)}
    lens = replace(scene.lens, entrance=fronts[ENTRANCE]) if ENTRANCE in fronts else scene.lens
    elements = tuple(
        replace(e, surfaces=(fronts.get(surface_name(k, SIDES[0])), fronts.get(surface_name(k, SIDES[1])))) if e.free_sides else e
        for k, e in enumerate(scene.elements)
    )
    return replace(scene, lens=lens, elements=elements), heights[-1]


def lens_frame(scene: Scene) -> Pose:
    """The frame of the lens as it stands relative to the other elements (`Scene.mounting`)."""
    shift, tilt = scene.mounting
    if not any((*shift, *tilt)):
        return Pose()
    middle = (0.0, 0.0, scene.lens.z_in)
    turned = rotate_to_global(Pose(tilt=tilt), middle)
    x, y, z = (m + d - t for m, d, t in zip(middle, (*shift, 0.0), turned, strict=True))
    return Pose((x, y, z), tilt)


def trace_arguments(scene: Scene, field: HeightField, heights: Tensor) -> tuple[Scene, HeightField, Tensor]:
    """Scene, height field and heights (n, m) of the exit, the arguments of a trace; see `split_heights`."""
    scene, exit = split_heights(scene, field, heights)
    return scene, field, exit


def freeform_of(field: HeightField, heights: Tensor) -> FreeForm:
    """A free-form surface as data, from heights (n, m) above its vertex plane, mm."""
    u, v = field.spaces
    return FreeForm(heights.detach().cpu().double().numpy(), (u.degree, v.degree), (u.knots.tolist(), v.knots.tolist()))


def _elements_of(component: Component, number: int, leg: AxisSegment, scene: Scene, exit: HeightField) -> list[Element]:
    """The surfaces of a component on an axis segment; a free surface without heights uses the spline spaces of the exit, which has
    some where a lens is designed."""
    elements, glass = [], Medium(component.index, component.absorption, component.glass)
    for side in component.sides:
        front, radius = component.surfaces[SIDES.index(side)], component.radius[SIDES.index(side)]
        surface: Surface
        if front is not None:
            surface = fixed_surface(front, component.half_size)
        elif side in component.free_sides:
            surface = HeightField(exit.spaces, component.half_size)
        else:
            surface = Sphere(radius, component.reach) if math.isfinite(radius) else Plane()
        pose = leg.pose(component.vertex(side), component.tilt)
        name, opening = surface_name(number, side), component.opening
        behind = glass if side == "front" else AIR
        elements.append(Element(name, surface, opening, component.interaction.name, behind, pose, scene.lens.fresnel))
    return elements


@dataclass(frozen=True)
class PlacedScreen:
    """A screen with an arbitrary pose: `screen` gives its size, pixels and shift, `pose` its centre and orientation."""

    screen: Screen
    pose: Pose


@dataclass(frozen=True)
class System:
    """A sequential system; see the module.

    Raises:
        InputError: there is no element or no source, names are not unique, the first aperture is infinite, or an element is
            parallel to the axis.
    """

    #: Simultaneous, mutually incoherent sources.
    sources: tuple[Source, ...]
    #: In the order in which light reaches them.
    elements: tuple[Element, ...]
    #: Each collects all light in its plane, as if the others were absent.
    screens: tuple[Screen | PlacedScreen, ...] = ()
    light: Light = field(default_factory=Light)
    #: The medium in front of the first element.
    object_space: Medium = AIR
    #: The pupil that the sources illuminate; None for the first element's aperture.
    lit: Pupil | None = None
    #: The segment of a folded axis that a `Screen` refers to; None for a straight axis.
    leg: AxisSegment | None = None

    def __post_init__(self):
        self.object_space.check_first()
        if not self.elements or not self.sources:
            raise InputError("a system needs at least one source and one element")
        names = [e.name for e in self.elements]
        if len(set(names)) < len(names):
            raise InputError(f"elements must have unique names, got {', '.join(names)}")
        if not all(map(math.isfinite, self.pupil.half_size)):
            raise InputError(f"the first element, {names[0]}, must have an aperture, which the sources illuminate")
        for name, cosine in zip(names, self._along()[0], strict=True):
            if abs(cosine) < PARALLEL:
                raise InputError(f"element {name} must face the light: the axis is parallel to its surface")

    @classmethod
    def of(cls, scene: Scene, surface: HeightField | None = None) -> System:
        """The system of a scene: the free-form lens or mirror between other lenses and fold mirrors.  Other free surfaces use the
        exit's spline spaces unless the scene contains their heights."""
        lens = scene.lens
        surface = surface or HeightField.of(lens)
        entrance = Plane() if not scene.two_sided else surface if lens.entrance is None else entrance_of(lens)
        elements: tuple[Element, ...] = (
            Element(EXIT, surface, lens.clear, lens.interaction.name, fresnel=lens.fresnel, roughness=lens.roughness),
        )
        if not lens.mirror:
            first = Element(
                ENTRANCE,
                entrance,
                lens.opening,
                behind=medium_of(lens),
                pose=Pose((0.0, 0.0, lens.z_in)),
                fresnel=lens.fresnel,
            )
            elements = (first, *elements)
        lit, leg = None if scene.two_sided or scene.in_front else scene.pupil, AxisSegment()
        in_front = tuple(e for k, c in enumerate(scene.in_front) for e in _elements_of(c, k, leg, scene, surface))
        stands = lens_frame(scene)
        if stands != Pose():
            if in_front:  # which the source illuminates: everything is in their frame, and otherwise in that of the lens
                elements = tuple(replace(e, pose=carried(stands, e.pose)) for e in elements)
            else:
                around = seen_from(stands, Pose())
                leg = AxisSegment(around.position, around.frame)
        elements = (*in_front, *elements)
        for k, component in enumerate(scene.behind, len(scene.in_front)):
            elements += tuple(_elements_of(component, k, leg, scene, surface))
            leg = component.axis_behind(leg)
        return cls((scene.source,), elements, (scene.screen,), scene.light, lit=lit, leg=leg if leg != AxisSegment() else None)

    def placed(self, screen: Screen) -> PlacedScreen:
        """The pose of a screen on the folded axis; its tilt, shift and shape are relative to that axis."""
        assert self.leg is not None
        (sx, sy), turned = screen.shift, Pose(tilt=screen.tilt, frame=self.leg.frame)
        middle = self.leg.at(sx, sy, screen.z)  # the centre of rotation; coordinates are measured from the axis
        x, y, z = (m - sx * a - sy * b for m, a, b in zip(middle, *turned.axes[:2], strict=True))
        return PlacedScreen(screen, replace(turned, position=(x, y, z)))

    @property
    def pupil(self) -> Pupil:
        """The aperture that the sources illuminate."""
        if self.lit is not None:
            return self.lit
        first = self.elements[0]
        return Pupil(first.aperture, first.pose.position[2])

    @property
    def shapes(self) -> dict[str, tuple[int, int]]:
        """Shapes of the heights of all free-form surfaces, by name."""
        return {e.name: e.surface.shape for e in self.elements if e.surface.shape is not None}

    @property
    def effects(self) -> frozenset[str]:
        """Names of the effects on rays (`optics.effects`) that its parts cause."""
        components: tuple[Medium | Element | Light, ...] = (*self.media(), *self.elements, self.light)
        return frozenset[str]().union(*(component.effects for component in components))

    def media(self) -> tuple[Medium, ...]:
        """The medium in front of each element, and behind the last."""
        return tuple(self.object_space if k is None else self.elements[k].behind for k in self.owners())

    def owners(self) -> tuple[int | None, ...]:
        """Index of the element in front of each of `media`, None for the first medium."""
        owners: list[int | None] = [None]
        for k, element in enumerate(self.elements):
            owners.append(owners[-1] if element.reflects else k)
        return tuple(owners)

    def _along(self) -> tuple[list[float], tuple[float, float, float]]:
        """Cosines between the axis and each element's z axis, and the direction of the axis behind the last element.

        The axis starts along +z, or in the direction of a source at infinity, is undeviated by refraction, and is reflected by
        mirrors like a ray at the vertex.
        """
        axis, cosines = self.source.axis if self.source.distant else (0.0, 0.0, 1.0), []
        for element in self.elements:
            normal = element.pose.axes[2]
            cosine = sum(a * b for a, b in zip(axis, normal, strict=True))
            cosines.append(cosine)
            if element.reflects:
                x, y, z = (a - 2.0 * cosine * b for a, b in zip(axis, normal, strict=True))
                axis = x, y, z
        return cosines, axis

    def sides(self) -> tuple[float, ...]:
        """The side from which the axis reaches each element: +1 from below, -1 from above."""
        return tuple(math.copysign(1.0, cosine) for cosine in self._along()[0])

    @property
    def axis(self) -> tuple[float, float, float]:
        """Direction of the axis behind the last element."""
        return self._along()[1]

    @property
    def fractions(self) -> tuple[float, ...]:
        """Fraction of the total power of each source."""
        total = math.fsum(s.power for s in self.sources)
        return tuple(s.power / total for s in self.sources)

    @property
    def source(self) -> Source:
        """The first source."""
        return self.sources[0]

    def with_source(self, source: Source) -> System:
        """The system with another source."""
        return replace(self, sources=(source,))
