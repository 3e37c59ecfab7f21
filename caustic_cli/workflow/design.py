"""A complete design: create or open the project, run the optimisation, save checkpoints, evaluate the lens, report.

Nothing is written before everything the user gave has been checked.
"""

from __future__ import annotations

import hashlib
import math
import signal
import threading
import time
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from caustic_cli import __version__
from caustic_cli.config import settings
from caustic_cli.config.completion import PLATE, WALL, build_options, build_stages, complete, shape_words
from caustic_cli.config.default_stages import transport_cells
from caustic_cli.config.settings import Given
from caustic_cli.config.table import TABLE, LensSettings
from caustic_cli.errors import CausticError, InputError, Interrupted, at_most
from caustic_cli.inverse import ranks
from caustic_cli.inverse.deconvolution import SMOOTH_STEPS
from caustic_cli.inverse.designer import Designer, InitialHeights, State
from caustic_cli.inverse.initial_surface import InitialSurface, first_surface
from caustic_cli.inverse.initial_two_sided import first_sides
from caustic_cli.inverse.lenslets import initial_array
from caustic_cli.inverse.reachability import largest_magnification, refuse_unreachable
from caustic_cli.inverse.sharpness import advice
from caustic_cli.inverse.source_limits import best_irradiance, point_source, source_spread
from caustic_cli.inverse.surface_from_map import OutOfReach
from caustic_cli.inverse.target import grey
from caustic_cli.io.files import Piped
from caustic_cli.io.picture import Picture
from caustic_cli.io.surfaces import SUFFIXES, onto, read_surface
from caustic_cli.optics.emission.measured import coarse_words
from caustic_cli.optics.obstruction import refuse_obstructed
from caustic_cli.optics.resolution import Resolution
from caustic_cli.optics.surfaces.heightfield import HeightField
from caustic_cli.optics.system import split_heights
from caustic_cli.project import directory, uptodate
from caustic_cli.project.checkpoint import Checkpoint
from caustic_cli.project.new import new_project
from caustic_cli.project.packing import expected_bytes, rounded
from caustic_cli.project.project import CHECKPOINT, Project, is_project
from caustic_cli.scene import Scene
from caustic_cli.studies.manufacture import preview, wall_and_stock
from caustic_cli.workflow.compilation import announce_compilation, compile_usual
from caustic_cli.workflow.evaluation import evaluate_and_write, evaluation_seconds, expected_seconds
from caustic_cli.workflow.gradient_index import design_index, index_figures, is_free, limit_of
from caustic_cli.workflow.movie import Movie
from caustic_cli.workflow.reporter import Reporter

#: Fraction of pixels brighter than NEARLY of the maximum above which a picture is taken for a drawing on white.
GROUND, NEARLY = 0.6, 0.98
#: Reasons of termination after which the state of the optimiser, much larger than the lens, is not saved, unless the number of
#: iterations was given: resuming then restarts the optimiser.
DONE = ("iterations", "no progress")
#: Fractions of a time limit: least for the iterations, whatever the initial surface took; and most for the initial surface.
LEAST_PART, START_PART = 0.25, 0.3
#: Time of a checkpoint, s, beyond which the interval to the next one grows, and the factor of the excess.
QUICK, RARELY = 0.5, 10.0
#: Least number of source cells along a lenslet.
LEAST_CELLS = 128


