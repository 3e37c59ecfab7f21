"""A complete design: run the optimisation of a new or an opened project, save checkpoints, evaluate the lens, report."""

from __future__ import annotations

import math
import time
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
import torch

from caustic_cli.config import settings
from caustic_cli.config.settings import Settings
from caustic_cli.errors import Interrupted
from caustic_cli.inverse.accuracy_cost import Aim, Start, as_table
from caustic_cli.inverse.designer import Designer, InitialHeights, State
from caustic_cli.inverse.target import grey
from caustic_cli.io.picture import Picture
from caustic_cli.kinds import OneSurface, problem_of
from caustic_cli.kinds.evaluation import Evaluated
from caustic_cli.loading import OnDemand
from caustic_cli.optics import ranks
from caustic_cli.optics.surfaces.heightfield import HeightField
from caustic_cli.optics.system import split_heights, trace_arguments
from caustic_cli.project import attachments, directory, uptodate
from caustic_cli.project.completion import complete
from caustic_cli.project.correction import refuse_corrected
from caustic_cli.project.packing import expected_bytes, rounded
from caustic_cli.project.project import CHECKPOINT, Project
from caustic_cli.scene import Scene
from caustic_cli.workflow.compilation import announce_compilation, compile_design, compile_for
from caustic_cli.workflow.estimate import noise_of
from caustic_cli.workflow.evaluation import evaluate_and_write, evaluation_seconds, expected_seconds, prepare_report
from caustic_cli.workflow.movie import NoMovie
from caustic_cli.workflow.preparation import PreparedDesign, solved
from caustic_cli.workflow.progress import Records, Watch, signals_collected
from caustic_cli.workflow.reporter import Reporter

manufacture = OnDemand("caustic_cli.studies.manufacture")

#: Fraction of pixels brighter than NEARLY of the maximum above which a picture is taken for a drawing on white.
GROUND, NEARLY = 0.6, 0.98
#: Reasons of termination after which the state of the optimiser, much larger than the lens, is not saved, unless the number of
#: iterations was given: resuming then restarts the optimiser.
REACHED = "error reached"
DONE = ("iterations", "no progress", REACHED)
#: Least part of a time limit for the iterations, whatever the initial surface took.
LEAST_PART = 0.25
NO_MOVIE = NoMovie()


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
    prepared: PreparedDesign, device: str, say: Reporter, began: Start, movie: NoMovie = NO_MOVIE, aim: Aim | None = None
) -> Result:
    """Run a new design from its initial heights to its end; movie: records it; aim: an error at which it ends.

    A finished design found by `prepare` is returned; an unfinished one is continued.
    """
    project, problem, first = prepared.project, prepared.problem, prepared.first
    if problem is None:
        return _again(project, device, say, began, movie, aim)
    if first is not None:  # as a checkpoint keeps them
        first = InitialHeights(*(None if z is None else rounded(z) for z in first))
    with project.hold:
        _compile(problem, say)
        state = Designer(problem).initial_state(*first or ())
        if problem.in_stages:
            _say_limits(project, problem, first, say)
        result = _run(project, problem, state, say, began, None, movie, aim)
        if aim and result.state.reason == REACHED and result.figures["error"] > aim.error + noise_of(result.figures):
            closer = aim.closer(result.figures["error"])
            result = _run(project, problem, Designer(problem).restored(result.state), say, began, None, movie, closer)
        return result


def _again(project: Project, device: str, say: Reporter, began: Start, movie: NoMovie, aim: Aim | None) -> Result:
    """The result of a design found by `prepare`."""
    figures = uptodate.finished(project, project.checkpoint)
    if figures and figures["reason"].startswith(REACHED) and not (aim and figures["error"] <= aim.error):
        figures = {}  # it ended for a larger error
    rest = "there is nothing to do; ⟨force⟩ designs it anew" if figures else "it continues from its checkpoint"
    say.say(f"{project.path}: was designed from the same picture with the same options, so {rest}")
    if not figures:
        return resume(project, None, None, device, say, began, movie, aim)
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
    aim: Aim | None = None,
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
            first = solved(project, problem, fixed=True)
            state = designer.initial_state(*designer.initial_heights(None if first is None else first.heights) or ())
        _refuse_edited(project, designer, state)
        state = designer.restored(state)
        if iterations is not None:
            changed = project.settings.design.changed(iterations=iterations)
            project = replace(project, settings=project.settings.changed(design=changed))
            project.write_settings()
        project = replace(project, asked=uptodate.asked_of(project, checkpoint) if has_checkpoint else uptodate.begun(project))
        return _run(project, problem, state, say, began, time_limit, movie, aim)


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


