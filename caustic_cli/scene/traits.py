"""What a scene may have beyond the simplest one, and what each capability of this program does not support of it.

The simplest scene is a clear lens of one refractive index with a flat entrance, unpolarised light of one wavelength from one
source, and a plane screen, upright and centred on the axis.  Whatever does not support every trait (an export format, the
interactive page, a study) says so in one `Capability`, from which its refusals and the matrix in the documents are made.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass

from caustic_cli.errors import InputError
from caustic_cli.scene import Scene


@dataclass(frozen=True)
class Trait:
    """Something that a scene may have: a noun phrase for messages, and whether a scene has it."""

    words: str
    found_in: Callable[[Scene], bool]


#: All traits by name, in the order in which messages list them.
TRAITS: Mapping[str, Trait] = {
    "mirror": Trait("a mirror", lambda s: s.lens.mirror),
    "gradient index": Trait("an index that varies", lambda s: s.lens.gradient is not None),
    "two sides": Trait("a free-form entrance", lambda s: s.two_sided),
    "other elements": Trait("other elements beside it", lambda s: bool(s.unfolded.elements)),
    "lenslet array": Trait("lenslets", lambda s: s.lens.arrayed),
    "circular aperture": Trait("a circular aperture", lambda s: s.lens.opening.round),
    "absorption": Trait("absorption", lambda s: s.lens.absorption > 0 or any(e.absorption > 0 for e in s.elements)),
    "roughness": Trait("roughness", lambda s: s.lens.roughness > 0),
    "polarisation": Trait("polarised light", lambda s: s.light.polarisation is not None),
    "several wavelengths": Trait("several wavelengths", lambda s: len(s.light.wavelengths) > 1),
    "tilted screen": Trait("a tilted screen", lambda s: any(s.screen.tilt)),
    "shifted screen": Trait("a shifted screen", lambda s: any(s.screen.shift)),
    "curved screen": Trait("a curved screen", lambda s: s.screen.curved),
    "several sources": Trait("several sources", lambda s: len(s.source.members) > 1),
    "ray file": Trait("the rays of a file", lambda s: any(one.rays is not None for one in s.source.members)),
}


def traits_of(scene: Scene) -> Iterator[str]:
    """Names of the traits that a scene has, in their order."""
    return (name for name, trait in TRAITS.items() if trait.found_in(scene))


@dataclass(frozen=True)
class Capability:
    """Something this program does with a scene: name, as the documents say it, and for each trait that it does not support the
    message of its refusal, in which {} stands for all traits of the scene that have the same message."""

    name: str
    unsupported: Mapping[str, str]

    def why_not(self, scene: Scene) -> str:
        """Why a scene is not supported; "" if it is."""
        there = [name for name in self.unsupported if TRAITS[name].found_in(scene)]
        if not there:
            return ""
        message = self.unsupported[there[0]]
        return message.format(", ".join(TRAITS[name].words for name in there if self.unsupported[name] == message))

    def refuse(self, scene: Scene) -> None:
        """Refuse a scene before work begins.

        Raises:
            InputError: the scene has a trait that is not supported.
        """
        if why := self.why_not(scene):
            raise InputError(why)
