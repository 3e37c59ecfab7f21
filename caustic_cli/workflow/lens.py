"""The public `Lens`: a lens in its scene, loaded or designed, with its surface, renders and exports."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from inspect import signature
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from caustic_cli.config import keywords
from caustic_cli.config.design import region_of
from caustic_cli.effort import current_effort
from caustic_cli.errors import InputError
from caustic_cli.export import format_of
from caustic_cli.inverse.designer import State
from caustic_cli.loading import OnDemand
from caustic_cli.optics.obstruction import refuse_obstructed
from caustic_cli.optics.plan import Plan, compile_plan, parse_effects
from caustic_cli.optics.reconstruction import Filter
from caustic_cli.optics.surfaces.cut import CutSurface
from caustic_cli.optics.surfaces.heightfield import HeightField
from caustic_cli.optics.system import entrance_of
from caustic_cli.project import directory, uptodate
from caustic_cli.project.archived import ArchivedLens, origin_of
from caustic_cli.project.checkpoint import Checkpoint
from caustic_cli.project.project import Project
from caustic_cli.scene import Scene
from caustic_cli.schema import checks
from caustic_cli.studies.beam import shaped_figures
from caustic_cli.studies.judge import judged
from caustic_cli.studies.retrace import evaluation_rays, retrace
from caustic_cli.studies.viewing import tristimulus_values
from caustic_cli.studies.waves import height_deviation, wave_figures
from caustic_cli.workflow.compilation import compile_for
from caustic_cli.workflow.machining import FINER
from caustic_cli.workflow.reporter import Listener, Reporter

exporting = OnDemand("caustic_cli.workflow.export")


@dataclass(frozen=True, eq=False)
class Render:
    """A rendered image with its figures; `image, figures = lens.render()` takes it apart."""

    #: Power per pixel as a part of the source's, (n_x, n_y) or (3, n_x, n_y), float64.
    image: np.ndarray
    #: As of `render json`.
    figures: dict[str, Any]
    #: (3, n_x, n_y) tristimulus values on the same scale, Y that of the image; None for light without colour (`Scene.white`).
    xyz: np.ndarray | None = None

    def __iter__(self) -> Iterator[Any]:
        return iter((self.image, self.figures))


@dataclass(frozen=True, eq=False)
class Lens:
    """A lens in its scene."""

    #: Source, lens, screen.
    scene: Scene
    #: Spline spaces of the exit surface over the aperture.
    field: HeightField
    #: Its control heights (n, m), mm, float64.
    heights: Tensor
    #: (n_x, n_y) or (3, n_x, n_y) on the screen's pixels, None for an archive.
    target: np.ndarray | None
    #: Of the evaluation of the design with independent rays; empty for an unfinished design.
    figures: dict[str, Any]
    #: The project or the archive that it comes from.
    origin: Project | ArchivedLens
    #: Of the design.
    state: State | None = None
    #: Of that, see `workflow.progress.provenance`.
    provenance: dict[str, Any] | None = None

    def surface(self, x: Any, y: Any, side: str = "exit") -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Height z, mm, and slopes dz/dx, dz/dy of the exit surface at points of the aperture, float64, of their common shape.

        side: exit, or entrance.
        """
        checks.choice("side", side, ("exit", "entrance"))
        x, y = np.broadcast_arrays(np.asarray(x, dtype=np.float64), np.asarray(y, dtype=np.float64))
        rx, ry = self.scene.lens.half_size
        if not (np.isfinite(x).all() and np.isfinite(y).all() and (np.abs(x) <= rx).all() and (np.abs(y) <= ry).all()):
            raise InputError(f"points must lie on the aperture, x within +-{rx:g} mm and y within +-{ry:g} mm")
        u, v = (torch.from_numpy(c.ravel().copy()) for c in (x, y))
        if side == "exit":
            surface = self.field.at(self.heights, u, v)
        elif self.scene.lens.entrance is not None:
            surface = entrance_of(self.scene.lens).at(None, u, v)
            surface[0] = surface[0] + self.scene.lens.z_in
        else:
            surface = [torch.full_like(u, self.scene.lens.z_in), torch.zeros_like(u), torch.zeros_like(u)]
        z, zx, zy = (c.numpy().reshape(x.shape) for c in surface)
        return z, zx, zy

    @classmethod
    def of(cls, origin: Project | ArchivedLens, given: Mapping[str, Any] | None = None) -> Lens:
        """The lens of a project or an archive; given: path in `schema.table` -> value, overriding the settings of a project."""
        data = origin.read(given or {})
        return cls(*data[:4], dict(data.figures), origin, *data[5:])

    @property
    def project(self) -> Project | None:
        """Settings and picture, None for an archive."""
        return self.origin if isinstance(self.origin, Project) else None

    def under(self, given: Mapping[str, Any]) -> Lens:
        """The lens in its scene with other settings of light or screen: path in `schema.table` -> value.

        Raises:
            InputError: it comes from an archive, whose scene is fixed, or a value is out of range.
        """
        if not given:
            return self
        scene = self.origin.scene(given)
        scene = replace(scene, lens=replace(scene.lens, entrance=self.scene.lens.entrance), elements=self.scene.elements)
        return replace(self, scene=scene, target=self.origin.target(scene))

    @cached_property
    def made(self) -> tuple[HeightField, Tensor]:
        """The surface to be made, corrected for its finish."""
        return self.origin.made(self.field, self.heights)

    @property
    def seed(self) -> int:
        """Seed of the rays of its design."""
        return self.origin.seed

    @property
    def by_waves(self) -> bool:
        """Whether its design was refined on its wave image, which then judges it."""
        return self.origin.refined_by_waves(self.state)

    @property
    def encoding(self) -> str:
        """Encoding of its picture, and of its images."""
        return self.origin.encoding

    def plan(self, effects: str = "auto", steeper: float = 0.0) -> Plan:
        """The effects to simulate: those that the scene calls for ("auto"), only those that cannot be left out ("none"), or those
        named; steeper: by how much the slopes of the traced surface may exceed those of the lens.

        Raises:
            InputError: an effect is unknown, or something stands in the light.
        """
        refuse_obstructed(self.scene, designed=True)
        return compile_plan(self.scene, self.field, self.heights, parse_effects(effects), steeper)

    def render(
        self,
        rays: float | None = None,
        *,
        seed: int | None = None,
        tolerance: float | None = None,
        filter: Filter | None = None,
        effects: str | Plan = "auto",
        dtype: torch.dtype = torch.float64,
        device: str = "cpu",
        say: Reporter | None = None,
        cut: CutSurface | None = None,
        **given: Any,
    ) -> Render:
        """Retrace the lens with independent rays, with the effects that the scene calls for.

        Args:
            rays: their number; with `tolerance`, the initial one.  None for those of the evaluation of a design,
                `evaluation_rays`, of other light than a plane wave's more until its noise is a tenth of the error.
            seed: of the rays, that of the design unless given.
            tolerance: relative RMS noise of the image, for which the number of rays is increased.
            filter: reconstruction filter; None for a bincount.
            effects: as of `plan`, or a plan.
            dtype: of the ray arithmetic.
            cut: a machined surface instead of that of the lens (`workflow.machining`).
            given: settings of another light or screen, by the names of the options of `caustic render` (`source="point"`,
                `screen_tilt=[0, 20]`), see `config.keywords`.

        Raises:
            InputError: a keyword is unknown, or a value is out of range.
        """
        lens = self.under(_other_scene(given, signature(Lens.render).parameters))
        plan = effects if isinstance(effects, Plan) else lens.plan(effects)
        effort = current_effort()
        compile_for(plan.scene, device, say or Listener(), plan.requests)
        exposure, figures = retrace(
            plan.scene,
            lens.field if cut is None else cut,
            lens.heights,
            lens.target,
            rays=evaluation_rays(plan.scene, effort.final_rays) if rays is None else count(rays),
            quiet=effort.noise if rays is None else None,
            seed=lens.seed if seed is None else seed,
            filter=filter,
            tolerance=tolerance,
            device=device,
            dtype=dtype,
            requests=plan.requests,
        )
        return Render(exposure.image.cpu().numpy(), judged(figures, False), tristimulus_values(plan.scene, exposure))

    def render_waves(
        self, *, effects: str | Plan = "auto", required: bool = True, device: str = "cpu", cut: CutSurface | None = None
    ) -> Render:
        """The wave image at the wavelengths of the scene; only its figures if it is not `required` and not available (empty image).
        cut: as in `render`.

        Raises:
            InputError: it is required and not available.
        """
        plan = effects if isinstance(effects, Plan) else self.plan(effects)
        light, figures = wave_figures(
            plan.scene,
            self.field,
            self.heights.to(device),
            self.target,
            self.origin.resolution(plan.scene, self.field, self.heights),
            finer=1.0 if cut is None else FINER,
            required=required,
            perturbation=None if cut is None else height_deviation(cut, self.field, self.heights),
        )
        if light is None:
            return Render(np.empty((0, 0)), judged(figures, True))
        if self.project is not None and self.target is not None and cut is None:
            region = region_of(self.project.settings.design)
            figures |= shaped_figures(plan.scene, self.field, self.heights, self.target, region, light)
        return Render(light.image.cpu().numpy(), judged(figures, True), tristimulus_values(plan.scene, light))

    def export(
        self,
        path: str | Path,
        format: str | None = None,
        *,
        samples: tuple[int, int] | None = None,
        tolerance: float | None = None,
        script: bool = False,
        mould: bool = False,
        block: float | None = None,
        milling: dict | None = None,
        levels: int | None = None,
    ) -> Path:
        """Export the lens; the format follows from the suffix (.step, .stl, .npz, ...) unless it is given.

        Args:
            samples: points along x and y, for sampled formats; tolerance: for meshes instead, mm; for step, 0 for the exact spline.
            script: for lighttools: also write a script that rebuilds the scene.
            mould: the negative; block: least material behind a mirror or a mould, mm; milling: for gcode, see `export.milling`.
            levels: for phase: of a turn.
        """
        path = Path(path)
        name = format_of(path, format)
        each = (("samples", samples), ("tolerance", tolerance), ("levels", levels))
        given: dict[str, Any] = {key: value for key, value in each if value is not None}
        exporter = exporting.Exporter(self.scene, *self.made, self.target, self.by_waves, self.seed)
        exporter.write(path, name, script, mould, block, milling, **given)
        return path

    def save(self, path: str | Path, force: bool = False) -> Path:
        """Save the lens as a project directory, which `load` and the command line open; force: replace a project there."""
        place = Path(path)
        project = self.origin.moved(place)
        assert self.state is not None and self.provenance is not None  # of every project
        directory.check(place, force)
        state = Checkpoint(self.state, self.field.spaces, self.provenance, self.figures, uptodate.inputs(project))
        directory.create(project, force, state)
        project.hold.close()
        return place


def load(path: str | Path, at: str | None = None, **given: Any) -> Lens:
    """The lens of a project directory, or of an exported .npz archive.

    at: parameter values for a network trained over ranges, "throw=300"; the middle of each range that is not named; given: settings
    of another light or screen, as for `Lens.render`.

    Raises:
        InputError: there is none, it is damaged, a keyword is unknown, or a value is out of range.
    """
    other = _other_scene(given, ("at", *signature(Lens.render).parameters))
    return Lens.of(origin_of(path, at), other)


def _other_scene(given: Mapping[str, Any], own: Iterable[str]) -> dict[str, Any]:
    """Path -> value of keywords that change light or screen; own: names of the function's other parameters."""
    return keywords.checked(keywords.from_keywords("render", given, own), {}, "render")


def count(rays: float) -> int:
    """A number of rays as int, also given as 1e7."""
    if not (isinstance(rays, int | float) and rays == int(rays) and 1 <= rays <= 1e12):
        raise InputError(f"rays must be a whole number 1 to 1e12, got {rays!r}")
    return int(rays)
