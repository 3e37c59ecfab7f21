"""Lamps: their design and render, as those of lenses in `design` and `render`; their export is `lamp_export`.

A lamp is a project like others, whose checkpoint holds the control values of r instead of heights.  It is written after every
stage, with which an interrupted design goes on.
"""

from __future__ import annotations

import math
import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from caustic_cli import __version__
from caustic_cli.config.lamp import goal_of, lamp_of
from caustic_cli.effort import current_effort
from caustic_cli.errors import InputError
from caustic_cli.export.lamp_mitsuba import FINE, plane_of, write_lamp_mitsuba
from caustic_cli.inverse.accuracy_cost import Start
from caustic_cli.inverse.designer import State
from caustic_cli.inverse.lamp import design_lamp, final_field, first_lamp, judged_pixels, pixels_of, refuse_thin, stages_of, wanted
from caustic_cli.inverse.lamp_limits import chip_limits
from caustic_cli.io.files import Piped
from caustic_cli.io.picture import WIDE, Picture, write_image, write_npy
from caustic_cli.loading import OnDemand
from caustic_cli.optics import ranks
from caustic_cli.optics.lamp import uncoated_limit
from caustic_cli.optics.lamp_array import clear_pitch
from caustic_cli.optics.surfaces.polarfield import PolarField
from caustic_cli.project import checkpoint, directory, uptodate
from caustic_cli.project.checkpoint import Checkpoint
from caustic_cli.project.new import new_project
from caustic_cli.project.project import CHECKPOINT, RENDER, REPORT, Project
from caustic_cli.scene.lamp import Goal, Lamp
from caustic_cli.studies.lamp import lamp_figures
from caustic_cli.studies.lamp_verify import verify_lamp
from caustic_cli.studies.photometry import IntensitySum, IntensityTable
from caustic_cli.studies.tolerances import one_thread
from caustic_cli.studies.verify import write_panels
from caustic_cli.workflow import lamp_formats
from caustic_cli.workflow.lens import Render, count
from caustic_cli.workflow.reporter import Reporter

lamp_report = OnDemand("caustic_cli.studies.lamp_report")

#: Pixels of a comparison with Mitsuba, and its rays unless given.
VERIFIED, BESIDE_RAYS = 2400, 1_000_000
#: The effect that a lamp may have or not.
GHOSTS = "ghosts"
#: Part of the light that meets lenses of neighbours which is told.
SHADOWED = 0.002
#: Part of the brightest pixels of an image that are white.
WHITE = 0.999
#: Part of the lit pixels of a picture that edges have in shades while it is one of a single brightness.
SMOOTH = 0.02


class LampEvaluation(NamedTuple):
    """image, wanted: part of the light on each pixel, (n_x, n_y), and as it should be; table: of intensities; figures: of
    `studies.lamp` and of the table."""

    image: np.ndarray
    wanted: np.ndarray
    table: IntensityTable
    figures: dict[str, Any]


