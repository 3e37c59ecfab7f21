"""The free-form entrance of a lens with two free-form sides, and what its light does behind the picture."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from caustic_cli.config.table import check
from caustic_cli.errors import InputError
from caustic_cli.scene.screen import Screen


@dataclass(frozen=True, eq=False)
class Front:
    """A B-spline entrance over the lens' aperture.

    Args:
        heights: (n, m) control heights, counted from the entrance's plane, mm.
        degree, knots: as of a `Lens`.
    """

    heights: np.ndarray
    degree: tuple[int, int]
    knots: tuple[Sequence[float], Sequence[float]] | None = None


@dataclass(frozen=True)
class Second:
    """What light does behind the picture, which a lens with one free-form side has no say in.

    Args:
        screen: farther on, where another picture is; None for light that goes on parallel to the axis, or towards a focus.
        focus: (x, y, z), mm.
    """

    screen: Screen | None = None
    focus: tuple[float, float, float] | None = None

    def __post_init__(self):
        if self.screen is not None and self.focus is not None:
            raise InputError("⟨second.z⟩ and ⟨second.focus⟩ both say what light does behind the picture: give one of them")
        if self.focus is not None:
            check("second.focus", self.focus)

    def check(self, screen: Screen) -> None:
        """Refuse what does not lie behind the picture's screen.

        Raises:
            InputError: saying where it lies.
        """
        if not screen.upright:
            raise InputError("the screen of a lens with two free-form sides must be plane and upright, without ⟨screen.tilt⟩")
        z = self.screen.z if self.screen is not None else self.focus[2] if self.focus is not None else None
        if z is not None and z <= screen.z:
            name = "z" if self.screen is not None else "focus"
            raise InputError(f"⟨second.{name}⟩ must lie behind the picture's screen at {screen.z:g} mm, got z = {z:g} mm")
