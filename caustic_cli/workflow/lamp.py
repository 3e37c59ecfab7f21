"""Lamps: their design, render and export, as those of lenses in `design`, `render` and `export`.

A lamp is a project like others, whose checkpoint holds the control values of log r instead of heights.  It is written when its
design has ended; an interrupted one is begun anew.
"""

from __future__ import annotations

import math
import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from caustic_cli import __version__
from caustic_cli.config.lamp import goal_of, lamp_of
from caustic_cli.effort import current_effort
from caustic_cli.errors import InputError
from caustic_cli.export.lamp import MESHES, write_lamp
from caustic_cli.inverse.accuracy_cost import Start
from caustic_cli.inverse.designer import State
from caustic_cli.inverse.lamp import design_lamp, field_of, pixels_of, refuse_thin, stages_of, wanted
from caustic_cli.inverse.lamp_limits import chip_limits
from caustic_cli.io.files import Piped
from caustic_cli.io.photometry import Photometry, write_ies, write_ldt
from caustic_cli.io.picture import WIDE, Picture, write_image, write_npy
from caustic_cli.loading import OnDemand
from caustic_cli.optics.surfaces.polarfield import PolarField
from caustic_cli.project import directory, uptodate
from caustic_cli.project.checkpoint import Checkpoint
from caustic_cli.project.new import new_project
from caustic_cli.project.project import RENDER, Project
from caustic_cli.scene.lamp import Goal, Lamp
from caustic_cli.studies.lamp import lamp_figures
from caustic_cli.studies.photometry import FLUX, intensity_table
from caustic_cli.studies.tolerances import one_thread
from caustic_cli.workflow.reporter import Reporter

retrace = OnDemand("caustic_cli.studies.retrace")

#: Photometric formats: suffix, writer and description.
PHOTOMETRIC = {"ies": (".ies", write_ies, "IES LM-63-2019, type C"), "ldt": (".ldt", write_ldt, "EULUMDAT")}
FORMATS = MESHES | PHOTOMETRIC
#: Part of the brightest pixels of an image that are white.
WHITE = 0.999


