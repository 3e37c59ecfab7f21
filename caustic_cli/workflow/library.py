"""The library: design, load and render lenses from Python, without files unless asked.

    from caustic_cli import design, load, render, trace

    lens = design("flame.png", source="plane", mag=3)
    image, figures = lens.render(rays=1e7)
    lens.export("lens.step")
    lens.save("flame.caustic")

Lengths are millimetres, angles degrees, wavelengths nanometres, powers watts; arrays are indexed [i, j] with i along +x and j along
+y.  Errors are `caustic_cli.errors.InputError` for what was given, and `CausticError` for what could not be finished.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple, cast

import numpy as np
import torch
from torch import Tensor

from caustic_cli.config import settings as schema
from caustic_cli.errors import InputError
from caustic_cli.export import BY_SUFFIX
from caustic_cli.inverse.designer import State
from caustic_cli.io.archive import open_archive
from caustic_cli.io.picture import Picture
from caustic_cli.optics.emission import rays_of
from caustic_cli.optics.reconstruction import Filter
from caustic_cli.optics.surfaces.heightfield import HeightField
from caustic_cli.optics.system import EXIT
from caustic_cli.optics.trace import tracers
from caustic_cli.project import directory, uptodate
from caustic_cli.project.checkpoint import Checkpoint
from caustic_cli.project.project import Project
from caustic_cli.scene import Scene
from caustic_cli.studies.retrace import retrace
from caustic_cli.workflow import design as workflow
from caustic_cli.workflow.compilation import compile_for, compile_usual
from caustic_cli.workflow.export import write
from caustic_cli.workflow.reporter import Listener, Reporter

#: Told of a design's progress: stage, what it is at, iterations done, and in all.
Progress = Callable[[str, str, int | None, int | None], None]


class Render(NamedTuple):
    """image: power per pixel as a part of the source's, (n_x, n_y) or (3, n_x, n_y), float64; figures: as of `render json`."""

    image: np.ndarray
    figures: dict[str, Any]


