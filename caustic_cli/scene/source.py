"""Light sources: a plane wave, points, a disc (thesis 4.2).  All shine along +z."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from caustic_cli.errors import InputError
from caustic_cli.scene import checks

#: uniform: the same power into every solid angle; lambertian: proportional to the cosine from +z.
INTENSITIES = ("uniform", "lambertian")
#: Most point sources at once.
MAX_POINTS = 1_000_000
#: A cone that just covers the aperture is wider by this part, so that rounding leaves no corner dark.
SLACK = 1e-9


@dataclass(frozen=True, eq=False)
class PlaneWave:
    """Parallel light at normal incidence on the entrance surface, as wide as the lens' aperture (thesis 4.2.1).

    Args:
        power: power through the aperture, W.
        profile: optional relative irradiance E over the aperture, (a, b) non-negative, [i, j] with i along +x and j
            along +y, constant on each cell (eq. 4.2.3); None for uniform light.
    """

    power: float = 1.0
    profile: np.ndarray | None = None

    def __post_init__(self):
        checks.number("[source] power", self.power, 0.0, open_low=True)
        if self.profile is not None:
            e = np.asarray(self.profile, dtype=float)
            if e.ndim != 2 or not np.isfinite(e).all() or (e < 0).any() or not e.sum() > 0:
                raise InputError("[source] profile must be a 2-D picture, finite, not negative, and not black all over")
            object.__setattr__(self, "profile", e)


@dataclass(frozen=True)
class Points:
    """Point sources, each with a position and a power, that shine into a cone about +z (thesis 4.2.2).

    Args:
        positions: (x, y, z) of each, mm.
        powers: emitted into the cone by each, W; None for 1 W shared equally.
        cone: half-angle of the cone, degrees; None for the narrowest that covers the lens from every position.
        intensity: one of INTENSITIES.
        aimed: rays are sampled where they meet the lens, with the weights that this asks for; otherwise all over the cone.
        kind: point, or grid for points that stand for an extended source.
    """

    positions: tuple[tuple[float, float, float], ...]
    powers: tuple[float, ...] | None = None
    cone: float | None = None
    intensity: str = "uniform"
    aimed: bool = True
    kind: str = "point"

    def __post_init__(self):
        if not 1 <= len(self.positions) <= MAX_POINTS:
            raise InputError(f"[source] position must name 1 to {MAX_POINTS:,} points, got {len(self.positions)}")
        for position in self.positions:
            _triple("[source] position", position)
        if self.powers is None:
            object.__setattr__(self, "powers", (1.0 / len(self.positions),) * len(self.positions))
        if len(self.powers) != len(self.positions):
            raise InputError(f"[source] powers must be one for each of the {len(self.positions)} positions,"
                             f" got {len(self.powers)}")
        for power in self.powers:
            checks.number("[source] powers", power, 0.0)
        if not sum(self.powers) > 0:
            raise InputError("[source] powers must not all be 0")
        _cone(self.cone)
        checks.choice("[source] intensity", self.intensity, INTENSITIES)

    @classmethod
    def grid(cls, centre: Sequence[float], size: tuple[float, float], shape: tuple[int, int], power: float = 1.0,
             **options) -> Points:
        """shape = (N, M) equispaced points on a rectangle of full width and height `size` mm, borders included (fig. 6.4.1)."""
        centre = _triple("[source] position", centre)
        _extent(size)
        checks.pair("[source] grid", shape, lambda w, n: checks.whole(w, n, 1, 1000))
        xs, ys = (np.linspace(-w / 2.0, w / 2.0, n) if n > 1 else np.zeros(1) for w, n in zip(size, shape, strict=True))
        positions = tuple((centre[0] + float(x), centre[1] + float(y), centre[2]) for x in xs for y in ys)
        return cls(positions, (power / len(positions),) * len(positions), kind="grid", **options)

    @property
    def power(self) -> float:
        """Of all, W."""
        return math.fsum(self.powers)

    @property
    def nearest(self) -> float:
        """z of the source nearest to the lens, mm."""
        return max(p[2] for p in self.positions)

    @property
    def centre(self) -> tuple[float, float, float]:
        """Mean position, weighted by power, mm."""
        x, y, z = np.average(np.array(self.positions), axis=0, weights=self.powers)
        return float(x), float(y), float(z)


@dataclass(frozen=True)
class Disc:
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
        _triple("[source] position", self.position)
        _extent(self.size)
        checks.number("[source] power", self.power, 0.0, open_low=True)
        _cone(self.cone)
        checks.choice("[source] intensity", self.intensity, INTENSITIES)
        if self.angle is not None:
            checks.number("[source] angle", self.angle, 0.0, 170.0)

    @property
    def nearest(self) -> float:
        """z of the source, mm; minus infinity for a far one."""
        return self.position[2] if self.angle is None else -math.inf

    @property
    def centre(self) -> tuple[float, float, float]:
        """Position of the middle, mm."""
        return (*self.position[:2], self.nearest) if self.angle is None else (0.0, 0.0, -math.inf)


Source = PlaneWave | Points | Disc


def blur_limit(source: Source, z_in: float, throw: float) -> float:
    """Width in mm, on a screen `throw` mm beyond the entrance, over which an extended source blurs every point; 0 for a point.

    To first order the throw times the angle under which the lens sees the source: a lens can show nothing finer.
    """
    if isinstance(source, Disc):
        if source.angle is not None:
            return throw * math.radians(source.angle)
        return throw * max(source.size) / (z_in - source.position[2])
    if isinstance(source, Points) and source.kind == "grid":
        points = np.array(source.positions)
        return throw * float(np.ptp(points[:, :2], axis=0).max()) / (z_in - source.nearest)
    return 0.0


def covering_cone(source: Points | Disc, half_size: tuple[float, float], z_in: float, round: bool = False) -> float:
    """Half-angle of the source's cone, rad: what it says, or the least that covers the aperture, `round` or not, from all of it."""
    if source.cone is not None:
        return math.radians(source.cone)
    points = np.array(source.positions if isinstance(source, Points) else [source.position])
    extent = (0.0, 0.0) if isinstance(source, Points) else source.size
    across = [np.abs(points[:, k]) + extent[k] / 2.0 + (0.0 if round else half_size[k]) for k in (0, 1)]
    farthest = np.hypot(*across) + (half_size[0] if round else 0.0)
    return min((1.0 + SLACK) * float(np.arctan2(farthest, z_in - points[:, 2]).max()), math.pi / 2.0)


def _triple(where: str, value) -> tuple[float, float, float]:
    if isinstance(value, str) or not isinstance(value, Sequence) or len(value) != 3:
        raise InputError(f"{where} must be three numbers x, y, z in mm, got {value!r}")
    return tuple(checks.number(where, v, -1e12, 1e12) for v in value)


def _extent(size) -> None:
    checks.pair("[source] size", size, lambda w, x: checks.number(w, x, 0.0, 1e9))


def _cone(cone: float | None) -> None:
    if cone is not None:
        checks.number("[source] cone", cone, 0.0, 90.0, open_low=True)
