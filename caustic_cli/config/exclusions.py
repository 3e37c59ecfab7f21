"""Settings that exclude each other, and why: one table."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from caustic_cli.config.settings import Settings
from caustic_cli.config.table import TABLE, default
from caustic_cli.errors import InputError
from caustic_cli.optics.waves.unsupported import WAVE_REFINEMENT, WAVES_BY_DEFAULT
from caustic_cli.scene.elements import NOT_BESIDE
from caustic_cli.scene.traits import TRAITS, Capability


def _by_settings(capability: Capability) -> dict[str, str]:
    """The messages of a capability for the settings by which a scene gets what it does not support."""
    return {entry: message for trait, message in capability.unsupported.items() for entry in TRAITS[trait].settings}


_SIDES = "⟨{path}⟩ cannot be combined with ⟨{feature}⟩, which needs two free-form sides of heights by lbfgs"
_LENSLETS = (
    "⟨lens.array⟩ needs ⟨start⟩ transport, which gives every lenslet its surface, or the lens of a file, network none and optimizer"
    " lbfgs"
)
_FREE_INDEX = "⟨{path}⟩ of a free gradient must be {default}, got {value}"

#: Feature -> what excludes it -> message: a setting with any value but the default, or with one.  In messages {path} and {value}
#: are those of that setting, {said} both of them, or the path of a flag alone, {default} its default, and {feature} the setting by
#: which the feature was asked for.
EXCLUDED: Mapping[str, Mapping[str, str]] = {
    "second": {
        **dict.fromkeys(("lens.mirror", "target.color", "lens.gradient", "lens.array"), _SIDES),
        **dict.fromkeys(("design.robust", "design.network", "design.optimizer"), _SIDES),
        **dict.fromkeys(("source.also", "source.type rays"), "⟨{feature}⟩ needs one source that is no ray file"),
    },
    "element": {
        **dict.fromkeys(TRAITS["two sides"].settings, "⟨{path}⟩" + NOT_BESIDE),
        **dict.fromkeys(("design.robust", "design.waves on", "lens.gradient"), "{said}" + NOT_BESIDE),
    },
    "element.free": dict.fromkeys(
        ("design.network", "design.optimizer", "target.color"),
        "{said} cannot be combined with ⟨element.free⟩: it is not implemented beside other free surfaces",
    ),
    "lens.array": dict.fromkeys(("design.start offset", "design.network", "design.optimizer"), _LENSLETS),
    "lens.gradient free": {
        "lens.array": "⟨lens.array⟩ cannot be combined with a free gradient, whose sides are flat",
        "target.color": "⟨target.color⟩ is not for a free gradient, whose index is designed at one wavelength",
        "design.robust": "{said} averages over errors of a designed surface, but ⟨lens.gradient⟩ free designs the index",
        **dict.fromkeys(("design.network", "design.optimizer", "design.loss"), _FREE_INDEX),
        "design.waves on": WAVE_REFINEMENT.unsupported["gradient index"],
    },
    "target.color": {"source.also": "[[source]] of a coloured picture must be one, whose three wavelengths are its colours"},
    "design.over": {"design.robust": "⟨design.robust⟩ cannot be combined with ⟨design.over⟩, which is a mean over scenes already"},
    "design.waves on": {
        "design.network": "⟨design.waves⟩ on needs network none: the wave image is refined by control heights",
        **_by_settings(WAVE_REFINEMENT),
    },
    "design.waves auto": {
        **_by_settings(WAVES_BY_DEFAULT),
        "design.network": "a network is trained on rays alone; ⟨network⟩ none refines it",
        "design.optimizer": "{value} was asked for, and the wave image takes lbfgs; ⟨waves⟩ on adds stages that use it",
    },
}


def _default(path: str) -> Any:
    return default(path) if path in TABLE else ()


def _found(path: str, s: Settings) -> Any:
    """The value of a setting, or the tables of elements; None for the default."""
    value = s.elements if path == "element" else s.value(path)
    plane = path == "screen.radius" and value is not None and all(map(math.isinf, value))
    return None if plane or value == _default(path) else value


def why_excluded(feature: str, s: Settings, by: str = "") -> str:
    """Why settings exclude a feature, "" if they do not; by: the path of the setting that asks for it."""
    for entry, message in EXCLUDED[feature].items():
        path, _, only = entry.partition(" ")
        value = _found(path, s)
        if value == only if only else value is not None:
            said = f"⟨{path}⟩" if value is True else f"⟨{path}⟩ {value}"
            return message.format(path=path, value=value, said=said, default=_default(path), feature=by or feature)
    return ""


def refuse_excluded(feature: str, s: Settings, by: str = "") -> None:
    """Refuse settings that exclude a feature; arguments as of `why_excluded`.

    Raises:
        InputError: they do.
    """
    if why := why_excluded(feature, s, by):
        raise InputError(why)
