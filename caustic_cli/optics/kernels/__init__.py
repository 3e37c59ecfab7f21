"""CPU kernels behind the stages of a trace, each tested against its plain-torch reference; `backends.cpu` calls them."""

from __future__ import annotations

import os

import torch

#: numba's threads are OpenMP's, as torch's are.  By itself it takes TBB first, whose parallel loops started ever more slowly here:
#: in 26 microseconds at first, in 500 after 20,000 of them; OpenMP's in 3 throughout.
THREADING = ["omp", "workqueue", "tbb"]


def blocks() -> int:
    """Blocks to cut the rays into, each with sums of its own: torch's threads, which numba's follow."""
    import numba  # noqa: PLC0415

    if "NUMBA_THREADING_LAYER_PRIORITY" not in os.environ:
        numba.config.THREADING_LAYER_PRIORITY = THREADING  # type: ignore[attr-defined]  # made as numba is loaded
    count = torch.get_num_threads()
    most = numba.config.NUMBA_NUM_THREADS  # type: ignore[attr-defined]  # made as numba is loaded
    numba.set_num_threads(max(1, min(count, most)))
    if torch.get_num_threads() != count:  # numba's OpenMP layer resets the count it shares with torch when it starts
        torch.set_num_threads(count)
    return count
