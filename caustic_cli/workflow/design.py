"""A complete design: create or open the project, run the optimisation, save checkpoints, evaluate the lens, report.

Nothing is written before everything the user gave has been checked.
"""

from __future__ import annotations

import hashlib
import math
import signal
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch

from caustic_cli import __version__
from caustic_cli.config import settings
from caustic_cli.config.settings import Given, Settings
from caustic_cli.errors import CausticError, InputError, Interrupted, at_most
from caustic_cli.inverse.accuracy_cost import CostOfAccuracy, Start, as_table
from caustic_cli.inverse.designer import Designer, InitialHeights, State
from caustic_cli.inverse.reachability import largest_magnification
from caustic_cli.inverse.surface_from_map import OutOfReach
from caustic_cli.inverse.target import grey
from caustic_cli.io.files import Piped
from caustic_cli.io.picture import Picture
from caustic_cli.kinds import OneSurface, problem_of
from caustic_cli.kinds.evaluation import Evaluated
from caustic_cli.kinds.surface import PLATE, WALL
from caustic_cli.loading import OnDemand
from caustic_cli.optics import ranks
from caustic_cli.optics.surfaces.heightfield import HeightField
from caustic_cli.optics.system import split_heights, trace_arguments
from caustic_cli.project import attachments, directory, uptodate
from caustic_cli.project.checkpoint import Checkpoint
from caustic_cli.project.completion import complete, shape_words
from caustic_cli.project.correction import refuse_corrected
from caustic_cli.project.new import new_project
from caustic_cli.project.packing import expected_bytes, rounded
from caustic_cli.project.project import CHECKPOINT, Project, is_project
from caustic_cli.scene import Scene
from caustic_cli.schema.table import TABLE, LensSettings
from caustic_cli.workflow.compilation import announce_compilation, compile_design, compile_for
from caustic_cli.workflow.evaluation import evaluate_and_write, evaluation_seconds, expected_seconds, prepare_report
from caustic_cli.workflow.movie import NoMovie
from caustic_cli.workflow.reporter import Reporter

surfaces, manufacture = OnDemand("caustic_cli.io.surfaces"), OnDemand("caustic_cli.studies.manufacture")

#: Fraction of pixels brighter than NEARLY of the maximum above which a picture is taken for a drawing on white.
GROUND, NEARLY = 0.6, 0.98
#: Reasons of termination after which the state of the optimiser, much larger than the lens, is not saved, unless the number of
#: iterations was given: resuming then restarts the optimiser.
REACHED = "error reached"
DONE = ("iterations", "no progress", REACHED)
#: Fractions of a time limit: least for the iterations, whatever the initial surface took; and most for the initial surface.
LEAST_PART, START_PART = 0.25, 0.3
NO_MOVIE = NoMovie()
COMPILING = "compiling the kernels for this machine, once: about ten seconds"
#: Time of a checkpoint, s, beyond which the interval to the next one grows, and the factor of the excess.
QUICK, RARELY = 0.5, 10.0


class PreparedDesign(NamedTuple):
    """A design about to be run: its project, its problem, None where it exists already, and its initial heights, None for the
    offset surface."""

    project: Project
    problem: OneSurface | None = None
    first: InitialHeights | None = None

    @property
    def scene(self) -> Scene:
        """The scene of the design."""
        return self.project.scene() if self.problem is None else self.problem.scene


