"""Design runs for the comparison of optimisers, `convergence study design`."""

from __future__ import annotations

import math
import time
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from caustic_cli.config import settings
from caustic_cli.config.default_stages import coarse_to_fine
from caustic_cli.config.design import stage_of
from caustic_cli.config.settings import Settings
from caustic_cli.effort import current_effort
from caustic_cli.errors import InputError
from caustic_cli.inverse.designer import Designer, State
from caustic_cli.inverse.initial_surface import first_surface
from caustic_cli.inverse.objective import LossOfHeights
from caustic_cli.inverse.parametrisation import Heights, Parametrisation
from caustic_cli.inverse.problem import Options, Problem
from caustic_cli.inverse.schedule import LossImage, Stage
from caustic_cli.inverse.target import target_on_screen
from caustic_cli.io.picture import Picture
from caustic_cli.kinds import OneSurface, problem_of
from caustic_cli.kinds.surface import NETWORK_CONTROL
from caustic_cli.optics.surfaces.heightfield import HeightField
from caustic_cli.project.completion import complete
from caustic_cli.project.project import Project
from caustic_cli.scene import Lens, Scene
from caustic_cli.schema.table import Parameters

#: A comparison without a project: pixels across the screen, and control points, 64 spans and the degree.
PIXELS, CONTROL = 96, 67
#: Of its picture, a bright disc: cells across, and radius over half the width.
CELLS, DISC = 480, 0.8
#: Knot spans of the control nets compared: all, half, and a quarter.
PARTS = (1, 2, 4)
ENDLESS = 10**9
TRANSPORT = "lbfgs, from transport"
#: Default designs that are compared as well.
QUALITIES = ("draft", "standard", "fine")


class CachingDesigner(Designer):
    """A designer that caches the objective of a stage between time slices."""

    _kept: tuple[int, LossOfHeights] | None = None

    def objective(self, k: int, heights: Heights) -> LossOfHeights:
        if self._kept is None or self._kept[0] != k:
            self._kept = None  # released first: objectives are large
            self._kept = k, super().objective(k, heights)
        return self._kept[1]


class TimedDesign:
    """A `studies.optimiser_comparison.DesignRun`: a design that is advanced in time slices.

    Raises:
        InputError: the lens leaves the heights no room.
        CausticError: no light reaches the screen.
    """

    def __init__(self, series: str, problem: Problem, transport: bool = False):
        self.transport = transport or series == TRANSPORT
        self.series, self.optimizer, self.network = series, problem.options.optimizer, problem.options.parametrisation.network
        self.designer, target = CachingDesigner(problem), problem.target
        self.designer.run(self._begin(target), iterations=1)  # warm-up: compilation and caches
        self.state, self.done, self.pixels = self._begin(target), False, target.numel()
        self.waited = self.state.seconds

    def _begin(self, target: Tensor) -> State:
        """The initial state, with the time of its computation."""
        if not self.transport:
            return self.designer.initial_state()
        began, problem = time.monotonic(), self.designer.problem
        if isinstance(problem, OneSurface):
            first = problem.transport(True, math.inf).heights
        else:
            first = first_surface(self.designer.scene, target.numpy(), self.designer.field(0)).heights
        return replace(self.designer.initial_state(first), seconds=time.monotonic() - began)

    @property
    def field(self) -> HeightField:
        """Spline spaces of the current stage."""
        return self.designer.field(self.state.stage)

    @property
    def heights(self) -> Tensor:
        """Control heights (n, m) mm."""
        return self.state.heights

    @property
    def seconds(self) -> float:
        """Seconds so far."""
        return self.state.seconds

    @property
    def iterations(self) -> int:
        """Iterations so far."""
        return self.state.total

    @property
    def steps(self) -> list[float]:
        """Seconds of each iteration so far."""
        return np.diff([self.waited, *(row[4] for row in self.state.history)]).tolist()

    @property
    def loss(self) -> float | None:
        """Loss of the last iteration, times the pixels; None before the first."""
        return self.state.history[-1][2] * self.pixels if self.state.history else None

    def advance(self, seconds: float) -> None:
        """Iterate for this number of seconds, at least once."""
        end, steps = time.monotonic() + seconds, 0

        def count(_: State) -> None:
            nonlocal steps
            steps += 1

        self.state = self.designer.run(
            self.state, iterations=ENDLESS, on_iteration=count, stop=lambda: steps > 0 and time.monotonic() >= end
        )
        self.done = self.state.reason != "interrupted"


def timed_designs(
    project: Project | None, device: str, dtype: torch.dtype | None = None, seed: int | None = None
) -> tuple[Scene, np.ndarray, list[TimedDesign]]:
    """Scene, target (n_x, n_y) and design runs for a project; without one, for a bright disc on fewer pixels and control points.

    Raises:
        InputError, CausticError: as of `variants` and `TimedDesign`.
    """
    project = project or project_of_disc(PIXELS, CONTROL)
    problem = problem_of(project, device)
    runs = [TimedDesign(name, problem.varied(*how)) for name, *how in variants(problem, project.settings, dtype, seed)]
    if type(problem) is OneSurface and problem.options.parametrisation.free:
        for quality in QUALITIES:
            other = of_quality(project, quality)
            runs.append(TimedDesign(quality, problem_of(other, device), other.settings.design.start == "transport"))
    return problem.scene, problem.target.numpy(), runs


