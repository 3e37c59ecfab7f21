"""A complete render: open the lens, compile the scene into a plan, retrace it, write images and figures."""

from __future__ import annotations

import time
from dataclasses import replace

from caustic_cli.errors import InputError
from caustic_cli.io.files import destination, refuse_foreign
from caustic_cli.optics.plan import parse_effects
from caustic_cli.project.archived import origin_of
from caustic_cli.project.correction import CORRECTIONS
from caustic_cli.project.project import Project
from caustic_cli.project.uptodate import Outputs
from caustic_cli.workflow.lens import Lens
from caustic_cli.workflow.outputs.base import Place, Rendering, Request
from caustic_cli.workflow.reporter import Reporter


def render(asked: Request, device: str, say: Reporter) -> dict:
    """Trace a lens and write its irradiance image and the other outputs of a request.

    Returns:
        the figures of the JSON table, with those of each output; those of the earlier run if all is up to date.

    Raises:
        InputError: there is no lens, a value is out of range, or a file exists already; nothing was written.
    """
    began = time.monotonic()
    parse_effects(asked.tracing.effects)
    _check_image(asked)
    origin = origin_of(asked.lens, asked.at)
    project = origin if isinstance(origin, Project) else None
    place = Place(asked.lens, project, asked.image)
    paths = [path for output in asked.outputs for path in output.paths(place)]
    for path in paths:
        refuse_foreign(path, asked.force)
    kept = project is not None and all(output.kept for output in asked.outputs)
    made = Outputs(project, "render", asked.asks | {"device": device}, paths) if kept else None
    if made and not asked.force and (figures := made.found()):
        say.say(
            f"{place.image}: is up to date: the same options and the same project, so there is nothing to do; ⟨force⟩ repeats it"
        )
        return figures
    if project is not None and (project.path / CORRECTIONS).exists():
        say.say(f"{project.path}: is corrected for the errors of a part, without which its image is not the picture")
    lens = _with_screen_at(Lens.of(origin, asked.tracing.given), asked.tracing.screen_at)
    rendering = Rendering(asked, place, lens, device, say)
    figures = _written(rendering, began)
    if made:
        made.keep(figures)
    return figures


def _check_image(asked: Request) -> None:
    """Refuse an image that cannot be written."""
    if asked.image is None:
        return
    if asked.image.suffix.lower() not in ("", ".png"):
        raise InputError(f"{asked.image}: ⟨out⟩ is a PNG, and its name must end in .png")
    destination(asked.image)  # refuses what is no file name, before others are made of it


def _with_screen_at(lens: Lens, z: float | None) -> Lens:
    """The lens with its screen at z, mm."""
    return lens if z is None else replace(lens, scene=replace(lens.scene, screen=replace(lens.scene.screen, z=z, far=False)))


def _written(rendering: Rendering, began: float) -> dict:
    """Trace the image and write all outputs; the figures.  began: when the render did, s."""
    outputs, lens = rendering.asked.outputs, rendering.lens
    for output in outputs:
        if why := output.unsupported(lens):
            raise InputError(why)
    for output in outputs:
        output.prepare(rendering)
    rendering.trace_image()
    for output in outputs:
        if not output.beyond:
            rendering.figures |= output.write(rendering)
    rendering.figures |= {
        "iterations": None if lens.state is None else lens.state.total,
        "seconds": time.monotonic() - began,
        "image": str(rendering.place.image),
    }
    for output in outputs:
        if output.beyond:
            rendering.figures |= output.write(rendering)
    return rendering.figures
