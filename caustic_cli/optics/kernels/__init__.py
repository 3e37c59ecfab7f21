"""Fused CPU kernels behind the functions of `optics`, each tested against its plain-torch reference.

`fused(device)` says whether they are used: on the CPU, unless CAUSTIC_KERNELS=torch asks for the reference.
"""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator

import torch


def fused(device: torch.device | str) -> bool:
    """Whether arrays on `device` are handled by the kernels."""
    return torch.device(device).type == "cpu" and os.environ.get("CAUSTIC_KERNELS", "") != "torch"


@contextlib.contextmanager
def plain() -> Iterator[None]:
    """Rays prepared meanwhile go by the plain-torch reference."""
    before = os.environ.get("CAUSTIC_KERNELS")
    os.environ["CAUSTIC_KERNELS"] = "torch"
    try:
        yield
    finally:
        if before is None:
            del os.environ["CAUSTIC_KERNELS"]
        else:
            os.environ["CAUSTIC_KERNELS"] = before


def precision(dtype: torch.dtype, device: torch.device | str) -> torch.dtype:
    """Of rays on `device` for which `dtype` was asked: the kernels' arithmetic is float64, in which they are no slower."""
    return torch.float64 if fused(device) else dtype


#: numba's threads are OpenMP's, as torch's are.  By itself it takes TBB first, whose parallel loops started ever more slowly here:
#: in 26 microseconds at first, in 500 after 20,000 of them; OpenMP's in 3 throughout.
THREADING = ["omp", "workqueue", "tbb"]


def blocks() -> int:
    """Blocks to cut the rays into, each with sums of its own: torch's threads, which numba's follow, so --threads decides."""
    import numba  # noqa: PLC0415

    if "NUMBA_THREADING_LAYER_PRIORITY" not in os.environ:
        numba.config.THREADING_LAYER_PRIORITY = THREADING
    count = torch.get_num_threads()
    numba.set_num_threads(max(1, min(count, numba.config.NUMBA_NUM_THREADS)))
    if torch.get_num_threads() != count:  # numba's OpenMP layer resets the count it shares with torch when it starts
        torch.set_num_threads(count)
    return count
