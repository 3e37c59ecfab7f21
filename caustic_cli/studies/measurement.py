"""Benchmark of image settings: error against a common reference, and computation time.

Notation
    setting     a way to make the image: rays, filter, precision
    reference   the mean of two independent float64 images with many times more rays than any setting
    error       relative RMS between two images, each over its own mean (metrics.relative_rms)

The two halves A and B of a reference are independent, so (A + B) / 2 has an error of about |A - B| / 2; its rays are independent
of those of a setting, so its error adds to that of the setting in quadrature and is subtracted again.  They are `stratified`:
unbiased, with an error of order 3/4.

Settings are measured alternately in rounds, so that a temporary slowdown of the machine affects all of them.
"""

from __future__ import annotations

import math
import statistics
import time
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, field
from functools import partial
from typing import TypeVar

import torch
from torch import Tensor

from caustic_cli.errors import CausticError
from caustic_cli.optics import ranks
from caustic_cli.optics.emission import Rays, rays_of
from caustic_cli.optics.reconstruction import Filter
from caustic_cli.optics.surfaces.heightfield import HeightField
from caustic_cli.optics.trace import expose
from caustic_cli.scene import Scene
from caustic_cli.studies.metrics import relative_rms

R = TypeVar("R")

#: Rays of a reference over those of the largest setting: an error of order 3/4 falls to an eighth, so the correction in quadrature
#: is about one per cent.
REFERENCE_FACTOR = 16
#: Offset of the seed of a reference to that of its study, beyond any number of repeats.
REFERENCE_SEED = 1_000_003
#: Ratio of the longest to the shortest time of a setting beyond which the machine counts as busy; a few tenths above 1 are usual.
BUSY = 2.0


@dataclass(frozen=True)
class Setting:
    """Settings of an image; `series` names the curve it belongs to, `rays` is rounded to whole cells."""

    series: str
    sampler: str
    rays: int
    filter: Filter
    dtype: torch.dtype


@dataclass(frozen=True)
class Reference:
    """Image (n_x, n_y), its number of rays, and the estimate of its error (relative RMS)."""

    image: Tensor
    rays: int
    error: float

    def error_of(self, image: Tensor) -> float:
        """Relative RMS error of `image` (n_x, n_y), corrected for the error of the reference.

        sqrt(d^2 - error^2) with the distance d to the reference; 0 where d < error.
        """
        return math.sqrt(max(0.0, relative_rms(image, self.image) ** 2 - self.error**2))


#: (setting, its image, the image of the setting before it in the same round or None) -> figures by column name
Figures = Callable[[Setting, Tensor, Tensor | None], dict[str, float | None]]


