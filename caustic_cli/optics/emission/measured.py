"""Rays of a ray file, traced to the pupil: all that reach it, or a systematic sample of them.

A smaller number of rays is selected by systematic resampling in Morton order of their points on the pupil: one ray from each
interval of equal power, so that the sample is as uniform over the pupil as the whole set, and all its rays have equal power.

An image of P pixels from N independent rays of equal power has the noise sqrt(P / N), root mean square relative to the mean pixel:
the variance of a pixel is its power times that of a ray.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import cast

import numpy as np
import torch
from scipy.ndimage import gaussian_filter
from torch import Tensor

from caustic_cli.errors import InputError
from caustic_cli.optics.emission.base import Illuminated
from caustic_cli.optics.interface import reflectance
from caustic_cli.optics.rays import RayState
from caustic_cli.optics.sampling import SAMPLERS, random_numbers
from caustic_cli.scene import Pupil, Scene, Source
from caustic_cli.scene.sources.rays import Measured

#: Bits of each coordinate of the Morton code: finer than the spacing of a million rays.
BITS = 12
#: Noise of an image that is good enough to look at.
WORTHY = 0.1
#: Number of rays under the smoothing kernel of the irradiance on a lens, and the largest width of the kernel relative to the lens.
SMOOTHED, WIDEST = 1000.0, 0.1


@dataclass(frozen=True, eq=False)
class MeasuredRays:
    """The rays of a file, or a sample of them.

    Raises:
        InputError: no ray reaches the pupil.
    """

    #: The illuminated scene or system, with a ray-file source.
    scene: Illuminated
    #: Sampler, one of `sampling.SAMPLERS`; ignored.
    kind: str
    #: Largest number of rays.
    rays: int
    #: Of the sample.
    seed: int = 0
    #: Of its tensors.
    device: str | torch.device = "cpu"

    def __post_init__(self):
        if self.kind not in SAMPLERS:
            raise InputError(f"sampler must be one of {', '.join(SAMPLERS)}, got {self.kind!r}")
        _ = self._drawn

    @cached_property
    def _drawn(self) -> tuple[Tensor, ...]:
        """Points of the pupil x, y, mm, directions, and fractions of the source's power: (N,) each."""
        source, pupil = _of_file(self.scene.source), self.scene.pupil
        x, y, met, part = meeting(source, pupil)
        if self.rays < len(met):
            (rx, ry), chosen = pupil.half_size, random_numbers(self.seed, 0, torch.zeros(1, dtype=torch.int64))
            order = np.argsort(_morton(0.5 + 0.5 * x / rx, 0.5 + 0.5 * y / ry), kind="stable")
            sums, whole = np.cumsum(part[order]), float(part.sum())
            at = (np.arange(self.rays) + float(chosen)) * (sums[-1] / self.rays)
            taken = order[np.searchsorted(sums, at, side="right").clip(max=len(order) - 1)]
            x, y, met, part = x[taken], y[taken], met[taken], np.full(self.rays, whole / self.rays)
        d = source.turned.directions[met]
        return tuple(torch.from_numpy(np.ascontiguousarray(c)).to(self.device) for c in (x, y, *d.T, part))

    @property
    def count(self) -> int:
        """Number of rays, all through the pupil."""
        return len(self._drawn[0])

    def chunks(self, size: int = 1 << 20) -> Iterator[RayState]:
        """As of an `Emission`."""
        missed = 1.0 - float(self._drawn[-1].sum())
        for start in range(0, self.count, size):
            x, y, dx, dy, dz, power = (c[start : start + size] for c in self._drawn)
            lost = missed * len(power) / self.count
            yield RayState((x, y, self.scene.pupil.z), (dx, dy, dz), power, lost={"missed_lens": lost})


def _of_file(source: Source) -> Measured:
    """A source as a `Measured`."""
    return cast(Measured, source)


