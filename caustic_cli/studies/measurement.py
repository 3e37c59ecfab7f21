"""Error and time of many settings, measured against one reference in one run.

Notation
    setting     a way to make the image: rays, filter, precision
    reference   the mean of two float64 images of their own rays, many times more than any setting's
    error       relative RMS between two images, each over its own mean (metrics.relative_rms)

The two halves A and B of a reference are independent, so (A + B) / 2 is wrong by about |A - B| / 2; and its rays are
others than a setting's, so its error adds to the setting's in quadrature and is taken off again.  They are `stratified`:
unbiased, with an error of order 3/4.

Settings take turns, round after round, so that a machine that slows down for a while slows all of them.
"""

from __future__ import annotations

import math
import statistics
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import torch
from torch import Tensor

from caustic_cli.errors import CausticError
from caustic_cli.optics.emission import Rays, rays_of
from caustic_cli.optics.reconstruction import Filter
from caustic_cli.optics.surfaces.heightfield import HeightField
from caustic_cli.optics.trace import expose
from caustic_cli.scene import Scene
from caustic_cli.studies.metrics import relative_rms

#: Rays of a reference over those of the largest setting: an error of order 3/4 falls to an eighth, so what is taken off in
#: quadrature is a few per cent.
REFERENCE_FACTOR = 16
#: Distance from a study's seed to its reference's: no number of repeats reaches it.
REFERENCE_SEED = 1_000_003
#: Repeats of one setting on an idle machine differ by a few tenths; by more than this, something else was running.
BUSY = 2.0


@dataclass(frozen=True)
class Setting:
    """A way to make the image; `series` names the curve it belongs to, `rays` is rounded to whole cells."""

    series: str
    sampler: str
    rays: int
    filter: Filter
    dtype: torch.dtype


@dataclass(frozen=True)
class Reference:
    """Image (n_x, n_y), how many rays made it, and the estimate of its own error (relative RMS)."""

    image: Tensor
    rays: int
    error: float

    def error_of(self, image: Tensor) -> float:
        """Relative RMS of `image` (n_x, n_y) against the truth: against this image, less this image's own error.

        sqrt(d^2 - error^2); 0 for an image that is closer to the reference than the truth is.
        """
        return math.sqrt(max(0.0, relative_rms(image, self.image) ** 2 - self.error**2))


#: (setting, its image, the image of the setting before it in the same round or None) -> figures by column name
Figures = Callable[[Setting, Tensor, Tensor | None], dict[str, float | None]]


@dataclass
class Bench:
    """A lens to be measured.

    Args:
        scene, heightfield, heights: the lens; (n, m) mm float64, on the device to work on.
        seed: of the rays of the first round; each round takes the next one.
        repeats: rounds.
        max_rays: rays of the largest setting.
        progress: told (rays traced, rays in all) after every image, or None.
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
        """Announce all the work: the settings, a bincount reference, and so many others."""
        references = (1 + filtered) * REFERENCE_FACTOR * self.max_rays
        self.total = references + self.repeats * sum(s.rays for s in settings)

    def sampler(self, setting: Setting, seed: int) -> Rays:
        """The rays of a setting: about as many as it asks for."""
        return rays_of(self.scene, setting.sampler, setting.rays, seed, self.heights.device)

    def image(self, setting: Setting, seed: int) -> Tensor:
        """The image that a setting makes with the rays of `seed`: (n_x, n_y) float64, colours added up."""
        found = expose(self.scene, self.heightfield, self.heights, self.sampler(setting, seed), setting.filter, setting.dtype).image
        return found.sum(0) if self.scene.colored else found

    def reference(self, filter: Filter) -> Reference:
        """The image to compare with, through `filter`.

        Raises:
            CausticError: no light reaches the screen.
        """
        half = Setting("reference", "stratified", REFERENCE_FACTOR * self.max_rays // 2, filter, torch.float64)
        images = []
        for k in (0, 1):
            images.append(self.image(half, self.seed + REFERENCE_SEED + k))
            self._tick(half.rays)
        if not all(float(image.sum()) > 0 for image in images):
            raise CausticError(
                "no light reaches the screen, so there is no image to study: every ray is reflected"
                " inside the lens or misses the screen; check index, throw, mag and screen size"
            )
        return Reference(sum(images) / 2.0, 2 * self.sampler(half, 0).count, relative_rms(*images) / 2.0)

    def measure(self, settings: Sequence[Setting], figures: Figures) -> list[dict]:
        """Run every setting in turn, each round with the same fresh rays for all: one row a setting.

        A row holds series, sampler, rays, the figures (root mean square over the rounds; None stays None), and seconds,
        seconds_min, seconds_max (median and extremes).  One untimed run of the smallest setting warms the machine up.
        """
        found: list[list[dict]] = [[] for _ in settings]
        times: list[list[float]] = [[] for _ in settings]
        self.image(min(settings, key=lambda s: s.rays), self.seed)
        for k in range(self.repeats):
            before = None
            for i, setting in enumerate(settings):
                start = time.perf_counter()
                image = self.image(setting, self.seed + k)
                times[i].append(time.perf_counter() - start)
                found[i].append(figures(setting, image, before))
                before = image
                self._tick(setting.rays)
        rows = []
        for setting, values, seconds in zip(settings, found, times, strict=True):
            row = {"series": setting.series, "sampler": setting.sampler, "rays": self.sampler(setting, 0).count}
            for name in values[0]:
                column = [v[name] for v in values]
                row[name] = None if None in column else math.sqrt(statistics.fmean(c * c for c in column))
            row |= {"seconds": statistics.median(seconds), "seconds_min": min(seconds), "seconds_max": max(seconds)}
            rows.append(row)
        return rows

    def _tick(self, rays: int) -> None:
        self.done += rays
        if self.progress is not None:
            self.progress(self.done, self.total)


def haste(rows: Sequence[dict]) -> str:
    """A warning where the machine was too busy for its times, with their spread in `seconds_min` and `_max`, to mean much."""
    spread = statistics.median(row["seconds_max"] / row["seconds_min"] for row in rows)
    return f" (half of the times varied more than {spread:.1f}-fold: the machine was busy)" if spread > BUSY else ""
