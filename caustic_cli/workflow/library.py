"""Public Python interface: design, load and render lenses, without writing files unless asked.

    from caustic_cli import design, load, render, trace

    lens = design("flame.png", source="plane", mag=3)
    image, figures = lens.render(rays=1e7)
    lens.export("lens.step")
    lens.save("flame.caustic")

Lengths are millimetres, angles degrees, wavelengths nanometres, powers watts; arrays are indexed [i, j] with i along +x and j along
+y.  Errors are `caustic_cli.errors.InputError` for invalid input, and `CausticError` for what could not be completed.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from inspect import signature
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np
import torch
from torch import Tensor

from caustic_cli.config import keywords
from caustic_cli.config.lamp import asks_for_lamp, says_lamp
from caustic_cli.errors import InputError
from caustic_cli.inverse.accuracy_cost import Start
from caustic_cli.io.files import Piped
from caustic_cli.io.picture import Picture
from caustic_cli.loading import OnDemand
from caustic_cli.optics.emission import rays_of
from caustic_cli.optics.reconstruction import Filter
from caustic_cli.optics.surfaces.heightfield import HeightField
from caustic_cli.optics.system import EXIT
from caustic_cli.optics.trace import tracers
from caustic_cli.project.project import Project
from caustic_cli.scene import Scene
from caustic_cli.workflow import design as workflow
from caustic_cli.workflow import lens, preparation, progress
from caustic_cli.workflow.finishing import of_design
from caustic_cli.workflow.lens import Lens, Render, count
from caustic_cli.workflow.movie import recorder
from caustic_cli.workflow.reporter import Listener, Reporter

if TYPE_CHECKING:
    from caustic_cli.workflow.lamp import LampDesign

estimate, lamp = OnDemand("caustic_cli.workflow.estimate"), OnDemand("caustic_cli.workflow.lamp")

#: Progress callback of a design: stage, status, iterations done, and in total.
Progress = Callable[[str, str, int | None, int | None], None]


def design(
    picture: str | Path | np.ndarray | Tensor,
    *,
    source: str | Mapping[str, Any] | None = None,
    mag: float | None = None,
    margin: float | None = None,
    throw: float | None = None,
    quality: str | None = None,
    rays: float | None = None,
    settings: Mapping[str, Mapping[str, Any] | Sequence[Mapping[str, Any]]] | None = None,
    preset: str | None = None,
    out: str | Path | None = None,
    force: bool = False,
    movie: str | Path | None = None,
    on_progress: Progress | None = None,
    on_message: Callable[[str], None] | None = None,
    device: str = "cpu",
    **given: Any,
) -> Lens | LampDesign:
    """Design a lens for a picture, as `caustic design` does; with `lamp` a lamp.

    Args:
        picture: a file, or irradiance (n_x, n_y), not negative, [i, j] with j upwards.
        source: a type such as "point", or a section as of project.toml: {"type": "disc", "position": [0, 0, -500], "size": [5, 5]}.
        mag: width of the picture over that of the lens; margin: dark border around it, in total, over its width.
        throw: distance of the screen from the lens' origin, mm.
        quality: draft, standard or fine; rays: of the last stage.
        settings: further sections and keys of project.toml: {"lens": {"size": [20, 20]}, "design": {"max_slope": 0.5}},
            and tables of other elements: {"element": [{"type": "mirror", "z": 120.0, "tilt": [45, 0]}]}.
        preset: name of a set of settings, "plate-100", see `config.presets`.
        out: a project directory to keep checkpoints and pictures in; without it, no file is touched.
        force: replace a project there.
        movie: a GIF or MP4 file that shows the image at its iterations.
        on_progress, on_message: callbacks; device: cpu or cuda.
        given: any other setting, by the name of its option (`resolution=128`, `lens_size=[20, 20]`, `linear=True`, `waves="off"`)
            or by its section and key in project.toml (`lens_z_in=1.0`), see `config.keywords`; `element` and `stages` are lists
            of tables.

    Raises:
        InputError: a keyword is unknown, a value is out of range, or the picture cannot be reached in this scene.
        CausticError: the design could not be completed.
    """
    by_name = {"mag": mag, "margin": margin, "throw": throw, "quality": quality, **given}
    by_name["rays"] = None if rays is None else count(rays)
    sections = dict(settings or {})
    if source is None or isinstance(source, str):
        by_name["source"] = source
    else:
        sections["source"] = _source_section(sections.get("source", {}), source)
    chosen = keywords.checked(keywords.from_keywords("design", by_name, signature(design).parameters), sections, "settings")
    return design_of(
        picture if isinstance(picture, str | Path) else _picture(picture),
        chosen,
        preset=preset,
        out=None if out is None else Path(out),
        force=force,
        movie=None if movie is None else Path(movie),
        say=Listener(on_progress, on_message),
        device=device,
    )


def _source_section(others: Any, source: Any) -> dict[str, Any]:
    """The section of a source, which overrides the keys of another.

    Raises:
        InputError: they are not one section each.
    """
    if not (isinstance(source, Mapping) and isinstance(others, Mapping)):
        raise InputError("source must be a type or a section; several are given in settings, as a list of sections")
    return {**others, **source}


def design_of(
    target: str | Path | Piped | Picture,
    given: Mapping[str, Any],
    *,
    preset: str | None = None,
    config: Path | None = None,
    out: Path | None = None,
    force: bool = False,
    movie: Path | None = None,
    error: float | None = None,
    say: Reporter,
    device: str = "cpu",
) -> Lens | LampDesign:
    """Design a lens or a lamp for a picture and settings by their paths in `schema.table`: {"mag": 3, "lens.size": [20, 20]}.

    Args:
        preset: settings by name, see `config.presets`; config: a TOML file of further ones, which override those of the preset and
            are overridden by those `given`.
        out, force, movie, device: as in `design`; say: receives progress and messages.
        error: design by the cheapest quality that should reach this relative RMS error, until it is reached; None for the settings.

    Raises:
        InputError, CausticError: as in `design`.
    """
    began = Start.now()
    read = Path(target) if isinstance(target, str) else target
    how: dict[str, Any] = {"preset": preset, "config": config}
    if asks_for_lamp(given, preset, config):
        _refuse_for_lamps({"movie": movie, "error": error}, device)
        return lamp.design(read, given, **how, out=out, force=force, say=say)
    tries = [(None, None)] if error is None else estimate.cheapest(read, given, error, say, **how)
    for quality, aim in tries:
        wanted, recording = given if quality is None else {**given, "quality": quality}, recorder(movie, force)
        prepared = preparation.prepare(read, wanted, **how, out=out, force=force, say=say, device=device)
        done = workflow.design(prepared, device, say, began, recording, aim)
        if aim is None or quality is None or estimate.reached(done.figures, aim.error, quality, say):
            break
        force = True  # it replaces the lens that was not good enough
    return _lens(done, device, say)


def resume(
    path: str | Path,
    *,
    iterations: int | None = None,
    time_limit: float | None = None,
    movie: Path | None = None,
    force: bool = False,
    say: Reporter | None = None,
    device: str = "cpu",
) -> Lens | LampDesign:
    """Continue the design of a project directory from its last checkpoint, that of a lamp from its last complete stage.

    Args:
        iterations: in total, counted from the beginning, instead of those of the project; time_limit: s.
        movie: as in `design`, from this checkpoint on; force: replace an existing one.

    Raises:
        InputError: there is no project, or it was edited into another design.
    """
    if says_lamp(Path(path)):
        _refuse_for_lamps({"movie": movie, "design.iterations": iterations, "design.time_limit": time_limit}, device)
        return lamp.resume(Project.open(path), say or Listener())
    began, say, recording = Start.now(), say or Listener(), recorder(movie, force)
    return _lens(workflow.resume(Project.open(path), iterations, time_limit, device, say, began, recording), device, say)


def _refuse_for_lamps(given: Mapping[str, Any], device: str) -> None:
    """Refuse arguments that the design of a lamp does not take.

    Raises:
        InputError: one is given.
    """
    for name, value in given.items():
        if value is not None:
            raise InputError(f"⟨{name}⟩ is for a lens before its light, not for a lamp around it")
    if device != "cpu":
        raise InputError(f"a lamp is designed on the CPU: leave out ⟨device⟩ {device}")


def load(path: str | Path, at: str | None = None, **given: Any) -> Lens | LampDesign:
    """The lamp of a project directory, or the lens as of `workflow.lens.load`."""
    if says_lamp(Path(path)):
        if at is not None or given:
            raise InputError(f"{path}: is a lamp, which has no other light or screen, got {', '.join([*given] or ['at'])}")
        return lamp.LampDesign.of(Project.open(path))
    return lens.load(path, at, **given)


def _lens(done: workflow.Result, device: str, say: Reporter) -> Lens:
    made = progress.provenance(done.project, device)
    lens = Lens(done.scene, done.field, done.heights, done.target, done.figures, done.project, done.state, made)
    lens.figures.update(of_design(lens, say))
    return lens


def render(lens: Lens | LampDesign | str | Path, rays: float | None = None, **options: Any) -> Render:
    """`Lens.render` of a lens or a lamp, or of a project or an archive, with the keywords of `load`, too."""
    if not isinstance(lens, str | Path):
        return lens.render(rays, **options)
    own = {name: options.pop(name) for name in signature(Lens.render).parameters if name in options}
    return load(lens, **options).render(rays, **own)


def trace(
    scene: Scene,
    heights: Tensor,
    rays: float = 250_000,
    *,
    sampler: str = "stratified",
    seed: int = 0,
    filter: Filter | None = None,
    dtype: torch.dtype = torch.float64,
) -> Tensor:
    """The irradiance image of a lens as a differentiable function of its control heights.

    Args:
        scene: its lens gives degree and knots of the net, equispaced by default.
        heights: (n, m) mm float64, the control net; gradients flow to it.
        rays: how many, in a sampler of `optics.sampling.SAMPLERS`.
        filter: reconstruction filter, a 3 x 3 cosine unless given; a bincount has no derivative.

    Returns:
        (n_x, n_y), or (3, n_x, n_y) for a coloured scene: power per pixel as a fraction of the source's.
    """
    scene = replace(scene, lens=replace(scene.lens, control=cast("tuple[int, int]", tuple(heights.shape))))
    filter = filter or Filter("cosine", (3, 3))
    drawn = rays_of(scene, sampler, count(rays), seed, heights.device)
    parts = tracers(scene, HeightField.of(scene.lens), drawn, dtype, drawn.count)
    return cast(Tensor, sum(part.expose({EXIT: heights}, scene.screen, filter).image for part in parts))


def _picture(given: np.ndarray | Tensor) -> Picture:
    values = np.array(given.detach().cpu().numpy() if isinstance(given, Tensor) else given, dtype=np.float64)
    if values.ndim != 2 or min(values.shape) < 2 or not np.isfinite(values).all() or values.min() < 0 or not values.max() > 0:
        raise InputError("picture must be a file, or a 2-D array of at least 2 x 2 finite values, none of them negative, not all 0")
    return Picture(values, "linear")
