"""Kinds of design, one file each: what applies, how settings are completed, unknowns, initial surface, loss, evaluation, messages.

Every kind is a subclass of `surface.OneSurface`, a `Problem` for the stage loop (`inverse.designer`).  A new one is a file here and
a place in KINDS; nothing else asks which kind a design is of.
"""

from __future__ import annotations

from caustic_cli.config.settings import Settings
from caustic_cli.kinds.defaults import Defaults
from caustic_cli.kinds.elements import AmongElements, FreeElements
from caustic_cli.kinds.gradient_index import IndexPlate
from caustic_cli.kinds.lenslet_array import LensletArray
from caustic_cli.kinds.network_range import NetworkAmongElements, NetworkOverRange
from caustic_cli.kinds.robust import RobustAmongElements, RobustArray, RobustSurface
from caustic_cli.kinds.surface import Described, OneSurface
from caustic_cli.kinds.two_sides import TwoSides

#: All kinds; a design is of the first that applies.
KINDS: tuple[type[OneSurface], ...] = (
    IndexPlate,
    TwoSides,
    FreeElements,
    NetworkAmongElements,
    NetworkOverRange,
    RobustAmongElements,
    AmongElements,
    RobustArray,
    LensletArray,
    RobustSurface,
    OneSurface,
)


def kind_of(s: Settings) -> type[OneSurface]:
    """The kind of the design of these settings."""
    return next(kind for kind in KINDS if kind.applies(s))


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
