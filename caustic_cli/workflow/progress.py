"""What happens during the iterations of a design: progress, the curve of its error, checkpoints, and interruption."""

from __future__ import annotations

import hashlib
import math
import signal
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import torch

from caustic_cli import __version__
from caustic_cli.errors import CausticError
from caustic_cli.inverse.accuracy_cost import Aim, CostOfAccuracy, Start, seconds_to
from caustic_cli.inverse.designer import Designer, State
from caustic_cli.inverse.target import grey
from caustic_cli.project import checkpoint, uptodate
from caustic_cli.project.checkpoint import Checkpoint
from caustic_cli.project.project import CHECKPOINT, Project
from caustic_cli.workflow.movie import NoMovie
from caustic_cli.workflow.reporter import Reporter

#: Time of a checkpoint, s, beyond which the interval to the next one grows, and the factor of the excess.
QUICK, RARELY = 0.5, 10.0
#: Further iterations, of those done, after which it is decided anew whether more should reach an error.
FURTHER = 0.125


class Watch:
    """Called after every iteration of a design: progress, movie and checkpoints."""

    def __init__(
        self, project: Project, designer: Designer, records: Records, say: Reporter, movie: NoMovie, began: Start, state: State
    ):
        self.designer, self.records, self.say, self.movie = designer, records, say, movie
        self.chosen, self.encoding = project.settings.design, project.settings.target.encoding
        self.target = designer.problem.target.numpy()
        lasting = [s for s in designer.stages if not s.spare] or designer.stages
        self.total = self.chosen.iterations or sum(s.iterations for s in lasting)
        self.stage, self.saved = -1, time.monotonic()
        self.now = state
        self.late: float | None = None  # when further iterations began
        self.show: Callable[..., None] = lambda *progress: None
        error_of, count = partial(designer.problem.error_of, designer), designer.problem.effort.cost_points
        self.cost = CostOfAccuracy(began, error_of, self.total, count, state.accuracy)

    def measure(self, now: State, always: bool = False) -> None:
        """Measure the error of the lens, as `CostOfAccuracy.measure` does."""
        self.now = now
        now.accuracy = list(self.cost.measure(now.total, now, always))

    def reaches(self, aim: Aim | None) -> bool:
        """Whether the lens has at most this error, which is measured anew where the loss says that it may, or is another's."""
        now = self.now
        if aim is None or not now.accuracy:
            return False
        last, losses = now.accuracy[-1], {row[0]: row[2] for row in now.history if row[1] == now.stage}
        before = losses.get(last.iteration, math.inf)
        if last.iteration < now.total and last.error * losses.get(now.total, 0.0) <= aim.error * before:
            self.measure(now, always=True)
        return now.accuracy[-1].iteration == now.total and now.accuracy[-1].error <= aim.error

    def goes_on(self, aim: Aim | None) -> bool:
        """Whether iterations beyond those of the stages should reach an error in the time that they may take."""
        now = self.now
        if aim is None:
            return False
        if now.total < self.total:
            return True
        self.measure(now, always=True)
        self.late = self.late or now.seconds
        more = seconds_to(now.accuracy, aim.error)
        if more is None or now.seconds - self.late + more > aim.seconds:
            return False
        self.total = now.total + max(1, round(FURTHER * now.total))
        return True

    def __call__(self, now: State) -> None:
        self.now = now
        stages, stage = self.designer.stages, self.designer.stages[now.stage]
        name = f"stage {now.stage + 1}/{len(stages)}"
        begins = now.stage != self.stage
        if begins:
            self.stage = now.stage
            self.say.say(f"{name}: {stage.control[0]} x {stage.control[1]} control points, {stage.light}")
        _, _, loss, on_screen, _ = now.history[-1]
        self.show(name, f"loss {loss * grey(self.target).size:.4f}  on screen {on_screen:.1%}", now.total, self.total)
        self.movie.record(now, self.target, self.encoding, bool(stage.waves))
        self.measure_if_due(now, begins)
        self.records.settle(wait=False)
        self.keep_if_due(now)

    def measure_if_due(self, now: State, begins: bool = False) -> None:
        """Measure the error of the lens if this iteration is one of those planned, or the first of a stage; by rays the last once
        the lens is as it is kept, whose image then serves the evaluation too."""
        last = now.total == self.total and not self.designer.stages[now.stage].waves
        if begins or (now.total in self.cost.due and not last):
            self.measure(now)

    def keep_if_due(self, now: State) -> None:
        """Write a checkpoint if the last one is old enough."""
        if time.monotonic() - self.saved >= max(self.chosen.checkpoint_every, RARELY * (self.records.seconds - QUICK)):
            self.measure(now)
            self.saved = time.monotonic()  # before writing, which takes time itself
            self.records.keep_behind(now)


