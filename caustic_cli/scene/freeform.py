"""A second free-form surface as data, and the target that it allows the light to meet behind the first picture."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
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

    def at(self, u: np.ndarray, v: np.ndarray) -> np.ndarray:
        """Heights (k, l), mm, at positions u (k,), v (l,) of the aperture in its half widths; beyond -1 and 1 its outer pieces are
        continued."""
        dense = []
        for c, n, p, t in zip((u, v), self.heights.shape, self.degree, self._knots, strict=True):
            first, values = _basis(0.5 * (c + 1.0), p, t)
            dense.append(np.zeros((len(c), n)))
            dense[-1][np.arange(len(c))[:, None], first[:, None] + np.arange(p + 1)] = values
        return dense[0] @ self.heights @ dense[1].T

    def at_points(self, u: np.ndarray, v: np.ndarray, order: tuple[int, int] = (0, 0)) -> np.ndarray:
        """A derivative by u and v, each at most the first, at points (N,): (N,) mm."""
        (i, bu), (j, bv) = (
            _basis(0.5 * (c + 1.0), p, t, k) for c, p, t, k in zip((u, v), self.degree, self._knots, order, strict=True)
        )
        parts = (
            bu[:, a] * bv[:, b] * self.heights[i + a, j + b] for a in range(self.degree[0] + 1) for b in range(self.degree[1] + 1)
        )
        return sum(parts, np.zeros(len(u))) * 0.5 ** sum(order)

    @cached_property
    def _knots(self) -> tuple[np.ndarray, np.ndarray]:
        u, v = (
            np.concatenate([np.zeros(p), np.linspace(0.0, 1.0, n - p + 1), np.ones(p)]) if t is None else np.asarray(t, float)
            for n, p, t in zip(self.heights.shape, self.degree, self.knots or (None, None), strict=True)
        )
        return u, v

    def scaled(self, factor: float) -> FreeForm:
        """Larger by a factor."""
        return replace(self, heights=factor * self.heights)


def _basis(at: np.ndarray, degree: int, t: np.ndarray, order: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """The basis functions of knots t that are not 0 at points (N,), or their first derivatives, by the Cox-de Boor recursion:
    number of the first (N,) and values (N, degree + 1); beyond the ends those of the outer spans."""
    span = np.clip(np.searchsorted(t, at, "right") - 1, degree, len(t) - degree - 2)
    found = np.ones((len(at), 1))
    for q in range(1, degree + 1):
        low, high = (t[span[:, None] + shift + np.arange(q)] for shift in (1 - q, 1))
        over = found / (high - low)
        last = order and q == degree
        rising, falling = (q * over, -q * over) if last else ((at[:, None] - low) * over, (high - at[:, None]) * over)
        found = np.pad(rising, ((0, 0), (1, 0))) + np.pad(falling, ((0, 0), (0, 1)))
    return span - degree, found


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
