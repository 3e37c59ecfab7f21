"""The error of the picture through another surface: as a file describes it, in place of the lens' own.

Both are traced with the same independent rays, or propagated at the same wavelengths, so that their difference is due to the
surfaces alone.

Notation
    E, E'   relative RMS error of the picture by the lens itself, and through the other surface
    s       relative RMS noise of the image from stratified rays, which both errors contain; 0 for figures corrected for noise

The other surface keeps the picture if E' without its noise is at most `MARGIN` times E without its noise:
E'^2 - s^2 <= MARGIN^2 (E^2 - s^2).
"""

from __future__ import annotations

from dataclasses import replace
from functools import cached_property

import numpy as np
import torch
from torch import Tensor

from caustic_cli.optics.plan import Plan
from caustic_cli.optics.resolution import Resolution
from caustic_cli.optics.surfaces.base import MeasuredSurface
from caustic_cli.optics.surfaces.heightfield import HeightField
from caustic_cli.optics.waves.unsupported import NoWaveImage
from caustic_cli.scene import FreeForm, Scene
from caustic_cli.studies.metrics import relative_rms
from caustic_cli.studies.retrace import retrace
from caustic_cli.studies.waves import height_deviation, wave_figures

#: Largest error relative to the lens' own.
MARGIN = 1.05
#: Largest difference of the images, relative RMS, for a lens whose picture is not known.
UNKNOWN = 0.01
#: Rays for each pixel, of a plane wave and of other light, and at least.
EACH, EACH_OTHER, LEAST = 256, 64, 250_000


class PictureError:
    """Errors of one lens' picture, through its own surface and through others.

    Args:
        plan: of the scene; field, heights: of its exit, (n, m) mm.
        target: (n_x, n_y) or (3, n_x, n_y); None for the image of the lens itself.
        waves: judge by the wave image.
        seed: of the rays.
    """

    def __init__(self, plan: Plan, field: HeightField, heights: Tensor, target: np.ndarray | None, waves: bool, seed: int = 0):
        self.plan, self.field, self.heights, self.seed = plan, field, heights.detach(), seed
        self.known, self._target, self._waves = target is not None, target, waves and target is not None

    @property
    def by(self) -> str:
        """What judges the picture: waves or rays."""
        return "waves" if self._waves and self._own_by_waves is not None else "rays"

    @cached_property
    def _own_by_waves(self) -> float | None:
        return self._by_waves(self.plan.scene, self.field, self.heights)

    @cached_property
    def _own_by_rays(self) -> tuple[np.ndarray, dict]:
        image, figures = self._by_rays(self.plan.scene, self.field, self.heights, noise=True)
        return image, figures if self.known else figures | {"relative_rms": 0.0, "noise": None}

    @property
    def own(self) -> float:
        """Relative RMS error of the lens itself; 0 if its picture is not known."""
        return self._own_by_waves if self.by == "waves" else self._own_by_rays[1]["relative_rms"]

    @property
    def noise(self) -> float | None:
        """Standard error of the figures by rays, which is common to both surfaces; None by waves."""
        return None if self.by == "waves" else self._own_by_rays[1]["noise"]

    @cached_property
    def largest(self) -> float:
        """Largest error of a surface that keeps the picture."""
        if not self.known:
            return self.own + UNKNOWN
        noise = 0.0
        if self.by == "rays" and self.plan.scene.source.collimated:
            noise = min(self._own_by_rays[1]["error_estimate"] or 0.0, self.own)
        return float(np.sqrt(noise**2 + MARGIN**2 * (self.own**2 - noise**2)))

    def through(self, surface: HeightField | MeasuredSurface, heights: Tensor | None, entrance: FreeForm | None = None) -> float:
        """Relative RMS error of the picture through another exit, and another free-form entrance."""
        scene = self.plan.scene
        if entrance is None and surface is self.field and heights is not None and torch.equal(heights, self.heights):
            return self.own  # stored exactly
        if entrance is not None:
            scene = replace(scene, lens=replace(scene.lens, entrance=entrance))
        if self.by == "waves":
            found = self._by_waves(scene, surface, heights)
            return np.inf if found is None else found
        if self.known:
            return self._by_rays(scene, surface, heights)[1]["relative_rms"]
        return relative_rms(self._by_rays(scene, surface, heights)[0], self._own_by_rays[0])

    def _by_rays(self, scene: Scene, surface, heights: Tensor | None, noise: bool = False) -> tuple[np.ndarray, dict]:
        each = EACH if scene.source.collimated else EACH_OTHER
        image, figures = retrace(
            scene,
            surface,
            self.heights if heights is None else heights,
            self._target,
            rays=max(LEAST, each * int(np.prod(scene.screen.resolution))),
            seed=self.seed,
            requests=self.plan.requests,
            noise=noise,
        )
        return image.image.cpu().numpy(), figures

    def _by_waves(self, scene: Scene, surface, heights: Tensor | None) -> float | None:
        """Error of the wave image, None if there is none."""
        perturbation = None
        if isinstance(surface, MeasuredSurface):
            perturbation = height_deviation(surface, self.field, self.heights)
            surface, heights = self.field, self.heights
        try:
            figures = wave_figures(
                scene,
                surface,
                heights,  # type: ignore[arg-type]
                self._target,
                Resolution.at(scene, self.field, self.heights),
                required=False,
                perturbation=perturbation,
            )[1]
        except NoWaveImage:
            return None
        return figures["wave_relative_rms"]
