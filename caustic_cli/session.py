"""A design from beginning to end: make or open the project, run the loop, keep checkpoints, judge the lens, report.

Nothing is written before everything the user gave has been checked.
"""

from __future__ import annotations

import hashlib
import os
import signal
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from caustic_cli import __version__, settings
from caustic_cli.checkpoint import Checkpoint
from caustic_cli.console import Reporter
from caustic_cli.derive import build_options, build_stages, complete
from caustic_cli.errors import InputError, Interrupted
from caustic_cli.inverse.designer import Designer, State
from caustic_cli.inverse.first import first_surface
from caustic_cli.inverse.target import grey
from caustic_cli.optics.heightfield import HeightField
from caustic_cli.picture import read_picture
from caustic_cli.project import CHECKPOINT, RENDER, REPORT, TOML, Project, is_project
from caustic_cli.scene import Scene
from caustic_cli.scene.source import blur_limit
from caustic_cli.surfaces import SUFFIXES, onto, read_surface
from caustic_cli.verdict import judge

#: Part of a time limit that is left to the iterations, however long the start took.
LEAST_PART = 0.25


def begin(target: Path, out: Path | None, given: dict, screen, pixels, shaped: dict, config: Path | None,
          force: bool) -> tuple[Project, torch.Tensor | None]:
    """Check everything, then make the project directory; also returns the first heights, None for the offset surface.

    Args:
        given: (section, key, option) -> value, what the options say.
        screen: --screen-size, one or two lengths; pixels: --resolution, one or two counts; shaped: mag, margin, quality, rays.

    Raises:
        InputError: something is wrong; nothing was written.
    """
    said = settings.read(config) if config else {}
    for (section, key, _), value in given.items():
        said.setdefault(section, {})[key] = value
    if "index" in said.get("lens", {}) and "glass" in said["lens"]:
        names = [option for (_, key, option) in given if key in ("index", "glass")]
        if len(names) == 1:  # an option replaces what the configuration says
            del said["lens"]["glass" if names[0] == "--index" else "index"]
    goal = said.get("target", {})
    picture = read_picture(target, goal.get("encoding") == "linear", goal.get("color", False))
    if goal.get("color", False):
        light = [float(c) for c in picture.irradiance().sum((1, 2))]
        said.setdefault("source", {}).setdefault("weights", [c / sum(light) for c in light])
    if screen:
        height = screen[1] if len(screen) == 2 else screen[0] * picture.aspect
        said.setdefault("screen", {})["size"] = [screen[0], height]
        given = {**given, ("screen", "size", "--screen-size"): screen}
    if pixels and len(pixels) == 2:
        said.setdefault("screen", {})["resolution"] = list(pixels)
    elif pixels:
        said.get("screen", {}).pop("resolution", None)
    given = {**given, ("screen", "resolution", "--resolution"): pixels}
    profile = said.get("source", {}).get("profile")
    light = read_picture(config.parent / profile, linear=True) if profile else None
    path = out or Path(f"{target.stem or 'design'}.caustic")
    _check_place(path, force)  # before the transport, which may take a minute
    try:
        full = complete(said, picture.aspect, width=pixels[0] if pixels and len(pixels) == 1 else None, **shaped)
        settings.refuse_unused(full["source"], given, [stage.get("source") for stage in full["design"]["stages"]])
        full["target"] |= {"file": f"target{picture.suffix}", "encoding": picture.encoding}
        if light is not None:
            full["source"]["profile"] = f"profile{light.suffix}"
        project = Project(path, full, picture, light)
        _designer(project, "cpu")  # builds and so checks scene, target, stages, options
        first = _first_heights(project)
        if first is not None and _make_room(full, said, first):
            _designer(project, "cpu")
            first = _first_heights(project)
        if first is not None:
            first = _designer(project, "cpu")[0].within_limits(State(first))
    except InputError as error:  # about a project.toml that is not written yet
        raise InputError(settings.as_options(str(error).removeprefix(f"{path / TOML}: "), given)) from error
    _make_directory(path, force)
    project.write()
    return project, first


def find(target: Path, out: Path | None) -> Project:
    """The project that --resume means: TARGET itself, or the one that designing TARGET would make."""
    path = target if target.is_dir() else (out or Path(f"{target.stem}.caustic"))
    if not target.exists() and not path.exists():
        raise InputError(f"{target}: no such project; --resume needs a directory made by caustic design")
    return Project.open(path)


