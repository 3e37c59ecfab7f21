"""Tolerance analysis of a lens: figures, CSV of all draws and plot."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from torch import Tensor

from caustic_cli.optics.plan import Plan
from caustic_cli.optics.resolution import Resolution
from caustic_cli.optics.surfaces.heightfield import HeightField
from caustic_cli.optics.waves.image import wave_image
from caustic_cli.scene import Scene
from caustic_cli.scene.tolerances import Tolerances
from caustic_cli.studies import tolerances as study
from caustic_cli.studies.irradiance import source_figures
from caustic_cli.workflow.lens import Lens
from caustic_cli.workflow.reporter import Reporter


def tolerances(lens: Lens, plan: Plan, asked: Tolerances, sheet: Path, plot: Path, say: Reporter) -> dict:
    """Analyse a lens under errors; write all draws to `sheet`, CSV, and `plot`, PNG.

    A lens that was refined on its wave image is evaluated by that, others by the ray image.

    Returns:
        the figures for JSON, with the paths of both files.

    Raises:
        InputError: an error makes the scene invalid.
    """
    assert lens.target is not None
    refined = lens.figures.get("wave_relative_rms") is not None and plan["diffraction"].on
    seen = Resolution.at(plan.scene, lens.field, lens.heights)
    with study.one_thread(), say.progress(None) as show:
        trials = study.Trials(
            plan.scene,
            lens.field,
            lens.heights,
            lens.target,
            asked,
            requests=plan.requests,
            waves=_waves if refined else None,
            near=seen.diffraction / max(plan.scene.screen.pixel) / 2.0,
        )
        found = study.study(trials, lambda what, done, whole: show("tolerances", what, done, whole))
    figures = study.figures(found)
    figures["nominal"] |= source_figures(plan.scene, figures["nominal"]["on_target"])
    study.write_csv(sheet, found)
    study.write_plot(plot, found)
    for name, why in found.unused.items():
        say.say(f"[{name}] of the tolerances is left out: {why}")
    return figures | {"csv": str(sheet), "plot": str(plot)}


def _waves(scene: Scene, field: HeightField, heights: Tensor) -> np.ndarray:
    """The wave image, (n_x, n_y) or (3, n_x, n_y)."""
    return wave_image(scene, field, heights).image.cpu().numpy()
