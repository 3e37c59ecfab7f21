"""What a scene may have beyond the simplest one, and what each capability of this program does not support of it.

The simplest scene is a clear rectangular lens of one refractive index with a flat entrance in an unpolarised plane wave of one
wavelength, and a plane screen, upright and centred on the axis.  Whatever does not support every trait (an
export format, the interactive page, a study) says so in one `Capability`, from which its refusals and the matrix in the documents
are made.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Self

from caustic_cli.errors import InputError

if TYPE_CHECKING:
    from caustic_cli.scene import Scene

#: Types of sources that this program has by itself.
KNOWN_SOURCES = ("plane", "point", "grid", "disc", "rays", "several", "gaussian", "measured")


def _disc(scene: Scene) -> bool:
    return scene.source.kind == "disc"


def _points(scene: Scene) -> bool:
    return scene.source.kind in ("point", "grid")


@dataclass(frozen=True)
class Trait:
    """Something that a scene may have."""

    #: Noun phrase for messages.
    words: str
    #: Whether a scene has it.
    found_in: Callable[[Scene], bool]
    #: The settings by which a scene gets it: paths, each with a value where only that value counts; or element.
    settings: tuple[str, ...] = ()


#: All traits by name, in the order in which messages list them.
TRAITS: Mapping[str, Trait] = {
    "mirror": Trait("a mirror", lambda s: s.lens.mirror, ("lens.mirror",)),
    "gradient index": Trait("an index that varies", lambda s: s.lens.gradient is not None, ("lens.gradient",)),
    "two sides": Trait("a curved entrance", lambda s: s.two_sided, ("second.file", "second.collimate", "second.focus")),
    "designed entrance": Trait("a given curved entrance", lambda s: s.lens.entrance is not None),
    "unknown entrance": Trait(
        "an entrance that is designed with it",
        lambda s: s.second_target is not None,
        ("second.file", "second.collimate", "second.focus"),
    ),
    "other elements": Trait("other elements beside it", lambda s: bool(s.unfolded.elements), ("element.reshapes",)),
    "unknown elements": Trait(
        "other elements that are designed with it", lambda s: any(e.free_sides for e in s.elements), ("element.free",)
    ),
    "folded axis": Trait("an axis folded by flat mirrors", lambda s: s.unfolded is not s),
    "lenslet array": Trait("lenslets", lambda s: s.lens.arrayed, ("lens.array",)),
    "round lenslets": Trait("an opaque mask between round lenslets", lambda s: s.lens.round_lenslets, ("lens.lenslets round",)),
    "circular aperture": Trait("a circular aperture", lambda s: s.lens.opening.round, ("lens.aperture circle",)),
    "absorption": Trait(
        "absorption", lambda s: s.lens.absorption > 0 or any(e.absorption > 0 for e in s.elements), ("lens.absorption",)
    ),
    "roughness": Trait("roughness", lambda s: s.lens.roughness > 0, ("lens.roughness",)),
    "approximate Fresnel": Trait("approximate Fresnel", lambda s: s.lens.fresnel != "exact", ("lens.fresnel",)),
    "polarisation": Trait("polarised light", lambda s: s.light.polarisation is not None, ("source.polarisation",)),
    "several wavelengths": Trait("several wavelengths", lambda s: len(s.light.wavelengths) > 1, ("source.wavelengths",)),
    "coloured picture": Trait("a coloured picture", lambda s: s.colored, ("target.color",)),
    "lumens": Trait("power in lumens", lambda s: s.light.unit != "W", ("source.power_unit",)),
    "tilted screen": Trait("a tilted screen", lambda s: any(s.screen.tilt), ("screen.tilt",)),
    "shifted screen": Trait("a shifted screen", lambda s: any(s.screen.shift), ("screen.shift",)),
    "curved screen": Trait("a curved screen", lambda s: s.screen.curved, ("screen.radius", "screen.shape_file")),
    "unrollable screen": Trait("a screen on which no flat sheet lies", lambda s: s.screen.curved and not s.screen.rolled),
    "far field": Trait("a picture in the far field", lambda s: s.screen.far, ("screen.far",)),
    "several sources": Trait("several sources", lambda s: len(s.source.members) > 1, ("source.also", "source.each")),
    "ray file": Trait("the rays of a file", lambda s: s.source.rays is not None, ("source.type rays",)),
    "ray file among sources": Trait(
        "the rays of a file among several sources",
        lambda s: len(s.source.members) > 1 and any(one.rays is not None for one in s.source.members),
    ),
    "user-defined source": Trait("a type of source from outside the program", lambda s: s.source.kind not in KNOWN_SOURCES),
    "laser beam": Trait("the beam of a laser", lambda s: any(one.beam for one in s.source.members)),
    "near source": Trait("a source nearby", lambda s: not s.source.distant, ("source.position",)),
    "tilted light": Trait("light that is tilted to the axis", lambda s: s.source.oblique, ("source.tilt",)),
    "light not parallel": Trait("light that is not parallel", lambda s: not s.source.parallel),
    "separate places": Trait("sources in separate places", lambda s: s.source.apart),
    "uneven plane wave": Trait("a profile of its irradiance", lambda s: s.source.uneven, ("source.profile",)),
    "uneven source": Trait("a picture of its radiance", lambda s: s.source.brightness is not None),
    "uneven directions": Trait(
        "a picture of its directions", lambda s: s.source.brightness is not None and s.source.distant and not s.source.beam
    ),
    "tabulated intensity": Trait("a table of its intensity", lambda s: not isinstance(s.source.intensity, str)),
    "uneven points": Trait("points of another than uniform intensity", lambda s: _points(s) and s.source.intensity != "uniform"),
    "disc at infinity": Trait("a disc at infinity", lambda s: _disc(s) and s.source.distant, ("source.angle",)),
    "disc not Lambertian": Trait("a disc that is not Lambertian", lambda s: _disc(s) and s.source.intensity != "lambertian"),
    "disc in a cone": Trait("a disc with a cone", lambda s: _disc(s) and s.source.cone is not None, ("source.cone",)),
    "elliptical disc": Trait("an elliptical disc", lambda s: s.source.extent[0] != s.source.extent[1]),
    "line source": Trait("a disc without area", lambda s: _disc(s) and min(s.source.frame) == 0),
}


@dataclass(frozen=True)
class Capability:
    """Something that this program does with a scene."""

    #: As the documents call it.
    name: str
    #: Message of its refusal for each trait that it does not support, in the order in which they are looked for; {} stands for the
    #: words of all traits of the scene with the same message, {setting} for the setting of the trait, {scene} for the scene.
    unsupported: Mapping[str, str]
    #: Why, in a phrase, for the matrix; of traits whose message says no more than that.
    reasons: Mapping[str, str] = field(default_factory=dict)

    @classmethod
    def because(cls, name: str, reasons: Mapping[str, Sequence[str]], message: str) -> Self:
        """From the traits for each reason; message: with {reason} for it, and the rest as in `unsupported` with doubled braces."""
        each = {trait: reason for reason, traits in reasons.items() for trait in traits}
        return cls(name, {trait: message.format(reason=reason) for trait, reason in each.items()}, each)

    def reason(self, trait: str) -> str:
        """Why a trait is not supported, in a phrase; "" where its message gives settings instead."""
        message = self.unsupported[trait]
        return self.reasons.get(trait, "" if set(message) & set("⟨{") else message)

    def obstacle(self, scene: Scene) -> str:
        """The first trait of a scene that is not supported, "" if there is none."""
        return next((name for name in self.unsupported if TRAITS[name].found_in(scene)), "")

    def supports(self, scene: Scene) -> bool:
        """Whether a scene is supported."""
        return not self.obstacle(scene)

    def why_not(self, scene: Scene, **words: str) -> str:
        """Why a scene is not supported, "" if it is; words: further ones of the message."""
        if not (first := self.obstacle(scene)):
            return ""
        message = self.unsupported[first]
        alike = [TRAITS[name].words for name, m in self.unsupported.items() if m == message and TRAITS[name].found_in(scene)]
        return message.format(", ".join(alike), setting=next(iter(TRAITS[first].settings), ""), scene=scene, **words)

    def refuse(self, scene: Scene, **words: str) -> None:
        """Refuse a scene before work begins; arguments as of `why_not`.

        Raises:
            InputError: the scene has a trait that is not supported.
        """
        if why := self.why_not(scene, **words):
            raise InputError(why)