class Records:
    """Writes the checkpoints of a design, if it has a directory; as a context, waits at its end for what is written behind."""

    def __init__(self, project: Project, designer: Designer):
        self.project, self.designer, self.inputs = project, designer, uptodate.inputs(project)
        self.provenance = provenance(project, designer.problem.device)
        self._resumes = f"caustic design ⟨resume⟩ {project.path} continues from it"
        self._before = project.path is not None and (project.path / CHECKPOINT).exists()
        self._safe = f"the one before is intact, {self._resumes}" if self._before else "nothing of it is on disk"
        self.seconds = 0.0  # that the last checkpoint took
        self._behind = ThreadPoolExecutor(1)
        self._writing: Future[None] | None = None
        self._packed: tuple[list[torch.Tensor | None], Future[dict[str, bytes | None]]] | None = None

    def __enter__(self) -> Records:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        self._behind.shutdown()
        if kind is None:
            self.settle()

    def keep(self, now: State, figures: dict[str, Any] | None = None) -> None:
        """Write a checkpoint, with the figures of a finished design.

        Raises:
            CausticError: it, or one before, could not be written; says which checkpoint is intact.
        """
        self.settle()
        self._write(now, figures or {}, self._nets(now))

    def keep_behind(self, now: State) -> None:
        """Write a checkpoint while the design goes on, unless its next step would change what is written; raises as `keep`, of one
        before."""
        if self.designer.problem.optimiser(now.stage).in_place:
            return self.keep(now)
        self.settle()
        copy = replace(now, history=[*now.history], accuracy=[*now.accuracy])
        # Without prepared nets: its only thread must not wait for what it is to compress itself.
        self._writing = self._behind.submit(self._write, copy, {}, None)

    def settle(self, wait: bool = True) -> None:
        """Raise the error of a checkpoint that is written behind; wait: until it is written."""
        if self._writing is not None and (wait or self._writing.done()):
            writing, self._writing = self._writing, None
            writing.result()

    def prepare(self, now: State) -> None:
        """Compress the nets of a state that is going to be kept, while it is evaluated."""
        if self.project.path is not None:
            self._packed = _nets_of(now), self._behind.submit(checkpoint.packed, replace(now))

    def _nets(self, now: State) -> dict[str, bytes | None] | None:
        """The nets of a state, if they have been prepared."""
        if self._packed is None:
            return None
        nets, packed = self._packed
        return packed.result() if all(a is b for a, b in zip(nets, _nets_of(now), strict=True)) else None

    def _write(self, now: State, figures: dict[str, Any], nets: dict[str, bytes | None] | None) -> None:
        if self.project.path is None:
            return
        began = time.monotonic()
        spaces = self.designer.field(now.stage).spaces
        try:
            self.project.save(Checkpoint(now, spaces, self.provenance, figures, self.inputs), nets)
        except CausticError as error:
            raise CausticError(f"{error} after iteration {now.total}; {self._safe}") from error
        if not self._before:  # the first checkpoint
            uptodate.forget_begun(self.project.path)
            self._before = True
        self._safe = f"the one of iteration {now.total} is intact, {self._resumes}"
        self.seconds = time.monotonic() - began


def _nets_of(state: State) -> list[torch.Tensor | None]:
    return [state.heights, *(getattr(state, name) for name in checkpoint.STARTS)]


def provenance(project: Project, device: str) -> dict[str, Any]:
    """Provenance of a lens: versions, device, threads, seed and hash of the picture."""
    return {
        "caustic": __version__,
        "torch": torch.__version__,
        "numpy": np.__version__,
        "device": device,
        "threads": torch.get_num_threads(),
        "seed": project.settings.design.seed,
        "target_sha256": hashlib.sha256(np.ascontiguousarray(project.picture.values).tobytes()).hexdigest(),
    }


@contextmanager
def signals_collected(collect: bool = True) -> Iterator[list[int]]:
    """Collect SIGINT and SIGTERM instead of terminating, if asked and in the main thread; a second SIGINT interrupts."""
    asked: list[int] = []
    if not collect or threading.current_thread() is not threading.main_thread():
        yield asked
        return

    def handler(number: int, _frame) -> None:
        if asked and number == signal.SIGINT:
            raise KeyboardInterrupt
        asked.append(number)

    previous = {number: signal.signal(number, handler) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield asked
    finally:
        for number, old in previous.items():
            signal.signal(number, old)