def begin(
    target: Path | Piped | Picture,
    given: Mapping[str, Any],
    *,
    preset: str | None = None,
    config: Path | None = None,
    out: Path | None = None,
    force: bool = False,
    recorded: bool = False,
    say: Reporter,
    device: str = "cpu",
) -> tuple[Project, InitialHeights | None]:
    """Validate all input, then create the project directory, if any; also returns the initial heights, None for the offset surface.

    If the same design exists already, finished or not, its project is opened instead (`Project.found`).

    Args:
        given: path in `config.table` -> value, including derived parameters such as "mag".
        preset: a name of `config.presets`, whose settings are overridden by those of config.
        config: a TOML file of further settings, which are overridden by those `given`.
        out: the directory; None for a design in memory.
        force: replace a project there; recorded: whether a movie of the design is to be made.
        device: of the design, whose kernels are compiled after the validation.

    Raises:
        InputError: invalid input; nothing was written.
    """
    project, said = new_project(target, given, preset, config, out, say.say)
    if recorded and is_free(project):
        raise InputError("⟨movie⟩ records the design of a surface; ⟨lens.gradient⟩ free designs the index")
    if out is not None and not force:
        if same := uptodate.same_design(out, project.asked):
            return replace(same[0], found=same[1]), None
        force = uptodate.is_begun(out, project.asked)  # and interrupted before the first checkpoint: it is begun anew
    designer, goal = _designer(project, "cpu")  # builds and thereby validates scene, target, stages, options
    for scene in designer.scenes:
        refuse_obstructed(scene)
    if out is not None:
        directory.check(out, force)  # before the transport, which may take a minute
    if designer.scene.second is None and not designer.scene.elements:
        for scene in designer.scenes:
            refuse_unreachable(scene, grey(goal))
    if words := shape_words(project.settings):
        say.say(words)
    compile_usual(device, say)
    with (
        announce_compilation(say, "compiling the kernels of the transport, once: about half a minute"),
        say.notify_if_slow("solving the transport of the light to the picture"),
    ):
        try:
            project, first = first_heights(project, said)
        except OutOfReach as error:
            most = largest_magnification(designer.scene, project.settings.target.size)
            most = min(most or 0.0, TABLE["mag"].high)
            within = f"; ⟨+mag⟩ of at most about {at_most(most, 2)} is within reach at this throw" if most else ""
            raise InputError(f"{error}{within}") from error
    if out is not None:
        directory.create(project, force)
    return project, first


def first_heights(project: Project, said: Given) -> tuple[Project, InitialHeights | None]:
    """Initial heights of a design, None for the offset surface; and the project with thickness and height range adapted to them,
    except for values `said` by the user.

    Raises:
        InputError: as of `begin`.
    """
    fixed = "thickness" in said.get("lens", {})
    first, middle = _solved(project, fixed)
    if project.settings.second is not None:
        return project, _designer(project, "cpu")[0].initial_heights(first)
    if middle is not None:
        project = _with_lens(project, thickness=middle)
    if first is not None and not fixed and (spare := _spare(project.settings.lens, said, first)) > 0:
        middle = project.settings.lens.thickness - spare
        project = _with_lens(project, thickness=middle)
        first = _solved(project, fixed=True)[0]
    if first is not None and (room := _room(project.settings.lens, said, first)):
        project = _with_lens(project, **room)
        if middle is None:
            _designer(project, "cpu")
            first, _ = _solved(project, fixed)
    return project, _designer(project, "cpu")[0].initial_heights(first)


def _with_lens(project: Project, **values: Any) -> Project:
    """The project with other settings of its lens."""
    full = project.settings
    return replace(project, settings=full.changed(lens=full.lens.changed(**values)))


@dataclass(frozen=True)
class Result:
    """A finished design: its project, its lens, and the figures of the JSON table.

    scene: with the designed entrance, if that is free-form; heights: (n, m) mm of the exit.
    """

    project: Project
    scene: Scene
    field: HeightField
    heights: torch.Tensor
    target: np.ndarray
    state: State
    figures: dict[str, Any]


def design(
    project: Project, first: InitialHeights | None, device: str, say: Reporter, began: float, movie: Movie | None = None
) -> Result:
    """Run a new design from its initial heights to its end; movie: records it.

    A finished design found by `begin` is returned; an unfinished one is continued.
    """
    if project.found is not None:
        figures = uptodate.finished(project, project.found)
        say.say(
            f"{project.path}: was designed from the same picture with the same options, so "
            + (
                "there is nothing to do; ⟨force⟩ designs it anew"
                if figures
                else "it is designed again"
                if is_free(project)
                else "it continues from its checkpoint"
            )
        )
        if not figures and is_free(project):
            project.hold.enter_context(directory.locked(project.path))
            return design(replace(project, asked=uptodate.asked_of(project, project.found), found=None), None, device, say, began)
        if not figures:
            return resume(project, None, None, device, say, began, movie)
        if movie is not None:
            say.say(f"{movie.path}: is not written, since no design was run")
        scene = project.scene()
        target = project.target(scene)
        scene, field, heights, checkpoint = project.lens(scene)
        return Result(project, scene, field, heights, target, checkpoint.state, figures)
    with project.hold:
        if is_free(project):
            return _run_index(project, say, began, device)
        designer, target = _designer(project, device)
        _say_limits(project, designer, target, first, say)
        return _run(project, designer, target, designer.begin(*first or ()), say, began, None, device, movie)