def prepare(
    target: Path | Piped | Picture,
    given: Mapping[str, Any],
    *,
    preset: str | None = None,
    config: Path | None = None,
    out: Path | None = None,
    force: bool = False,
    say: Reporter,
    device: str = "cpu",
) -> PreparedDesign:
    """Validate all input, then create the project directory, if any.

    If the same design exists already, finished or not, its project is opened instead (`Project.checkpoint`).

    Args:
        given: path in `schema.table` -> value, including derived parameters such as "mag".
        preset: a name of `config.presets`, whose settings are overridden by those of config.
        config: a TOML file of further settings, which are overridden by those `given`.
        out: the directory; None for a design in memory.
        force: replace a project there.
        device: of the design, whose kernels are compiled after the validation.

    Raises:
        InputError: invalid input; nothing was written.
    """
    project, said = new_project(target, given, preset, config, out, say.say)
    if out is not None and not force:
        if same := uptodate.same_design(out, project.asked):
            return PreparedDesign(replace(same[0], checkpoint=same[1]))
        force = uptodate.is_begun(out, project.asked)  # and interrupted before the first checkpoint: it is begun anew
    problem = problem_of(project, device)  # builds and thereby validates scene, target, stages, options
    problem.refuse_obstructed()
    if out is not None:
        directory.check(out, force)  # before the transport, which may take a minute
    problem.refuse_unreachable()
    if words := shape_words(project.settings):
        say.say(words)
    compile_design(problem.stages, device)
    with (
        announce_compilation(say, COMPILING),
        say.notify_if_slow("solving the transport of the light to the picture"),
    ):
        try:
            prepared = first_heights(project, said, problem)
        except OutOfReach as error:
            most = largest_magnification(problem.scene, project.settings.target.size)
            most = min(most or 0.0, TABLE["mag"].high)
            within = f"; ⟨+mag⟩ of at most about {at_most(most, 2)} is within reach at this throw" if most else ""
            raise InputError(f"{error}{within}") from error
    if out is not None:
        directory.create(prepared.project, force)
    return prepared


def first_heights(project: Project, said: Given, problem: OneSurface) -> PreparedDesign:
    """The initial heights of a design; and its project and problem with thickness and height range adapted to them, except for
    values `said` by the user.

    Raises:
        InputError: as of `prepare`.
    """
    fixed = "thickness" in said.get("lens", {})
    plate = problem.adapts and not fixed and _is_plate(project.settings.lens)
    first, middle = _solved(project, problem, fixed, rough=plate)  # of a plate the surface is solved again, for its thickness
    if not problem.adapts:
        return PreparedDesign(project, problem, Designer(problem).initial_heights(first))
    if plate and first is not None:
        thickness = project.settings.lens.thickness if middle is None else middle
        if (spare := _spare(project.settings.lens, said, first)) > 0:
            project, problem = _with_lens(project, problem, thickness=thickness - spare)
        first, middle = _solved(project, problem, fixed=spare > 0)
        middle = thickness - spare if spare > 0 else middle
    if middle is not None:
        project, problem = _with_lens(project, problem, thickness=middle)
    if first is not None and (room := _room(project.settings.lens, said, first)):
        project, problem = _with_lens(project, problem, **room)
        if middle is None:
            first, _ = _solved(project, problem, fixed)
    return PreparedDesign(project, problem, Designer(problem).initial_heights(first))


def _with_lens(project: Project, problem: OneSurface, **values: Any) -> tuple[Project, OneSurface]:
    """The project with other settings of its lens, and its problem."""
    full = project.settings
    project = replace(project, settings=full.changed(lens=full.lens.changed(**values)))
    return project, problem_of(project, problem.device)


@dataclass(frozen=True)
class Result:
    """A finished design: its project, its lens, and the figures of the JSON table."""

    project: Project
    #: With the designed entrance, if that is free-form.
    scene: Scene
    field: HeightField
    #: (n, m) mm of the exit.
    heights: torch.Tensor
    target: np.ndarray
    state: State
    figures: dict[str, Any]


def design(
    prepared: PreparedDesign, device: str, say: Reporter, began: Start, movie: NoMovie = NO_MOVIE, goal: float = 0.0
) -> Result:
    """Run a new design from its initial heights to its end; movie: records it; goal: independent error at which it ends.

    A finished design found by `prepare` is returned; an unfinished one is continued.
    """
    project, problem, first = prepared
    if problem is None:
        return _again(project, device, say, began, movie, goal)
    with project.hold:
        _compile(problem, say)
        state = Designer(problem).initial_state(*first or ())
        if problem.in_stages:
            _say_limits(project, problem, first, say)
        return _run(project, problem, state, say, began, None, movie, goal)


def _again(project: Project, device: str, say: Reporter, began: Start, movie: NoMovie, goal: float) -> Result:
    """The result of a design found by `prepare`."""
    figures = uptodate.finished(project, project.checkpoint)
    if figures and figures["reason"].startswith(REACHED) and not figures["error"] <= goal:
        figures = {}  # it ended for a larger error
    rest = "there is nothing to do; ⟨force⟩ designs it anew" if figures else "it continues from its checkpoint"
    say.say(f"{project.path}: was designed from the same picture with the same options, so {rest}")
    if not figures:
        return resume(project, None, None, device, say, began, movie, goal)
    movie.unused(say)
    scene = project.scene()
    target = project.target(scene)
    scene, field, heights, checkpoint = project.lens(scene)
    return Result(project, scene, field, heights, target, checkpoint.state, figures)