def meeting(source: Measured, pupil: Pupil) -> tuple[np.ndarray, ...]:
    """Rays through a pupil: points x and y, mm, indices in the file, and fractions of the power."""
    x, y, met = source.crossing(pupil)
    (met,) = np.nonzero(met)
    if not len(met):
        raise InputError(
            f"⟨source.file⟩: none of its {source.rays.count:,} rays meets the lens, which must lie in the direction +z;"
            " ⟨source_position⟩ moves them"
        )
    return x[met], y[met], met, source.rays.flux[met] / source.rays.flux.sum()


def effective_count(part: np.ndarray) -> float:
    """Number of rays of equal power that have the noise of rays of these powers."""
    return float(part.sum()) ** 2 / float((part * part).sum())


def _morton(u: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Morton codes of points of the unit square: interleaved bits of both coordinates."""
    code = np.zeros(len(u), dtype=np.int64)
    i, j = ((c * (1 << BITS)).astype(np.int64).clip(0, (1 << BITS) - 1) for c in (u, v))
    for bit in range(BITS):
        code |= (i >> bit & 1) << (2 * bit + 1) | (j >> bit & 1) << (2 * bit)
    return code


def coarseness(scene: Scene) -> tuple[float, int] | None:
    """Noise of the image of all rays of a scene's ray file, relative to the mean pixel, and the number of rays in such a file for
    the noise WORTHY; None for other sources."""
    if scene.source.rays is None:
        return None
    source, lens = _of_file(scene.source), scene.lens
    *_, part = meeting(source, lens.pupil)
    noise = math.sqrt(math.prod(scene.screen.resolution) / effective_count(part))
    return noise, math.ceil(source.rays.count * (noise / WORTHY) ** 2)


def coarse_words(scene: Scene) -> str | None:
    """A warning that a scene's ray file has too few rays for its picture; None if it has enough."""
    noise, wanted, rays = 0.0, 0, 0
    for one in scene.by_source:
        found, file = coarseness(one), one.source.rays
        if found is not None and file is not None and found[0] > noise:
            (noise, wanted), rays = found, file.count
    if noise <= WORTHY:
        return None
    nx, ny = scene.screen.resolution
    return (
        f"the ray file is coarse for {nx} x {ny} pixels: its {rays:,} rays leave {noise:.0%} of noise, and it would take"
        f" {_rounded(wanted)} to leave {WORTHY:.0%}"
    )


def _rounded(count: int) -> str:
    """A number of rays rounded up to two digits."""
    scale = 10 ** max(0, len(str(count)) - 2)
    return f"{-(-count // scale) * scale:,}"


def irradiance(scene: Scene, x: np.ndarray, y: np.ndarray, height: float) -> np.ndarray | None:
    """Power of a ray file on the cells between edges x (n + 1,), y (m + 1,) of the plane at `height`, mm, behind the entrance: (n,
    m), smoothed by a Gaussian over about SMOOTHED rays; None for other sources."""
    if scene.source.rays is None:
        return None
    source, lens = _of_file(scene.source), scene.lens
    at_x, at_y, met, part = meeting(source, lens.pupil)
    d, n = source.turned.directions[met], lens.inside
    inside = np.sqrt(1.0 - (d[:, 0] ** 2 + d[:, 1] ** 2) / (n * n))
    if lens.interior.fresnel != "none":
        part = part * (1.0 - reflectance("exact", d[:, 2], inside, 1.0 / n))
    way = (height - lens.pupil.z) / (n * inside)
    cells, _, _ = np.histogram2d(at_x + way * d[:, 0], at_y + way * d[:, 1], (x, y), weights=part)
    lit = max(1, int(np.count_nonzero(cells)))
    sigma = math.sqrt(SMOOTHED * lit / (4.0 * math.pi * len(met)))
    return gaussian_filter(cells, [min(sigma, WIDEST * k) for k in cells.shape], mode="reflect")


EMISSIONS = {"rays": MeasuredRays}