def _joined(settings: Settings, picture: Picture, state: State, limit: float, device: str) -> None:
    """Run a design together with the first rank, without reading or writing files."""
    problem = problem_of(Project(None, settings, picture), device)
    Designer(problem).run(state, iterations=settings.design.iterations, time_limit=limit)


def _joined_index(settings: Settings, picture: Picture, state: State, total: int, device: str) -> None:
    """The same for a gradient index."""
    problem = problem_of(Project(None, settings, picture), device)
    problem.iterate(settings.lens, state, total, time.monotonic(), math.inf, lambda: False, lambda now: None)


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


def _run(
    project: Project,
    problem: OneSurface,
    state: State,
    say: Reporter,
    began: Start,
    time_limit: float | None,
    movie: NoMovie = NO_MOVIE,
    aim: Aim | None = None,
) -> Result:
    if not problem.in_stages:
        return _run_index(project, problem, state, say, began, time_limit, movie)
    chosen, designer = project.settings.design, Designer(problem)
    limit = chosen.time_limit if time_limit is None else time_limit
    timed = math.isfinite(limit)
    if timed:  # the limit includes the initial surface and the evaluation
        limit = max(LEAST_PART * limit, limit - began.seconds - expected_seconds(designer, state))
    records = Records(project, designer)
    watch = Watch(project, designer, records, say, movie, began, state)
    movie.begin(problem.scene)
    prepare_report(project, designer)
    with announce_compilation(say), signals_collected(project.path is not None) as asked, records:
        with say.progress(watch.total) as watch.show:
            records.keep_behind(state)
            if aim is not None and not designer.stages[-1].waves:  # before an objective that may not be needed
                watch.measure(state)
            with ranks.together(partial(_joined, project.settings, project.picture, _on_cpu(state), limit, problem.device)):
                state = designer.run(
                    state,
                    iterations=chosen.iterations,
                    time_limit=limit,
                    stop=lambda: bool(asked) or watch.reaches(aim),
                    further=lambda: watch.goes_on(aim),
                    on_iteration=watch,
                    on_objective=watch.measure_if_due,
                    notice=say.say,
                )
            if not asked and watch.reaches(aim):
                state.reason = REACHED
            if not asked and not chosen.iterations and problem.options.parametrisation.free and state.reason in DONE:
                start, sharp = (None if z is None else rounded(z) for z in (state.start, state.unrounded))
                state = replace(state, start=start, unrounded=sharp, parameters={}, optimizer={})
            if asked:
                records.keep(state)
                movie.write()
                saved = f"{project.path / CHECKPOINT} is saved, caustic design ⟨resume⟩ {project.path} continues it"
                raise Interrupted(f"interrupted after {state.total} iterations; {saved}", 128 + asked[0])
            watch.keep_if_due(state)
            state.heights = rounded(designer.within_limits(state))
            records.prepare(state)
            watch.measure(state, always=True)
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
    """Design a free gradient index, and a surface with it if asked for; evaluate and save it."""
    chosen, lens, target = project.settings.design, project.settings.lens, problem.target.numpy()
    total, limit = chosen.iterations or problem.stages[-1].iterations, chosen.time_limit if time_limit is None else time_limit
    movie.begin(problem.scene)
    with signals_collected(project.path is not None) as asked:
        say.say(problem.words(lens))
        with say.progress(total) as show:

            def on_iteration(now: State) -> None:
                _, _, loss, on_screen, _ = now.history[-1]
                show("index", f"loss {loss * grey(target).size:.4f}  on screen {on_screen:.1%}", now.total, total)
                movie.record(now, target, project.settings.target.encoding, False)

            with ranks.together(partial(_joined_index, project.settings, project.picture, _on_cpu(state), total, problem.device)):
                values, state = problem.iterate(lens, state, total, began.wall, limit, lambda: bool(asked), on_iteration)
        if not asked and not chosen.iterations and state.reason in DONE:
            state = replace(state, optimizer={})
        lens = lens.changed(index_file=attachments.index_attached(values))
        project = replace(project, settings=project.settings.changed(lens=lens))
        if project.path is not None:
            project.write()
        designer = Designer(problem_of(project, problem.device))
        evaluated = evaluate_and_write(project, designer, state, math.isfinite(limit))
        figures = {"index_least": float(np.min(values)), "index_most": float(np.max(values))}
        result = _finished(project, designer, evaluated, figures, began, Records(project, designer))
        result = replace(result, figures=result.figures | movie.finish(evaluated.shown, evaluated.figures, say))
        if asked:
            continues = f"caustic design ⟨resume⟩ {project.path} continues it"
            raise Interrupted(
                f"interrupted after {state.total} iterations; {project.path} is complete, {continues}", 128 + asked[0]
            )
    return result


def _finished(
    project: Project, designer: Designer, evaluated: Evaluated, more: dict[str, Any], began: Start, records: Records
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