def of_quality(project: Project, quality: str) -> Project:
    """The same design by rays, with control net and stages that are the default of a quality."""
    s = project.settings
    lens = {key: value for key, value in s.lens.items() if key != "control"}
    given = {"source": dict(s.source), "lens": lens, "screen": dict(s.screen), "target": dict(s.target), "design": {"waves": "off"}}
    picture = project.picture
    full = complete(given, picture.aspect, Parameters(quality=quality), picture.lit, picture.gaps)
    return replace(project, settings=full)


def lens_of_disc() -> tuple[Scene, HeightField, Tensor]:
    """The default scene, and field and heights (n, m) mm of the transport lens for a bright disc."""
    full = complete({}, 1.0)
    scene = settings.build_scene(full)
    field = HeightField.of(scene.lens)
    return scene, field, first_surface(scene, disc(scene, full.target.size), field, current_effort().source_cells).heights


def disc(scene: Scene, size: tuple[float, float]) -> np.ndarray:
    """A bright disc in a dark square of `size` mm on the scene's screen: (n_x, n_y)."""
    return target_on_screen(picture_of_disc(), size, scene.screen)


def project_of_disc(pixels: int, control: int) -> Project:
    """One in memory whose picture is the bright disc."""
    full = complete({"screen": {"resolution": [pixels] * 2}, "lens": {"control": [control] * 2}}, 1.0)
    return Project(None, full, Picture(picture_of_disc(), "linear"))


def picture_of_disc() -> np.ndarray:
    """The same, (CELLS, CELLS)."""
    x = (np.arange(CELLS) + 0.5) * 2.0 / CELLS - 1.0
    return (np.hypot(x[:, None], x) <= DISC).astype(float)


def variants(
    problem: Problem, full: Settings, dtype: torch.dtype | None = None, seed: int | None = None
) -> list[tuple[str, list[Stage], Options]]:
    """Name, stages and options of every design run; dtype and seed replace those of the settings.

    L-BFGS on the finished control net, on nets of half and a quarter of its knot spans, coarse to fine, and from transport where
    the design would begin there; Adam on the heights themselves and on the networks of the thesis, on its control net.  Rays,
    filter, apron and loss are those of the last stage on rays.

    Raises:
        InputError: a setting is out of range, or no stage is on rays.
    """
    scene, on_rays, options = problem.scene, [s for s in problem.stages if not s.waves], problem.options
    if not on_rays:
        raise InputError("[[design.stages]] all have waves; designs are compared on rays, so one stage on rays is needed")
    last = on_rays[-1]
    options = replace(options, dtype=dtype or options.dtype, seed=options.seed if seed is None else seed)
    last = replace(last, rendering=replace(last.rendering, blur=0.0), iterations=ENDLESS, tolerance=0.0, source=None)
    lens = scene.lens
    nets = _nets(lens)
    newton = replace(options, optimizer="lbfgs", parametrisation=Parametrisation())
    found = [(f"lbfgs, {_net(net)}", [replace(last, control=net)], newton) for net in nets]
    if len(nets) > 1:
        stages = [
            stage_of(table, full)
            for table in coarse_to_fine(lens.control, lens.degree, last.rays, scene.screen.resolution, sampler=last.sampler)
        ]
        stages = [replace(s, rendering=_rendering(s, last, options)) for s in stages]
        stages[-1] = replace(stages[-1], iterations=ENDLESS, tolerance=0.0)
        found.append(("lbfgs, coarse to fine", stages, newton))
    net = (
        lens.control
        if lens.knots is not None
        else tuple(min(n, max(NETWORK_CONTROL, p + 1)) for n, p in zip(lens.control, lens.degree, strict=True))
    )
    if full.design.start == "transport":
        found.append((TRANSPORT, [replace(last, control=lens.control)], newton))
    for kind in ("none", "sparse", "dense"):
        if kind != "dense" or math.prod(net) <= NETWORK_CONTROL**2:  # weights: the square of the control points
            name = "adam" if kind == "none" else f"adam, {kind} network"
            found.append((f"{name}, {_net(net)}", [replace(last, control=net)], _by_adam(options, kind)))
    return found


def _rendering(stage: Stage, last: Stage, options: Options) -> LossImage:
    """The rendering of a stage with the filter of the last one; the loss rms is defined on the screen only."""
    how = replace(stage.rendering, filter=last.rendering.filter)
    return replace(how, apron=0) if options.loss == "rms" else how


def _by_adam(options: Options, network: str) -> Options:
    architecture = options.parametrisation.architecture
    return replace(options, optimizer="adam", parametrisation=Parametrisation(network, "zero", "none", architecture))


def _nets(lens: Lens) -> list[tuple[int, int]]:
    """The control net of a lens and, unless it has knots of its own, those of PARTS of its knot spans."""
    if lens.knots is not None:
        return [lens.control]
    axes = list(zip(lens.control, lens.degree, strict=True))
    nets = ([max(p + 1, math.ceil((n - p) / part) + p) for n, p in axes] for part in PARTS)
    return list(dict.fromkeys((nx, ny) for nx, ny in nets))


def _net(control: tuple[int, int]) -> str:
    return "x".join(map(str, control))