def _say_limits(project: Project, problem: OneSurface, first: InitialHeights | None, say: Reporter) -> None:
    """Report the limits set by diffraction and an extended source, and manufacturing figures of the initial surface."""
    light, chosen = grey(project.picture.irradiance()), project.settings.design
    if (ground := float((light >= NEARLY * light.max()).mean())) > GROUND and light.min() < 0.5 * light.max():
        say.say(f"{ground:.0%} of the picture are at its maximum: for a drawing on white, ⟨invert⟩ makes the lines bright")
    size, timed = project.settings.target.size, math.isfinite(chosen.time_limit)
    for words in problem.notes(size, timed, project.without_waves if chosen.waves == "auto" else ""):
        say.say(words)
    heights = Designer(problem).initial_state().heights if first is None else first.heights
    nets = 3 if first is not None and first.unrounded is not None else 2
    for words in problem.preview(heights, nets * expected_bytes(heights.numel())):
        say.say(words)


def resume(
    project: Project,
    iterations: int | None,
    time_limit: float | None,
    device: str,
    say: Reporter,
    began: Start,
    movie: NoMovie = NO_MOVIE,
    goal: float = 0.0,
) -> Result:
    """Continue from the last checkpoint; with nothing left to do, evaluate the lens again."""
    with project.hold:
        refuse_corrected(project.path)
        project.hold.enter_context(directory.locked(project.path))
        problem = problem_of(project, device)
        problem.refuse_obstructed()
        _compile(problem, say)
        designer = Designer(problem)
        has_checkpoint = (project.path / CHECKPOINT).exists()  # else it was killed before its first checkpoint
        checkpoint = project.load() if has_checkpoint else None
        if has_checkpoint:
            state = checkpoint.state
        else:
            state = designer.initial_state(*designer.initial_heights(_solved(project, problem, fixed=True)[0]) or ())
        _refuse_edited(project, designer, state)
        state = designer.restored(state)
        if iterations is not None:
            changed = project.settings.design.changed(iterations=iterations)
            project = replace(project, settings=project.settings.changed(design=changed))
            project.write_settings()
        project = replace(project, asked=uptodate.asked_of(project, checkpoint) if has_checkpoint else uptodate.begun(project))
        return _run(project, problem, state, say, began, time_limit, movie, goal)


def _compile(problem: OneSurface, say: Reporter) -> None:
    """Compile the kernels of iterations on rays before the first; those of the wave image and of the evaluation are compiled by
    other processes, or when they are needed."""
    if all(stage.waves or stage.spare for stage in problem.stages):
        compile_design(problem.stages, problem.device)
    else:
        compile_for(problem.scene, problem.device, say, gradient=True)


def _refuse_edited(project: Project, designer: Designer, state: State) -> None:
    """Refuse a project whose stages are no longer those of its checkpoint.

    Raises:
        InputError: they are not.
    """
    if state.stage >= len(designer.stages):
        raise project.error(f"has {len(designer.stages)} stages, but the checkpoint is in stage {state.stage + 1}")
    if tuple(state.heights.shape[-2:]) != designer.stages[state.stage].control:
        raise project.error(
            f"stage {state.stage + 1} has control"
            f" {list(designer.stages[state.stage].control)}, but the checkpoint {list(state.heights.shape)}"
        )
    if state.start is not None and tuple(state.start.shape[-2:]) != designer.stages[0].control:
        raise project.error(
            f"stage 1 has control {list(designer.stages[0].control)}, but the design began on {list(state.start.shape)}"
        )


def follow() -> None:
    """Main loop of all ranks but the first, whose signals the first handles."""
    with _signals():
        ranks.serve()


def _joined(settings: Settings, picture: Picture, state: State, limit: float, device: str) -> None:
    """Run a design together with the first rank, without reading or writing files."""
    problem = problem_of(Project(None, settings, picture), device)
    Designer(problem).run(state, iterations=settings.design.iterations, time_limit=limit)


def _on_cpu(state: State) -> State:
    """The state with all tensors on the CPU, to be sent to other ranks."""
    start, unrounded = (None if z is None else z.cpu() for z in (state.start, state.unrounded))
    return replace(
        state,
        heights=state.heights.cpu(),
        start=start,
        unrounded=unrounded,
        image=None,
        parameters={k: v.cpu() for k, v in state.parameters.items()},
        optimizer={k: v.cpu() for k, v in state.optimizer.items()},
    )


