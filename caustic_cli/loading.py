"""Modules of capabilities that few commands need, loaded when they are first used rather than by every import; the memory of the
process; and its end, which does not take them down."""

from __future__ import annotations

import atexit
import contextlib
import ctypes
import os
import sys
import threading
from importlib import import_module
from typing import Any, NoReturn

#: Parameters of mallopt(3), from glibc's malloc.h.
TRIM_THRESHOLD, MMAP_MAX = -1, -4


class OnDemand:
    """In place of a module: loads it when one of its names is asked for."""

    def __init__(self, name: str):
        self._name = name

    def __getattr__(self, attribute: str) -> Any:
        return getattr(import_module(self._name), attribute)

    def _load(self) -> None:
        with contextlib.suppress(Exception):  # which its first use raises again
            import_module(self._name)


def load_behind(module: OnDemand) -> None:
    """Load a module that is going to be used, in another thread."""
    threading.Thread(target=module._load, name="loading").start()


def leave(status: int) -> NoReturn:
    """End this process after its exit functions, without taking down the libraries, which costs a design 1 s, and in which one of
    three processes of torchrun aborted in two of eight runs with many designs."""
    atexit._run_exitfuncs()
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(status)


def keep_freed_memory() -> None:
    """Reuse freed memory for large arrays, and use huge pages: a third of the time of a design on a net of 3003 x 3003 points was
    spent on clearing new pages (tests/benchmarks/README.md).

    For glibc, whose malloc otherwise maps every large array anew (mallopt(3)); no effect elsewhere.  Call before torch is loaded.
    """
    os.environ.setdefault("THP_MEM_ALLOC_ENABLE", "1")  # read by torch
    if (mallopt := _of_glibc("mallopt")) is not None:
        mallopt(TRIM_THRESHOLD, -1)
        mallopt(MMAP_MAX, 0)


def give_back_freed_memory() -> None:
    """Return it to the system, before work whose arrays have other sizes than the gaps that are free; no effect but on glibc."""
    if (trim := _of_glibc("malloc_trim")) is not None:
        trim(0)


def _of_glibc(name: str) -> Any | None:
    """A function of its allocator, or None where there is none."""
    try:
        return getattr(ctypes.CDLL(None), name)
    except (AttributeError, OSError, TypeError):  # another C library; none by that name
        return None
