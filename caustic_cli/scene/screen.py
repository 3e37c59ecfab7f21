"""The screen: a rectangle of pixels in the plane z = const."""

from __future__ import annotations

from dataclasses import dataclass

from caustic_cli.scene import checks

#: Most pixels along one axis of the screen.
MAX_RESOLUTION = 16384


@dataclass(frozen=True)
class Screen:
    """Pixels [i, j], i along +x, j along +y, on [-R_x, R_x] x [-R_y, R_y] at z (thesis 3.1.1).

    Args:
        size: full width and height (2 R_x, 2 R_y), mm.
        z: position, mm.
        resolution: pixels along x and y.
    """

    size: tuple[float, float]
    z: float = 300.0
    resolution: tuple[int, int] = (250, 250)

    def __post_init__(self):
        checks.pair("[screen] size", self.size, lambda w, x: checks.number(w, x, 1e-6, 1e9))
        checks.number("[screen] z", self.z, -1e12, 1e12)
        checks.pair("[screen] resolution", self.resolution, lambda w, x: checks.whole(w, x, 2, MAX_RESOLUTION))

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
        return Screen((self.size[0] + 2 * ax * wx, self.size[1] + 2 * ay * wy), self.z, (nx + 2 * ax, ny + 2 * ay))