def _say_limits(project: Project, designer: Designer, target: np.ndarray, first: InitialHeights | None, say: Reporter) -> None:
    """Report the limits set by diffraction and an extended source, and manufacturing figures of the initial surface."""
    light = grey(project.picture.irradiance())
    if (ground := float((light >= NEARLY * light.max()).mean())) > GROUND and light.min() < 0.5 * light.max():
        say.say(f"{ground:.0%} of the picture are at its maximum: for a drawing on white, ⟨invert⟩ makes the lines bright")
    if coarse := coarse_words(designer.scene):
        say.say(coarse)
    seen = Resolution.before(designer.scene, project.settings.target.size)
    if not designer.scene.elements:
        say.say(seen.sentence())
    timed = math.isfinite(project.settings.design.time_limit)
    words = designer.source_limits(SMOOTH_STEPS if timed else None).sentence()
    if words:
        say.say(words)
    if designer.scene.joint:
        return
    if seen.matters and project.settings.design.waves == "auto" and project.without_waves:
        say.say(f"the wave image is not refined: {project.without_waves}")
    field = designer.field(0)
    heights = designer.begin().heights if first is None else first.heights
    nets = 3 if first is not None and first.unrounded is not None else 2
    say.say(preview(designer.scene, field, heights, nets * expected_bytes(heights.numel())))


def _listed(wavelengths: tuple[float, ...]) -> str:
    """Numbers as a comma-separated list."""
    return ", ".join(f"{w:.4g}" for w in wavelengths)


def resume(
    project: Project,
    iterations: int | None,
    time_limit: float | None,
    device: str,
    say: Reporter,
    began: float,
    movie: Movie | None = None,
) -> Result:
    """Continue from the last checkpoint; with nothing left to do, evaluate the lens again."""
    with project.hold:
        if is_free(project):
            raise project.error("⟨lens.gradient⟩ free cannot be resumed: design it anew, with more ⟨iterations⟩")
        project.hold.enter_context(directory.locked(project.path))
        designer, target = _designer(project, device)
        for scene in designer.scenes:
            refuse_obstructed(scene)
        begun = (project.path / CHECKPOINT).exists()  # else it was killed before its first checkpoint
        before = project.load() if begun else None
        state = before.state if begun else designer.begin(*designer.initial_heights(_solved(project, fixed=True)[0]) or ())
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
        state = designer.restored(state)
        if iterations is not None:
            changed = project.settings.design.changed(iterations=iterations)
            project = replace(project, settings=project.settings.changed(design=changed))
            project.write_settings()
        project = replace(project, asked=uptodate.asked_of(project, before) if begun else uptodate.begun(project))
        return _run(project, designer, target, state, say, began, time_limit, device, movie)


def follow(device: str) -> None:
    """Main loop of all ranks but the first: run each design it sends, without reading or writing files."""
    with _signals():  # handled by the first rank
        while task := ranks.receive():
            *parts, state, limit = task
            project = Project(None, *parts)
            _designer(project, device)[0].run(state, iterations=project.settings.design.iterations, time_limit=limit)


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


def _designer(project: Project, device: str) -> tuple[Designer, np.ndarray]:
    scene = project.scene()
    target = project.target(scene)
    stages, chosen = build_stages(project.settings), build_options(project.settings)
    own = [torch.from_numpy(one) for one in project.targets(scene)]
    second = project.second_target(scene)
    farther = None if second is None else torch.from_numpy(second)
    return Designer(scene, torch.from_numpy(target), stages, chosen, device, own, farther), target