@dataclass(frozen=True)
class LampDesign:
    """A designed lamp.

    project: where it is kept; values: control values of r, mm, over the spline spaces `field`, (n, m) or (2, n, m)
    (`optics.lamp.sides`); picture: irradiance (a, b), or intensity in the far field; figures: of the JSON table.
    """

    project: Project
    lamp: Lamp
    goal: Goal
    field: PolarField
    values: Tensor
    picture: np.ndarray
    figures: dict[str, Any]

    @classmethod
    def of(cls, project: Project) -> LampDesign:
        """The lamp of a project's checkpoint.

        Raises:
            InputError: there is none, or a setting was edited out of range.
        """
        saved, s = project.load(), project.settings
        lamp, goal, field, values = lamp_of(s), goal_of(s), PolarField(saved.spaces), saved.state.heights
        shape = field.shape if lamp.surfaces == 1 else (2, *field.shape)
        if tuple(values.shape) != shape or not bool(torch.isfinite(values).all()):
            raise project.error("holds no lamp in its checkpoint: design it again")
        try:
            refuse_thin(lamp, field, values)
        except InputError as error:
            raise project.error(f"{error}") from error
        return cls(project, lamp, goal, field, values, picture_of(project), dict(saved.results))

    @property
    def name(self) -> str:
        """Its name in files: that of its project."""
        return "lamp" if self.project.path is None else self.project.path.resolve().stem

    @property
    def exported(self) -> lamp_formats.Exported:
        """As it is written in a format."""
        return lamp_formats.Exported(self.lamp, self.goal, self.field, self.values, self.name, self.project.seed)

    def evaluated(self, rays: int | None, seed: int) -> LampEvaluation:
        """The light by independent rays; rays: None for those of the evaluation of a design."""
        effort = current_effort()
        rays = rays or effort.final_rays
        pixels = [judged_pixels(self.lamp, self.goal, effort), pixels_of(self.goal, effort.lamp_coarse)]
        fine, coarse = (wanted(self.goal, self.picture, n).numpy() for n in pixels)
        lit = self.picture[self.picture > 0]
        shaded = bool((lit < lit.max()).mean() > SMOOTH)
        intensities = IntensitySum()
        how: dict[str, Any] = {"shaded": shaded, "rays": rays, "seed": seed, "also": intensities.add}
        with one_thread():  # the tensors of a chunk of rays are too small for more
            found, figures = lamp_figures(self.lamp, self.goal, self.field, self.values, fine, coarse, **how)
        table = intensities.table()
        return LampEvaluation(found.image, fine, table, figures | table.figures)

    def render(self, rays: float | None = None, *, seed: int | None = None) -> Render:
        """Trace the lamp with independent rays: part of the light on each pixel, and the figures of `caustic render`.

        rays: None for those of the evaluation of a design.
        """
        seen = self.evaluated(None if rays is None else count(rays), self.project.seed if seed is None else seed)
        return Render(seen.image, seen.figures)

    def export(self, path: str | Path, format: str | None = None, *, samples: tuple[int, int] | None = None) -> Path:
        """Export the lamp or its light; the format follows from the suffix unless it is given; samples: rings, and points of each.

        Raises:
            InputError: the format is not one of a lamp, or has no samples.
        """
        name = format or lamp_formats.format_of(Path(path).suffix)
        lamp_formats.check_export(name, samples)
        lamp_formats.write(Path(path), self.exported, name, samples)
        return Path(path)

    def write_report(self, path: Path, found: LampEvaluation) -> None:
        """Write the report of an evaluation."""
        of = (self.lamp, self.goal, self.field, self.values)
        lamp_report.write_lamp_report(path, *of, found.image, found.wanted, found.table, found.figures)

    def verified(self, panels: Path, rays: int, seed: int) -> dict[str, Any]:
        """The figures of a comparison with Mitsuba, and its image, which is written.

        Raises:
            CausticError: see `studies.lamp_verify`.
        """
        lamp = replace(self.lamp, ghosts=False)  # Mitsuba's rays are followed along the direct path
        pixels, seen = pixels_of(self.goal, VERIFIED), plane_of(self.goal, self.lamp.radius)
        with TemporaryDirectory() as folder:
            scene = Path(folder) / "lamp.xml"
            write_lamp_mitsuba(scene, lamp, self.goal, self.field, self.values, pixels, FINE, dark=True)
            found = verify_lamp(scene, lamp, seen, self.field, self.values, pixels, rays, seed)
        write_panels(panels, found, (0.5 * seen.size[0], 0.5 * seen.size[1]))
        return found.figures | {"image": str(panels)}


def picture_of(project: Project) -> np.ndarray:
    """The picture of a lamp's target, irradiance or intensity (a, b), flipped as its settings say."""
    light, flip = project.picture.irradiance(), project.settings.target.flip
    light = light[::-1] if "x" in flip else light
    return np.ascontiguousarray(light[:, ::-1] if "y" in flip else light)


def design(
    target: Path | Piped | Picture,
    given: Mapping[str, Any],
    *,
    preset: str | None,
    config: Path | None,
    out: Path | None,
    force: bool,
    say: Reporter,
) -> LampDesign:
    """Design a lamp; arguments as of `library.design_of`.  The same design in `out` is opened instead.

    Raises:
        InputError: invalid input; nothing was written.
    """
    project, _ = new_project(target, given, preset, config, out, say.say)
    if out is not None and not force and (same := uptodate.same_design(out, project.asked)):
        say.say(f"{out}: was designed from the same picture with the same options")
        return resume(same[0], say)
    if out is not None:
        directory.check(out, force)
    return _run(project, None, force, say)


