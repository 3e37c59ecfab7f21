"""Settings that exclude or need each other, and why."""

from __future__ import annotations

from caustic_cli.config.settings import Settings
from caustic_cli.errors import InputError
from caustic_cli.optics.waves.unsupported import WAVES_BY_DEFAULT
from caustic_cli.scene.traits import TRAITS, Capability
from caustic_cli.schema.table import TABLE, default


def _by_settings(capability: Capability) -> dict[str, str]:
    """The messages of a capability for the settings by which a scene gets what it does not support."""
    return {entry: message for trait, message in capability.unsupported.items() for entry in TRAITS[trait].settings}


_SHEET = "⟨target.sheet⟩ needs ⟨+lens.array⟩, and a picture without colours"
_LENSLETS = (
    "⟨lens.array⟩ needs ⟨start⟩ transport, which gives every lenslet its surface, or the lens of a file, network none and optimizer"
    " lbfgs"
)
_TWO_SIDES = {
    "lens.mirror": "⟨lens.mirror⟩ cannot be combined with ⟨{feature}⟩: a mirror has one side, and the direction of the light behind"
    " its picture takes a second one",
    "lens.gradient": "⟨lens.gradient⟩ cannot be combined with ⟨{feature}⟩, whose initial sides are solved for along straight rays"
    " between them",
    "lens.array": "⟨lens.array⟩ cannot be combined with ⟨{feature}⟩: lenslets with two free-form sides each are not implemented",
    "element.free": "⟨element.free⟩ cannot be combined with ⟨{feature}⟩, which designs both sides of the lens instead",
    "design.over": "⟨design.over⟩ cannot be combined with ⟨{feature}⟩: what light does behind the picture is given for one scene",
}

_BOTH = "⟨{feature}⟩ and ⟨{path}⟩ both define the light behind the picture: give one of them"
_SECOND = (("second.file", "second.collimate", "second.focus"), ("second.collimate", "second.focus"), ("second.focus",))

#: Feature -> settings that exclude it -> message.  Both are settings with any value but the default, or with one.  In messages
#: {path} and {value} are those of the setting, {said} both of them, or the path of a flag alone, {default} its default, and
#: {feature} the feature.
EXCLUDED: dict[str, dict[str, str]] = {
    "lens.base_file": {
        "lens.radius": "⟨lens.base_file⟩ and ⟨lens.radius⟩ both give the base surface: give one of them",
        **dict.fromkeys(
            TRAITS["two sides"].settings,
            "⟨lens.base_file⟩ is of a lens with one designed side, without ⟨{path}⟩",
        ),
    },
    "lens.entrance": {
        "lens.mirror": "⟨lens.entrance⟩ parallel needs a lens: light never enters a mirror",
        "lens.gradient": "⟨lens.entrance⟩ parallel cannot be combined with ⟨lens.gradient⟩, whose index counts from a flat side",
        "lens.array": "⟨lens.entrance⟩ parallel is of one lens: on an array every lenslet has a base surface of its own",
        **dict.fromkeys(
            TRAITS["two sides"].settings,
            "⟨{path}⟩ designs the entrance, which ⟨lens.entrance⟩ parallel gives: one of them is possible",
        ),
    },
    "target.sheet": {"target.color": _SHEET},
    "target.color": {
        "source.each": "⟨source.each⟩ is not for a coloured picture",
        "source.also": "[[source]] of a coloured picture must be one, whose three wavelengths are its colours",
        "source.spectrum": "⟨source.spectrum⟩ is not for a coloured picture, whose three wavelengths are its colours",
    },
    **{feature: dict.fromkeys(others, _BOTH) | _TWO_SIDES for feature, *others in _SECOND},
    "lens.gradient free": {
        "lens.mirror": "⟨lens.gradient⟩ free needs a lens: light never enters a mirror",
        "lens.array": "⟨lens.array⟩ cannot be combined with a free gradient, whose index is that of the plate as a whole",
        **dict.fromkeys(("design.network", "design.optimizer"), "⟨{path}⟩ of a free gradient must be {default}, got {value}"),
        "design.waves on": "⟨design.waves⟩ on refines heights, but ⟨lens.gradient⟩ free designs the index, by rays",
    },
    "source.each": {
        "source.also": "⟨source.each⟩ needs one [[source]], of which there is one behind every lenslet",
        "design.waves on": "{said} is not for ⟨source.each⟩: the light of every source has an image behind the whole array",
    },
    "design.over": {
        "design.robust": "⟨design.robust⟩ cannot be combined with ⟨design.over⟩, which draws its scenes anew at every iteration"
    },
}
#: Feature -> settings of which it needs one -> message.
NEEDED: dict[str, tuple[tuple[str, ...], str]] = {
    "target.sheet": (("lens.array",), _SHEET),
    "lens.entrance": (
        ("lens.radius", "lens.base_file"),
        "⟨lens.entrance⟩ parallel needs ⟨+lens.radius⟩ or ⟨+lens.base_file⟩, the outer side",
    ),
    "source.each": (("lens.array",), "⟨source.each⟩ needs ⟨+lens.array⟩, for each of whose lenslets there is a source"),
    "lens.packing": (("lens.array",), "⟨lens.packing⟩ is that of lenslets, which ⟨+lens.array⟩ makes"),
    "lens.lenslets": (("lens.array",), "⟨lens.lenslets⟩ is the shape of lenslets, which ⟨+lens.array⟩ makes"),
    "second.file": (("second.z",), "⟨second.file⟩ needs ⟨+second.z⟩, the distance of its screen"),
    **{
        feature: (TRAITS["two sides"].settings, f"⟨{feature}⟩ belongs to ⟨+second.file⟩, which is not given")
        for feature in ("second.z", "second.size")
    },
}
#: The same as EXCLUDED of what follows from other settings, too.
EXCLUDED_LATER: dict[str, dict[str, str]] = {
    "lens.array": dict.fromkeys(("design.start offset", "design.network", "design.optimizer"), _LENSLETS),
    "design.waves on": {
        "design.network": "⟨design.waves⟩ on needs network none: the wave image is refined by control heights",
    },
    "design.waves auto": {
        **_by_settings(WAVES_BY_DEFAULT),
        "lens.gradient free": "a free gradient is designed by rays",
        "design.network": "a network is trained on rays alone; ⟨network⟩ none refines it",
        "design.optimizer": "{value} was asked for, and the wave image takes lbfgs; ⟨waves⟩ on adds stages that use it",
    },
}


def why_excluded(feature: str, s: Settings) -> str:
    """Why settings exclude a feature, "" if they do not."""
    for entry, message in (EXCLUDED | EXCLUDED_LATER)[feature].items():
        if (value := s.chosen(entry)) is not None:
            path = entry.partition(" ")[0]
            said, usual = f"⟨{path}⟩" if value is True else f"⟨{path}⟩ {value}", default(path) if path in TABLE else ""
            return message.format(path=path, value=value, said=said, default=usual, feature=feature)
    return ""


def refuse_excluded(feature: str, s: Settings) -> None:
    """Refuse settings that exclude a feature.

    Raises:
        InputError: they do.
    """
    if why := why_excluded(feature, s):
        raise InputError(why)


def refuse_contradictions(s: Settings) -> None:
    """Refuse settings of which one excludes another, or needs one that is not there.

    Raises:
        InputError: there are such.
    """
    for feature, (others, message) in NEEDED.items():
        if s.chosen(feature) is not None and all(s.chosen(other) is None for other in others):
            raise InputError(message)
    for feature in EXCLUDED:
        if s.chosen(feature) is not None:
            refuse_excluded(feature, s)
