"""How kernels are compiled: numba's `njit` as all files of this package use it.

Most of the time it takes is LLVM's, which optimises a function by itself and again in everything that calls it.  What this
leaves out for functions that only others call is half of that.
"""

from __future__ import annotations

from typing import Any

import numba
from numba import prange

from caustic_cli.optics.kernels import cache

__all__ = ["FAST", "PARALLEL", "njit", "prange"]

#: Sums of products may be contracted, and zeros lose their sign; no sum is reordered, no NaN or infinity assumed away.
FAST: dict[str, Any] = {"fastmath": {"contract", "nsz"}}
#: Loops over `prange` run in parallel, and nothing else: every array that is filled would be a parallel loop of its own.
PARALLEL = {
    "prange": True,
    "comprehension": False,
    "reduction": False,
    "inplace_binop": False,
    "setitem": False,
    "numpy": False,
    "stencil": False,
    "fusion": False,
}

# Off by default in numba: it turns the steps of four neighbouring pixels in `plane` into vector instructions.
numba.config.SLP_VECTORIZE = 1  # type: ignore[attr-defined]  # numba makes its settings as it is loaded


def njit(*, entry: bool = False, parallel: bool = False, **options):
    """The decorator of a function that is compiled when it is first called, and kept in `cache.DIRECTORY`.

    Args:
        entry: Python calls it.  Otherwise only other such functions do, and it needs no wrapper for that.
        parallel: its loops over `prange` run in parallel; Python calls it.
        options: as of numba.njit.
    """
    if parallel:
        options["parallel"] = dict(PARALLEL)  # numba empties the one it is given
    options |= {
        "cache": cache.DIRECTORY is not None,
        "error_model": "numpy",
        "no_cfunc_wrapper": True,
        "no_cpython_wrapper": not (entry or parallel),
    }

    def decorate(function):
        before = numba.config.CACHE_DIR
        try:  # numba looks at it here and now: what others compile in this process is kept where they want it
            numba.config.CACHE_DIR = str(cache.DIRECTORY or "")
            return numba.njit(**options)(function)
        finally:
            numba.config.CACHE_DIR = before

    return decorate
