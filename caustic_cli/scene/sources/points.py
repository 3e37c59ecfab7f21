"""Point sources: one, several, or a grid of them that represents an extended source (thesis 4.2.2)."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from caustic_cli.errors import InputError
from caustic_cli.scene.sources.base import Source
from caustic_cli.scene.sources.distribution import Distribution
from caustic_cli.scene.sources.section import (
    SourceType,
    Table,
    check_emission,
    emission_arguments,
    position_defaults,
    positions,
    single_position,
)
from caustic_cli.schema.table import check

#: Largest number of point sources.
MAX_POINTS = 1_000_000


@dataclass(frozen=True)
class Points(Source):
    """Point sources, each with a position and a power, that emit into a cone about an axis."""

    #: (x, y, z) of each, mm.
    positions: tuple[tuple[float, float, float], ...]
    #: Emitted into the cone by each, W; None for 1 W in equal parts.
    powers: tuple[float, ...] = None  # type: ignore[assignment]  # what None means is found on construction
    #: Half-angle of the cone, degrees; None for the narrowest that covers the lens from every position.
    cone: float | None = None
    #: uniform, lambertian, or tabulated.
    intensity: str | Distribution = "uniform"
    #: Rays are sampled over the lens (importance sampling); otherwise over the whole cone.
    aimed: bool = True
    #: point, or grid for points that represent an extended source.
    kind: str = "point"
    #: Of the cones and intensities, a unit vector.
    axis: tuple[float, float, float] = (0.0, 0.0, 1.0)

    def __post_init__(self):
        if not 1 <= len(self.positions) <= MAX_POINTS:
            raise InputError(f"⟨source.position⟩ must name 1 to {MAX_POINTS:,} points, got {len(self.positions)}")
        for position in self.positions:
            check("source.position", position)
        if self.powers is None:
            object.__setattr__(self, "powers", (1.0 / len(self.positions),) * len(self.positions))
        if len(self.powers) != len(self.positions):
            raise InputError(f"⟨source.powers⟩ must be one for each of the {len(self.positions)} positions, got {len(self.powers)}")
        check("source.powers", self.powers)
        if not sum(self.powers) > 0:
            raise InputError("⟨source.powers⟩ must not all be 0")
        check_emission(self)

    @classmethod
    def grid(
        cls, centre: Sequence[float], size: tuple[float, float], shape: tuple[int, int], power: float = 1.0, **options
    ) -> Points:
        """A uniform grid of shape (N, M) on a rectangle of full width and height `size` mm, borders included (fig. 6.4.1)."""
        centre = check("source.position", centre)
        check("source.size", size)
        check("source.grid", shape)
        xs, ys = (np.linspace(-w / 2.0, w / 2.0, n) if n > 1 else np.zeros(1) for w, n in zip(size, shape, strict=True))
        places = tuple((centre[0] + float(x), centre[1] + float(y), centre[2]) for x in xs for y in ys)
        return cls(places, (power / len(places),) * len(places), kind="grid", **options)

    @property
    def power(self) -> float:
        """Total power, W."""
        return math.fsum(self.powers)

    def points(self) -> tuple[np.ndarray, np.ndarray]:
        """As of a source."""
        powers = np.array(self.powers, dtype=float)
        return np.array(self.positions, dtype=float), powers / powers.sum()

    @property
    def several(self) -> bool:
        """As of a source."""
        return len(self.positions) > 1

    @property
    def apart(self) -> bool:
        """Whether they are separate points; a grid is one source."""
        return self.several and self.kind == "point"

    @property
    def sharp(self) -> bool:
        """Whether it is a single point; a grid is an extended source."""
        return self.kind == "point" and not self.several

    @property
    def label(self) -> str:
        """As of a source."""
        return f"{len(self.positions)} points"

    def extent_words(self, z_in: float) -> str:
        """As of a source."""
        return f"the source is {len(self.positions)} points" if self.several else "the source is a point"

    def blur(self, z_in: float, throw: float) -> float:
        """As of a source; separate points have no blur, since each forms a sharp picture."""
        return super().blur(z_in, throw) if self.kind == "grid" else 0.0

    @property
    def sized(self) -> bool:
        """Whether it is a grid."""
        return self.kind == "grid"

    def displaced(
        self,
        place: Callable[[Sequence[float]], tuple[float, float, float]],
        scale: float,
        axis: tuple[float, float, float] | None = None,
    ) -> Source:
        """The points moved; those of a grid are also scaled about its centre."""
        centre = np.array(self.centre)
        spread = scale if self.sized else 1.0
        wide = [p if spread == 1.0 else tuple(centre + (np.array(p) - centre) * spread) for p in self.positions]
        return replace(self, positions=tuple(place(p) for p in wide), axis=axis or self.axis)

    def pointlike(self) -> Source:
        """One point at the centre of all."""
        return (
            Points((self.centre,), (self.power,), self.cone, self.intensity, self.aimed, axis=self.axis) if self.several else self
        )


def _points(table: Table, _profile) -> Points:
    places = positions(table)
    parts = table.get("powers", [1.0] * len(places))
    total = math.fsum(parts)
    return Points(
        places, tuple(table["power"] * p / total for p in parts) if total > 0 else tuple(parts), **emission_arguments(table)
    )


def _grid(table: Table, _profile) -> Points:
    return Points.grid(
        single_position(table, "grid"), tuple(table["size"]), tuple(table["grid"]), table["power"], **emission_arguments(table)
    )


TYPES = (
    SourceType("point", "point", ("position", "each", "powers", "cone", "intensity", "aim"), _points, position_defaults),
    SourceType(
        "grid", "grid (of points)", ("position", "each", "size", "grid", "cone", "intensity", "aim"), _grid, position_defaults
    ),
)
