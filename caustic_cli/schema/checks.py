"""Validation of numbers, choices and environment variables, with messages that give the accepted range."""

from __future__ import annotations

import math
import os
from collections.abc import Sequence

from caustic_cli.errors import InputError

#: Largest height or thickness, mm, and power, W: their squares and products stay within the range of float32.
LENGTH, POWER = 1e9, 1e30


def number(where: str, value, low: float = -math.inf, high: float = math.inf, *, open_low: bool = False) -> float:
    """`value` as a finite float in [low, high], or (low, high] with `open_low`.

    Raises:
        InputError: naming `where`, the accepted range and the value.
    """
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise InputError(f"{where} must be a number, got {value!r}")
    try:
        value = float(value)
    except OverflowError:  # an integer of hundreds of digits
        value = math.inf if value > 0 else -math.inf
    ok = math.isfinite(value) and value <= high and (value > low if open_low else value >= low)
    if not ok:
        raise InputError(f"{where} must be {_range(low, high, open_low)}, got {value:g}")
    return value


def whole(where: str, value, low: float, high: float) -> int:
    """`value` as an int in [low, high]."""
    if isinstance(value, bool) or not isinstance(value, int) or not low <= value <= high:
        raise InputError(f"{where} must be a whole number {low} to {high}, got {value!r}")
    return value


def pair(where: str, value, check) -> tuple:
    """Two numbers, each through `check(where, element)`."""
    if isinstance(value, str) or not isinstance(value, Sequence) or len(value) != 2:
        raise InputError(f"{where} must be a pair [x, y], got {value!r}")
    return check(where, value[0]), check(where, value[1])


def choice(where: str, value, names: Sequence[str]) -> str:
    """`value` if it is one of `names`."""
    if value not in names:
        raise InputError(f"{where} must be one of {', '.join(filter(None, names))}, got {value!r}")
    return value


def of_environment(name: str, default: int | None, low: int, high: int) -> int:
    """An environment variable as an int in [low, high]; without a default it is required.

    Raises:
        InputError: naming the variable, the accepted range and the value.
    """
    text = os.environ.get(name)
    if text is None and default is not None:
        return default
    value = int(text) if text and text.isascii() and text.isdigit() and len(text) < 20 else None
    if value is None or not low <= value <= high:
        raise InputError(f"the environment's {name} must be a whole number {low} to {high}, got {text!r}")
    return value


def rank_and_size() -> tuple[int, int]:
    """Rank of this process and number of processes, from torchrun's environment variables; (0, 1) without torchrun.

    Raises:
        InputError: RANK or WORLD_SIZE is invalid.
    """
    size = of_environment("WORLD_SIZE", 1, 1, 10**6)
    of_environment("RANK", 0, 0, 10**6)
    if size == 1 or "MASTER_ADDR" not in os.environ:
        return 0, 1
    return of_environment("RANK", None, 0, size - 1), size


def _range(low: float, high: float, open_low: bool) -> str:
    if math.isinf(high):
        if math.isinf(low):
            return "finite"
        return f"greater than {low:g}" if open_low else f"at least {low:g}"
    return f"greater than {low:g} and at most {high:g}" if open_low else f"{low:g} to {high:g}"
