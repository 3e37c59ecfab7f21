"""What a numerically difficult case is."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any


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

    def worst(self) -> tuple[float, float]:
        """The largest errors of all settings, NaN the largest of all."""
        naive, ours = zip(*map(self.measure, self.settings), strict=True)
        return tuple(max(errors, key=lambda e: (math.isnan(e), e)) for errors in (naive, ours))  # type: ignore[return-value]
