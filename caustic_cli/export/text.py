"""Numbers as text for the exported files: 17 significant digits, which give every float64 back to the last bit."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from caustic_cli import __version__
from caustic_cli.io.files import CREATED_BY

#: The comment that every text file carries in its first lines, each in its format's own way.
CREATED = f"{CREATED_BY} {__version__}"
#: Rows formatted at a time, which bounds the memory.
BLOCK = 1 << 16


def real(value: float) -> str:
    """17 digits, no more than needed: "0.5", "300", "0.10000000000000001"."""
    return format(float(value), ".17g")


def rows(table: np.ndarray, form: str) -> Iterator[bytes]:
    """The rows of `table` (n, k) through a %-format for one row, some at a time."""
    for start in range(0, len(table), BLOCK):
        some = table[start : start + BLOCK]
        yield (form * len(some) % tuple(some.reshape(-1).tolist())).encode()
