"""The screen: a rectangle of pixels, in the plane z = const unless it is tilted."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

from caustic_cli.config.table import check_all, default


@dataclass(frozen=True)
class Screen:
    """Pixels [i, j], i along +x, j along +y, on [-R_x, R_x] x [-R_y, R_y] at z (thesis 3.1.1).

    Args:
        size: full width and height (2 R_x, 2 R_y), mm.
        z: position, mm.
        resolution: pixels along x and y.
        tilt: right-handed turns of the screen about its own centre, first about the fixed x axis, then about the fixed y axis,
            degrees.
        shift: of its middle from the axis along x and y, mm.
    """

    size: tuple[float, float]
    z: float = default("screen.z")
    resolution: tuple[int, int] = (250, 250)
    tilt: tuple[float, float] = default("screen.tilt")
    shift: tuple[float, float] = default("screen.shift")

    def __post_init__(self):
        check_all("screen", self, "size", "z", "resolution", "tilt", "shift")

    @property
    def half_size(self) -> tuple[float, float]:
        """(R_x, R_y) mm."""
        return self.size[0] / 2.0, self.size[1] / 2.0

    @property
    def pixel(self) -> tuple[float, float]:
        """Width and height of a pixel (w_x, w_y), mm (eq. 4.4.1)."""
        return self.size[0] / self.resolution[0], self.size[1] / self.resolution[1]

    def grown(self, pixels: tuple[int, int]) -> Screen:
        """The same screen with so many more pixels on each side."""
        (wx, wy), (nx, ny), (ax, ay) = self.pixel, self.resolution, pixels
        return replace(self, size=(self.size[0] + 2 * ax * wx, self.size[1] + 2 * ay * wy), resolution=(nx + 2 * ax, ny + 2 * ay))

    @property
    def low(self) -> tuple[float, float]:
        """Its low edges along its own axes, counted from the foot of the optical axis, mm: -R + shift."""
        return self.shift[0] - self.half_size[0], self.shift[1] - self.half_size[1]

    @property
    def axes(self) -> tuple[tuple[float, float, float], tuple[float, float, float], tuple[float, float, float]]:
        """Unit vectors along its x and y, and its normal."""
        (sa, ca), (sb, cb) = ((math.sin(t), math.cos(t)) for t in map(math.radians, self.tilt))
        return (cb, 0.0, -sb), (sb * sa, ca, cb * sa), (sb * ca, -sa, cb * ca)

    @property
    def depth(self) -> float:
        """How far a tilted screen reaches before and behind its middle, mm."""
        along_x, along_y, _ = self.axes
        return abs(along_x[2]) * self.half_size[0] + abs(along_y[2]) * self.half_size[1]
