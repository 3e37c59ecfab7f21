"""What a numerically difficult case is."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import cached_property
from typing import Any


def largest(errors: Iterable[float]) -> float:
    """The largest of these errors; NaN is larger than any."""
    return max(errors, key=lambda e: (math.isnan(e), e))


@dataclass(frozen=True)
class Case:
    """A family of difficult inputs.

    Args:
        family: its name.
        error_of: what the errors are those of, and their unit.
        naively: what the naive formula does, in a few words.
        bound: largest error that counts as right.
        measure: setting -> errors (of the naive formula, of this program).
        settings: the inputs.
    """

    family: str
    error_of: str
    naively: str
    bound: float
    measure: Callable[[Any], tuple[float, float]]
    settings: tuple

    @cached_property
    def errors(self) -> dict[Any, tuple[float, float]]:
        """Setting -> errors (of the naive formula, of this program), measured once."""
        return {setting: self.measure(setting) for setting in self.settings}

    def worst(self) -> tuple[float, float]:
        """The largest errors of all settings, NaN the largest of all."""
        naive, ours = zip(*self.errors.values(), strict=True)
        return largest(naive), largest(ours)
