"""The first run on a machine compiles the kernels: their parts side by side, in processes of their own.

What they have compiled they keep in `kernels.cache.DIRECTORY`, where this process finds it afterwards; what another has not
compiled after all, it compiles itself.
"""

from __future__ import annotations

import itertools
import os
import subprocess
import sys
from pathlib import Path

import numpy as np

from caustic_cli.optics.kernels import cache, functions, plane

#: What is compiled by itself, and about how long that takes, s.
PARTS = {"adjoint": 5.0, "transport": 5.5, "splat": 4.0, "surface": 2.8}
#: Parts that call the same functions, and how much sooner they are compiled one after the other in one process, s.
ALIKE, SAVED = {"adjoint", "splat"}, 2.2


def kept() -> bool:
    """Whether an earlier run has compiled the kernels, as far as their names and times tell; or nothing can be kept anyway."""
    if cache.DIRECTORY is None:
        return True
    path, written = Path(plane.backward.stats.cache_path), Path(plane.__file__).stat().st_mtime
    return any(p.stat().st_mtime >= written for p in path.glob("plane.backward-*.nbi"))


def compile_part(part: str) -> None:
    """Have one of PARTS compiled, and kept, by calling it."""
    if part == "splat":
        functions.compile_splat()
    elif part == "adjoint":
        functions.compile_adjoint()
    elif part == "surface":
        functions.compile_surface()
    else:
        from caustic_cli.inverse import transport  # noqa: PLC0415

        for light in (np.ones((8, 8)), np.arange(1.0, 65.0).reshape(8, 8)):
            transport.solve(light, np.ones((64, 64)), (1.0, 1.0), (1.0, 1.0))


def shares(processes: int) -> list[list[str]]:
    """PARTS in so many lists that the longest takes as short as it can; it comes first."""
    def cost(parts: list[str]) -> float:
        return sum(PARTS[p] for p in parts) - (SAVED if set(parts) >= ALIKE else 0.0)

    ways = [[[p for p, at in zip(PARTS, way, strict=True) if at == k] for k in range(processes)]
            for way in itertools.product(range(processes), repeat=len(PARTS)) if len(set(way)) == processes]
    return sorted(min(ways, key=lambda lists: sorted(map(cost, lists), reverse=True)), key=cost, reverse=True)


def compile_side_by_side() -> None:
    """Compile what is not kept, on as many cores as this process may use."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    mine, *others = shares(min(len(PARTS), cores))
    path = os.pathsep.join([str(Path(__file__).resolve().parents[1]), os.environ.get("PYTHONPATH", "")]).rstrip(os.pathsep)
    env = os.environ | {"PYTHONPATH": path, "NUMBA_CACHE_DIR": str(cache.DIRECTORY.parent)}  # so that theirs is this one too
    running = [subprocess.Popen([sys.executable, "-m", __name__, *parts], env=env,
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