def resume(project: Project, say: Reporter) -> LampDesign:
    """Go on with the design of a project after its last complete stage; a finished one is opened.

    Raises:
        InputError: there is no lamp.
    """
    saved = project.load()
    if saved.results:
        say.say(f"{project.path}: is finished, so there is nothing to do; ⟨force⟩ designs it anew")
        return LampDesign.of(project)
    with project.hold:
        assert project.path is not None
        project.hold.enter_context(directory.locked(project.path))
        return _run(project, saved, True, say)


def _run(project: Project, before: Checkpoint | None, force: bool, say: Reporter) -> LampDesign:
    """Design a lamp after the stages that were done `before`, and evaluate it; the checkpoint is written after each stage."""
    began, s, effort = Start.now(), project.settings, current_effort()
    lamp, goal, picture = lamp_of(s), goal_of(s), picture_of(project)
    for words in (*notes(lamp, goal), *chip_limits(lamp, goal, picture, effort.bound_steps)):
        say.say(words)
    stages = stages_of(lamp, effort)
    last, total = len(stages), sum(iterations for _, (_, _, iterations, _) in stages)
    state = State(torch.empty(0)) if before is None else before.state
    history, earlier = list(state.history), state.seconds
    made = {"caustic": __version__, "torch": torch.__version__, "numpy": np.__version__, "seed": s.design.seed}

    def told(stage: int, _: int, loss: float) -> None:
        history.append((len(history) + 1, stage, loss, 0.0, earlier + began.seconds))
        show(f"stage {stage + 1}/{last}", f"loss {loss:.5f}", len(history), total)

    def save(done: int, field: PolarField, values: Tensor, figures: dict[str, Any] | None = None) -> None:
        nonlocal before
        if project.path is None:
            return
        why = {"reason": "iterations"} if figures else {}
        state = State(values, done, 0, len(history), history=list(history), seconds=earlier + began.seconds, **why)
        saved = Checkpoint(state, field.spaces, made, figures or {}, uptodate.inputs(project))
        if before is None:
            directory.create(project, force, saved)
        else:
            checkpoint.save(project.path / CHECKPOINT, saved)
        before = saved

    with project.hold:
        threads = torch.get_num_threads()
        with say.progress(total) as show, one_thread():  # each of those that trace a part of the rays
            if before is None:
                begun = first_lamp(lamp, goal, picture, effort)
            else:
                begun = before.state.stage, PolarField(before.spaces), before.state.heights
            designed = partial(design_lamp, lamp, goal, picture, effort=effort, begun=begun, threads=threads)
            with ranks.together(designed):
                values = designed(on_iteration=told, on_stage=save)
        found = LampDesign(project, lamp, goal, final_field(lamp, effort), values, picture, {})
        evaluation = found.evaluated(None, s.design.seed)
        for words in warnings(lamp, goal, evaluation.figures):
            say.say(words)
        seconds = earlier + began.seconds
        figures = evaluation.figures | {"iterations": len(history), "seconds": seconds, "reason": "iterations"}
        if project.path is not None:
            figures |= {"image": str(project.path / RENDER), "project": str(project.path)}
            _write_image(project.path / RENDER, evaluation.image, project, goal)
            if effort.report:
                found.write_report(project.path / REPORT, evaluation)
        save(last, found.field, values, figures)
    return replace(found, figures=figures)


def notes(lamp: Lamp, goal: Goal) -> Iterator[str]:
    """What limits a lamp, before its design: its uncoated surfaces, and the deflection of one."""
    how = "by normal incidence" if lamp.flat is None else "through a flat inner side"
    yield f"uncoated surfaces pass at most {uncoated_limit(lamp):.1%} of the light, {how}"
    if lamp.count > 1 and not goal.far:
        width, height = lamp.places.max(0) - lamp.places.min(0)
        yield f"the pictures of the lamps lie within {width:g} x {height:g} mm of each other"
    if lamp.surfaces == 2 or lamp.flat is not None:
        return
    most = math.degrees(math.acos(1.0 / lamp.index))
    if (needed := 90.0 - goal.nearest_edge) > most:
        yield (
            f"one surface of index {lamp.index:.4g} turns light by at most {most:.1f} degrees, and that of the rim would have to be"
            f" turned by {needed:.0f} to reach the nearest edge of the picture: part of it falls beside"
        )


