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
from numba.core.caching import CompileResultCacheImpl, FunctionCache, UserProvidedCacheLocator

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


class _Place(UserProvidedCacheLocator):
    """Below `cache.DIRECTORY`, which is of one state of the sources, wherever these are installed and whenever they were."""

    def __init__(self, function, file: str):
        assert cache.DIRECTORY is not None
        self._lineno = function.__code__.co_firstlineno
        self._cache_path = str(cache.DIRECTORY / Path(file).resolve().relative_to(cache.PACKAGE).parent)

    @classmethod
    def from_function(cls, function, file: str):
        """The place of a function of a file; None if it cannot be written to, or is no file of this package's."""
        with contextlib.suppress(OSError, ValueError):
            place = cls(function, file)
            place.ensure_cache_path()
            return place

    def get_source_stamp(self) -> str:
        """Nothing: the directory is the stamp."""
        return ""


class _Placed(CompileResultCacheImpl):
    _locator_classes = [_Place]  # noqa: RUF012  # as numba has it


class _Kept(FunctionCache):
    """What numba keeps of a function; a file that cannot be read or written, on a full disk for instance, is as none."""

    _impl_class = _Placed

    def load_overload(self, sig, target_context):
        """The compiled code of a signature, None if none is kept."""
        with contextlib.suppress(OSError, EOFError, pickle.PickleError):
            return super().load_overload(sig, target_context)

    def save_overload(self, sig, data):
        """Keep the compiled code of a signature, if it can be; an index that cannot be read, which is before that, begins anew."""
        with contextlib.suppress(OSError, EOFError, pickle.PickleError):
            try:
                super().save_overload(sig, data)
            except (EOFError, pickle.PickleError):
                self.flush()
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
        compiled = numba.njit(**options)(function)
        if cache.DIRECTORY is not None:
            with contextlib.suppress(RuntimeError):  # it cannot be written to after all: compiled anew in every process
                compiled._cache = _Kept(function)  # as its option `cache` does
        return compiled

    return decorate
