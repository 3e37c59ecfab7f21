"""A second free-form surface as data, and the target that it allows the light to meet behind the first picture."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from operator import mul

import numpy as np

from caustic_cli.errors import InputError
from caustic_cli.scene.screen import Screen
from caustic_cli.schema.table import check


@dataclass(frozen=True, eq=False)
class FreeForm:
    """A free-form surface with known control heights: a B-spline height field over an aperture."""

    #: (n, m) control heights above the vertex plane, mm.
    heights: np.ndarray
    #: As for `Lens`.
    degree: tuple[int, int]
    knots: tuple[Sequence[float], Sequence[float]] | None = None

    def scaled(self, factor: float) -> FreeForm:
        """Larger by a factor."""
        return replace(self, heights=factor * self.heights)


@dataclass(frozen=True)
class SecondTarget:
    """What the light must do behind the first picture: form a second picture, converge to a focus, or leave collimated.

    It takes two free-form surfaces: one determines where light arrives, two also determine its direction there.

    Raises:
        InputError: both are given, or a value is out of range.
    """

    #: Screen of the second picture; None for collimated or focused light.
    screen: Screen | None = None
    #: (x, y, z), mm; None for collimated light, or a second picture.
    focus: tuple[float, float, float] | None = None

    def __post_init__(self):
        if self.screen is not None and self.focus is not None:
            raise InputError("⟨second.z⟩ and ⟨second.focus⟩ both define the light behind the picture: give one of them")
        if self.focus is not None:
            check("second.focus", self.focus)

    @property
    def setting(self) -> str:
        """Path of the setting that defines it."""
        return "second.file" if self.screen is not None else "second.collimate" if self.focus is None else "second.focus"

    def check(self, screen: Screen) -> None:
        """Check that the target lies behind the first picture's screen.

        Raises:
            InputError: it does not, or that screen is the far field.
        """
        if screen.far:
            raise InputError(
                f"⟨{self.setting}⟩ says what light does behind the picture, and nothing is behind the far field: it needs a screen"
                " at a distance"
            )
        place = self.screen.centre if self.screen is not None else self.focus
        if place is None:
            return
        away = [a - b for a, b in zip(place, screen.centre, strict=True)]
        normal = screen.axes[2]
        if not sum(map(mul, away, normal)) * normal[2] > 0:
            name = "z" if self.screen is not None else "focus"
            raise InputError(f"⟨second.{name}⟩ must lie behind the picture's screen at {screen.z:g} mm, got z = {place[2]:g} mm")