def design(project: Project, first: torch.Tensor | None, device: str, say: Reporter, began: float) -> dict:
    """Run a new design from its first heights to its end; returns the figures of the JSON table."""
    designer, target = _designer(project, device)
    _say_blur(designer.scene, say)
    state = designer.begin(first)
    return _run(project, designer, target, state, say, began, 0, None, device)


def _say_blur(scene: Scene, say: Reporter) -> None:
    """What no lens can do about an extended source, before time is spent on it."""
    blur, pixel = blur_limit(scene.source, scene.lens.z_in, abs(scene.screen.z - scene.lens.z_in)), max(scene.screen.pixel)
    if blur > 0:
        finer = f"; the picture's detail below that, {blur / pixel:.3g} pixels, is out of reach" if blur > pixel else ""
        say.say(f"the source's own size blurs every point over {blur:.3g} mm on the screen{finer}")


def resume(project: Project, iterations: int | None, time_limit: float | None, device: str, say: Reporter,
           began: float) -> dict:
    """Go on from the last checkpoint; with nothing left to do, judge the lens again."""
    designer, target = _designer(project, device)
    state = project.load().state
    if state.stage >= len(designer.stages):
        raise InputError(f"{project.path / TOML}: has {len(designer.stages)} stages, but the checkpoint stands in stage"
                         f" {state.stage + 1}")
    if tuple(state.heights.shape) != designer.stages[state.stage].control:
        raise InputError(f"{project.path / TOML}: stage {state.stage + 1} has control"
                         f" {list(designer.stages[state.stage].control)}, but the checkpoint {list(state.heights.shape)}")
    state = designer.restored(state)
    if iterations is not None:
        project.settings["design"]["iterations"] = iterations
        project.write()
    return _run(project, designer, target, state, say, began, iterations, time_limit, device)


def sphere() -> tuple[Scene, HeightField, torch.Tensor]:
    """The lens a design begins from when nothing but defaults is said, its field and heights."""
    full = complete({}, 1.0)
    scene = settings.build_scene(full)
    field = HeightField.of(scene.lens)
    x, y = (c.numpy() for c in field.control_xy())
    offset = scene.lens.offset
    return scene, field, torch.from_numpy(offset.thickness + offset.sag(x[:, None], y[None, :]))


def _designer(project: Project, device: str) -> tuple[Designer, np.ndarray]:
    scene = project.scene()
    target = project.target(scene)
    stages, chosen = build_stages(project.settings), build_options(project.settings)
    return Designer(scene, torch.from_numpy(target), stages, chosen, device), target


def _first_heights(project: Project) -> torch.Tensor | None:
    """Heights of the transport start or of --start on the first stage's net, or None for the offset surface.

    Raises:
        InputError: no such project or surface, its lens is of another size, or transport cannot reach the picture.
    """
    start = project.settings["design"]["start"]
    if start == "offset":
        return None
    if start == "transport":
        designer, target = _designer(project, "cpu")
        return first_surface(designer.scene, grey(target), designer.field(0))
    net = _designer(project, "cpu")[0].field(0)
    if Path(start).suffix.lower() in SUFFIXES and not Path(start).is_dir():
        return onto(*read_surface(start, net.half_size), net)
    if not is_project(Path(start)):
        raise InputError("[design] start must be transport, offset, a project directory or a lens surface"
                         f" ({', '.join(SUFFIXES)}), got {start!r}")
    other = Project.open(start)
    field, checkpoint = other.lens(other.scene())
    if other.settings["lens"]["size"] != project.settings["lens"]["size"]:
        raise InputError(f"[design] start: the lens of {start} is {other.settings['lens']['size']} mm, not"
                         f" {project.settings['lens']['size']} mm")
    return onto(field, checkpoint.state.heights, net)


def _make_room(full: dict, said: dict, first: torch.Tensor) -> bool:
    """Widen height_range and thickness, unless the user fixed them, to what the first surface needs; True if they changed."""
    lens = settings.build_lens(full)
    offset = HeightField.of(replace(lens, control=tuple(first.shape)))
    x, y = (c.numpy() for c in offset.control_xy())
    base = lens.offset.thickness + lens.offset.sag(x[:, None], y[None, :])
    departure = 2.0 * float(np.abs(first.numpy() - base).max())
    short = lens.z_in + lens.min_thickness - float(first.min())
    fixed, changed = said.get("lens", {}), False
    if departure > lens.height_range[1] and "height_range" not in fixed:
        full["lens"]["height_range"], changed = [-departure, departure], True
    if short > 0 and "thickness" not in fixed:
        full["lens"]["thickness"] += 1.5 * short + 0.02 * max(lens.size)
        changed = True
    return changed