@dataclass(frozen=True)
class LampDesign:
    """A designed lamp.

    project: where it is kept; values: control values of log r over the spline spaces `field`, (n, m) or (2, n, m)
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

    def image_and_figures(self, rays: int | None, seed: int) -> tuple[np.ndarray, dict[str, Any]]:
        """Part of the light on each pixel, (n_x, n_y), and the figures of `studies.lamp`, with those of the far field; rays: None
        for those of the evaluation of a design."""
        effort = current_effort()
        rays = rays or effort.final_rays
        finest = effort.lamp_pixels if self.lamp.chip.shape == "point" else effort.lamp_pixels // 4  # of what it does not blur
        counts = finest, effort.lamp_pixels // 16
        fine, coarse = (wanted(self.goal, self.picture, pixels_of(self.goal, count)).numpy() for count in counts)
        shaded = len(np.unique(self.picture[self.picture > 0])) > 1
        found, figures = lamp_figures(
            self.lamp, self.goal, self.field, self.values, fine, coarse, shaded=shaded, rays=rays, seed=seed
        )
        if self.goal.far:
            table = intensity_table(self.lamp, self.field, self.values, rays=rays, seed=seed)
            figures |= {"peak_candela": table.peak, "beam_angles": [table.full_angle(0.5, k) for k in (0, len(table.planes) // 4)]}
        return found.image, figures


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
    began = Start.now()
    project, _ = new_project(target, given, preset, config, out, say.say)
    if out is not None and not force and (same := uptodate.same_design(out, project.asked)):
        say.say(
            f"{out}: was designed from the same picture with the same options, so there is nothing to do; ⟨force⟩ designs it anew"
        )
        return LampDesign.of(same[0])
    if out is not None:
        directory.check(out, force)
    s, effort = project.settings, current_effort()
    lamp, goal, picture = lamp_of(s), goal_of(s), picture_of(project)
    for words in (*notes(lamp, goal), *chip_limits(lamp, goal, picture, effort.bound_steps)):
        say.say(words)
    stages = stages_of(lamp, effort)
    last, total = len(stages), sum(iterations for _, (_, _, iterations, _) in stages)
    history = list[tuple[int, int, float, float, float]]()
    with say.progress(total) as show:

        def told(stage: int, _: int, loss: float) -> None:
            history.append((len(history) + 1, stage, loss, 0.0, began.seconds))
            show(f"stage {stage + 1}/{last}", f"loss {loss:.5f}", len(history), total)

        with one_thread():  # the tensors of a chunk of rays are too small for more
            values = design_lamp(lamp, goal, picture, effort=effort, on_iteration=told)
    found = LampDesign(project, lamp, goal, field_of(effort), values, picture, {})
    image, figures = found.image_and_figures(None, s.design.seed)
    figures |= {"iterations": len(history), "seconds": began.seconds, "reason": "iterations"}
    if out is not None:
        figures |= {"image": str(out / RENDER), "project": str(out)}
        state = State(
            values, len(effort.lamp_stages) - 1, 0, len(history), history=history, seconds=began.seconds, reason="iterations"
        )
        made = {"caustic": __version__, "torch": torch.__version__, "numpy": np.__version__, "seed": s.design.seed}
        with project.hold:
            directory.create(project, force, Checkpoint(state, found.field.spaces, made, figures, uptodate.inputs(project)))
            _write_image(out / RENDER, image, project, goal)
    return replace(found, figures=figures)


def notes(lamp: Lamp, goal: Goal) -> Iterator[str]:
    """What limits a lamp, before its design: its uncoated surfaces, and the deflection of one."""
    yield f"uncoated surfaces pass at most {lamp.uncoated_limit:.1%} of the light, by normal incidence"
    if lamp.surfaces == 2:
        return
    most = math.degrees(math.acos(1.0 / lamp.index))
    if (needed := 90.0 - goal.nearest_edge) > most:
        yield (
            f"one surface of index {lamp.index:.4g} turns light by at most {most:.1f} degrees, and that of the rim would have to be"
            f" turned by {needed:.0f} to reach the nearest edge of the picture: part of it falls beside"
        )


def _write_image(path: Path, image: np.ndarray, project: Project, goal: Goal, wide: int = WIDE) -> None:
    """The image as illuminance, or intensity in the far field."""
    density = image / goal.shares((image.shape[0], image.shape[1]))
    write_image(path, density, float(np.quantile(density, WHITE)), project.encoding, wide)


def render(
    project: Project, rays: int | None, seed: int | None, image: Path | None, npy: Path | None, force: bool, say: Reporter
) -> dict[str, Any]:
    """Trace a lamp with independent rays, write its image, and return its figures; arguments as of caustic render.

    Raises:
        InputError: there is no lamp, or a file exists already; nothing was written.
    """
    began, path = time.monotonic(), image or project.image
    made = uptodate.Outputs(project, "render", {"rays": rays, "seed": seed}, [path, npy])
    if not force and (figures := made.found()):
        say.say(f"{path}: is up to date: the same options and the same project, so there is nothing to do; ⟨force⟩ repeats it")
        return figures
    made.refuse_foreign(force)
    lamp = LampDesign.of(project)
    seen, figures = lamp.image_and_figures(rays, project.seed if seed is None else seed)
    _write_image(path, seen, project, lamp.goal, WIDE if image is None else 1)
    if npy is not None:
        write_npy(npy, seen)
    figures |= {"iterations": lamp.figures.get("iterations"), "seconds": time.monotonic() - began, "image": str(path)}
    made.keep(figures)
    return figures


def check_export(format: str, samples: tuple[int, int] | None) -> None:
    """Refuse a format that no lamp has, or samples of one that has none.

    Raises:
        InputError: as it says.
    """
    if format not in FORMATS:
        raise InputError(
            f"⟨format⟩ {format} holds height fields, and a lamp's surface is none; {', '.join(FORMATS)} hold the lamp or its light"
        )
    if samples is not None and format in PHOTOMETRIC:
        raise InputError(f"⟨samples⟩ belongs to {', '.join(MESHES)}, got {format}")


def export(
    project: Project, format: str, output: Path | None, samples: tuple[int, int] | None, force: bool, say: Reporter
) -> dict[str, Any]:
    """Write a lamp in one of FORMATS; returns file, format, bytes and seconds, and for a photometric file of its light flux, lm per
    1000 lm of the chip, and peak_candela.

    Raises:
        InputError: there is no lamp, the format is not one of a lamp, or a file exists already; nothing was written.
    """
    began = time.monotonic()
    check_export(format, samples)
    assert project.path is not None
    path = output or Path(project.path.resolve().stem + FORMATS[format][0])
    made = uptodate.Outputs(project, "export", {"format": format, "samples": samples}, [path])
    if not force and (found := made.found()):
        say.say(f"{path}: is up to date: the same options and the same project, so there is nothing to do; ⟨force⟩ repeats it")
        return found
    made.refuse_foreign(force)
    lamp, more = LampDesign.of(project), {}
    if format in MESHES:
        write_lamp(path, format, lamp.lamp, lamp.field, lamp.values, samples)
    else:
        table = intensity_table(lamp.lamp, lamp.field, lamp.values, rays=current_effort().final_rays, seed=project.seed)
        greatest = lamp.field.extent(lamp.values if lamp.lamp.surfaces == 1 else lamp.values[1])[1]
        name = project.path.resolve().stem
        PHOTOMETRIC[format][1](path, Photometry(table.planes, table.angles, table.values, FLUX, name, 2.0 * greatest, greatest))
        more = {"flux": table.flux, "peak_candela": table.peak}
    figures = {"file": str(path), "format": format, "bytes": path.stat().st_size, **more, "seconds": time.monotonic() - began}
    made.keep(figures)
    return figures


def rows(figures: Mapping[str, Any]) -> list[tuple[str, str]]:
    """The figures of a lamp as rows for display."""

    def number(key: str, form: str) -> str:
        value = figures.get(key)
        return "-" if value is None else format(value, form)

    lost = {name.replace("_", " "): part for name, part in figures["lost"].items() if part > 0}
    width, height = figures["pixels"]
    found = [
        ("on target", f"{figures['of_source']:.2%} of all light; uncoated limit {figures['uncoated_limit']:.2%}"),
        (
            "relative RMS error",
            f"{number('interior_rms', '.4f')}, noise {number('interior_noise', '.2g')}; with the outer"
            f" {number('border', '.4g')} {'degrees' if 'peak_candela' in figures else 'mm'}"
            f" {number('relative_rms', '.4f')}, noise {number('noise', '.2g')}",
        ),
        ("least over mean", number("uniformity", ".3f")),
        ("lost", ", ".join(f"{name} {part:.2%}" for name, part in lost.items()) or "nothing"),
    ]
    if figures.get("cut_off") is not None:
        found.append(("upper edge", f"{figures['cut_off']:.2f} degrees from 90 % to 10 % of the intensity beneath it"))
    if "peak_candela" in figures:
        angles = " x ".join(f"{angle:.0f}" for angle in figures["beam_angles"])
        found.append(("peak", f"{figures['peak_candela']:.0f} cd per 1000 lm of the chip; half of it at {angles} degrees"))
    found += [
        ("least wall", f"{figures['least_wall']:.3g} mm; greatest radius {figures['greatest_radius']:.4g} mm"),
        ("rays", f"{figures['rays']:,} on {width} x {height} pixels"),
        ("iterations", number("iterations", "d")),
        ("time", f"{figures['seconds']:.1f} s"),
    ]
    return [*found, ("image", figures["image"])] if "image" in figures else found
