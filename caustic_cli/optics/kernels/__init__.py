"""Compiled CPU kernels of the stages of a trace, each tested against its plain-torch reference; called by `backends.cpu`."""

from __future__ import annotations

import os

#: numba uses OpenMP threads, as torch does.  Its default is TBB, whose parallel loops became slower to start in measurements: from
#: 26 microseconds at first to 500 after 20,000 of them; those of OpenMP take 3 throughout.
THREADING = ["omp", "workqueue", "tbb"]


def blocks() -> int:
    """Number of blocks of rays, each with its own partial sums: the number of torch's threads, which numba uses, too."""
    import torch  # noqa: PLC0415, I001 - first, whose OpenMP numba uses, too

    import numba  # noqa: PLC0415

    if "NUMBA_THREADING_LAYER_PRIORITY" not in os.environ:
        numba.config.THREADING_LAYER_PRIORITY = THREADING  # type: ignore[attr-defined]  # made as numba is loaded
    count = torch.get_num_threads()
    most = numba.config.NUMBA_NUM_THREADS  # type: ignore[attr-defined]  # made as numba is loaded
    numba.set_num_threads(max(1, min(count, most)))
    if torch.get_num_threads() != count:  # numba's OpenMP layer resets the count it shares with torch when it starts
        torch.set_num_threads(count)
    return count
