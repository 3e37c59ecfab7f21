"""What is there: lens, source, screen, materials.  Frozen, validated on construction, no light yet."""

from __future__ import annotations

from caustic_cli.scene.aperture import Aperture, Pupil
from caustic_cli.scene.elements import Component, check_places, refuse_beside, surface_name
from caustic_cli.scene.front import Front, Second
from caustic_cli.scene.lens import Lens, Offset
from caustic_cli.scene.light import Light
from caustic_cli.scene.screen import Screen
from caustic_cli.scene.sources import Disc, PlaneWave, Points, Source

__all__ = [
    "Aperture",
    "Band",
    "Component",
    "Disc",
    "Front",
    "Lens",
    "Light",
    "Offset",
    "PlaneWave",
    "Points",
    "Pupil",
    "Scene",
    "Screen",
    "Second",
    "Source",
]

from dataclasses import dataclass, field, replace

from caustic_cli.errors import InputError
from caustic_cli.scene.materials import refractive_index


@dataclass(frozen=True)
class Band:
    """Light that is traced in one go: a part of the source's power, with one index and one state of polarisation.

    channel: of a coloured image, or None where the image has no colours; member: which of several sources shines, None of one.
    """

    scene: Scene
    weight: float = 1.0
    channel: int | None = None
    member: int | None = None


@dataclass(frozen=True)
class Scene:
    """Source, lens and screen on one optical axis (z); lengths in mm, powers in the unit of `light`.

    second: what light does behind the screen, of a lens with two free-form sides.
    elements: other lenses and folding mirrors, in the order in which light meets them; behind a mirror z counts along the folded
    axis, which the screen stands on.

    Raises:
        InputError: the screen does not stand behind the lens, or the source not before it; the screen does not fit on its sphere;
            elements that stand in each other's way, or beside what they cannot be had with.
    """

    source: Source
    lens: Lens
    screen: Screen
    light: Light = field(default_factory=Light)
    second: Second | None = None
    elements: tuple[Component, ...] = ()

    def __post_init__(self):
        self._check_elements()
        if self.second is not None:
            self.second.check(self.screen)
        if not self.lens.mirror and self.screen.z <= self.lens.z_in:
            raise InputError(f"⟨screen.z⟩ must lie behind the lens (beyond z_in = {self.lens.z_in:g} mm), got {self.screen.z:g} mm")
        self.screen.refuse_beyond()
        if self.source.nearest >= self.lens.z_in:
            raise InputError(
                f"⟨source.position⟩ must lie before the lens (z below z_in = {self.lens.z_in:g} mm),"
                f" got z = {self.source.nearest:g} mm"
            )
        if self.dispersive:
            for wavelength in self.light.wavelengths:
                for glass in self.glasses:
                    refractive_index(glass, wavelength)

    def _check_elements(self) -> None:
        if not self.elements:
            return
        lens = self.lens
        wrong = {"lens.mirror": lens.mirror, "lens.gradient": lens.gradient is not None, "lens.array": lens.arrayed}
        refuse_beside(wrong | {"second.file": self.two_sided, "source.type": self.source.rays is not None})
        check_places(self.elements, (lens.z_in, lens.offset.thickness), self.source.nearest, self.screen.z)

    @property
    def before(self) -> tuple[Component, ...]:
        """The elements that light meets before the lens."""
        return tuple(e for e in self.elements if e.z < self.lens.z_in)

    @property
    def behind(self) -> tuple[Component, ...]:
        """Those that it meets behind it."""
        return self.elements[len(self.before) :]

    @property
    def shaped(self) -> tuple[str, ...]:
        """Names of the surfaces that a design shapes, the lens' exit last."""
        beside = [surface_name(k, side) for k, e in enumerate(self.elements) for side in e.shaped]
        return (*(["entrance"] if self.second is not None else beside), "exit")

    @property
    def jointly(self) -> bool:
        """Whether a design shapes other surfaces beside the exit: heights are then (k, n, m), in the sequence of `shaped`."""
        return len(self.shaped) > 1

    @property
    def pupil(self) -> Pupil:
        """What the source lights: the lens' entrance, or the first element before it."""
        first = next(iter(self.before), None)
        if first is not None:
            return Pupil(first.half_size, first.z, first.round)
        return Pupil(self.lens.half_size, self.lens.z_in, self.lens.round)

    @property
    def lowest(self) -> float:
        """z that no surface lies below where light comes from the source, mm."""
        return min([e.extent[0] for e in self.before[:1]] + [self.lens.lowest])

    @property
    def glasses(self) -> tuple[str, ...]:
        """Materials by name of the lens and of other lenses, whose indices change with the wavelength."""
        named = (None if self.lens.mirror else self.lens.glass, *(e.glass for e in self.elements))
        return tuple(dict.fromkeys(glass for glass in named if glass is not None))

    def at(self, wavelength: float) -> Scene:
        """The same with every glass' index at a wavelength, nm."""
        lens = self.lens if self.lens.glass is None else replace(self.lens, index=refractive_index(self.lens.glass, wavelength))
        return replace(self, lens=lens, elements=tuple(e.at(wavelength) for e in self.elements))

    @property
    def axial(self) -> bool:
        """Whether all light within the lens runs along the axis."""
        return self.source.collimated and not self.two_sided and self.lens.gradient is None and not self.before

    def part(self, k: int, of: int) -> Scene:
        """The same in the k-th of so many lights that are alike and independent: a ray file's rays are shared out among them,
        other light's are drawn anew."""
        return replace(self, source=self.source.part(k, of))

    def onto(self, screen: Screen) -> Scene:
        """The same light on another screen, with nothing said of what it does behind that."""
        return replace(self, screen=screen, second=None)

    @property
    def two_sided(self) -> bool:
        """Whether the lens' entrance is free-form, too."""
        return self.second is not None or self.lens.front is not None

    @property
    def dispersive(self) -> bool:
        """Whether the source's wavelengths are refracted differently."""
        return bool(self.light.wavelengths and self.glasses)

    @property
    def colored(self) -> bool:
        """Whether images keep red, green and blue apart: (3, n_x, n_y)."""
        return self.light.color

    @property
    def by_source(self) -> tuple[Scene, ...]:
        """The scene in the light of each of its sources alone."""
        if len(self.source.members) == 1:
            return (self,)
        spectra = self.source.spectra if self.light.wavelengths else [((), ())] * len(self.source.members)
        return tuple(
            replace(self, source=one, light=replace(self.light, wavelengths=wavelengths, weights=weights))
            for one, (wavelengths, weights) in zip(self.source.members, spectra, strict=True)
        )

    @property
    def bands(self) -> tuple[Band, ...]:
        """What has to be traced apart, by source, wavelength and polarisation: the scene itself where one trace says it all."""
        if len(self.source.members) > 1:
            each = zip(self.by_source, self.source.fractions, strict=True)
            return tuple(
                replace(band, weight=fraction * band.weight, member=k)
                for k, (one, fraction) in enumerate(each)
                for band in one.bands
            )
        states = (0.0, 90.0) if self.light.tracked and self.light.polarisation is None else (self.light.polarisation,)
        if not (self.dispersive or self.colored):
            if len(states) == 1:
                return (Band(self),)
            return tuple(Band(replace(self, light=Light(state)), 1.0 / len(states)) for state in states)
        bands = []
        for k, (wavelength, part) in enumerate(zip(self.light.wavelengths, self.light.parts, strict=True)):
            scene = self.at(wavelength) if self.dispersive else self
            bands += [Band(replace(scene, light=Light(state)), part / len(states), k if self.colored else None) for state in states]
        return tuple(bands)
