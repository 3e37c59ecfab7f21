"""Selection of the device, and compilation of its kernels: on the first run on a machine, which other processes share (`ahead`)."""

from __future__ import annotations

import math
import time
from collections.abc import Iterable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import replace

import torch
from numba.core import event

from caustic_cli.errors import is_out_of_memory
from caustic_cli.inverse.schedule import Stage
from caustic_cli.optics.backends import backend_for
from caustic_cli.optics.effects import NO_REQUESTS, Requests
from caustic_cli.optics.emission import rays_of
from caustic_cli.optics.kernels.ahead import PARTS, compile_behind, compile_part
from caustic_cli.optics.reconstruction import Filter
from caustic_cli.optics.surfaces.heightfield import HeightField
from caustic_cli.optics.system import EXIT
from caustic_cli.optics.trace import tracers
from caustic_cli.scene import Disc, Lens, Light, PlaneWave, Points, Scene, Screen
from caustic_cli.workflow.reporter import Reporter

#: Seconds of compilation before the user is told.
PATIENCE = 2.0
COMPILING = "compiling the kernels for this machine, once: about ten seconds"


def choose_device(asked: str, say: Reporter) -> str:
    """The device for auto, cpu or cuda: auto selects the CPU, whose results are the same bits every time."""
    if asked != "cuda":
        return "cpu"
    say.say(f"tracing on {torch.cuda.get_device_name()}, in plain torch")
    return "cuda"


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
def announce_compilation(say: Reporter, text: str = COMPILING) -> Iterator[None]:
    """Report `text` if the block compiles kernels for more than `PATIENCE` seconds."""
    with event.install_listener("numba:compile", _Compiled(say, text)):
        yield


def compile_usual(device: str, say: Reporter, gradient: bool = True) -> None:
    """Compile the kernels for plane waves, if the backend of the device is compiled; gradient: and their adjoint."""
    if not backend_for(device).compiled:
        return
    compile_behind(["image"])
    with announce_compilation(say):
        for part in ("surface", "adjoint", "image") if gradient else ("surface", "image"):
            compile_part(part)


def compile_design(stages: Iterable[Stage], device: str) -> None:
    """Have other processes compile the kernels that a design with these stages is going to use, while this one goes on; those of
    spare stages are compiled when they are needed."""
    if backend_for(device).compiled:
        by_waves = {bool(stage.waves) or stage.spare for stage in stages}
        parts = {"fields": True in by_waves, "adjoint": False in by_waves}
        compile_behind(part for part in PARTS if parts.get(part, True))


def compile_for(scene: Scene | None, device: str, say: Reporter, requests: Requests | None = None, gradient: bool = False) -> None:
    """Compile the usual kernels and those that tracing this scene needs in addition.

    Args:
        scene: None for the kernels of all scenes.
        requests: of a plan, or None.
        gradient: also compile derivatives.
    """
    compile_usual(device, say, gradient)
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


def warm_up(scene: Scene, requests: Requests = NO_REQUESTS, gradient: bool = False) -> None:
    """Trace a few rays of a scene, so that all kernels that it needs are compiled.

    Net and image are small, and a plane wave or a point represents the source.  gradient: compile the adjoints, too.
    """
    lens = replace(scene.lens, control=(4, 4), degree=(3, 3), knots=None, array=(1, 1))
    given, source = scene.source, Points(((0.0, 0.0, lens.z_in - 5.0 * max(lens.size)),))
    if given.distant:
        source = PlaneWave(tilt=given.tilt) if given.parallel else Disc(angle=math.degrees(2.0 * given.half_angle), tilt=given.tilt)
    scene, field = Scene(source, lens, scene.screen, Light(scene.light.polarisation)), HeightField.of(lens)
    heights = torch.full((4, 4), lens.offset.thickness, dtype=torch.float64, requires_grad=gradient)
    screen = replace(scene.screen, resolution=(4, 4))
    with torch.set_grad_enabled(gradient):
        for kind in ("lines", "stratified") if scene.source.parallel else ("stratified",):
            traced = next(tracers(scene, field, rays_of(scene, kind, 16), torch.float64, 1 << 10, requests))
            image = traced.expose({EXIT: heights}, screen, Filter("cosine", (3, 3)))
            if gradient:
                (image.image.sum() + image.leaving.sum()).backward()
