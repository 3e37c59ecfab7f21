"""Candidates for the comparison of network architectures (`studies.architectures`)."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch

from caustic_cli.config.completion import build_options, build_stages, complete
from caustic_cli.config.settings import build_scene
from caustic_cli.errors import InputError
from caustic_cli.inverse.designer import Designer, InitialHeights, Options
from caustic_cli.inverse.parametrisation import Architecture
from caustic_cli.inverse.scene_parameters import Range, Ranges
from caustic_cli.inverse.schedule import Stage
from caustic_cli.project.project import Project
from caustic_cli.scene import Scene
from caustic_cli.studies.retrace import retrace
from caustic_cli.workflow import range_evaluation
from caustic_cli.workflow.comparison import disc
from caustic_cli.workflow.design import first_heights

#: Grid of hyperparameters: hidden layers, neurons in each, activations, learning rates, and preconditioners of the output.
LAYERS, WIDTHS, ACTIVATIONS, RATES = (1, 2, 3), (16, 64, 256), ("tanh", "silu"), (3e-4, 1e-3, 3e-3)
OUTPUTS = ("none", "laplacian")
#: Learning rates of free heights, which bound the change of raw values per step.
FREE_RATES = (1e-3, 1e-2, 1e-1)
#: Without a project: pixels across the screen, and control points.
PIXELS, CONTROL = 48, 35
#: Rays of a retrace per pixel.
RAYS_PER_PIXEL = 64


class Candidate:
    """A `studies.architectures.Candidate`: one design, or several for different parameter values with common columns.

    Args:
        about: constant columns.
        designers: of the lenses evaluated, each over its own ranges or in its own scene.
        first: initial heights of all, None for the offset surface.
        target: (n_x, n_y).
        rays, seed: of the retrace.
    """

    def __init__(
        self,
        about: dict[str, Any],
        designers: list[Designer],
        first: InitialHeights | None,
        target: np.ndarray,
        rays: int,
        seed: int,
    ):
        self.designers, self.target, self.rays, self.seed = designers, target, rays, seed
        self.states = [one.begin(*first or ()) for one in designers]
        held = [state.parameters or {"heights": state.heights} for state in self.states]  # free heights are the parameters
        count = sum(v.numel() for parameters in held for name, v in parameters.items() if name != "start")
        self.about = about | {"parameters": count}

    @property
    def seconds(self) -> float:
        """Seconds of iterations so far, of all designs."""
        return sum(state.seconds for state in self.states)

    @property
    def loss(self) -> float | None:
        """Mean loss of the last iterations, times the pixels."""
        losses = [state.history[-1][2] for state in self.states if state.history]
        return self.target.size * sum(losses) / len(losses) if losses else None

    def reach(self, iterations: int) -> None:
        """Continue to this total number of iterations."""
        self.states = [one.run(state, iterations=iterations) for one, state in zip(self.designers, self.states, strict=True)]

    def judged(self) -> dict[str, float]:
        """Figures error, worst and noise, see `studies.architectures.COLUMNS`."""
        found = []
        for designer, state in zip(self.designers, self.states, strict=True):
            if designer.options.over is not None:
                found += range_evaluation.errors(
                    designer, state, self.target, rays=self.rays, seed=self.seed, device=designer.device, middle=False
                )
                continue
            field, device = designer.field(state.stage), designer.device
            found.append(
                retrace(designer.scene, field, state.heights, self.target, rays=self.rays, seed=self.seed, device=device)[1]
            )
        errors, noises = (np.array([row[key] or 0.0 for row in found]) for key in ("relative_rms", "noise"))
        error = float(np.sqrt(np.mean(errors**2)))
        noise = float(np.sqrt(np.sum((errors * noises) ** 2)) / (error * len(found))) if error > 0 else 0.0
        return {"error": error, "worst": float(errors.max()), "noise": noise}


@dataclass(frozen=True, eq=False)
class NetworkComparison:
    """What all candidates have in common."""

    scene: Scene
    target: np.ndarray
    #: Initial heights, None for the offset surface.
    first: InitialHeights | None
    stage: Stage
    #: Of the project's own design, with the precision and the seed that were asked for; and those that candidates begin from.
    own: Options
    base: Options
    #: Of a retrace.
    rays: int
    device: str

    def candidate(
        self, name: str, options: Options, inputs: str = "", each: list[tuple[Scene, Options]] | None = None
    ) -> Candidate:
        """A candidate: one design with these options, or one in each of several scenes with its own."""
        dense = options.network == "dense"
        shape = options.architecture
        about = {
            "series": f"{name}, {options.preconditioner}, lr {options.lr:g}",
            "network": options.network,
            "inputs": inputs,
            "layers": shape.layers if dense else None,
            "width": (shape.width or math.prod(self.scene.lens.control)) if dense else None,
            "activation": shape.activation if dense else None,
            "preconditioner": options.preconditioner,
            "lr": options.lr,
        }
        goal = torch.from_numpy(self.target)
        designers = [Designer(one, goal, [self.stage], how, self.device) for one, how in each or [(self.scene, options)]]
        return Candidate(about, designers, self.first, self.target, self.rays, self.base.seed)

    def grid(self, outputs: Sequence[str], activations: Sequence[str], inputs: str) -> Iterator[Candidate]:
        """Dense networks of all hyperparameters, with these preconditioners and activations."""
        for output, lr, act, layers, width in itertools.product(outputs, RATES, activations, LAYERS, WIDTHS):
            shape = Architecture(layers, width, act)
            options = replace(self.base, network="dense", initial="zero-last", preconditioner=output, lr=lr, architecture=shape)
            yield self.candidate(f"{layers} x {width} {act}", options, inputs)

    def free_heights(self) -> Iterator[Candidate]:
        """Free heights by Adam."""
        for output, lr in itertools.product(OUTPUTS, FREE_RATES):
            options = replace(self.base, network="none", initial="zero", preconditioner=output, lr=lr, architecture=Architecture())
            yield self.candidate("no network", options)

    def of_range(self, over: Ranges) -> Iterator[Candidate]:
        """The network as designed, the same without inputs, and one network for each value of a range."""
        yield self.candidate("as designed", self.own, "range")
        blind = replace(self.own, inputs=False)
        yield self.candidate("one lens for all", blind, "none")
        alone = [
            (
                over.scene(self.scene, values),
                replace(blind, over=Ranges(tuple(Range(k, v, v) for k, v in zip(over.keys, values, strict=True)))),
            )
            for values in over.evaluation_points()
        ]
        yield self.candidate("each value alone", blind, "alone", alone)


def candidates(
    project: Project | None, device: str, dtype: torch.dtype | None = None, seed: int | None = None, rays: int | None = None
) -> list[Candidate]:
    """The grid for the picture and scene of a project, or without one for a bright disc; and its baselines.

    For a project whose network is trained over a range, all candidates are, from its initial surface and with its activation and
    preconditioner; the baselines are its own network, the same without inputs, a single lens for the whole range, and one network
    for each value.  Otherwise networks start from the offset surface, and the baselines are free heights by Adam.

    Raises:
        InputError: no stage is on rays, or there are two free-form sides.
    """
    compared = _comparison(project, device, dtype, seed, rays)
    own = compared.own
    if own.over is None:
        return [*compared.grid(OUTPUTS, ACTIVATIONS, ""), *compared.free_heights()]
    return [*compared.grid((own.preconditioner,), (own.architecture.activation,), "range"), *compared.of_range(own.over)]


def _comparison(
    project: Project | None, device: str, dtype: torch.dtype | None, seed: int | None, rays: int | None
) -> NetworkComparison:
    """The scene of a project, or without one that of a bright disc, and the last stage on rays."""
    first: InitialHeights | None = None
    if project is None:
        full = complete({"screen": {"resolution": [PIXELS] * 2}, "lens": {"control": [CONTROL] * 2}}, 1.0)
        scene = build_scene(full)
        target = disc(scene, full.target.size)
    else:
        if project.over is not None and project.settings.design.start != "offset":
            project, first = first_heights(project, {"lens": dict(project.settings.lens)})
        full, scene = project.settings, project.scene()
        target = project.target(scene)
    stages = [s for s in build_stages(full) if not s.waves]
    if not stages or scene.second is not None or scene.lens.arrayed:
        raise InputError(
            "⟨networks⟩ are compared on ray images of a lens with one free-form side, which this project does not have"
        )
    stage = replace(stages[-1], blur=0.0, iterations=10**9, tolerance=0.0, source=None, spread=False, control=scene.lens.control)
    own = build_options(full)
    own = replace(own, dtype=dtype or own.dtype, seed=own.seed if seed is None else seed)
    count = rays or RAYS_PER_PIXEL * math.prod(scene.screen.resolution)
    return NetworkComparison(scene, target, first, stage, own, replace(own, optimizer="adam", robust=None), count, device)