def _check_place(path: Path, force: bool) -> None:
    """Refuse a path where something stands that a new project must not replace; changes nothing.

    Raises:
        InputError: it is no directory, not a project, a project without `force`, or cannot be written to.
    """
    place = path if path.exists() else path.parent
    if not place.exists() or not os.access(place, os.W_OK):
        reason = "no such directory" if not place.exists() else "permission denied"
        raise InputError(f"{path}: cannot be written to ({reason}); -o DIR chooses another place")
    if not path.exists():
        return
    if not path.is_dir():
        raise InputError(f"{path}: exists and is not a directory; -o DIR chooses another place")
    if any(path.iterdir()):
        if not is_project(path):
            raise InputError(f"{path}: exists and is not a caustic project; -o DIR chooses another place")
        if not force:
            raise InputError(f"{path}: holds a design already; --resume goes on with it, --force begins anew,"
                             " -o DIR chooses another place")


def _make_directory(path: Path, force: bool) -> None:
    """An empty place for a project.

    Raises:
        InputError: something stands there, or the place cannot be written to.
    """
    _check_place(path, force)
    try:
        path.mkdir(exist_ok=True)
        for name in (CHECKPOINT, RENDER, REPORT):
            (path / name).unlink(missing_ok=True)
        probe = path / ".caustic-probe"
        probe.touch()
        probe.unlink()
    except OSError as error:
        raise InputError(f"{path}: cannot be written to ({error.strerror}); -o DIR chooses another place") from error


def _run(project: Project, designer: Designer, target: np.ndarray, state: State, say: Reporter, began: float,
         iterations: int | None, time_limit: float | None, device: str) -> dict:
    chosen = project.settings["design"]
    limit = chosen["time_limit"] if time_limit is None else time_limit
    limit = max(LEAST_PART * limit, limit - (time.monotonic() - began))  # what the start took counts too
    provenance = {
        "caustic": __version__, "torch": torch.__version__, "numpy": np.__version__, "device": device,
        "threads": torch.get_num_threads(), "seed": chosen["seed"],
        "target_sha256": hashlib.sha256(np.ascontiguousarray(project.picture.values).tobytes()).hexdigest(),
    }

    def keep(now: State, results: dict | None = None) -> None:
        project.save(Checkpoint(now, designer.field(now.stage).spaces, provenance, results or {}))

    total = chosen["iterations"] or sum(s.iterations for s in designer.stages)
    with _signals() as asked, say.progress(total) as show:
        stage, saved = -1, time.monotonic()

        def on_iteration(now: State) -> None:
            nonlocal stage, saved
            if now.stage != stage:
                stage = now.stage
                s = designer.stages[stage]
                say.say(f"stage {stage + 1}/{len(designer.stages)}: {s.control[0]} x {s.control[1]} control points,"
                        f" {s.rays:,} rays, blur {s.blur:g} px")
            _, _, loss, on_screen, _ = now.history[-1]
            show(f"stage {stage + 1}/{len(designer.stages)}",
                 f"loss {loss * grey(target).size:.4f}  on screen {on_screen:.1%}", now.total, total)
            if time.monotonic() - saved >= chosen["checkpoint_every"]:
                keep(now)
                saved = time.monotonic()

        keep(state)
        state = designer.run(state, iterations=chosen["iterations"], time_limit=limit, stop=lambda: bool(asked),
                             on_iteration=on_iteration)
        keep(state)
        if not asked:
            state.heights = designer.within_limits(state)
        if asked:
            raise Interrupted(f"interrupted after {state.total} iterations; {project.path / CHECKPOINT} is saved,"
                              f" caustic design --resume {project.path} goes on", 128 + asked[0])
        lens, figures = judge(project, designer, target, state, device)
        figures |= {"iterations": state.total, "seconds": time.monotonic() - began, "image": str(project.path / RENDER),
                    "project": str(project.path), "reason": lens.reason}
        keep(lens, figures)
        if asked:
            raise Interrupted(f"interrupted when the design was done; {project.path} is whole", 128 + asked[0])
    return figures


@contextmanager
def _signals() -> Iterator[list[int]]:
    """Collect SIGINT and SIGTERM instead of dying of them; a second SIGINT interrupts at once."""
    asked: list[int] = []

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
