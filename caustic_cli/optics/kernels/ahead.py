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

from caustic_cli.optics.kernels import cache

#: Most processes, each of which loads the libraries.
MOST = 3


def _multigrid() -> None:
    """The linear equations of the Newton steps of a transport, for a chain of sites."""
    from caustic_cli.optics.kernels import multigrid  # noqa: PLC0415

    count = 5 * multigrid.SMALLEST
    sites, one, none = np.arange(count - 1), np.ones(count), np.zeros(0, np.int64)
    end = np.stack([sites + 1, sites], 1).ravel()
    a = multigrid.matrix(end, np.ones(len(end)), one, one, none, none, one[:0])
    multigrid.Multigrid(a).solve(np.linspace(-1.0, 1.0, count), 0.1)


def _surface() -> None:
    """The evaluation of the surface at rays of a plane wave, and its adjoint."""
    from caustic_cli.optics.kernels import fused_functions  # noqa: PLC0415

    fused_functions.compile_surface()


def _refraction() -> None:
    """The rays that are traced for a wave image: a few points of the surface, and refraction."""
    import torch  # noqa: PLC0415

    from caustic_cli.optics.bspline import SplineSpace  # noqa: PLC0415
    from caustic_cli.optics.kernels.refraction import interact  # noqa: PLC0415
    from caustic_cli.optics.kernels.surface import FusedSurface  # noqa: PLC0415

    one, space = torch.ones(1, dtype=torch.float64), SplineSpace.uniform(6, 3)
    interact((0.0, 0.0, 1.0), (0.0 * one, 0.0 * one), one, eta=1.5, fresnel="exact")
    FusedSurface((space, space), (1.0, 1.0)).evaluate(np.zeros((6, 6)), np.ones(1), np.ones(1))


def _fields() -> None:
    """The wave image and its adjoint."""
    from caustic_cli.optics.kernels import fields  # noqa: PLC0415

    fields.compile_kernels()


def _image() -> None:
    """The image by rays of a plane wave."""
    from caustic_cli.optics.kernels import fused_functions  # noqa: PLC0415

    fused_functions.compile_splat()
    fused_functions.scattered_points((0, 0), (0, 0), 0, 1, 1, 1, True)


def _adjoint() -> None:
    """The adjoint of that image."""
    from caustic_cli.optics.kernels import fused_functions  # noqa: PLC0415

    fused_functions.compile_adjoint()


#: Parts of the kernels, in the order in which other processes compile them for a design while this one compiles what precedes them
#: in the transport and what it needs first of the surface: one of its kernels, by whose presence in the cache a part is
#: known to be compiled, and a function that calls all of them.
PARTS: dict[str, tuple[str, Callable[[], None]]] = {
    "multigrid": ("multigrid.sweep", _multigrid),
    "refraction": ("spline.evaluate_net", _refraction),
    "surface": ("spline.pull_coefficients", _surface),
    "fields": ("fields.pull_displacement", _fields),
    "image": ("random_points.scatter", _image),
    "adjoint": ("fused.backward", _adjoint),
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
