"""The optical scene: light source, lens, other elements, screen.  Immutable data, validated on construction; nothing is traced
here."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property, reduce
from typing import TYPE_CHECKING, Any

import numpy as np

from caustic_cli.errors import InputError
from caustic_cli.scene import sources
from caustic_cli.scene.aperture import Aperture, CircularAperture, Pupil
from caustic_cli.scene.elements import (
    BESIDE_ELEMENTS,
    COMPONENTS,
    Component,
    FoldMirror,
    check_positions,
    surface_name,
)
from caustic_cli.scene.freeform import FreeForm, SecondTarget
from caustic_cli.scene.lens import Lens, Offset
from caustic_cli.scene.light import Light
from caustic_cli.scene.materials import nearest_index, refractive_index
from caustic_cli.scene.screen import Screen, Vector
from caustic_cli.scene.sources import PlaneWave, Source

if TYPE_CHECKING:
    from caustic_cli.scene.sources import Disc, Points

__all__ = [
    "COMPONENTS",
    "Aperture",
    "Band",
    "CircularAperture",
    "Component",
    "Disc",
    "FoldMirror",
    "FreeForm",
    "Lens",
    "Light",
    "Offset",
    "PlaneWave",
    "Points",
    "Pupil",
    "Scene",
    "Screen",
    "SecondTarget",
    "Source",
]


@dataclass(frozen=True)
class Band:
    """Light that one trace covers: one source, one refractive index and one state of polarisation."""

    scene: Scene
    #: Fraction of the total power.
    weight: float = 1.0
    #: Colour channel of the image, None for an image without colours.
    channel: int | None = None
    #: Tristimulus values of its light, with Y = 1, where the colour of the light differs from band to band.
    colour: tuple[float, float, float] | None = None
    #: Index of the source among several, None for a single one.
    member: int | None = None


@dataclass(frozen=True)
class Scene:
    """Source, lens and screen on one optical axis (z); lengths in mm, powers in the unit of `light`.

    Raises:
        InputError: the screen is not behind the lens, or the source not in front of it; a curved screen is larger than its sphere
            or cylinder allows; elements overlap, or are combined with something that does not support them.
    """

    source: Source
    lens: Lens
    screen: Screen
    light: Light = field(default_factory=Light)
    #: What the light must do behind the screen, for a lens with two free-form sides.
    second_target: SecondTarget | None = None
    #: Other lenses and fold mirrors, in the order in which light reaches them; behind a mirror, z and the screen refer to the
    #: folded axis.
    elements: tuple[Component, ...] = ()
    #: Where the lens stands relative to the other elements, which errors change: its decentre along x and y, mm, and its rotations
    #: about x and y through the centre of its entrance, degrees.
    mounting: tuple[tuple[float, float], tuple[float, float]] = ((0.0, 0.0), (0.0, 0.0))

    def __post_init__(self):
        self._check_elements()
        if self.second_target is not None:
            self.second_target.check(self.screen)
        self.lens.interaction.check_screen(self.screen.z, self.lens.z_in)
        self.screen.check_curvature()
        self.screen.check_facing(self.undeviated)
        begins, what = (self.lens.z_in, "z_in =") if self.lens.entrance is None else (self.lens.lowest, "all of its inner side,")
        if self.source.nearest >= min(begins, self.lens.pupil.z):
            raise InputError(
                f"⟨source.position⟩ must lie before the lens (z below {what} {begins:.6g} mm), got z = {self.source.nearest:g} mm"
            )
        if self.dispersive and self.light.measure is None:
            for wavelength in self.light.wavelengths:
                for glass in self.glasses:
                    refractive_index(glass, wavelength)

    @property
    def undeviated(self) -> Vector:
        """Unit direction, in the frame of the screen, of light along the source's axis behind surfaces without slopes."""
        return reduce(lambda d, element: element.sent(d), self.elements, self.lens.interaction.sent(self.source.axis))

    def _check_elements(self) -> None:
        if self.elements:
            BESIDE_ELEMENTS.refuse(self)
            check_positions(self.elements, (self.lens.z_in, self.lens.offset.thickness), self.source.nearest, self.screen.z)

    @property
    def in_front(self) -> tuple[Component, ...]:
        """The elements in front of the lens, in the order in which light reaches them."""
        return tuple(e for e in self.elements if e.z < self.lens.z_in)

    @property
    def behind(self) -> tuple[Component, ...]:
        """The elements behind the lens."""
        return self.elements[len(self.in_front) :]

    @cached_property
    def unfolded(self) -> Scene:
        """The equivalent scene with a straight axis and without other elements, its screen as seen in the mirrors, if the other
        elements only fold the axis; itself otherwise."""
        mirrors = [e for e in self.elements if isinstance(e, FoldMirror) and e.flat]
        if not mirrors or len(mirrors) < len(self.elements):
            return self
        second = self.second_target and reduce(lambda target, mirror: mirror.shows_target(target), mirrors, self.second_target)
        screen = reduce(lambda screen, mirror: mirror.shows(screen), mirrors, self.screen)
        return replace(self, elements=(), screen=screen, second_target=second)

    @property
    def free_surfaces(self) -> tuple[str, ...]:
        """Names of the free-form surfaces that a design optimises, the lens' exit last."""
        beside = [surface_name(k, side) for k, e in enumerate(self.elements) for side in e.free_sides]
        return (*(["entrance"] if self.second_target is not None else beside), "exit")

    @property
    def joint(self) -> bool:
        """Whether several surfaces are optimised together: heights are then (k, n, m), in the order of `free_surfaces`."""
        return len(self.free_surfaces) > 1

    @property
    def pupil(self) -> Pupil:
        """The aperture that the source illuminates: the lens' entrance, or the first element in front of it."""
        return next(iter(self.in_front), self.lens).pupil

    @property
    def lowest(self) -> float:
        """Lower bound of z over the first surface that light reaches, mm."""
        return min([e.extent[0] for e in self.in_front[:1]] + [self.lens.lowest])

    @property
    def glasses(self) -> tuple[str, ...]:
        """Names of the dispersive materials of the lens and of the other lenses, without repeats."""
        named = (self.lens.interior.glass, *(e.glass for e in self.elements))
        return tuple(dict.fromkeys(glass for glass in named if glass is not None))

    def at(self, wavelength: float) -> Scene:
        """The scene with every glass' refractive index evaluated at a wavelength, nm."""
        lens = self.lens if self.lens.glass is None else replace(self.lens, index=nearest_index(self.lens.glass, wavelength))
        return replace(self, lens=lens, elements=tuple(e.at(wavelength) for e in self.elements))

    @property
    def axial(self) -> bool:
        """Whether all light inside the lens is parallel to the axis."""
        return self.source.collimated and not self.two_sided and self.lens.gradient is None and not self.in_front

    def batch(self, k: int, of: int) -> Scene:
        """The scene with the k-th of `of` statistically independent batches of its light: the rays of a ray file are partitioned,
        the rays of any other source are sampled afresh."""
        return replace(self, source=self.source.batch(k, of))

    def onto(self, screen: Screen) -> Scene:
        """The scene with another screen and without a second target."""
        return replace(self, screen=screen, second_target=None)

    @property
    def two_sided(self) -> bool:
        """Whether the entrance is free-form as well as the exit."""
        return self.second_target is not None or self.lens.entrance is not None

    @property
    def dispersive(self) -> bool:
        """Whether several wavelengths pass a dispersive material."""
        return bool(self.light.wavelengths and self.glasses)

    @property
    def colored(self) -> bool:
        """Whether images have three colour channels, (3, n_x, n_y)."""
        return self.light.color

    @property
    def by_source(self) -> tuple[Scene, ...]:
        """One scene for each of its sources, with that source alone."""
        if len(self.source.members) == 1:
            return (self,)
        members, count = self.source.members, len(self.source.members)
        spectra = self.source.spectra if self.light.wavelengths else [((), ())] * count
        measures = self.source.measures or (self.light.measure,) * count
        return tuple(
            replace(self, source=member, light=replace(self.light, wavelengths=wavelengths, weights=weights, measure=measure))
            for member, (wavelengths, weights), measure in zip(members, spectra, measures, strict=True)
        )

    @cached_property
    def white(self) -> tuple[float, float, float] | None:
        """Tristimulus values X, Y, Z, with Y = 1, of the light of all its sources on a white screen; None where that of one has no
        colour, see `Light.white`, or images have channels."""
        found = [one.light.white for one in self.by_source]
        if self.colored or None in found:
            return None
        fractions = self.source.fractions if len(found) > 1 else (1.0,)
        large, luminous, small = (np.array(fractions) @ np.array(found)).tolist()
        return large, luminous, small

    @property
    def bands(self) -> tuple[Band, ...]:
        """The separate traces that the scene needs, by source, wavelength and polarisation; the scene itself where one is
        enough."""
        if len(self.source.members) > 1:
            each = zip(self.by_source, self.source.fractions, strict=True)
            return tuple(
                replace(band, weight=fraction * band.weight, member=k, colour=band.colour or scene_of_member.light.white)
                for k, (scene_of_member, fraction) in enumerate(each)
                for band in scene_of_member.bands
            )
        states = self.light.states
        if not (self.dispersive or self.colored):
            if len(states) == 1:
                return (Band(self),)
            return tuple(Band(replace(self, light=Light(state)), 1.0 / len(states)) for state in states)
        bands, light = [], self.light
        for wavelength, fraction, channel, colour in zip(
            light.wavelengths, light.fractions, light.channels, light.colours_of(light.wavelengths), strict=True
        ):
            scene = self.at(wavelength) if self.dispersive else self
            bands += [Band(replace(scene, light=Light(state)), fraction / len(states), channel, colour) for state in states]
        return tuple(bands)


def __getattr__(name: str) -> Any:
    """The other sources of `__all__`, which are loaded when they are asked for."""
    if name in __all__:
        return getattr(sources, name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