def sphere() -> tuple[Scene, HeightField, torch.Tensor]:
    """The default scene, and field and heights (n, m) mm of its offset surface."""
    full = complete({}, 1.0)
    scene = settings.build_scene(full)
    field = HeightField.of(scene.lens)
    x, y = (c.numpy() for c in field.control_xy())
    return scene, field, torch.from_numpy(scene.lens.offset.heights(x, y))


def _solved(project: Project, problem: OneSurface, fixed: bool, rough: bool = False) -> tuple[torch.Tensor | None, float | None]:
    """Initial heights on the control net of the first stage, by transport or from another lens, None for the offset surface as it
    is; and the thickness that belongs to them, None if unchanged.

    fixed: the thickness is given by the user; a transport surface below the least thickness is raised, which leaves slopes
    unchanged; rough: by few cells, for its depth alone.

    Raises:
        InputError: the project or surface cannot be read, its lens has another size, or the picture cannot be reached.
    """
    start = project.settings.design.start
    if start == "offset":
        return problem.offset(), None
    if start == "transport":
        surface = problem.transport(fixed, START_PART * project.settings.design.time_limit, rough)
        return surface.heights, surface.middle
    net = problem.field(0)
    if Path(start).suffix.lower() in surfaces.SUFFIXES and not Path(start).is_dir():
        return surfaces.onto(*surfaces.read_surface(start, net.half_size), net), None
    if not is_project(Path(start)):
        raise InputError(
            "⟨design.start⟩ must be transport, offset, a project directory or a lens surface"
            f" ({', '.join(surfaces.SUFFIXES)}), got {start!r}"
        )
    other = Project.open(start)
    _, field, heights, _ = other.lens(other.scene())
    sizes = [list(one.settings.lens.size) for one in (other, project)]
    if sizes[0] != sizes[1]:
        raise InputError(f"⟨design.start⟩: the lens of {start} is {sizes[0]} mm, not {sizes[1]} mm")
    return surfaces.onto(field, heights, net), None


def _is_plate(lens: LensSettings) -> bool:
    """Whether the thickness follows from the depth of the surface and a wall behind it."""
    return not lens.mirror and max(lens.size) > PLATE


def _spare(lens: LensSettings, said: Given, first: torch.Tensor) -> float:
    """Excess thickness of a plate below its initial surface beyond the wall, which may be given, mm."""
    wall = lens.min_thickness if "min_thickness" in said.get("lens", {}) else WALL
    return max(0.0, float(first.min()) - lens.z_in - wall)


def _room(given: LensSettings, said: Given, first: torch.Tensor) -> dict[str, Any]:
    """Height range and thickness as the initial surface requires, where it needs others and the user fixed none."""
    lens = settings.build_lens(given)
    offset = HeightField.of(replace(lens, control=tuple(first.shape)))
    x, y = (c.numpy() for c in offset.control_xy())
    base = lens.offset.heights(x, y)
    departure = 2.0 * float(np.abs(first.numpy() - base).max())
    short = lens.floor - float(first.min())
    fixed, changed = said.get("lens", {}), dict[str, Any]()
    if departure > lens.height_range[1] and "height_range" not in fixed:
        changed["height_range"] = (-departure, departure)
    if short > 0 and "thickness" not in fixed:
        changed["thickness"] = given.thickness + (1.5 * short + 0.02 * max(lens.size))
    return changed