def warnings(lamp: Lamp, goal: Goal, figures: Mapping[str, Any]) -> Iterator[str]:
    """What is wrong with the light of a lamp, after its evaluation: shadows of an array."""
    if (part := figures["lost"].get("neighbours", 0.0)) > SHADOWED:
        clear = " x ".join(f"{math.ceil(p)}" for p in clear_pitch(lamp, goal))
        yield (
            f"{part:.1%} of the light meets the lens of a neighbour and is missing at the ends of the picture: with a ⟨lamp.pitch⟩"
            f" of {clear} mm all light for it passes"
        )


def _write_image(path: Path, image: np.ndarray, project: Project, goal: Goal, wide: int = WIDE) -> None:
    """The image as illuminance, or intensity in the far field."""
    density = image / goal.shares((image.shape[0], image.shape[1]))
    write_image(path, density, float(np.quantile(density, WHITE)), project.encoding, wide)


def render(
    project: Project,
    rays: int | None,
    seed: int | None,
    image: Path | None,
    npy: Path | None,
    force: bool,
    say: Reporter,
    mitsuba: bool = False,
    report: bool = False,
    effects: str = "auto",
) -> dict[str, Any]:
    """Trace a lamp with independent rays, write its image, and return its figures; arguments as of caustic render.

    mitsuba: compare with Mitsuba as well, and write the panels beside the image; report: write the report there; effects: as of
    `with_effects`.

    Raises:
        InputError: there is no lamp, or a file exists already; nothing was written.
    """
    began, path = time.monotonic(), image or project.image
    panels, plots = (
        path.with_name(name if image is None else f"{path.stem}-{name}") if asked else None
        for name, asked in (("verify.png", mitsuba), (REPORT, report))
    )
    options = {"rays": rays, "seed": seed, "report": report, "effects": effects}
    made = uptodate.Outputs(project, "render", options, [path, npy, panels, plots])
    if not (force or mitsuba) and (figures := made.found()):
        say.say(f"{path}: is up to date: the same options and the same project, so there is nothing to do; ⟨force⟩ repeats it")
        return figures
    made.refuse_foreign(force)
    lamp = with_effects(LampDesign.of(project), effects)
    seen = lamp.evaluated(rays, project.seed if seed is None else seed)
    for words in warnings(lamp.lamp, lamp.goal, seen.figures):
        say.say(words)
    _write_image(path, seen.image, project, lamp.goal, WIDE if image is None else 1)
    if npy is not None:
        write_npy(npy, seen.image)
    if plots is not None:
        lamp.write_report(plots, seen)
    figures = seen.figures | {"iterations": lamp.figures.get("iterations"), "seconds": time.monotonic() - began, "image": str(path)}
    if panels is not None:
        figures["verify"] = lamp.verified(panels, rays or BESIDE_RAYS, project.seed if seed is None else seed)
        return figures
    made.keep(figures)
    return figures


def with_effects(design: LampDesign, effects: str) -> LampDesign:
    """The lamp with light that is reflected within it followed, or booked as lost: `ghosts` and `none`; `auto` for the former where
    the reflectance of its chip is given.

    Raises:
        InputError: another effect.
    """
    if effects == "auto":
        return design
    if effects not in ("none", GHOSTS):
        raise InputError(
            f"⟨effects⟩ of a lamp must be none, auto or {GHOSTS}, got {effects}: refraction, Fresnel losses, total reflection and"
            " the size of the chip are always simulated"
        )
    return replace(design, lamp=replace(design.lamp, ghosts=effects == GHOSTS))


