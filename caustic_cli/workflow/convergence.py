"""Dispatch of the convergence studies, each for a given lens or a default scene."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch

from caustic_cli.config import checks
from caustic_cli.errors import InputError
from caustic_cli.studies import architectures, diffraction, effects, efficiency, intersection, optimiser_comparison
from caustic_cli.studies.convergence import run_study
from caustic_cli.studies.report import Study
from caustic_cli.workflow import architectures as networks
from caustic_cli.workflow import comparison, tradeoff
from caustic_cli.workflow.compilation import compile_for, compile_usual
from caustic_cli.workflow.design import sphere
from caustic_cli.workflow.lens import Lens
from caustic_cli.workflow.reporter import Reporter

#: Plots of the studies that define their own.
PLOTS = {
    "intersection": intersection.PLOTS,
    "design": optimiser_comparison.PLOTS,
    "networks": architectures.PLOTS,
    "effects": effects.PLOTS,
    "diffraction": diffraction.PLOTS,
    "light": efficiency.PLOTS,
}
#: Studies that support all scenes.
OF_ANY_SCENE = ("rays", "reconstruction", "precision")
#: Unit of the progress of a study.
UNITS = {
    "intersection": "evaluations",
    "effects": "effects",
    "design": "turns",
    "networks": "turns",
    "diffraction": "cases",
    "light": "lenses",
}


@dataclass(frozen=True)
class Request:
    """Parameters of a study; None for its default.

    rays: of the largest setting; repeats: rounds; seconds: for each design; dtype: of the rays.
    """

    rays: int | None = None
    repeats: int | None = None
    seconds: float | None = None
    seed: int | None = None
    dtype: torch.dtype | None = None


def measure(
    name: str, lens: Lens | None, asked: Request, device: str, say: Reporter, progress: Callable[[int, int], None]
) -> Study:
    """Run a study.

    Args:
        lens: None for the default of the study: the initial sphere of a design, the scene of table D.3, or a bright disc.
        progress: called with (done, in total), in UNITS.

    Raises:
        InputError: a value out of range, or a scene with other elements in a study of a single lens.
    """
    if lens and lens.scene.elements and name not in OF_ANY_SCENE:
        raise InputError(
            f"⟨study⟩ {name} supports single lenses only, and this scene has [[element]] tables; studies of such scenes are"
            f" {', '.join(OF_ANY_SCENE)}"
        )
    seed = asked.seed or 0
    compile_usual(device, say)
    if name == "intersection":
        case = (
            intersection.of_lens(lens.scene, lens.field, lens.heights, asked.rays, seed)
            if lens
            else intersection.table_d3(asked.rays, seed)
        )
        return intersection.run_intersection(case, seed=seed, repeats=asked.repeats, progress=progress)
    project = lens.project if lens else None
    if name == "design":
        scene, target, entries = comparison.timed_designs(project, device, asked.dtype, asked.seed)
        return optimiser_comparison.run_comparison(
            scene, target, entries, seconds=asked.seconds, seed=seed, rays=asked.rays, device=device, progress=progress
        )
    if name == "networks":
        compared = networks.candidates(project, device, asked.dtype, asked.seed, asked.rays)
        return architectures.run_architectures(
            compared, seconds=asked.seconds, about={"seed": seed, "device": device}, progress=progress
        )
    if name == "light":
        each = checks.number("⟨seconds⟩", efficiency.SECONDS if asked.seconds is None else asked.seconds, 0.0, 1e6, open_low=True)
        count, lenses = tradeoff.lenses(project, each, device)
        return efficiency.run_efficiency(lenses, count, rays=asked.rays, seed=seed, device=device, progress=progress)
    other = comparison.lens_of_disc if name == "diffraction" else sphere
    scene, field, heights = (lens.scene, lens.field, lens.heights) if lens else other()
    heights = heights.to(device)
    if name == "diffraction":
        return diffraction.run_diffraction(scene, field, heights, rays=asked.rays, seed=seed, dtype=asked.dtype, progress=progress)
    if name == "effects":
        compile_for(None, device, say)
        return effects.run_effects(
            scene, field, heights, rays=asked.rays, repeats=asked.repeats, seed=seed, dtype=asked.dtype, progress=progress
        )
    return run_study(
        name,
        scene,
        field,
        heights,
        seed=seed,
        max_rays=asked.rays,
        repeats=3 if asked.repeats is None else asked.repeats,
        dtype=asked.dtype,
        progress=progress,
    )
