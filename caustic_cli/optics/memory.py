"""Recovery from out-of-memory errors: the work is repeated with smaller chunks of rays.

Memory use is proportional to the rays of a chunk, whose number changes nothing but the rounding of sums.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

import torch

from caustic_cli.errors import CausticError, is_out_of_memory

#: Least number of rays in a chunk: smaller ones save no memory of note.
LEAST = 1 << 14
T = TypeVar("T")


def smaller_chunk(chunk: int, problem: BaseException) -> int:
    """The chunk size to try after memory ran out with `chunk` rays.

    Raises:
        CausticError: `chunk` is the least size already.
        BaseException: `problem` itself, if it is not an out-of-memory error.
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
    """`work(chunk)`, repeated with smaller chunks while memory runs out (see `smaller_chunk`)."""
    while True:
        try:
            return work(chunk)
        except (MemoryError, RuntimeError) as error:
            if not is_out_of_memory(error):
                raise
            problem = error.with_traceback(None)  # whose frames hold everything that was allocated
        chunk = smaller_chunk(chunk, problem)
