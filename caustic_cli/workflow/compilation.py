"""The device that traces, and its kernels.  The first run on a machine compiles the CPU's: their parts side by side, in processes
of their own.

What they have compiled they keep in `kernels.cache.DIRECTORY`, where this process finds it afterwards; what another has not
compiled after all, it compiles itself.
"""

from __future__ import annotations

import itertools
import os
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

import numpy as np
import torch
from numba.core import event

from caustic_cli.errors import is_out_of_memory
from caustic_cli.optics.backends import backend_for, cuda_kernels
from caustic_cli.optics.effects import NO_REQUESTS, Requests
from caustic_cli.optics.kernels import cache, fused, fused_functions
from caustic_cli.optics.trace import warm_up
from caustic_cli.scene import Lens, PlaneWave, Points, Scene, Screen
from caustic_cli.workflow.reporter import Reporter

#: s that are compiled before it is spoken of.
PATIENCE = 2.0
#: What is compiled by itself, and about how long that takes, s.
PARTS = {"adjoint": 5.0, "transport": 5.5, "splat": 4.0, "surface": 2.8}
#: Parts that call the same functions, and how much sooner they are compiled one after the other in one process, s.
ALIKE, SAVED = {"adjoint", "splat"}, 2.2


def choose_device(asked: str, say: Reporter) -> str:
    """The device for auto, cpu or cuda, which is at hand: auto takes a CUDA device where torch finds one and numba its kernels."""
    if asked == "cpu" or not torch.cuda.is_available():
        return "cpu"
    name, kernels = torch.cuda.get_device_name(), cuda_kernels()
    if kernels:
        say.say(f"tracing on {name}, by kernels")
        return "cuda"
    lacking = "numba has no kernels for it (pip install 'caustic-cli[cuda]' brings what they need)"
    if asked == "auto":
        say.say(f"tracing on the CPU: there is {name}, but {lacking}")
        return "cpu"
    say.say(f"tracing on {name} in plain torch: {lacking}")
    return "cuda"


def kept() -> bool:
    """Whether an earlier run has compiled the kernels, as far as their names tell; or nothing can be kept anyway."""
    place = fused.backward.stats.cache_path
    return cache.DIRECTORY is None or place is None or any(Path(place).glob("fused.backward-*.nbi"))


def compile_part(part: str) -> None:
    """Have one of PARTS compiled, and kept, by calling it."""
    if part == "splat":
        fused_functions.compile_splat()
    elif part == "adjoint":
        fused_functions.compile_adjoint()
    elif part == "surface":
        fused_functions.compile_surface()
    else:
        from caustic_cli.inverse import transport  # noqa: PLC0415

        for light in (np.ones((8, 8)), np.arange(1.0, 65.0).reshape(8, 8)):
            transport.solve(light, np.ones((64, 64)), (1.0, 1.0), (1.0, 1.0))


def shares(processes: int) -> list[list[str]]:
    """PARTS in so many lists that the longest takes as short as it can; it comes first."""

    def cost(parts: list[str]) -> float:
        return sum(PARTS[p] for p in parts) - (SAVED if set(parts) >= ALIKE else 0.0)

    ways = [
        [[p for p, at in zip(PARTS, way, strict=True) if at == k] for k in range(processes)]
        for way in itertools.product(range(processes), repeat=len(PARTS))
        if len(set(way)) == processes
    ]
    return sorted(min(ways, key=lambda lists: sorted(map(cost, lists), reverse=True)), key=cost, reverse=True)


def compile_side_by_side() -> None:
    """Compile what is not kept, on as many cores as this process may use."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    mine, *others = shares(min(len(PARTS), cores))
    path = os.pathsep.join([str(Path(__file__).resolve().parents[2]), os.environ.get("PYTHONPATH", "")]).rstrip(os.pathsep)
    env = os.environ | {"PYTHONPATH": path, "NUMBA_CACHE_DIR": str(cache.DIRECTORY.parent)}  # so that theirs is this one too
    running: list[subprocess.Popen] = []
    try:
        for parts in others:
            running.append(
                subprocess.Popen(
                    [sys.executable, "-m", __name__, *parts],
                    env=env,
                    stdin=subprocess.DEVNULL,
                    stdout=subprocess.DEVNULL,
                    stderr=subprocess.DEVNULL,
                )
            )
        for part in mine:
            compile_part(part)
        for process in running:
            process.wait()
    finally:  # also where this process is interrupted: nothing of it stays at work
        for process in running:
            process.terminate()
        for process in running:
            process.wait()


class _Compiled(event.Listener):
    """Says a text, once, when numba has compiled for `PATIENCE` seconds: what is read from its cache is no compilation."""

    def __init__(self, say: Reporter, text: str):
        self.say, self.text = say, text
        self.depth, self.spent, self.since, self.waiting = 0, 0.0, 0.0, ExitStack()

    def on_start(self, event: event.Event) -> None:
        """A function is compiled, by itself or within another."""
        self.depth += 1
        if self.depth == 1 and self.spent < PATIENCE:
            self.since = time.monotonic()
            self.waiting.enter_context(self.say.notify_if_slow(self.text, PATIENCE - self.spent))

    def on_end(self, event: event.Event) -> None:
        """It is done."""
        self.depth -= 1
        if self.depth == 0 and self.spent < PATIENCE:
            self.waiting.close()
            self.spent += time.monotonic() - self.since


@contextmanager
def told_of(say: Reporter, text: str) -> Iterator[None]:
    """Say `text` while the block compiles kernels, if that takes long."""
    with event.install_listener("numba:compile", _Compiled(say, text)):
        yield


def compile_usual(device: str, say: Reporter) -> None:
    """Compile the kernels that every design and render takes, where the device's are compiled."""
    if not backend_for(device).compiled:
        return
    with told_of(say, "compiling the kernels for this machine, once: about ten seconds"):
        if not kept():
            compile_side_by_side()
        backend_for(device).compile_plane()


def compile_for(scene: Scene | None, device: str, say: Reporter, requests: Requests | None = None, gradient: bool = False) -> None:
    """Have the CPU's kernels compiled that the light of a scene needs, beyond the usual ones too.

    Args:
        scene: None for whatever any scene may need.
        requests: of a plan, or None.
        gradient: derivatives are needed too.
    """
    compile_usual(device, say)
    if not backend_for(device).compiled:
        return
    wanted = [(scene, requests or NO_REQUESTS)]
    if scene is None:
        lens, screen = Lens(), Screen((30.0, 30.0))
        wanted = [
            (Scene(Points(((0.0, 0.0, -50.0),)), lens, screen), NO_REQUESTS),
            (Scene(PlaneWave(), lens, screen), Requests(stages=True)),
        ]
    with told_of(say, "compiling the kernels that this scene needs, once: about half a minute"):
        try:
            for one, asked in wanted:
                warm_up(one, asked, gradient)
        except (MemoryError, RuntimeError) as problem:
            if not is_out_of_memory(problem):  # the work itself knows what to do about that, and compiles what it needs
                raise


if __name__ == "__main__":
    for name in sys.argv[1:]:
        compile_part(name)
