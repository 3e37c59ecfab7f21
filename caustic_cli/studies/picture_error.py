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

import math
from dataclasses import replace
from functools import cached_property
from typing import ClassVar

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
    """Errors of one lens' picture by rays, through its own surface and through others.

    Args:
        plan: of the scene; field, heights: of its exit, (n, m) mm.
        target: (n_x, n_y) or (3, n_x, n_y), None if it is not known; seed: of the rays.
    """

    #: What judges the picture, rays or waves, and whether it is known; otherwise images are compared with that of the lens.
    by: ClassVar[str] = "rays"
    known: ClassVar[bool] = True

    def __init__(self, plan: Plan, field: HeightField, heights: Tensor, target: np.ndarray | None, seed: int = 0):
        self.plan, self.field, self.heights, self.seed = plan, field, heights.detach(), seed
        self.target = target

    @cached_property
    def _own(self) -> tuple[np.ndarray, dict]:
        """Image and figures of the lens itself."""
        return self._retrace(self.plan.scene, self.field, self.heights, noise=True)

    @property
    def own(self) -> float:
        """Relative RMS error of the lens itself; 0 if its picture is not known."""
        return self._own[1]["relative_rms"]

    @property
    def noise(self) -> float | None:
        """Standard error of the figures, which is common to both surfaces; None where there is none."""
        return self._own[1]["noise"]

    @cached_property
    def largest(self) -> float:
        """Largest error of a surface that keeps the picture."""
        noise = min(self._own[1]["error_estimate"] or 0.0, self.own) if self.plan.scene.source.parallel else 0.0
        return float(np.sqrt(noise**2 + MARGIN**2 * (self.own**2 - noise**2)))

    def through(self, surface: HeightField | MeasuredSurface, heights: Tensor | None, entrance: FreeForm | None = None) -> float:
        """Relative RMS error of the picture through another exit, and another free-form entrance."""
        scene = self.plan.scene
        if entrance is None and surface is self.field and heights is not None and torch.equal(heights, self.heights):
            return self.own  # stored exactly
        if entrance is not None:
            scene = replace(scene, lens=replace(scene.lens, entrance=entrance))
        return self._error(scene, surface, heights)

    def _error(self, scene: Scene, surface: HeightField | MeasuredSurface, heights: Tensor | None) -> float:
        return self._retrace(scene, surface, heights)[1]["relative_rms"]

    def _retrace(self, scene: Scene, surface, heights: Tensor | None, noise: bool = False) -> tuple[np.ndarray, dict]:
        each = EACH if scene.source.parallel else EACH_OTHER
        image, figures = retrace(
            scene,
            surface,
            self.heights if heights is None else heights,
            self.target,
            rays=max(LEAST, each * int(np.prod(scene.screen.resolution))),
            seed=self.seed,
            requests=self.plan.requests,
            noise=noise,
        )
        return image.image.cpu().numpy(), figures


class ImageDifference(PictureError):
    """Of a lens whose picture is not known: differences from its own image by rays."""

    known: ClassVar[bool] = False

    @cached_property
    def _own(self) -> tuple[np.ndarray, dict]:
        image, figures = self._retrace(self.plan.scene, self.field, self.heights, noise=True)
        return image, figures | {"relative_rms": 0.0, "noise": None}

    @cached_property
    def largest(self) -> float:
        """Largest difference of a surface that keeps the image."""
        return UNKNOWN

    def _error(self, scene: Scene, surface: HeightField | MeasuredSurface, heights: Tensor | None) -> float:
        return relative_rms(self._retrace(scene, surface, heights)[0], self._own[0])


class PictureErrorByWaves(PictureError):
    """Errors of the wave image, infinite where there is none."""

    by: ClassVar[str] = "waves"

    @cached_property
    def _own(self) -> tuple[np.ndarray, dict]:
        error = self._error(self.plan.scene, self.field, self.heights)
        return np.empty((0, 0)), {"relative_rms": error, "noise": None, "error_estimate": None}

    def _error(self, scene: Scene, surface: HeightField | MeasuredSurface, heights: Tensor | None) -> float:
        perturbation = None
        if isinstance(surface, MeasuredSurface):
            perturbation = height_deviation(surface, self.field, self.heights)
            surface, heights = self.field, self.heights
        try:
            figures = wave_figures(
                scene,
                surface,
                heights,  # type: ignore[arg-type]
                self.target,
                Resolution.at(scene, self.field, self.heights),
                required=False,
                perturbation=perturbation,
            )[1]
        except NoWaveImage:
            return math.inf
        return math.inf if figures["wave_relative_rms"] is None else figures["wave_relative_rms"]


def picture_error(
    plan: Plan, field: HeightField, heights: Tensor, target: np.ndarray | None, waves: bool, seed: int = 0
) -> PictureError:
    """The errors of a picture by waves if they are asked for and the lens has a wave image, otherwise by rays; differences from the
    image of the lens itself if the target is None."""
    lens = plan, field, heights, target, seed
    if target is None:
        return ImageDifference(*lens)
    if waves and math.isfinite((found := PictureErrorByWaves(*lens)).own):
        return found
    return PictureError(*lens)
