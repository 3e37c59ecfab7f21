"""Compilation of kernels: the configuration of numba's `njit` that all files of this package use.

Most of the compilation time is spent in LLVM, which optimises a function by itself and again in everything that calls it.  Omitting
the wrappers of functions that are called by compiled code only halves it.
"""

from __future__ import annotations

import contextlib
import pickle
from pathlib import Path
from typing import Any

import numba
from numba import prange
from numba.core.caching import CompileResultCacheImpl, FunctionCache, UserProvidedCacheLocator
from numba.core.dispatcher import Dispatcher

from caustic_cli.errors import InputError
from caustic_cli.optics.kernels import cache

__all__ = ["FAST", "PARALLEL", "SUMS", "njit", "prange"]

#: Sums of products may be contracted, and zeros lose their sign; no sum is reordered, no NaN or infinity assumed away.
FAST: dict[str, Any] = {"fastmath": {"contract", "nsz"}}
#: Sums over many numbers, whose order is left to the compiler.
SUMS: dict[str, Any] = {"fastmath": {"contract", "nsz", "reassoc"}}
#: Loops over `prange` run in parallel, and nothing else: every array that is filled would be a parallel loop of its own.
OTHER_LOOPS = ("comprehension", "reduction", "inplace_binop", "setitem", "numpy", "stencil", "fusion")
PARALLEL = {"prange": True} | dict.fromkeys(OTHER_LOOPS, False)

if numba.config.DISABLE_JIT:  # type: ignore[attr-defined]  # kernels call one another by address, which only compiled code has
    raise InputError("the environment's NUMBA_DISABLE_JIT is set, and the kernels run compiled only; unset it")

# Off by default in numba: it turns the steps of four neighbouring pixels in `fused` into vector instructions.
numba.config.SLP_VECTORIZE = 1  # type: ignore[attr-defined]  # numba makes its settings as it is loaded


class _Place(UserProvidedCacheLocator):
    """A cache location below `cache.DIRECTORY`, which belongs to one state of the sources, independent of path and time stamp."""

    def __init__(self, function, file: str):
        assert cache.DIRECTORY is not None
        self._lineno = function.__code__.co_firstlineno
        self._cache_path = str(cache.DIRECTORY / Path(file).resolve().relative_to(cache.PACKAGE).parent)

    @classmethod
    def from_function(cls, function, file: str):
        """The cache location of a function; None if it is not writable, or the file does not belong to this package."""
        with contextlib.suppress(OSError, ValueError):
            place = cls(function, file)
            place.ensure_cache_path()
            return place

    def get_source_stamp(self) -> str:
        """Constant, since the directory identifies the sources."""
        return ""


class _Placed(CompileResultCacheImpl):
    _locator_classes = [_Place]  # noqa: RUF012  # as numba has it


class _Kept(FunctionCache):
    """The cache of a function's compiled code; files that cannot be read or written, for instance on a full disk, are ignored."""

    _impl_class = _Placed

    def _index_key(self, sig, codegen):
        """What distinguishes compiled codes of one source: of functions made in others, also the functions these are made of, by
        their names.  Numba compares what they hold, which is never the same in another process."""
        return sig, codegen.magic_tuple(), _made_of(self._py_func)

    def load_overload(self, sig, target_context):
        """The compiled code of a signature, from another process if one is compiling it; None if there is none in the cache, and
        other processes wait for this one from then on."""
        found = self._stored(sig, target_context)
        if found is None:
            cache.claim(self._impl.filename_base)
            found = self._stored(sig, target_context)
            if found is not None:
                cache.release(self._impl.filename_base)
        return found

    def _stored(self, sig, target_context):
        with contextlib.suppress(OSError, EOFError, pickle.PickleError):
            return super().load_overload(sig, target_context)

    def save_overload(self, sig, data):
        """Store the compiled code of a signature, if possible; an unreadable index is replaced."""
        with contextlib.suppress(OSError, EOFError, pickle.PickleError):
            try:
                super().save_overload(sig, data)
            except (EOFError, pickle.PickleError):
                self.flush()
                super().save_overload(sig, data)
        cache.release(self._impl.filename_base)


def _made_of(function) -> tuple:
    """Names of a function and, recursively, of those that it is made of; and other values."""
    cells = [cell.cell_contents for cell in function.__closure__ or ()]
    made = [_made_of(v.py_func) if isinstance(v, Dispatcher) else v for v in cells]
    return function.__module__, function.__qualname__, *made


def njit(*, entry: bool = False, parallel: bool = False, **options):
    """Decorator of a function that is compiled when first called, and cached in `cache.DIRECTORY` if possible.

    Args:
        entry: the function is called from Python; otherwise only from compiled code, and no wrapper is generated.
        parallel: its loops over `prange` run in parallel; implies `entry`.
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
