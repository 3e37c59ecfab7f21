"""Tolerance analysis of a lens that was refined on its wave image: the image is warped by the displacement of the rays.

Light at q moves to q + u(q), with u the mean displacement of the rays that land near q.  Surface errors change the interference,
so each of a few realisations of them has its own wave image, which is warped by the other errors.  These change the phase only
slightly over the width of a detail; the error of this approximation is measured for the draw at the 95th percentile with its own
wave image, as far as index, thickness, throw and source are concerned.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any, ClassVar

import numpy as np
import torch
from scipy.ndimage import distance_transform_edt, gaussian_filter, map_coordinates, spline_filter
from torch import Tensor

from caustic_cli.optics.misalignment import LandingPoints, Misalignment
from caustic_cli.optics.surfaces import HeightField
from caustic_cli.scene import Scene
from caustic_cli.studies.tolerances import TrialFigures, Trials, Values

#: Realisations of the surface errors with a wave image, which the draws use cyclically.
REALISED = 8
#: Errors that can be included in the computation of a wave image.
WAVED = ("index", "thickness", "throw", "source_shift", "source_distance", "source_size", "wavelength")
#: Fixed-point iterations of the inverse displacement.
BACK = 4
#: Least width, pixels, of the average of displacements.
NEAR = 1.5
#: Least irradiance over its mean for which a displacement is estimated.
LIT = 1e-3


class WaveTrials(Trials):
    """Evaluation of a lens under given errors, by wave images.

    Args:
        lens: arguments of `Trials`.
        waves: function that returns the wave image of heights in a scene, of the target's shape.
        near: pixels over which displacements are averaged.
        how: further arguments of `Trials`.
    """

    by: ClassVar[str] = "waves"
    divisor: ClassVar[int] = 5  # fewer rays suffice for displacements, which are smooth

    def __init__(self, *lens: Any, waves: Callable[[Scene, HeightField, Tensor], np.ndarray], near: float = NEAR, **how: Any):
        super().__init__(*lens, **how)
        self.waves, self.near = waves, max(near, NEAR)
        self.smooth: dict[tuple[int, tuple[str, ...]], list[np.ndarray]] = {}
        self.begin = self._rays(Misalignment(), self.heights, 0)

    def nominal(self) -> TrialFigures:
        """Figures without errors."""
        return self.evaluate({})

    def noise(self, one: np.ndarray, other: np.ndarray, target: np.ndarray, error: float) -> float:
        """None, of a wave image."""
        return 0.0

    def _pair(self, errors: Misalignment, number: int | None, which: tuple[str, ...]) -> list[np.ndarray]:
        """Twice the same image."""
        light = self._wave_image(0, ()) if number is None else self._wave_image(number % REALISED, which)
        return [self._moved(self._rays(errors, self.heights, 0), light)] * 2

    def check(self, values: Values, number: int) -> tuple[float, float]:
        """Relative RMS of a draw, with only the errors WAVED, by the warped and by its own wave image."""
        quick, own = self.by_waves(values, number)
        return quick.relative_rms, own.relative_rms

    def by_waves(self, values: Values, number: int | None) -> tuple[TrialFigures, TrialFigures]:
        """Figures under the errors of `values` that are of index, thickness, throw and source (WAVED).

        By the warped nominal wave image, and by the wave image with these errors.
        """
        kept = {key: v for key, v in values.items() if key[0] in WAVED}
        errors, which = Misalignment.of(kept), self.tolerances.surface if number is not None else ()
        shaped, heights = self.shaped(None if number is None else number % REALISED, which)
        scene = errors.scene(shaped)
        screen, (x, y, z) = scene.screen, errors.away(scene)
        scene = replace(scene, screen=replace(screen, z=screen.z + z, shift=(screen.shift[0] + x, screen.shift[1] + y)))
        own = self._coloured(self.waves(scene, self.field, heights + errors.thickness))
        return self.evaluate(kept, number), self.figures_of(own, own)

    def _coloured(self, image: np.ndarray) -> np.ndarray:
        return image if image.ndim == 3 else image[None]

    def _wave_image(self, number: int, which: tuple[str, ...]) -> list[np.ndarray]:
        """Cubic spline coefficients of the wave image of a realisation of the surface errors, per colour."""
        if (number, which) not in self.smooth:
            scene, heights = self.shaped(number, which)
            found = self._coloured(self.waves(scene, self.field, heights))
            self.smooth[number, which] = [spline_filter(c, order=3) for c in found]
        return self.smooth[number, which]

    def _moved(self, now: list[LandingPoints], smooth: list[np.ndarray]) -> np.ndarray:
        """A wave image, given by splines, warped by the displacement of the rays, and brighter or darker as they are."""
        shape, (wx, wy), (rx, ry) = self.target.shape[1:], self.scene.screen.pixel, self.scene.screen.half_size
        out = np.zeros(self.target.shape)
        grid = np.meshgrid(*(np.arange(n, dtype=float) for n in shape), indexing="ij")
        for channel in range(len(out)):
            pairs = [(a, b) for a, b in zip(self.begin, now, strict=True) if (a.channel or 0) == channel]
            if not pairs:
                continue
            sums = np.zeros((5, *shape))
            for a, b in pairs:
                weight = torch.where(b.power > 0, a.power, 0.0)
                i, j = ((a.x + rx) / wx).floor().long(), ((a.y + ry) / wy).floor().long()
                inside = (i >= 0) & (i < shape[0]) & (j >= 0) & (j < shape[1]) & (a.power > 0)
                cell, w = (i * shape[1] + j)[inside], weight[inside]
                # rays that miss the screen now have a place of their own, which may be anywhere: they have no displacement
                aside = [torch.where(w > 0, w * ((q - p) / width)[inside], 0.0) for p, q, width in ((a.x, b.x, wx), (a.y, b.y, wy))]
                for k, value in enumerate((w, *aside, a.power[inside], b.power[inside])):
                    sums[k] += torch.bincount(cell, value, minlength=shape[0] * shape[1]).numpy().reshape(shape)
            ux, uy = smoothed_ratios(sums[0], sums[1:3], self.near)
            (gain,) = smoothed_ratios(sums[3], sums[4:], self.near, 1.0)
            qx, qy = grid
            for _ in range(BACK):  # q + u(q) = p
                at = [qx, qy]
                qx, qy = (p - map_coordinates(u, at, order=1, mode="nearest") for p, u in zip(grid, (ux, uy), strict=True))
            (xx, xy), (yx, yy) = np.gradient(qx), np.gradient(qy)
            found = map_coordinates(smooth[channel], [qx, qy], order=3, mode="constant", prefilter=False)
            gain = map_coordinates(gain, [qx, qy], order=1, mode="nearest")
            out[channel] = gain * np.maximum(found, 0.0) * np.abs(xx * yy - xy * yx)
        return out


def smoothed_ratios(power: np.ndarray, sums: np.ndarray, near: float, without: float = 0.0) -> np.ndarray:
    """Means (k, n_x, n_y) on every pixel of quantities of its rays, from the sums of their power (n_x, n_y) and of power times
    quantity (k, n_x, n_y).

    Gaussian average over `near` pixels; where there is too little light, the value of the nearest pixel with enough, or `without`
    where there is none.
    """
    weight = gaussian_filter(power, near, mode="constant")
    enough = weight > LIT * power.mean()
    if not enough.any():
        return np.full_like(sums, without)
    at = tuple(distance_transform_edt(~enough, return_distances=False, return_indices=True))
    return np.stack([gaussian_filter(s, near, mode="constant")[at] / weight[at] for s in sums])
