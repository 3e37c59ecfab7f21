"""A design before its first iteration: its project, its problem and its initial heights, after everything that the user gave has
been checked."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch

from caustic_cli.config.settings import Given, build_lens
from caustic_cli.errors import InputError, at_most
from caustic_cli.inverse.designer import Designer, InitialHeights
from caustic_cli.inverse.initial_surface import InitialSurface
from caustic_cli.inverse.reachability import largest_magnification
from caustic_cli.inverse.surface_from_map import OutOfReach
from caustic_cli.inverse.target import grey
from caustic_cli.io.files import Piped
from caustic_cli.io.picture import Picture
from caustic_cli.kinds import OneSurface, problem_of
from caustic_cli.kinds.surface import PLATE, WALL
from caustic_cli.loading import OnDemand
from caustic_cli.optics.surfaces.heightfield import HeightField
from caustic_cli.project import directory, uptodate
from caustic_cli.project.completion import shape_words
from caustic_cli.project.new import new_project
from caustic_cli.project.project import Project, is_project
from caustic_cli.scene import Scene
from caustic_cli.schema.table import TABLE, LensSettings
from caustic_cli.workflow.compilation import announce_compilation, compile_design
from caustic_cli.workflow.reporter import Reporter

relief, surfaces = OnDemand("caustic_cli.inverse.relief"), OnDemand("caustic_cli.io.surfaces")

#: Most of a time limit for the initial surface.
START_PART = 0.3
#: Part of the light in wrong places after a transport from which it is said: one that converges leaves at most a hundredth.
MISPLACED = 0.03


class PreparedDesign(NamedTuple):
    """A design about to be run: its project, its problem, None where it exists already, its initial heights, None for the offset
    surface, the part of the light that their transport left in wrong places, and what is to be said of their relief."""

    project: Project
    problem: OneSurface | None = None
    first: InitialHeights | None = None
    misplaced: float = 0.0
    relief: str = ""

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
        announce_compilation(say),
        say.notify_if_slow("solving the transport of the light to the picture"),
    ):
        try:
            prepared = first_heights(project, said, problem)
        except OutOfReach as error:
            most = largest_magnification(problem.scene, project.settings.target.size)
            most = min(most or 0.0, TABLE["mag"].high)
            within = f"; ⟨+mag⟩ of at most about {at_most(most, 2)} is within reach at this throw" if most else ""
            raise InputError(f"{error}{within}") from error
    if prepared.misplaced > MISPLACED:
        say.say(
            f"the transport left {prepared.misplaced:.1%} of the light in wrong places: the design starts from a poorer surface"
            " than usual, and may end with a larger error"
        )
    if prepared.relief:
        say.say(prepared.relief)
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
    first = solved(project, problem, fixed, rough=plate)  # of a plate the surface is solved again, for its thickness
    if first is None or not problem.adapts:
        return _prepared(project, problem, first)
    middle = first.middle
    if plate:
        thickness = project.settings.lens.thickness if middle is None else middle
        if (spare := _spare(project.settings.lens, said, first.heights)) > 0:
            project, problem = _with_lens(project, problem, thickness=thickness - spare)
        first = solved(project, problem, fixed=spare > 0) or first
        middle = thickness - spare if spare > 0 else first.middle
    if middle is not None:
        project, problem = _with_lens(project, problem, thickness=middle)
    if room := _room(project.settings.lens, said, first.heights):
        project, problem = _with_lens(project, problem, **room)
        if middle is None:
            first = solved(project, problem, fixed)
    return _prepared(project, problem, first, limited="height_range" in said.get("lens", {}))


def _prepared(project: Project, problem: OneSurface, first: InitialSurface | None, limited: bool = False) -> PreparedDesign:
    """A design that starts from a surface; limited: whether the user gave limits of its relief, between which it is placed."""
    heights, misplaced = (None, 0.0) if first is None else (first.heights, first.misplaced)
    words = ""
    if limited and heights is not None:
        moved, lacking = relief.placed(heights.numpy(), *(limit.numpy() for limit in problem.bounds(0)))
        heights = torch.from_numpy(moved)
        if lacking:
            goal = grey(problem.target.numpy())
            words = relief.words(problem.scene, problem.field(0), moved, lacking, project.settings.target.size, goal)
    return PreparedDesign(project, problem, Designer(problem).initial_heights(heights), misplaced, words)


def solved(project: Project, problem: OneSurface, fixed: bool, rough: bool = False) -> InitialSurface | None:
    """The initial surface on the control net of the first stage, by transport or from another lens; None for the offset surface as
    it is.

    fixed: the thickness is given by the user; a transport surface below the least thickness is raised, which leaves slopes
    unchanged; rough: by few cells, for its depth alone.

    Raises:
        InputError: the project or surface cannot be read, its lens has another size, or the picture cannot be reached.
    """
    start = project.settings.design.start
    if start == "offset":
        heights = problem.offset()
        return None if heights is None else InitialSurface(heights)
    if start == "transport":
        return problem.transport(fixed, START_PART * project.settings.design.time_limit, rough)
    net = problem.field(0)
    if Path(start).suffix.lower() in surfaces.SUFFIXES and not Path(start).is_dir():
        return InitialSurface(surfaces.onto(*surfaces.read_surface(start, net.half_size), net))
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
    return InitialSurface(surfaces.onto(field, heights, net))


def _with_lens(project: Project, problem: OneSurface, **values: Any) -> tuple[Project, OneSurface]:
    """The project with other settings of its lens, and its problem."""
    full = project.settings
    project = replace(project, settings=full.changed(lens=full.lens.changed(**values)))
    return project, problem_of(project, problem.device)


def _is_plate(lens: LensSettings) -> bool:
    """Whether the thickness follows from the depth of the surface and a wall behind it."""
    return not lens.mirror and lens.entrance == "flat" and max(lens.size) > PLATE


def _spare(lens: LensSettings, said: Given, first: torch.Tensor) -> float:
    """Excess thickness of a plate below its initial surface beyond the wall, which may be given, mm."""
    wall = lens.min_thickness if "min_thickness" in said.get("lens", {}) else WALL
    return max(0.0, float(first.min()) - lens.z_in - wall)


def _room(given: LensSettings, said: Given, first: torch.Tensor) -> dict[str, Any]:
    """Height range and thickness as the initial surface requires, where it needs others and the user fixed none; of a surface that
    given limits cut off, as what is left of it requires."""
    lens, fixed = build_lens(given), said.get("lens", {})
    offset = HeightField.of(replace(lens, control=tuple(first.shape)))
    x, y = (c.numpy() for c in offset.control_xy())
    base, heights = lens.offset.heights(x, y), first.numpy()
    if "height_range" in fixed:
        low, high = (base + limit for limit in lens.height_range)
        heights = relief.placed(heights, low, high)[0].clip(low, high)
    departure = 2.0 * float(np.abs(heights - base).max())
    short, changed = float((lens.floors(x, y) - heights).max()), dict[str, Any]()
    if departure > lens.height_range[1] and "height_range" not in fixed:
        changed["height_range"] = (-departure, departure)
    if short > 0 and "thickness" not in fixed:
        changed["thickness"] = given.thickness + (1.5 * short + 0.02 * max(lens.size))
    return changed
