"""Selection of the device, and compilation of its kernels: in parallel subprocesses on the first run on a machine.

Subprocesses write to the cache in `kernels.cache.DIRECTORY`, from which this process loads the kernels; it compiles any that are
missing itself.
"""

from __future__ import annotations

import itertools
import os
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from numba.core import event

from caustic_cli.errors import is_out_of_memory
from caustic_cli.optics.backends import backend_for, cuda_kernels
from caustic_cli.optics.effects import NO_REQUESTS, Requests
from caustic_cli.optics.emission import rays_of
from caustic_cli.optics.kernels import cache
from caustic_cli.optics.reconstruction import Filter
from caustic_cli.optics.surfaces.heightfield import HeightField
from caustic_cli.optics.system import EXIT
from caustic_cli.optics.trace import tracers
from caustic_cli.scene import Lens, Light, PlaneWave, Points, Scene, Screen
from caustic_cli.workflow.reporter import Reporter

#: Seconds of compilation before the user is told.
PATIENCE = 2.0
#: Independent parts, and approximate compilation time of each, s.
PARTS = {"adjoint": 5.0, "transport": 5.5, "splat": 4.0, "surface": 2.8}
#: Parts that share functions, and the time saved by compiling them in the same process, s.
ALIKE, SAVED = {"adjoint", "splat"}, 2.2


def choose_device(asked: str, say: Reporter) -> str:
    """The device for auto, cpu or cuda: auto selects a CUDA device if torch finds one and numba has kernels for it."""
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


def is_cached() -> bool:
    """Whether the cache holds compiled kernels, judged by file names; also True if nothing can be cached."""
    place = backend_for("cpu").cache_path()
    return cache.DIRECTORY is None or place is None or any(Path(place).glob("fused.backward-*.nbi"))


def compile_part(part: str) -> None:
    """Compile one of PARTS into the cache, by calling it."""
    if part != "transport":
        backend_for("cpu").compile_part(part)
    else:
        from caustic_cli.inverse import transport  # noqa: PLC0415

        for light in (np.ones((8, 8)), np.arange(1.0, 65.0).reshape(8, 8)):
            transport.solve(light, np.ones((64, 64)), (1.0, 1.0), (1.0, 1.0))


def partition(processes: int) -> list[list[str]]:
    """Partition PARTS into this number of lists with minimal longest compilation time; the longest comes first."""

    def cost(parts: list[str]) -> float:
        return sum(PARTS[p] for p in parts) - (SAVED if set(parts) >= ALIKE else 0.0)

    ways = [
        [[p for p, at in zip(PARTS, way, strict=True) if at == k] for k in range(processes)]
        for way in itertools.product(range(processes), repeat=len(PARTS))
        if len(set(way)) == processes
    ]
    return sorted(min(ways, key=lambda lists: sorted(map(cost, lists), reverse=True)), key=cost, reverse=True)


def compile_side_by_side() -> None:
    """Compile all PARTS in parallel, on the cores available to this process."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    mine, *others = partition(min(len(PARTS), cores))
    path = os.pathsep.join([str(Path(__file__).resolve().parents[2]), os.environ.get("PYTHONPATH", "")]).rstrip(os.pathsep)
    env = os.environ | {"PYTHONPATH": path, "NUMBA_CACHE_DIR": str(cache.DIRECTORY.parent)}  # the same cache for subprocesses
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
    finally:  # also after an interrupt: no subprocess is left running
        for process in running:
            process.terminate()
        for process in running:
            process.wait()


class _Compiled(event.Listener):
    """Numba listener that reports a text once, after `PATIENCE` seconds of compilation; loading from the cache does not count."""

    def __init__(self, say: Reporter, text: str):
        self.say, self.text = say, text
        self.depth, self.spent, self.since, self.waiting = 0, 0.0, 0.0, ExitStack()

    def on_start(self, event: event.Event) -> None:
        """Compilation of a function begins, possibly within that of another."""
        self.depth += 1
        if self.depth == 1 and self.spent < PATIENCE:
            self.since = time.monotonic()
            self.waiting.enter_context(self.say.notify_if_slow(self.text, PATIENCE - self.spent))

    def on_end(self, event: event.Event) -> None:
        """Compilation of a function ends."""
        self.depth -= 1
        if self.depth == 0 and self.spent < PATIENCE:
            self.waiting.close()
            self.spent += time.monotonic() - self.since


@contextmanager
def announce_compilation(say: Reporter, text: str) -> Iterator[None]:
    """Report `text` if the block compiles kernels for more than `PATIENCE` seconds."""
    with event.install_listener("numba:compile", _Compiled(say, text)):
        yield


def compile_usual(device: str, say: Reporter) -> None:
    """Compile the kernels that every design and render uses, if the backend of the device is compiled."""
    if not backend_for(device).compiled:
        return
    with announce_compilation(say, "compiling the kernels for this machine, once: about ten seconds"):
        if not is_cached():
            compile_side_by_side()
        backend_for(device).compile_plane()


def compile_for(scene: Scene | None, device: str, say: Reporter, requests: Requests | None = None, gradient: bool = False) -> None:
    """Compile the usual kernels and those that tracing this scene needs in addition.

    Args:
        scene: None for the kernels of all scenes.
        requests: of a plan, or None.
        gradient: also compile derivatives.
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
    with announce_compilation(say, "compiling the kernels that this scene needs, once: about half a minute"):
        try:
            for one, asked in wanted:
                warm_up(one, asked, gradient)
        except (MemoryError, RuntimeError) as problem:
            if not is_out_of_memory(problem):  # out of memory is handled, and kernels compiled, during the actual work
                raise


if __name__ == "__main__":
    for name in sys.argv[1:]:
        compile_part(name)


def warm_up(scene: Scene, requests: Requests = NO_REQUESTS, gradient: bool = False) -> None:
    """Trace a few rays of a scene, so that all kernels that it needs are compiled.

    Net and image are small, and a plane wave or a point represents the source.  gradient: compile the adjoints, too.
    """
    lens = replace(scene.lens, control=(4, 4), degree=(3, 3), knots=None, array=(1, 1))
    source = PlaneWave() if scene.source.collimated else Points(((0.0, 0.0, lens.z_in - 5.0 * max(lens.size)),))
    scene, field = Scene(source, lens, scene.screen, Light(scene.light.polarisation)), HeightField.of(lens)
    heights = torch.full((4, 4), lens.offset.thickness, dtype=torch.float64, requires_grad=gradient)
    screen = replace(scene.screen, resolution=(4, 4))
    with torch.set_grad_enabled(gradient):
        for kind in ("lines", "stratified") if scene.source.collimated else ("stratified",):
            traced = next(tracers(scene, field, rays_of(scene, kind, 16), torch.float64, 1 << 10, requests))
            image = traced.expose({EXIT: heights}, screen, Filter("cosine", (3, 3)))
            if gradient:
                (image.image.sum() + image.leaving.sum()).backward()
