"""Disc sources: extended, at a finite distance or at infinity like the sun (thesis 4.2); of uniform radiance, or by a picture."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from caustic_cli.errors import InputError
from caustic_cli.scene.sources.base import Source
from caustic_cli.scene.sources.distribution import Distribution
from caustic_cli.scene.sources.plane import PlaneWave, direction, picture_of
from caustic_cli.scene.sources.points import Points
from caustic_cli.scene.sources.section import (
    SourceType,
    Table,
    check_emission,
    content,
    emission_arguments,
    position_defaults,
    single_position,
)
from caustic_cli.schema.table import check, check_all, default

#: Intervals of each step that locates the farthest point of an ellipse, and steps: the angle to 1e-6, the distance to 1e-12.
ZOOM, ZOOMS = 64, 4


@dataclass(frozen=True)
class Disc(Source):
    """An extended source: every point of an ellipse emits into a cone about an axis; with `angle`, a disc at infinity like the sun.

    Args:
        position: of the centre, mm.
        size: full widths of the ellipse along x and y, mm.
        power: emitted into the cone, W; with `angle`, through the aperture.
        cone, intensity, aimed, axis: as for `Points`.
        angle: angular diameter of a disc at infinity, degrees; position, size, cone, intensity, aimed and axis are then
            ignored.
        brightness: relative radiance over the ellipse's bounding rectangle, (a, b) [i, j] with i along +x, instead of uniform
            radiance; for a disc at infinity over direction sines.
        tilt: of the axis of a disc at infinity, see `PlaneWave`.
    """

    position: tuple[float, float, float] = (0.0, 0.0, -50.0)
    size: tuple[float, float] = (2.0, 2.0)
    power: float = 1.0
    cone: float | None = None
    intensity: str | Distribution = "lambertian"
    aimed: bool = True
    angle: float | None = None
    brightness: np.ndarray | None = field(default=None, compare=False)
    axis: tuple[float, float, float] = (0.0, 0.0, 1.0)
    tilt: tuple[float, float] = (0.0, 0.0)

    kind = "disc"

    def __post_init__(self):
        check_all("source", self, "position", "size", "power")
        check_emission(self)
        if self.angle is not None:
            check("source.angle", self.angle)
        if self.brightness is not None:
            object.__setattr__(self, "brightness", picture_of(self.brightness, "⟨source.file⟩ of a disc"))
            if self.distant and self.frame[0] * self._reach[2] >= 1.0:
                raise InputError(f"⟨source.angle⟩ of {self.angle:g} degrees is too wide for a picture whose corners lie beyond it")
        if self.distant:
            object.__setattr__(self, "axis", direction(self.tilt, self.half_angle))

    @property
    def distant(self) -> bool:
        """As of a source."""
        return self.angle is not None

    @property
    def half_angle(self) -> float:
        """As of a source; with a picture, the angle of the outermost corner of its lit pixels."""
        if self.angle is None:
            return 0.0
        half = math.radians(self.angle) / 2.0
        return half if self.brightness is None else math.asin(math.sin(half) * self._reach[2])

    @property
    def frame(self) -> tuple[float, float]:
        """As of a source."""
        if self.angle is None:
            return self.size[0] / 2.0, self.size[1] / 2.0
        return (math.sin(math.radians(self.angle) / 2.0),) * 2

    @cached_property
    def _corners(self) -> tuple[np.ndarray, np.ndarray]:
        """Corners x, y of the picture's outermost lit pixels, in half widths: the first and the last lit pixel of each row."""
        assert self.brightness is not None
        (nx, ny), lit = self.brightness.shape, self.brightness > 0
        (rows,) = np.nonzero(lit.any(1))
        first, last = lit[rows].argmax(1), ny - lit[rows, ::-1].argmax(1)
        x = np.concatenate([rows, rows, rows + 1, rows + 1]) * (2.0 / nx) - 1.0
        return x, np.concatenate([first, last, first, last]) * (2.0 / ny) - 1.0

    @cached_property
    def _reach(self) -> tuple[float, float, float]:
        """Extent of the picture's lit pixels from its centre along x, along y and radially, in half widths."""
        x, y = self._corners
        return float(np.abs(x).max()), float(np.abs(y).max()), float(np.hypot(x, y).max())

    @property
    def centre(self) -> tuple[float, float, float]:
        """As of a source; with a picture, its centroid."""
        if self.distant or self.brightness is None:
            return super().centre
        cells = [(np.arange(n) + 0.5) * (2.0 / n) - 1.0 for n in self.brightness.shape]
        total = self.brightness.sum()
        (x, y, z), (fx, fy) = self.position, self.frame
        return (
            x + fx * float(cells[0] @ self.brightness.sum(1) / total),
            y + fy * float(cells[1] @ self.brightness.sum(0) / total),
            float(z),
        )

    def points(self) -> tuple[np.ndarray, np.ndarray]:
        """Its centre."""
        return super().points() if self.distant else (np.array([self.position], dtype=float), np.ones(1))

    @property
    def extent(self) -> tuple[float, float]:
        """Half axes of the ellipse, or half widths of the rectangle that contains the picture's lit pixels."""
        if self.distant:
            return 0.0, 0.0
        wide, high = (1.0, 1.0) if self.brightness is None else self._reach[:2]
        return wide * self.size[0] / 2.0, high * self.size[1] / 2.0

    def _farthest(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """As of a source: of the ellipse, or of the lit pixels of its picture."""
        (fx, fy), (ax, ay) = self.frame, (np.abs(x), np.abs(y))
        if self.brightness is not None:
            return np.hypot(x[:, None] + fx * self._corners[0], y[:, None] + fy * self._corners[1]).max(1)
        if fx == fy:
            return np.hypot(ax, ay) + fx
        low, high = np.zeros_like(ax), np.full_like(ax, 0.5 * math.pi)  # angle of the farthest point, which is in this quadrant
        for _ in range(ZOOMS):
            turn = np.linspace(low, high, ZOOM + 1)
            far = np.hypot(ax + fx * np.cos(turn), ay + fy * np.sin(turn))
            best, step = np.take_along_axis(turn, far.argmax(0)[None], 0)[0], (high - low) / ZOOM
            low, high = np.maximum(low, best - step), np.minimum(high, best + step)
        return far.max(0)

    @property
    def sharp(self) -> bool:
        """Never, so that the type of design does not depend on its size."""
        return False

    @property
    def emission(self) -> str:
        """As of a source."""
        return "far disc" if self.distant else "disc"

    def apparent_angle(self, z_in: float) -> float:
        """As of a source; at infinity, the angle as given."""
        return super().apparent_angle(z_in) if self.angle is None else self.angle

    @property
    def sized(self) -> bool:
        """Always."""
        return True

    def displaced(
        self,
        place: Callable[[Sequence[float]], tuple[float, float, float]],
        scale: float,
        axis: tuple[float, float, float] | None = None,
    ) -> Source:
        """The disc moved and scaled."""
        if self.angle is not None:
            return replace(self, angle=self.angle * scale)
        size = self.size[0] * scale, self.size[1] * scale
        return replace(self, position=place(self.position), size=size, axis=axis or self.axis)

    def pointlike(self) -> Source:
        """A plane wave, or a point at its centre."""
        if self.distant:
            return PlaneWave(self.power, tilt=self.tilt)
        place = self.position if self.brightness is None else self.centre
        return Points((place,), (self.power,), self.cone, self.intensity, self.aimed, axis=self.axis)


def _build(table: Table, _profile) -> Disc:
    light = content(table, "file", np.ndarray)
    if light is None and table.get("file"):
        raise InputError("⟨source.file⟩ of a disc must be a picture of its brightness, an image or a 2-D .npy")
    return Disc(
        single_position(table, "disc"),
        tuple(table["size"]),
        table["power"],
        angle=table.get("angle"),
        brightness=light,
        tilt=tuple(table.get("tilt") or default("source.tilt")),
        **emission_arguments(table),
    )


def _idle(table: Table) -> dict[str, str]:
    why = "has no meaning for a disc at infinity, whose size is an angle (⟨source_angle⟩)"
    if "angle" in table:
        return dict.fromkeys(("position", "each", "size", "cone"), why)
    return {"tilt": "is for light from infinity: a plane wave, or a disc with an angle (⟨source_angle⟩)"}


KEYS = ("position", "each", "size", "cone", "angle", "intensity", "aim", "file", "tilt")
TYPES = (SourceType("disc", "disc", KEYS, _build, position_defaults, _idle),)