@dataclass(frozen=True, eq=False)
class Lens:
    """A lens in its scene.

    Attributes:
        scene: source, lens, screen.
        field: spline spaces of the exit surface over the aperture.
        heights: its control heights (n, m), mm, float64.
        target: (n_x, n_y) or (3, n_x, n_y) on the screen's pixels, None of an archive.
        figures: of the design's own evaluation, by rays it was not designed with; empty of what was loaded unfinished.
        project: settings and picture, None of an archive.
        state: where its design stands.
    """

    scene: Scene
    field: HeightField
    heights: Tensor
    target: np.ndarray | None
    figures: dict[str, Any]
    project: Project | None = None
    state: State | None = None

    def surface(self, x: Any, y: Any) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Height z, mm, and slopes dz/dx, dz/dy of the exit surface at points of the aperture, float64, of their common shape."""
        x, y = np.broadcast_arrays(np.asarray(x, dtype=np.float64), np.asarray(y, dtype=np.float64))
        rx, ry = self.scene.lens.half_size
        if not (np.isfinite(x).all() and np.isfinite(y).all() and (np.abs(x) <= rx).all() and (np.abs(y) <= ry).all()):
            raise InputError(f"points must lie on the aperture, x within +-{rx:g} mm and y within +-{ry:g} mm")
        u, v = (torch.from_numpy(c.ravel().copy()) for c in (x, y))
        z, zx, zy = (c.numpy().reshape(x.shape) for c in self.field.at(self.heights, u, v))
        return z, zx, zy

    def render(
        self,
        rays: float = 1_000_000,
        *,
        seed: int = 0,
        tolerance: float | None = None,
        filter: Filter | None = None,
        device: str = "cpu",
    ) -> Render:
        """Retrace the lens with rays of its own.

        Args:
            rays: how many; with `tolerance`, where the number begins.
            tolerance: relative RMS noise of the image that rays are added for.
            filter: reconstruction filter; None counts rays in pixels.
        """
        compile_for(self.scene, device, Listener())
        exposure, figures = retrace(
            self.scene,
            self.field,
            self.heights,
            self.target,
            rays=_count(rays),
            seed=seed,
            filter=filter,
            tolerance=tolerance,
            device=device,
        )
        return Render(exposure.image.cpu().numpy(), figures)

    def export(
        self,
        path: str | Path,
        format: str | None = None,
        *,
        samples: tuple[int, int] | None = None,
        tolerance: float | None = None,
        script: bool = False,
    ) -> Path:
        """Write the lens for another program; the format follows from the suffix (.step, .stl, .npz, ...) unless it is named.

        Args:
            samples: points along x and y of sampled formats; tolerance: of meshes instead, mm.
            script: of lighttools: also a script that rebuilds the scene.
        """
        path = Path(path)
        name = format or BY_SUFFIX.get(path.suffix.lower())
        if name is None or name not in BY_SUFFIX.values():
            raise InputError(f"format must be one of {', '.join(BY_SUFFIX.values())}, got {format or path.suffix!r}")
        given = {key: value for key, value in (("samples", samples), ("tolerance", tolerance)) if value is not None}
        write(path, self.scene, self.field, self.heights, name, script, **given)
        return path

    def save(self, path: str | Path, force: bool = False) -> Path:
        """Write the lens as a project directory, which `load` and the command line open; force: replace a project there."""
        if self.project is None or self.state is None:
            raise InputError("an archive's lens has no picture and no design, so it cannot be saved as a project")
        place = Path(path)
        project = replace(self.project, path=place)
        directory.check(place, force)
        directory.settle(project, force)
        with project.hold:
            project.save(
                Checkpoint(
                    self.state, self.field.spaces, workflow.provenance(project, "cpu"), self.figures, uptodate.inputs(project)
                )
            )
        return place


def design(
    picture: str | Path | np.ndarray | Tensor,
    *,
    source: str | Mapping[str, Any] | None = None,
    mag: float | None = None,
    margin: float | None = None,
    throw: float | None = None,
    quality: str | None = None,
    rays: float | None = None,
    settings: Mapping[str, Mapping[str, Any]] | None = None,
    linear: bool | None = None,
    waves: str | None = None,
    time_limit: float | None = None,
    out: str | Path | None = None,
    force: bool = False,
    on_progress: Progress | None = None,
    on_message: Callable[[str], None] | None = None,
    device: str = "cpu",
) -> Lens:
    """The lens that throws a picture, as `caustic design` finds it.

    Args:
        picture: a file, or irradiance (n_x, n_y), not negative, [i, j] with j upwards.
        source: a type such as "point", or a section as of project.toml: {"type": "disc", "position": [0, 0, -500], "size": [5, 5]}.
        mag: width of the picture over that of the lens; margin: dark border around it, part of its width in all.
        throw: distance of the screen from the lens' origin, mm.
        quality: draft, standard or fine; rays: of the last stage.
        settings: further sections and keys of project.toml: {"lens": {"size": [20, 20]}, "design": {"max_slope": 0.5}}.
        linear: whether values of the file are irradiance rather than sRGB codes.
        waves: auto, on or off: refine the wave image after the ray image.
        time_limit: seconds for the optimisation.
        out: a project directory to keep checkpoints and pictures in; without it, no file is touched.
        force: replace a project there.
        on_progress, on_message: told while it works.
        device: cpu or cuda.

    Raises:
        InputError: a value out of range, or a picture that no lens of this scene can throw.
        CausticError: the design could not be finished.
    """
    sections: dict[str, dict[str, Any]] = {section: dict(values) for section, values in (settings or {}).items()}
    if source is not None:
        sections["source"] = sections.get("source", {}) | ({"type": source} if isinstance(source, str) else dict(source))
    design = {key: value for key, value in (("waves", waves), ("time_limit", time_limit)) if value is not None}
    if design:
        sections["design"] = sections.get("design", {}) | design
    if linear:
        sections["target"] = sections.get("target", {}) | {"encoding": "linear"}
    by = {"mag": mag, "margin": margin, "throw": throw, "quality": quality, "rays": None if rays is None else _count(rays)}
    given = {
        f"{section}.{key}": value
        for section, values in schema.checked(sections, "settings").items()
        for key, value in values.items()
    }
    given |= {path: value for path, value in by.items() if value is not None}
    return design_of(
        picture if isinstance(picture, str | Path) else _picture(picture),
        given,
        out=None if out is None else Path(out),
        force=force,
        say=Listener(on_progress, on_message),
        device=device,
    )


def design_of(
    target: str | Path | Picture,
    given: Mapping[str, Any],
    *,
    config: Path | None = None,
    out: Path | None = None,
    force: bool = False,
    say: Reporter,
    device: str = "cpu",
) -> Lens:
    """The lens for a picture and settings by their paths in `config.table`: {"mag": 3, "lens.size": [20, 20]}.

    Args:
        config: a TOML file of further settings, which those `given` replace.
        out, force, device: as of `design`; say: who is told while it works.

    Raises:
        InputError, CausticError: as of `design`.
    """
    began = time.monotonic()
    compile_usual(device)
    project, first = workflow.begin(
        Path(target) if isinstance(target, str) else target, given, config=config, out=out, force=force, say=say
    )
    compile_for(project.scene(), device, say, gradient=True)
    return _lens(workflow.design(project, first, device, say, began))


def resume(
    path: str | Path,
    *,
    iterations: int | None = None,
    time_limit: float | None = None,
    say: Reporter | None = None,
    device: str = "cpu",
) -> Lens:
    """Go on with the design of a project directory from its last checkpoint.

    Args:
        iterations: in all, counted from the very first, instead of the project's; time_limit: s.

    Raises:
        InputError: there is no project, or it was edited into another design.
    """
    began, say = time.monotonic(), say or Listener()
    project = Project.open(path)
    compile_for(project.scene(), device, say, gradient=True)
    return _lens(workflow.resume(project, iterations, time_limit, device, say, began))


def _lens(done: workflow.Result) -> Lens:
    return Lens(done.scene, done.field, done.state.heights, done.target, done.figures, done.project, done.state)


def load(path: str | Path) -> Lens:
    """The lens of a project directory, or of an .npz archive as exported.

    Raises:
        InputError: there is none, or it is damaged.
    """
    path = Path(path)
    if path.suffix.lower() == ".npz" and path.is_file():
        return Lens(*open_archive(path), None, {})
    project = Project.open(path)
    scene = project.scene()
    field, checkpoint = project.lens(scene)
    return Lens(scene, field, checkpoint.state.heights, project.target(scene), dict(checkpoint.results), project, checkpoint.state)


def render(lens: Lens | str | Path, rays: float = 1_000_000, **options: Any) -> Render:
    """`Lens.render` of a lens, or of a project or an archive."""
    return (lens if isinstance(lens, Lens) else load(lens)).render(rays, **options)


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
        scene: whose lens has the net's degree; its knots, or equispaced ones.
        heights: (n, m) mm float64, the control net; gradients flow to it.
        rays: how many, in a sampler of `optics.sampling.SAMPLERS`.
        filter: reconstruction filter, a 3 x 3 cosine unless given; counting rays in pixels has no derivative.

    Returns:
        (n_x, n_y), or (3, n_x, n_y) of a coloured scene: power per pixel as a part of the source's.
    """
    scene = replace(scene, lens=replace(scene.lens, control=cast("tuple[int, int]", tuple(heights.shape))))
    filter = filter or Filter("cosine", (3, 3))
    drawn = rays_of(scene, sampler, _count(rays), seed, heights.device)
    parts = tracers(scene, HeightField.of(scene.lens), drawn, dtype, drawn.count)
    return cast(Tensor, sum(part.expose({EXIT: heights}, scene.screen, filter).image for part in parts))


def _count(rays: float) -> int:
    """A number of rays, also given as 1e7."""
    if not (isinstance(rays, int | float) and rays == int(rays) and 1 <= rays <= 1e12):
        raise InputError(f"rays must be a whole number 1 to 1e12, got {rays!r}")
    return int(rays)


def _picture(given: np.ndarray | Tensor) -> Picture:
    values = np.array(given.detach().cpu().numpy() if isinstance(given, Tensor) else given, dtype=np.float64)
    if values.ndim != 2 or min(values.shape) < 2 or not np.isfinite(values).all() or values.min() < 0 or not values.max() > 0:
        raise InputError("picture must be a file, or a 2-D array of at least 2 x 2 finite values, none of them negative, not all 0")
    return Picture(values, "linear")