def effects_of(project: Project, effects: str, figures: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Which effects a render simulated, and why, as rows for display; figures: of it."""
    lamp, lost = lamp_of(project.settings), figures["lost"]
    reflected = sum(lost.get(cause, 0.0) for cause in ("inner_fresnel", "outer_fresnel", "total_internal_reflection"))
    chip = f"the chip reflects {lamp.chip.reflectance:g} of the light that returns to it"
    if effects == GHOSTS or (lamp.ghosts and effects != "none"):
        ghosts = f"on: {'asked for' if effects == GHOSTS else 'its reflectance is given'}; {chip}"
    else:
        why = "asked to be left out" if effects == "none" else "not asked for, and no reflectance of the chip is given"
        ghosts = f"off: {why}; {reflected:.2%} of the light, reflected at the surfaces, is booked as lost"
    size = "off: the chip is a point" if lamp.chip.shape == "point" else "on: the chip has a size, which cannot be left out"
    return [
        ("fresnel", "on: always, at both surfaces"),
        ("total_reflection", f"on: always; {lost.get('total_internal_reflection', 0.0):.2%} of the light"),
        ("source_size", size),
        (GHOSTS, ghosts),
        ("diffraction", "off: the target is lit by overlapping parts of an incoherent source"),
    ]


def export(
    project: Project, format: str, output: Path | None, samples: tuple[int, int] | None, force: bool, say: Reporter
) -> dict[str, Any]:
    """Write a lamp in one of `lamp_formats.FORMATS`; returns file, format, bytes, seconds, and beside, the further files; of a
    photometric file the flux of its light, lm per 1000 lm of the chip, and peak_candela.

    Raises:
        InputError: there is no lamp, the format is not one of a lamp, or a file exists already; nothing was written.
    """
    began = time.monotonic()
    lamp_formats.check_export(format, samples)
    assert project.path is not None
    own = lamp_formats.FORMATS[format]
    path = output or Path(project.path.resolve().stem + own.suffix)
    made = uptodate.Outputs(project, "export", {"format": format, "samples": samples}, [path, *own.companions(path)])
    if not force and (found := made.found()):
        say.say(f"{path}: is up to date: the same options and the same project, so there is nothing to do; ⟨force⟩ repeats it")
        return found
    made.refuse_foreign(force)
    more = lamp_formats.write(path, LampDesign.of(project).exported, format, samples)
    figures = {"file": str(path), "format": format, "bytes": path.stat().st_size, **more, "seconds": time.monotonic() - began}
    made.keep(figures)
    return figures


def rows(figures: Mapping[str, Any]) -> list[tuple[str, str]]:
    """The figures of a lamp as rows for display."""

    def number(key: str, form: str) -> str:
        value = figures.get(key)
        return "-" if value is None else format(value, form)

    lost = {name.replace("_", " "): part for name, part in figures["lost"].items() if part > 1e-9}
    width, height = figures["pixels"]
    found = [
        ("on target", f"{figures['of_source']:.2%} of all light; uncoated limit {figures['uncoated_limit']:.2%}"),
        (
            "relative RMS error",
            f"{number('interior_rms', '.4f')}, noise {number('interior_noise', '.2g')}; with the outer"
            f" {number('border', '.4g')} {figures.get('border_unit', 'mm')}"
            f" {number('relative_rms', '.4f')}, noise {number('noise', '.2g')}",
        ),
        ("least over mean", number("uniformity", ".3f")),
        ("lost", ", ".join(f"{name} {part:.2%}" for name, part in lost.items()) or "nothing"),
    ]
    beam, field = (" x ".join(f"{angle:.0f}" for angle in figures[f"{name}_angles"]) for name in ("beam", "field"))
    found.append(
        ("intensity", f"{figures['peak_candela']:.0f} cd per 1000 lm of the chip; beam angle {beam} degrees, field angle {field}")
    )
    if figures.get("cut_off") is not None:
        found.append(("upper edge", f"{figures['cut_off']:.2f} degrees from 90 % to 10 % of the intensity beneath it"))
    found += [
        ("least wall", f"{figures['least_wall']:.3g} mm; greatest radius {figures['greatest_radius']:.4g} mm"),
        ("rays", f"{figures['rays']:,} on {width} x {height} pixels; their noise is subtracted"),
        ("iterations", number("iterations", "d")),
        ("time", f"{figures['seconds']:.1f} s"),
    ]
    return [*found, ("image", figures["image"])] if "image" in figures else found
