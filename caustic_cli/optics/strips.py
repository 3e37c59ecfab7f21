"""Work on large arrays by strips of rows, so that intermediate arrays fit in the cache, on all threads."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

import torch

#: Rows of a strip.
ROWS = 64
T = TypeVar("T")


def each_strip(n: int, work: Callable[[slice], T]) -> list[T]:
    """The results for slices of n rows, ROWS at a time, in their order, computed on torch's number of threads."""
    with ThreadPoolExecutor(torch.get_num_threads()) as pool:
        return list(pool.map(work, (slice(k, min(k + ROWS, n)) for k in range(0, n, ROWS))))