class _Watch:
    """Called after every iteration of a design: progress, movie and checkpoints."""

    def __init__(
        self, project: Project, designer: Designer, records: _Records, say: Reporter, movie: NoMovie, began: Start, state: State
    ):
        self.designer, self.records, self.say, self.movie = designer, records, say, movie
        self.chosen, self.encoding = project.settings.design, project.settings.target.encoding
        self.target = designer.problem.target.numpy()
        lasting = [s for s in designer.stages if not s.spare] or designer.stages
        self.total = self.chosen.iterations or sum(s.iterations for s in lasting)
        self.stage, self.saved = -1, time.monotonic()
        self.now: State | None = None
        self.show: Callable[..., None] = lambda *progress: None
        error_of, count = partial(designer.problem.error_of, designer), designer.problem.effort.cost_points
        self.cost = CostOfAccuracy(began, error_of, self.total, count, state.accuracy)

    def measure(self, now: State, always: bool = False) -> None:
        """Measure the error of the lens, as `CostOfAccuracy.measure` does."""
        self.now = now
        now.accuracy = list(self.cost.measure(now.total, now, always))

    def reaches(self, goal: float) -> bool:
        """Whether the lens has at most this error, which is measured anew where the loss says that it may."""
        now = self.now
        if not goal or now is None or not now.accuracy:
            return False
        last, losses = now.accuracy[-1], {0: math.inf} | {row[0]: row[2] for row in now.history}
        if last.iteration < now.total and last.error * losses[now.total] <= goal * losses[last.iteration]:
            self.measure(now, always=True)
        return now.accuracy[-1].iteration == now.total and now.accuracy[-1].error <= goal

    def __call__(self, now: State) -> None:
        self.now = now
        stages, stage = self.designer.stages, self.designer.stages[now.stage]
        name = f"stage {now.stage + 1}/{len(stages)}"
        if now.stage != self.stage:
            self.stage = now.stage
            self.say.say(f"{name}: {stage.control[0]} x {stage.control[1]} control points, {stage.light}")
        _, _, loss, on_screen, _ = now.history[-1]
        self.show(name, f"loss {loss * grey(self.target).size:.4f}  on screen {on_screen:.1%}", now.total, self.total)
        self.movie.record(now, self.target, self.encoding, bool(stage.waves))
        self.measure_if_due(now)
        self.keep_if_due(now)

    def measure_if_due(self, now: State) -> None:
        """Measure the error of the lens if this iteration is one of those planned."""
        if now.total in self.cost.due:
            self.measure(now)

    def keep_if_due(self, now: State) -> None:
        """Write a checkpoint if the last one is old enough."""
        if time.monotonic() - self.saved >= max(self.chosen.checkpoint_every, RARELY * (self.records.seconds - QUICK)):
            self.measure(now)
            self.saved = time.monotonic()  # before writing, which takes time itself
            self.records.keep(now)


def _run(
    project: Project,
    problem: OneSurface,
    state: State,
    say: Reporter,
    began: Start,
    time_limit: float | None,
    movie: NoMovie = NO_MOVIE,
    goal: float = 0.0,
) -> Result:
    if not problem.in_stages:
        return _run_index(project, problem, state, say, began, time_limit, movie)
    chosen, designer = project.settings.design, Designer(problem)
    limit = chosen.time_limit if time_limit is None else time_limit
    timed = math.isfinite(limit)
    if timed:  # the limit includes the initial surface and the evaluation
        limit = max(LEAST_PART * limit, limit - began.seconds - expected_seconds(designer, state))
    records = _Records(project, designer)
    watch = _Watch(project, designer, records, say, movie, began, state)
    movie.begin(problem.scene)
    prepare_report(project, designer)
    with announce_compilation(say, COMPILING), _signals(project.path is not None) as asked:
        with say.progress(watch.total) as watch.show:
            records.keep(state)
            ranks.send(partial(_joined, project.settings, project.picture, _on_cpu(state), limit, problem.device))
            state = designer.run(
                state,
                iterations=chosen.iterations,
                time_limit=limit,
                stop=lambda: bool(asked) or watch.reaches(goal),
                on_iteration=watch,
                on_objective=watch.measure_if_due,
                notice=say.say,
            )
            if not asked and watch.reaches(goal):
                state.reason = REACHED
            if not asked and not chosen.iterations and problem.options.parametrisation.free and state.reason in DONE:
                start, sharp = (None if z is None else rounded(z) for z in (state.start, state.unrounded))
                state = replace(state, start=start, unrounded=sharp, parameters={}, optimizer={})
            if asked:
                records.keep(state)
                movie.write()
                raise Interrupted(
                    f"interrupted after {state.total} iterations; {project.path / CHECKPOINT} is saved,"
                    f" caustic design ⟨resume⟩ {project.path} continues it",
                    128 + asked[0],
                )
            watch.keep_if_due(state)
            watch.measure(state, always=True)
            state.heights = rounded(designer.within_limits(state))
        with say.waiting("evaluation with independent rays", evaluation_seconds(designer, state)):
            evaluated = evaluate_and_write(project, designer, state, timed)
        field = designer.field(evaluated.state.stage)
        made = manufacture.wall_and_stock(*trace_arguments(problem.scene, field, evaluated.state.heights))
        result = _finished(project, designer, evaluated, made, began, records)
        result = replace(result, figures=result.figures | movie.finish(evaluated.shown, evaluated.figures, say))
        if asked:
            raise Interrupted(f"interrupted after the design had ended; {project.path} is complete", 128 + asked[0])
    if not timed and (words := problem.advice(project.settings.target.size)):
        say.say(words)
    return result


