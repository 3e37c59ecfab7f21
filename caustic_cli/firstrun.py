"""The first run on a machine compiles the kernels: their parts side by side, in processes of their own.

numba keeps what it has compiled in files, where this process finds it afterwards; what another has not compiled after all, it
compiles itself.
"""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import torch

from caustic_cli.optics.kernels import functions, plane

#: What is compiled by itself, and about how long that takes, s.
PARTS = {"splat": 32, "surface": 25, "adjoint": 24, "transport": 18}
DTYPES = (torch.float32, torch.float64)


def kept() -> bool:
    """Whether numba has the kernels of an earlier run of this version, as far as their names and times tell."""
    path, written = Path(plane.backward.stats.cache_path), Path(plane.__file__).stat().st_mtime
    return any(p.stat().st_mtime >= written for p in path.glob("plane.backward-*.nbi"))


def compile_part(part: str) -> None:
    """Have one of PARTS compiled, and kept, by calling it."""
    if part == "splat":
        functions.compile_splat(*DTYPES)
    elif part == "adjoint":
        functions.compile_adjoint(*DTYPES)
    elif part == "surface":
        functions.compile_surface(*DTYPES)
    else:
        from caustic_cli.inverse import transport  # noqa: PLC0415

        for light in (np.ones((8, 8)), np.arange(1.0, 65.0).reshape(8, 8)):
            transport.solve(light, np.ones((64, 64)), (1.0, 1.0), (1.0, 1.0))


def shares(processes: int) -> list[list[str]]:
    """PARTS in so many lists that take about as long as each other, the longest first."""
    lists: list[list[str]] = [[] for _ in range(processes)]
    for part in sorted(PARTS, key=PARTS.get, reverse=True):
        min(lists, key=lambda parts: sum(PARTS[p] for p in parts)).append(part)
    return lists


def compile_side_by_side() -> None:
    """Compile what is not kept, on as many cores as this process may use."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    mine, *others = shares(min(len(PARTS), cores))
    path = os.pathsep.join([str(Path(__file__).resolve().parents[1]), os.environ.get("PYTHONPATH", "")]).rstrip(os.pathsep)
    running = [subprocess.Popen([sys.executable, "-m", __name__, *parts], env=os.environ | {"PYTHONPATH": path},
                                stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) for parts in others]
    try:
        for part in mine:
            compile_part(part)
        for process in running:
            process.wait()
    finally:
        for process in running:
            process.terminate()


if __name__ == "__main__":
    for name in sys.argv[1:]:
        compile_part(name)
