"""Kinds of design, one file each: what applies, how settings are completed, unknowns, initial surface, loss, evaluation, messages.

Every kind is a subclass of `surface.OneSurface`, a `Problem` for the stage loop (`inverse.designer`).  A new one is a file here and
a place in KINDS; nothing else asks which kind a design is of.
"""

from __future__ import annotations

from importlib import import_module
from typing import cast

from caustic_cli.config.settings import Settings
from caustic_cli.kinds.defaults import Defaults
from caustic_cli.kinds.surface import Described, OneSurface

#: All kinds beside a single surface, each with the setting or section without which it does not apply and is not loaded; a design
#: is of the first that applies.
KINDS = (
    ("element.free", "robust.RobustGradedElements"),
    ("element.free", "gradient_index.GradedElements"),
    ("lens.with_surface", "robust.RobustGradedLens"),
    ("lens.with_surface", "gradient_index.GradedLens"),
    ("lens.gradient", "robust.RobustPlate"),
    ("lens.gradient", "gradient_index.IndexPlate"),
    ("design.robust", "robust.RobustTwoSidesAmongElements"),
    ("second", "two_sided.TwoSidesAmongElements"),
    ("design.robust", "robust.RobustTwoSides"),
    ("second", "two_sided.TwoSides"),
    ("design.robust", "robust.RobustElements"),
    ("element", "elements.FreeElements"),
    ("design.over", "network_range.NetworkAmongElements"),
    ("design.over", "network_range.NetworkOverRange"),
    ("design.robust", "robust.RobustAmongElements"),
    ("element", "elements.AmongElements"),
    ("design.robust", "robust.RobustArray"),
    ("lens.array", "lenslet_array.LensletArray"),
    ("design.robust", "robust.RobustSurface"),
)


def kind_of(s: Settings) -> type[OneSurface]:
    """The kind of the design of these settings."""
    for setting, name in KINDS:
        if s.chosen(setting) is not None:
            module, _, title = name.partition(".")
            kind = cast(type[OneSurface], getattr(import_module(f"{__name__}.{module}"), title))
            if kind.applies(s):
                return kind
    return OneSurface


def problem_of(described: Described, device: str = "cpu") -> OneSurface:
    """The problem that the design of a project solves.

    Raises:
        InputError: scene, targets, stages or options are invalid.
    """
    return kind_of(described.settings).of(described, device)


def complete_design(wanted: Defaults) -> Settings:
    """Settings with [design], its stages and the control net of a lens completed, all other sections being complete.

    Raises:
        InputError: a value is out of range, or two contradict each other.
    """
    wanted.refuse_given_stages()
    kind_of(wanted.s).complete(wanted)
    return wanted.s
