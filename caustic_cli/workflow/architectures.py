"""Candidates for the comparison of network architectures (`studies.architectures`)."""

from __future__ import annotations

import itertools
import math
from dataclasses import replace
from typing import Any

import numpy as np
import torch

from caustic_cli.errors import InputError
from caustic_cli.inverse.designer import Designer, InitialHeights
from caustic_cli.inverse.parametrisation import Architecture, Parametrisation
from caustic_cli.inverse.problem import Options
from caustic_cli.kinds import OneSurface, problem_of
from caustic_cli.project.project import Project
from caustic_cli.workflow.comparison import project_of_disc
from caustic_cli.workflow.preparation import first_heights

BY_RAYS = "⟨networks⟩ are compared on ray images, and no stage of this project is on rays"
#: Grid of hyperparameters: hidden layers, neurons in each, activations, learning rates, and preconditioners of the output.
LAYERS, WIDTHS, ACTIVATIONS, RATES = (1, 2, 3), (16, 64, 256), ("tanh", "silu"), (3e-4, 1e-3, 3e-3)
OUTPUTS = ("none", "laplacian")
#: Learning rates of free heights, which bound the change of raw values per step.
FREE_RATES = (1e-3, 1e-2, 1e-1)
#: Without a project: pixels across the screen, and control points.
PIXELS, CONTROL = 48, 35
#: Rays of a retrace per pixel.
RAYS_PER_PIXEL = 64


class NetworkDesign:
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
        self.states = [one.initial_state(*first or ()) for one in designers]
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
        found: list[dict] = []
        for one, state in zip(self.designers, self.states, strict=True):
            found += one.problem.errors(one, state, self.rays, self.seed, middle=False)
        errors, noises = (np.array([row[key] or 0.0 for row in found]) for key in ("relative_rms", "noise"))
        error = float(np.sqrt(np.mean(errors**2)))
        noise = float(np.sqrt(np.sum((errors * noises) ** 2)) / (error * len(found))) if error > 0 else 0.0
        return {"error": error, "worst": float(errors.max()), "noise": noise}


def candidates(
    project: Project | None, device: str, dtype: torch.dtype | None = None, seed: int | None = None, rays: int | None = None
) -> list[NetworkDesign]:
    """The grid for the picture and scene of a project, or without one for a bright disc; and its baselines.

    For a project whose network is trained over a range, all candidates are, from its initial surface and with its activation and
    preconditioner; the baselines are its own network, the same without inputs, a single lens for the whole range, and one network
    for each value.  Otherwise networks start from the offset surface, and the baselines are free heights by Adam.

    Raises:
        InputError: no stage is on rays.
    """
    study = _Study(project, device, dtype, seed, rays)
    own, over = study.own, study.over
    base, before, found = replace(own, optimizer="adam"), own.parametrisation, []
    outputs, activations = (OUTPUTS, ACTIVATIONS) if over is None else ((before.preconditioner,), (before.architecture.activation,))
    for output, lr, act, layers, width in itertools.product(outputs, RATES, activations, LAYERS, WIDTHS):
        network = Parametrisation("dense", "zero-last", output, Architecture(layers, width, act))
        options = replace(base, parametrisation=network, lr=lr)
        found.append(study.design(f"{layers} x {width} {act}", options, "" if over is None else "range"))
    if over is None:
        for output, lr in itertools.product(OUTPUTS, FREE_RATES):
            free = replace(base, parametrisation=Parametrisation(preconditioner=output), lr=lr)
            found.append(study.design("no network", free))
        return found
    blind = study.problem.blind
    found.append(study.design("as designed", own, "range"))
    found.append(study.design("one lens for all", own, "none", [blind()]))
    found.append(study.design("each value alone", own, "alone", [blind(values) for values in over.evaluation_points()]))
    return found


class _Study:
    """The problem of a project, or of a bright disc without one, and designs of it on the rays of its last stage alone."""

    def __init__(self, project: Project | None, device: str, dtype: torch.dtype | None, seed: int | None, rays: int | None):
        project = project or project_of_disc(PIXELS, CONTROL)
        chosen = project.settings.design.without("robust")
        project = replace(project, settings=project.settings.changed(design=chosen))
        self.over = project.over
        self.problem, self.first = problem_of(project, device), None
        if self.over is not None and chosen.start != "offset":
            prepared = first_heights(project, {"lens": dict(project.settings.lens)}, self.problem)
            self.problem, self.first = prepared.problem, prepared.first
        scene, stages, own = self.problem.scene, [s for s in self.problem.stages if not s.waves], self.problem.options
        if not stages:
            raise InputError(BY_RAYS)
        last, control = stages[-1], scene.lens.control
        how = replace(last.rendering, blur=0.0)
        self.stage = replace(last, rendering=how, iterations=10**9, tolerance=0.0, source=None, spread=False, control=control)
        self.own = replace(own, dtype=dtype or own.dtype, seed=own.seed if seed is None else seed)
        self.count = rays or RAYS_PER_PIXEL * math.prod(scene.screen.resolution)

    def design(self, name: str, options: Options, inputs: str = "", each: list[OneSurface] | None = None) -> NetworkDesign:
        """A design with these options, or one of each problem."""
        how = options.parametrisation
        dense, shape = how.network == "dense", how.architecture
        about = {
            "series": f"{name}, {how.preconditioner}, lr {options.lr:g}",
            "network": how.network,
            "inputs": inputs,
            "layers": shape.layers if dense else None,
            "width": (shape.width or math.prod(self.stage.control)) if dense else None,
            "activation": shape.activation if dense else None,
            "preconditioner": how.preconditioner,
            "lr": options.lr,
        }
        designers = [Designer(one.varied([self.stage], options)) for one in each or [self.problem]]
        return NetworkDesign(about, designers, self.first, self.problem.target.numpy(), self.count, options.seed)
