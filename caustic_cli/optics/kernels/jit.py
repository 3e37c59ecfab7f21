"""How kernels are compiled: numba's `njit` as all files of this package use it.

Most of the time it takes is LLVM's, which optimises a function by itself and again in everything that calls it.  What this
leaves out for functions that only others call is half of that.
"""

from __future__ import annotations

import contextlib
import pickle
from pathlib import Path
from typing import Any

import numba
from numba import prange
from numba.core.caching import FunctionCache

from caustic_cli.errors import InputError
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

if numba.config.DISABLE_JIT:  # type: ignore[attr-defined]  # kernels call one another by address, which only compiled code has
    raise InputError("the environment's NUMBA_DISABLE_JIT is set, and the kernels run compiled only; unset it")

# Off by default in numba: it turns the steps of four neighbouring pixels in `plane` into vector instructions.
numba.config.SLP_VECTORIZE = 1  # type: ignore[attr-defined]  # numba makes its settings as it is loaded


class _Kept(FunctionCache):
    """What numba keeps of a function; a file that cannot be read or written, on a full disk for instance, is as none."""

    def load_overload(self, sig, target_context):
        """The compiled code of a signature, None if none is kept."""
        with contextlib.suppress(OSError, EOFError, pickle.PickleError):
            return super().load_overload(sig, target_context)

    def save_overload(self, sig, data):
        """Keep the compiled code of a signature, if it can be."""
        with contextlib.suppress(OSError, EOFError, pickle.PickleError):
            super().save_overload(sig, data)


def njit(*, entry: bool = False, parallel: bool = False, **options):
    """The decorator of a function that is compiled when it is first called, and kept in `cache.DIRECTORY` if it can be.

    Args:
        entry: Python calls it.  Otherwise only other such functions do, and it needs no wrapper for that.
        parallel: its loops over `prange` run in parallel; Python calls it.
        options: as of numba.njit.
    """
    if parallel:
        options["parallel"] = dict(PARALLEL)  # numba empties the one it is given
    options |= {
        "error_model": "numpy",
        "no_cfunc_wrapper": True,
        "no_cpython_wrapper": not (entry or parallel),
    }

    def decorate(function):
        compiled, before = numba.njit(**options)(function), numba.config.CACHE_DIR
        if cache.DIRECTORY is not None:
            try:  # numba looks at it here and now: what others compile in this process is kept where they want it
                numba.config.CACHE_DIR = str(cache.DIRECTORY)
                with contextlib.suppress(RuntimeError):  # it cannot be written to after all: compiled anew in every process
                    kept = _Kept(function)
                    if cache.DIRECTORY in Path(kept.cache_path).parents:  # nor kept where numba would otherwise
                        compiled._cache = kept  # as its option `cache` does
            finally:
                numba.config.CACHE_DIR = before
        return compiled

    return decorate
