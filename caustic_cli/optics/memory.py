"""Out of memory: the same work with fewer rays at a time.

Memory is taken by the rays of one chunk, and their number changes nothing but the rounding of sums.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

import torch

from caustic_cli.errors import CausticError, is_out_of_memory

#: Fewer rays at a time than these save nothing that matters.
LEAST = 1 << 14
T = TypeVar("T")


def smaller_chunk(chunk: int, problem: BaseException) -> int:
    """The number of rays to try next after memory ran out with `chunk` of them.

    Raises:
        CausticError: it is too small already.
        BaseException: `problem` itself, if it is not about memory.
    """
    if not is_out_of_memory(problem):
        raise problem
    if chunk <= LEAST:
        raise CausticError(
            f"out of memory, even with {chunk:,} rays at a time; a smaller ⟨control⟩ or ⟨resolution⟩ needs less"
        ) from problem
    if torch.cuda.is_available():
        torch.cuda.empty_cache()
    return max(LEAST, chunk // 4)


def with_smaller_chunks(work: Callable[[int], T], chunk: int) -> T:
    """`work(chunk)`, again with fewer rays at a time for as long as memory runs out (see `smaller`)."""
    while True:
        try:
            return work(chunk)
        except (MemoryError, RuntimeError) as error:
            problem = error.with_traceback(None)  # which would hold all that was allocated
        chunk = smaller_chunk(chunk, problem)