def _run_index(
    project: Project, problem: OneSurface, state: State, say: Reporter, began: Start, time_limit: float | None, movie: NoMovie
) -> Result:
    """Design a free gradient index, evaluate and save it."""
    chosen, lens, target = project.settings.design, project.settings.lens, problem.target.numpy()
    total, limit = chosen.iterations or problem.stages[-1].iterations, chosen.time_limit if time_limit is None else time_limit
    movie.begin(problem.scene)
    with _signals(project.path is not None) as asked:
        say.say(problem.words(lens))
        with say.progress(total) as show:

            def on_iteration(now: State) -> None:
                _, _, loss, on_screen, _ = now.history[-1]
                show("index", f"loss {loss * target.size:.4f}  on screen {on_screen:.1%}", now.total, total)
                movie.record(now, target, project.settings.target.encoding, False)

            values, state = problem.iterate(lens, state, total, began.wall, limit, lambda: bool(asked), on_iteration)
        lens = lens.changed(index_file=attachments.index_attached(values))
        project = replace(project, settings=project.settings.changed(lens=lens))
        if project.path is not None:
            project.write()
        designer = Designer(problem_of(project, problem.device))
        evaluated = evaluate_and_write(project, designer, state, math.isfinite(limit))
        figures = {"index_least": float(np.min(values)), "index_most": float(np.max(values))}
        result = _finished(project, designer, evaluated, figures, began, _Records(project, designer))
        result = replace(result, figures=result.figures | movie.finish(evaluated.shown, evaluated.figures, say))
        if asked:
            continues = f"caustic design ⟨resume⟩ {project.path} continues it"
            raise Interrupted(
                f"interrupted after {state.total} iterations; {project.path} is complete, {continues}", 128 + asked[0]
            )
    return result


def _finished(
    project: Project, designer: Designer, evaluated: Evaluated, more: dict[str, Any], began: Start, records: _Records
) -> Result:
    """The result of an evaluated design, with `more` figures, which is saved."""
    state = evaluated.state
    figures = evaluated.figures | more
    figures |= {
        "accuracy_cost": as_table(state.accuracy),
        "iterations": state.total,
        "seconds": began.seconds,
        "reason": state.reason,
    }
    if project.path is not None:
        figures |= uptodate.made_by(project, figures.get("wave_relative_rms") is not None)
    records.keep(state, figures)
    field = designer.field(state.stage)
    scene, heights = split_heights(designer.scene, field, state.heights)
    return Result(project, scene, field, heights, designer.problem.target.numpy(), state, figures)


class _Records:
    """Writes the checkpoints of a design, if it has a directory."""

    def __init__(self, project: Project, designer: Designer):
        self.project, self.designer, self.inputs = project, designer, uptodate.inputs(project)
        self.provenance = provenance(project, designer.problem.device)
        self._resumes = f"caustic design ⟨resume⟩ {project.path} continues from it"
        self._before = project.path is not None and (project.path / CHECKPOINT).exists()
        self._safe = f"the one before is intact, {self._resumes}" if self._before else "nothing of it is on disk"
        self.seconds = 0.0  # that the last checkpoint took

    def keep(self, now: State, figures: dict[str, Any] | None = None) -> None:
        """Write a checkpoint, with the figures of a finished design.

        Raises:
            CausticError: it could not be written; says which checkpoint is intact.
        """
        if self.project.path is None:
            return
        began = time.monotonic()
        try:
            self.project.save(Checkpoint(now, self.designer.field(now.stage).spaces, self.provenance, figures or {}, self.inputs))
        except CausticError as error:
            raise CausticError(f"{error} after iteration {now.total}; {self._safe}") from error
        if not self._before:  # the first checkpoint
            uptodate.forget_begun(self.project.path)
            self._before = True
        self._safe = f"the one of iteration {now.total} is intact, {self._resumes}"
        self.seconds = time.monotonic() - began


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
def _signals(collect: bool = True) -> Iterator[list[int]]:
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
