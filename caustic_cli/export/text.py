"""Formatting of numbers for text files: 17 significant digits, from which every float64 is recovered exactly."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from caustic_cli import __version__
from caustic_cli.io.files import CREATED_BY

#: Comment in the first lines of every text file.
CREATED = f"{CREATED_BY} {__version__}"
#: Rows formatted at a time, which bounds the memory.
BLOCK = 1 << 16


def real(value: float) -> str:
    """At most 17 significant digits: "0.5", "300", "0.10000000000000001"."""
    return format(float(value), ".17g")


def rows(table: np.ndarray, form: str) -> Iterator[bytes]:
    """The rows of `table` (n, k), formatted by a %-format for one row, in blocks."""
    for start in range(0, len(table), BLOCK):
        some = table[start : start + BLOCK]
        yield (form * len(some) % tuple(some.reshape(-1).tolist())).encode()
