"""Arguments of the kernels that come together, as named tuples.

Numba compiles a kernel for each combination of argument types: integers are always `int` and other numbers `float`, so that there
is only one.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from caustic_cli.optics.kernels.filter_weights import KINDS
from caustic_cli.optics.kernels.transfer import TargetPlane
from caustic_cli.optics.reconstruction import Filter
from caustic_cli.scene import Screen


class Exit(NamedTuple):
    """The exit surface and the screen behind it.

    eta: ratio of the indices in front of and behind it, -1 for a mirror; fresnel: kind of Fresnel losses, as in `refraction`;
    start: height of the origins of oblique rays, height: of the screen, mm, both above the zero of the sag.
    """

    eta: float
    fresnel: int
    start: float
    height: float


class ScreenFrame(NamedTuple):
    """The screen's pixels: their numbers, the coordinates of the lower left corner and the pixel size, mm."""

    pixels_x: int
    pixels_y: int
    low_x: float
    low_y: float
    pixel_x: float
    pixel_y: float

    @classmethod
    def of(cls, screen: Screen, low: tuple[float, float] | None = None) -> ScreenFrame:
        """Of a screen; low: its lower edges, mm, where coordinates are not those of an upright screen."""
        return cls(*map(int, screen.resolution), *map(float, low or screen.low), *map(float, screen.pixel))


class Point(NamedTuple):
    """A source point behind the flat entrance, at the zero of x and y.

    distance: h, mm; n: index of the entrance; steps: of Newton's iteration; scale: 2 / largest s; emission: coefficients
    of J, the highest first; see `optics.pencil`.
    """

    distance: float
    n: float
    steps: int
    scale: float
    emission: np.ndarray


class ParallelLight(NamedTuple):
    """Parallel light behind a flat entrance, see `optics.beam`, and the plane of the screen, above the zero of the sag.

    kx, ky: k; power: E T, 1/mm^2; over_x, over_y: 1 / half widths of the entrance, 1/mm; round: whether its aperture is a circle.
    """

    kx: float
    ky: float
    power: float
    over_x: float
    over_y: float
    round: bool
    plane: TargetPlane


class Splat(NamedTuple):
    """The reconstruction filter: its kind, as in `filter_weights`, sizes in pixels (odd), and alpha, per pixel squared."""

    kind: int
    size_x: int
    size_y: int
    alpha_x: float
    alpha_y: float

    @classmethod
    def of(cls, filter: Filter) -> Splat:
        """Of a filter."""
        return cls(KINDS[filter.kind], *(int(2 * r + 1) for r in filter.reach), *map(float, filter.alpha))

    def padded(self, frame: ScreenFrame) -> tuple[int, int]:
        """Shape of an image padded by 2 r, with room for the scatter's last step of four pixels."""
        return frame.pixels_x + 2 * (self.size_x - 1), frame.pixels_y + 2 * (self.size_y - 1) + -self.size_y % 4


class RowsOfSurface(NamedTuple):
    """The surface by rows: of row i the sag is sum_k bu[i, k] net[first[i] + k], dz/dx the same with du and net_x, dz/dy with bu
    and net_y.

    first (a,) int64; bu, du (a, p + 1); nets (n, b).  Of oblique rays the first is that of distances along them.
    """

    first: np.ndarray
    bu: np.ndarray
    du: np.ndarray
    net: np.ndarray
    net_x: np.ndarray
    net_y: np.ndarray


class RowsOfRays(NamedTuple):
    """Rays by rows, (a, b): origins, mm, transverse components of directions (of oblique rays), and parts of the source's power."""

    x: np.ndarray
    y: np.ndarray
    along_x: np.ndarray
    along_y: np.ndarray
    flux: np.ndarray
