"""A disc: an extended source before the lens, or at infinity such as the sun (thesis 4.2)."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from caustic_cli.scene import checks
from caustic_cli.scene.sources import ranges
from caustic_cli.scene.sources.base import Source
from caustic_cli.scene.sources.plane import PlaneWave
from caustic_cli.scene.sources.points import Points
from caustic_cli.scene.sources.section import SourceType, Table, middle, shining, standing


@dataclass(frozen=True)
class Disc(Source):
    """An extended source: every point of an ellipse shines into a cone about +z.  Or, with `angle`, a far one such as the sun.

    Args:
        position: of the centre, mm.
        size: full widths of the ellipse along x and y, mm.
        power: emitted into the cone, W; with `angle`, through the aperture.
        cone, intensity, aimed: as for `Points`.
        angle: full angle under which the lens sees a round, evenly bright disc at infinity, degrees; position, size, cone,
            intensity and aimed then mean nothing.
    """

    position: tuple[float, float, float] = (0.0, 0.0, -50.0)
    size: tuple[float, float] = (2.0, 2.0)
    power: float = 1.0
    cone: float | None = None
    intensity: str = "lambertian"
    aimed: bool = True
    angle: float | None = None

    kind = "disc"

    def __post_init__(self):
        ranges.position(self.position)
        ranges.size(self.size)
        ranges.power(self.power)
        ranges.cone(self.cone)
        ranges.intensity(self.intensity)
        if self.angle is not None:
            checks.number("[source] angle", self.angle, 0.0, 170.0)

    @property
    def distant(self) -> bool:
        """As of a source."""
        return self.angle is not None

    @property
    def half_angle(self) -> float:
        """As of a source."""
        return math.radians(self.angle) / 2.0 if self.distant else 0.0

    def points(self) -> tuple[np.ndarray, np.ndarray]:
        """Its middle."""
        return super().points() if self.distant else (np.array([self.position], dtype=float), np.ones(1))

    @property
    def extent(self) -> tuple[float, float]:
        """Half axes of the ellipse."""
        return (0.0, 0.0) if self.distant else (self.size[0] / 2.0, self.size[1] / 2.0)

    @property
    def sharp(self) -> bool:
        """Never: the shape of its design does not hang on how small it is."""
        return False

    @property
    def emission(self) -> str:
        """As of a source."""
        return "far disc" if self.distant else "disc"

    def apparent_angle(self, z_in: float) -> float:
        """As of a source; of a far one, the very number that was given."""
        return self.angle if self.distant else super().apparent_angle(z_in)

    def pointlike(self) -> Source:
        """A plane wave, or a point in the middle."""
        if self.distant:
            return PlaneWave(self.power)
        return Points((self.position,), (self.power,), self.cone, self.intensity, self.aimed)


def _build(table: Table, _profile) -> Disc:
    return Disc(middle(table, "disc"), tuple(table["size"]), table["power"], angle=table.get("angle"), **shining(table))


def _idle(table: Table) -> dict[str, str]:
    why = "has no meaning for a disc at infinity, which is an angle wide (--source-angle)"
    return dict.fromkeys(("position", "size", "cone"), why) if "angle" in table else {}


TYPES = (SourceType("disc", "disc", ("position", "size", "cone", "angle", "intensity", "aim"), _build, standing, _idle),)
