"""Base surfaces given by a spline: the outer side of a part that exists."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from caustic_cli.errors import InputError
from caustic_cli.scene.aperture import larger
from caustic_cli.scene.freeform import FreeForm
from caustic_cli.scene.lens import Offset

#: Relative tolerance for the size of a face.
SAME = 1e-6


@dataclass(frozen=True, eq=False)
class Face(Offset):
    """The base surface thickness + S(x, y) - S(0, 0) of a height field S, continued beyond its edges; `radius` is not used."""

    #: S, over an aperture of half widths (r_x, r_y), mm.
    surface: FreeForm | None = None
    half_size: tuple[float, float] = (1.0, 1.0)

    def _at(self, x: np.ndarray, y: np.ndarray, order: tuple[int, int] = (0, 0)) -> np.ndarray:
        """A derivative of S by x and y at points of one shape."""
        assert self.surface is not None
        x, y = np.broadcast_arrays(np.asarray(x, float), np.asarray(y, float))
        (rx, ry), (a, b) = self.half_size, order
        return self.surface.at_points(x.ravel() / rx, y.ravel() / ry, order).reshape(x.shape) / (rx**a * ry**b)

    def sag(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """As of any base surface."""
        return self._at(x, y) - float(self._at(np.zeros(1), np.zeros(1))[0])

    def slopes(self, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """As of any base surface."""
        return self._at(x, y, (1, 0)), self._at(x, y, (0, 1))

    def heights(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """As of any base surface."""
        assert self.surface is not None
        z = self.surface.at(x / self.half_size[0], y / self.half_size[1])
        return self.thickness + z - float(self._at(np.zeros(1), np.zeros(1))[0])

    def scaled(self, factor: float) -> Face:
        """Larger by a factor."""
        assert self.surface is not None
        return Face(factor * self.thickness, surface=self.surface.scaled(factor), half_size=larger(self.half_size, factor))

    def check_size(self, size: tuple[float, float]) -> None:
        """Check that it covers a lens of this size, mm.

        Raises:
            InputError: it is smaller.
        """
        if any(2.0 * r < w * (1.0 - SAME) for r, w in zip(self.half_size, size, strict=True)):
            wide, high = (2.0 * r for r in self.half_size)
            raise InputError(
                f"⟨lens.base_file⟩ holds a face of {wide:g} x {high:g} mm, smaller than the lens of {size[0]:g} x {size[1]:g} mm:"
                " a smaller ⟨lens.size⟩ is needed"
            )
