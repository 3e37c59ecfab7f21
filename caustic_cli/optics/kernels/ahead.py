"""Compilation of kernels ahead of their first use, by processes on the other cores.

They take names of PARTS from standard input, until it is closed, and write to the cache, from which this process loads the kernels.
It compiles itself what it needs before they have begun it, and waits for what they are compiling (`cache.claim`).  They are ended
with it.
"""

from __future__ import annotations

import atexit
import contextlib
import os
import subprocess
import sys
from collections.abc import Callable, Iterable
from itertools import cycle
from typing import IO

import numpy as np

from caustic_cli.loading import OnDemand
from caustic_cli.optics.kernels import cache

multigrid, fields = OnDemand("caustic_cli.optics.kernels.multigrid"), OnDemand("caustic_cli.optics.kernels.fields")
fused = OnDemand("caustic_cli.optics.kernels.fused_functions")
#: Most processes, each of which loads the libraries.
MOST = 3


def _multigrid() -> None:
    """What is compiled of the linear equations of the Newton steps of a transport."""
    start, column, one = np.arange(2, dtype=np.int32), np.zeros(1, np.int32), np.ones(1)
    multigrid.aggregate(start, column, one)
    multigrid.sweep(start, column, one, one, one, one.copy())


#: Parts of the kernels, in the order in which other processes compile them for a design while this one compiles what precedes them
#: in the transport and what it needs first of the surface: one of its kernels, by whose presence in the cache a part is
#: known to be compiled, and a function that calls all of them.  The last four are the evaluation of the surface at rays of a plane
#: wave and its adjoint; the wave image and its adjoint; the image by these rays; and its adjoint.
PARTS: dict[str, tuple[str, Callable[[], None]]] = {
    "multigrid": ("multigrid.sweep", _multigrid),
    "surface": ("spline.pull_coefficients", lambda: fused.compile_surface()),  # noqa: PLW0108
    "fields": ("fields.pull_displacement", lambda: fields.compile_kernels()),  # noqa: PLW0108
    "image": ("random_points.scatter", lambda: fused.compile_image()),  # noqa: PLW0108
    "adjoint": ("fused.backward", lambda: fused.compile_adjoint()),  # noqa: PLW0108
}

_processes: list[subprocess.Popen[str]] = []
_sent: list[str] = []


def is_cached(part: str) -> bool:
    """Whether the cache holds a part, judged by file names; also True if nothing can be cached."""
    place = cache.DIRECTORY
    return place is None or any((place / "optics" / "kernels").glob(f"{PARTS[part][0]}-*.nbi"))


def compile_part(part: str) -> None:
    """Compile one of PARTS into the cache, by calling it; loads it if it is there."""
    PARTS[part][1]()


def compile_behind(parts: Iterable[str], more: bool = False) -> None:
    """Have processes compile those of the parts that are not in the cache, in this order; returns at once.

    more: whether others follow, for which the processes stay.
    """
    wanted = [part for part in parts if part not in _sent and not is_cached(part)]
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    ready = [process.stdin for process in _processes if process.stdin and not process.stdin.closed]
    with contextlib.suppress(OSError):  # where no process can be started, this one compiles everything, when it is needed
        while wanted and len(ready) < min(MOST, cores - 1):
            ready.append(_started())
    for part, pipe in zip(wanted, cycle(ready), strict=False):
        _sent.append(part)
        with contextlib.suppress(OSError):  # it was ended by the user, for instance
            print(part, file=pipe, flush=True)
    for pipe in () if more else ready:
        with contextlib.suppress(OSError):
            pipe.close()


def _started() -> IO[str]:
    """The pipe to a process that compiles the parts it is sent."""
    assert cache.DIRECTORY is not None
    if not _processes:
        atexit.register(_end)
    path = os.pathsep.join([str(cache.PACKAGE.parent), os.environ.get("PYTHONPATH", "")]).rstrip(os.pathsep)
    process = subprocess.Popen(
        [sys.executable, "-P", "-m", __name__],
        env=os.environ | {"PYTHONPATH": path, "NUMBA_CACHE_DIR": str(cache.DIRECTORY.parent)},  # the same cache
        stdin=subprocess.PIPE,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        text=True,
    )
    _processes.append(process)
    assert process.stdin is not None
    return process.stdin


def _end() -> None:
    """End the processes."""
    for process in _processes:
        process.terminate()
    for process in _processes:
        process.wait()


if __name__ == "__main__":
    for line in sys.stdin:
        compile_part(line.strip())
