"""Tolerance analysis of a lens: figures, CSV of all draws and plot."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from torch import Tensor

from caustic_cli.config.tolerances import read
from caustic_cli.optics.resolution import Resolution
from caustic_cli.optics.surfaces.heightfield import HeightField
from caustic_cli.optics.waves.image import wave_image
from caustic_cli.scene import Scene
from caustic_cli.scene.tolerances import Tolerances
from caustic_cli.scene.traits import Capability
from caustic_cli.studies import tolerances as study
from caustic_cli.studies.irradiance import source_figures
from caustic_cli.studies.tolerances_by_waves import WaveTrials
from caustic_cli.workflow.lens import Lens
from caustic_cli.workflow.outputs.base import Output, Rendering


@dataclass(eq=False)
class ToleranceAnalysis(Output):
    """Analysis of the errors of the TOML file `tolerances`: figures, and all draws as a table and as a plot beside the image.

    A lens that was refined on its wave image is evaluated by that, others by the ray image.
    """

    option: ClassVar[str] = "tolerances"
    capability: ClassVar[Capability] = Capability("tolerance analysis", {})
    files: ClassVar[tuple[str, ...]] = ("tolerances.csv", "tolerances.png")
    beyond: ClassVar[bool] = True

    tolerances: Path

    @cached_property
    def errors(self) -> Tolerances:
        """Distributions of the errors."""
        return read(self.tolerances)

    @property
    def asks(self) -> dict[str, object]:
        return {"tolerances": self.errors}

    def unsupported(self, lens: Lens) -> str:
        if lens.target is None:
            return "⟨tolerances⟩ compares with the picture, which an archive does not hold; render its project"
        return super().unsupported(lens)

    def write(self, rendering: Rendering) -> dict[str, Any]:
        """tolerances: the figures of `studies.tolerances`, with the paths of both files.

        Raises:
            InputError: an error makes the scene invalid.
        """
        lens, plan, say = rendering.lens, rendering.plan, rendering.say
        assert lens.target is not None
        sheet, plot = self.paths(rendering.place)
        refined = lens.figures.get("wave_relative_rms") is not None and plan["diffraction"].on
        scene = plan.scene.unfolded
        seen = Resolution.at(scene, lens.field, lens.heights)
        args, requests = (scene, lens.field, lens.heights, lens.target, self.errors), plan.requests
        with study.one_thread(), say.progress(None) as show:
            near = seen.diffraction / max(scene.screen.pixel) / 2.0
            trials = (
                WaveTrials(*args, requests=requests, waves=_waves, near=near) if refined else study.Trials(*args, requests=requests)
            )
            found = study.study(trials, lambda what, done, whole: show("tolerances", what, done, whole))
        figures = study.figures(found)
        figures["nominal"] |= source_figures(scene, figures["nominal"]["on_target"])
        study.write_csv(sheet, found)
        study.write_plot(plot, found)
        for name, why in found.unused.items():
            say.say(f"[{name}] of the tolerances is left out: {why}")
        return {"tolerances": figures | {"csv": str(sheet), "plot": str(plot)}}

    def show(self, figures: dict[str, Any], say: Any) -> None:
        say.table("tolerances", study.rows(figures["tolerances"]))


def _waves(scene: Scene, field: HeightField, heights: Tensor) -> np.ndarray:
    """The wave image, (n_x, n_y) or (3, n_x, n_y)."""
    return wave_image(scene, field, heights).image.cpu().numpy()