@dataclass
class Benchmark:
    """Measurement of settings for one lens.

    Args:
        scene, heightfield, heights: the lens; (n, m) mm float64, on the device to work on.
        seed: of the rays of the first round; each round takes the next one.
        repeats: rounds.
        max_rays: rays of the largest setting.
        progress: called with (rays traced, rays in total) after every image of this process, or None.
    """

    scene: Scene
    heightfield: HeightField
    heights: Tensor
    seed: int
    repeats: int
    max_rays: int
    progress: Callable[[int, int], None] | None = None
    done: int = field(default=0, init=False)
    total: int = field(default=0, init=False)

    def plan(self, settings: Sequence[Setting], filtered: int = 0) -> None:
        """Set the total for the progress: the settings, a bincount reference, and `filtered` other references."""
        references = (1 + filtered) * REFERENCE_FACTOR * self.max_rays
        self.total = references + self.repeats * sum(s.rays for s in settings)

    def sampler(self, setting: Setting, seed: int) -> Rays:
        """About as many rays as a setting asks for."""
        return rays_of(self.scene, setting.sampler, setting.rays, seed, self.heights.device)

    def image(self, setting: Setting, seed: int) -> Tensor:
        """The image of a setting with the rays of `seed`: (n_x, n_y) float64, summed over colours."""
        return expose(self.scene, self.heightfield, self.heights, self.sampler(setting, seed), setting.filter, setting.dtype).total

    def reference(self, filter: Filter) -> Reference:
        """The reference image, reconstructed with `filter`.

        Raises:
            CausticError: no light reaches the screen.
        """
        half = Setting("reference", "stratified", REFERENCE_FACTOR * self.max_rays // 2, filter, torch.float64)
        seeds = [self.seed + REFERENCE_SEED + k for k in (0, 1)]
        images = self._mapped(partial(_image, self, half), seeds, half.rays)
        if not all(float(image.sum()) > 0 for image in images):
            raise CausticError(
                "no light reaches the screen, so there is no image to study: every ray is reflected"
                " inside the lens or misses the screen; check index, throw, mag and screen size"
            )
        return Reference(sum(images) / 2.0, 2 * self.sampler(half, 0).count, relative_rms(*images) / 2.0)

    def measure(
        self, settings: Sequence[Setting], figures: Figures, within: Callable[[], AbstractContextManager] = nullcontext
    ) -> list[dict]:
        """Measure all settings in rounds, each with the same fresh rays for all: one row per setting.

        A row holds series, sampler, rays, the figures (root mean square over the rounds; None stays None), and seconds,
        seconds_min, seconds_max (median and extremes).  Before a round comes an untimed run of the smallest setting (warm-up).
        Several processes (`ranks`) share the rounds.

        Args:
            within: a context for the images.
        """
        found: list[list[dict]] = [[] for _ in settings]
        times: list[list[float]] = [[] for _ in settings]
        seeds = range(self.seed, self.seed + self.repeats)
        for images in self._mapped(partial(_round, self, settings, within), seeds, sum(s.rays for s in settings)):
            before = None
            for i, (setting, (image, seconds)) in enumerate(zip(settings, images, strict=True)):
                times[i].append(seconds)
                found[i].append(figures(setting, image, before))
                before = image
        rows = []
        for setting, values, seconds in zip(settings, found, times, strict=True):
            row = {"series": setting.series, "sampler": setting.sampler, "rays": self.sampler(setting, 0).count}
            for name in values[0]:
                column = [v[name] for v in values]
                row[name] = None if None in column else math.sqrt(statistics.fmean(c * c for c in column))
            row |= {"seconds": statistics.median(seconds), "seconds_min": min(seconds), "seconds_max": max(seconds)}
            rows.append(row)
        return rows

    def _mapped(self, function: Callable[[int], R], seeds: Sequence[int], rays: int) -> list[R]:
        """`ranks.mapped` over seeds, for each of which so many rays are traced."""
        whole = self.done + len(seeds) * rays
        found = ranks.mapped(function, seeds)
        self.tick(whole - self.done)  # what other processes traced
        return found

    def tick(self, rays: int) -> None:
        """Tell that so many rays were traced."""
        self.done += rays
        if self.progress is not None and rays:
            self.progress(self.done, self.total)

    def __getstate__(self) -> dict:
        return vars(self) | {"progress": None}  # for other processes, which tell nothing


def _image(bench: Benchmark, setting: Setting, seed: int) -> Tensor:
    image = bench.image(setting, seed)
    bench.tick(setting.rays)
    return image


def _round(
    bench: Benchmark, settings: Sequence[Setting], within: Callable[[], AbstractContextManager], seed: int
) -> list[tuple[Tensor, float]]:
    """Image and time, s, of each setting with the rays of a seed."""
    found = []
    with within():
        bench.image(min(settings, key=lambda s: s.rays), bench.seed)
        for setting in settings:
            start = time.perf_counter()
            image = bench.image(setting, seed)
            found.append((image, time.perf_counter() - start))
            bench.tick(setting.rays)
    return found


def busy_warning(rows: Sequence[dict]) -> str:
    """A warning, or "", where the spread of the times in `seconds_min` and `seconds_max` shows that the machine was busy."""
    spread = statistics.median(row["seconds_max"] / row["seconds_min"] for row in rows)
    return f" (half of the times varied more than {spread:.1f}-fold: the machine was busy)" if spread > BUSY else ""