def _solved(project: Project, fixed: bool) -> tuple[torch.Tensor | None, float | None]:
    """Initial heights on the control net of the first stage, by transport or from another lens, None for the offset surface as it
    is; and the thickness that belongs to them, None if unchanged.

    fixed: the thickness is given by the user; a transport surface below the least thickness is raised, which leaves slopes
    unchanged.

    Raises:
        InputError: the project or surface cannot be read, its lens has another size, or the picture cannot be reached.
    """
    start = project.settings.design.start
    if start == "offset":
        return _aimed_offset(project), None
    if start == "transport":
        designer, target = _designer(project, "cpu")
        scene, goal = designer.scene, grey(target)
        if scene.second is not None:
            return first_sides(scene, goal, project.second_target(scene), designer.field(0)), None
        spans = min(n - p for n, p in zip(designer.stages[0].control, scene.lens.degree, strict=True))
        cells = transport_cells(max(s.rays for s in designer.stages), not scene.source.collimated, spans)
        spread = source_spread(scene) if designer.stages[0].spread else None
        if spread is not None:
            light = best_irradiance(scene, goal, spread, SMOOTH_STEPS)
            scene, goal = replace(scene, source=point_source(scene), screen=scene.screen.grown(light.beside)), light.light
        if scene.lens.arrayed:
            goals = [goal] if len(designer.own) == 1 else [grey(own.numpy()) for own in designer.own]
            cells = max(LEAST_CELLS, cells // max(scene.lens.array))
            found = InitialSurface(initial_array(scene, goals, designer.stages[0].control, cells).heights)
        else:
            seconds = START_PART * project.settings.design.time_limit
            found = first_surface(scene, goal, designer.field(0), cells, fixed, seconds)
        lens = designer.scene.lens
        short = lens.z_in + lens.min_thickness - float(found.heights.min())
        return found.heights + 1.01 * short if fixed and short > 0 else found.heights, found.middle
    net = _designer(project, "cpu")[0].field(0)
    if Path(start).suffix.lower() in SUFFIXES and not Path(start).is_dir():
        return onto(*read_surface(start, net.half_size), net), None
    if not is_project(Path(start)):
        raise InputError(
            "⟨design.start⟩ must be transport, offset, a project directory or a lens surface"
            f" ({', '.join(SUFFIXES)}), got {start!r}"
        )
    other = Project.open(start)
    _, field, heights, _ = other.lens(other.scene())
    sizes = [list(one.settings.lens.size) for one in (other, project)]
    if sizes[0] != sizes[1]:
        raise InputError(f"⟨design.start⟩: the lens of {start} is {sizes[0]} mm, not {sizes[1]} mm")
    return onto(field, heights, net), None


def _aimed_offset(project: Project) -> torch.Tensor | None:
    """The offset surface with the slope that turns its light to the centre of a shifted screen; None for one that is not shifted,
    or for a network, whose heights are relative to the offset surface."""
    scene, shift = project.scene(), project.scene().screen.shift
    if not any(shift) or project.settings.design.network != "none":
        return None
    lens = scene.lens
    x, y = (c.numpy() for c in _designer(project, "cpu")[0].field(0).control_xy())
    slope = [c / ((lens.effective_index - 1.0) * (scene.screen.z - lens.offset.thickness)) for c in shift]
    return torch.from_numpy(lens.offset.heights(x, y) + slope[0] * x[:, None] + slope[1] * y[None, :])


def _spare(lens: LensSettings, said: Given, first: torch.Tensor) -> float:
    """Excess thickness of a plate below its initial surface beyond the wall, which may be given, mm; 0 for another lens."""
    if max(lens.size) <= PLATE:
        return 0.0
    wall = lens.min_thickness if "min_thickness" in said.get("lens", {}) else WALL
    return max(0.0, float(first.min()) - lens.z_in - wall)


def _room(given: LensSettings, said: Given, first: torch.Tensor) -> dict[str, Any]:
    """Height range and thickness as the initial surface requires, where it needs others and the user fixed none."""
    lens = settings.build_lens(given)
    offset = HeightField.of(replace(lens, control=tuple(first.shape)))
    x, y = (c.numpy() for c in offset.control_xy())
    base = lens.offset.heights(x, y)
    departure = 2.0 * float(np.abs(first.numpy() - base).max())
    short = lens.z_in + lens.min_thickness - float(first.min())
    fixed, changed = said.get("lens", {}), dict[str, Any]()
    if departure > lens.height_range[1] and "height_range" not in fixed:
        changed["height_range"] = (-departure, departure)
    if short > 0 and "thickness" not in fixed:
        changed["thickness"] = given.thickness + (1.5 * short + 0.02 * max(lens.size))
    return changed


def _run(
    project: Project,
    designer: Designer,
    target: np.ndarray,
    state: State,
    say: Reporter,
    began: float,
    time_limit: float | None,
    device: str,
    movie: Movie | None = None,
) -> Result:
    chosen = project.settings.design
    limit = chosen.time_limit if time_limit is None else time_limit
    timed = math.isfinite(limit)
    if timed:  # the limit includes the initial surface and the evaluation
        after = expected_seconds(designer, target, state, device)
        limit = max(LEAST_PART * limit, limit - (time.monotonic() - began) - after)
    records = _Records(project, designer, device)
    if movie is not None:
        movie.screen = designer.scene.screen
    total = chosen.iterations or sum(s.iterations for s in designer.stages)
    with _signals(project.path is not None) as asked, ExitStack() as shown:
        show = shown.enter_context(say.progress(total))
        stage, saved = -1, time.monotonic()

        def on_iteration(now: State) -> None:
            nonlocal stage
            if now.stage != stage:
                stage = now.stage
                s = designer.stages[stage]
                light = f"the wave image at {_listed(s.waves)} nm" if s.waves else f"{s.rays:,} rays, blur {s.blur:g} px"
                say.say(f"stage {stage + 1}/{len(designer.stages)}: {s.control[0]} x {s.control[1]} control points, {light}")
            _, _, loss, on_screen, _ = now.history[-1]
            show(
                f"stage {stage + 1}/{len(designer.stages)}",
                f"loss {loss * grey(target).size:.4f}  on screen {on_screen:.1%}",
                now.total,
                total,
            )
            if movie is not None:
                movie.record(now, target, project.settings.target.encoding, bool(designer.stages[stage].waves))
            keep_if_due(now)

        def keep_if_due(now: State) -> None:
            nonlocal saved
            if time.monotonic() - saved >= max(chosen.checkpoint_every, RARELY * (records.seconds - QUICK)):
                saved = time.monotonic()  # before writing, which takes time itself
                records.keep(now)

        records.keep(state)
        ranks.send((project.settings, project.picture, _on_cpu(state), limit))
        state = designer.run(
            state,
            iterations=chosen.iterations,
            time_limit=limit,
            stop=lambda: bool(asked),
            on_iteration=on_iteration,
            notice=say.say,
        )
        if not asked and not chosen.iterations and chosen.network == "none" and state.reason in DONE:
            start, sharp = (None if z is None else rounded(z) for z in (state.start, state.unrounded))
            state = replace(state, start=start, unrounded=sharp, parameters={}, optimizer={})
        if asked:
            records.keep(state)
            if movie is not None:
                movie.write()
            raise Interrupted(
                f"interrupted after {state.total} iterations; {project.path / CHECKPOINT} is saved,"
                f" caustic design ⟨resume⟩ {project.path} continues it",
                128 + asked[0],
            )
        keep_if_due(state)
        state.heights = rounded(designer.within_limits(state))
        shown.close()
        with say.waiting("evaluation with independent rays", evaluation_seconds(designer, state)):
            found = evaluate_and_write(project, designer, target, state, device, timed)
        made = wall_and_stock(designer.scene, designer.field(found.state.stage), designer.exit(found.state))
        figures = (
            found.figures | made | {"iterations": state.total, "seconds": time.monotonic() - began, "reason": found.state.reason}
        )
        if project.path is not None:
            figures |= uptodate.made_by(project, figures.get("wave_relative_rms") is not None)
        records.keep(found.state, figures)
        if movie is not None:
            movie.finish(found.image if found.waves is None else found.waves, found.figures)
            movie.write()
            say.say(f"{movie.path}: {len(movie.frames)} frames of the design")
            figures = figures | {"movie": str(movie.path)}
        if asked:
            raise Interrupted(f"interrupted after the design had ended; {project.path} is complete", 128 + asked[0])
    field = designer.field(found.state.stage)
    scene, heights = split_heights(designer.scene, field, found.state.heights)
    size = project.settings.target.size
    if not timed and scene.second is None and (words := advice(scene, grey(target), size)):
        say.say(words)
    return Result(project, scene, field, heights, target, found.state, figures)


def _run_index(project: Project, say: Reporter, began: float, device: str) -> Result:
    """Design a free gradient index, evaluate and save it."""
    with _signals(project.path is not None) as asked:
        found = design_index(project, say, began, limit_of(project), lambda: bool(asked))
        project, state = found.project, found.state
        designer, target = _designer(project, device)
        judged = evaluate_and_write(project, designer, target, state, device, math.isfinite(limit_of(project)))
        figures = judged.figures | index_figures(project)
        figures |= {"iterations": state.total, "seconds": time.monotonic() - began, "reason": state.reason}
        if project.path is not None:
            figures |= uptodate.made_by(project, figures.get("wave_relative_rms") is not None)
        _Records(project, designer, device).keep(state, figures)
        if asked:
            raise Interrupted(f"interrupted after {state.total} iterations; {project.path} is complete", 128 + asked[0])
    return Result(project, designer.scene, designer.field(0), state.heights, target, state, figures)


class _Records:
    """Writes the checkpoints of a design, if it has a directory."""

    def __init__(self, project: Project, designer: Designer, device: str):
        self.project, self.designer, self.inputs = project, designer, uptodate.inputs(project)
        self.provenance = provenance(project, device)
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

    before = {number: signal.signal(number, handler) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield asked
    finally:
        for number, old in before.items():
            signal.signal(number, old)
