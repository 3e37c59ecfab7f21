"""Ray sets: rays measured or simulated on a light source, and the position and size of the source derived from them.

Notation, ray i
    p_i     a point of it, mm;  d_i  its unit direction;  w_i  its flux
    c       point of closest approach to all rays, the minimiser of sum w_i |(1 - d_i d_i') (p_i - c)|^2

Coordinates are the file's own; emission is towards its +z.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from caustic_cli.errors import InputError

#: Largest coordinate of a ray, mm.
FARTHEST = 1e9
#: Largest distance of the point of closest approach from the rays' starting points, mm: parallel rays have none.
PARALLEL_AT = 1e6
#: Least number of rays in a batch: with fewer, a batch may have none that reaches the lens.
LEAST_SHARED = 50
#: Range of valid wavelengths, nm.
SHORTEST, LONGEST = 100.0, 20_000.0


@dataclass(frozen=True, eq=False)
class RaySet:
    """Rays of a source.

    Raises:
        InputError: there are no rays, a number is not finite, a direction is zero, or a flux is negative or the total is 0.
    """

    #: (N, 3) mm, starting point of each ray.
    positions: np.ndarray
    #: (N, 3), of any length but 0; stored as unit vectors.
    directions: np.ndarray
    #: (N,) of each ray, not negative; relative, since the scene gives the power of its source.
    flux: np.ndarray
    #: Flux of the whole source, in `unit`.
    total: float = 1.0
    #: W, or lm.
    unit: str = "W"
    #: (N,) nm, or None.
    wavelengths: np.ndarray | None = None

    def __post_init__(self):
        with np.errstate(invalid="ignore"):  # a signalling NaN is refused below
            flux, positions, directions = (np.asarray(a, dtype=np.float64) for a in (self.flux, self.positions, self.directions))
        n = len(flux)
        if n == 0:
            raise InputError("holds no rays; at least one is needed")
        if positions.shape != (n, 3) or directions.shape != (n, 3):
            raise InputError(f"positions and directions must be {n} x 3, got {positions.shape} and {directions.shape}")
        _refuse(~(np.abs(positions) <= FARTHEST).all(1), "a position that is not finite, or beyond 1e9 mm")
        with np.errstate(over="ignore", invalid="ignore"):
            length, whole = np.sqrt((directions * directions).sum(1)), float(flux.sum())
        _refuse(~(np.isfinite(length) & (length > 0)), "a direction that is not finite, or of no length")
        _refuse(~(np.isfinite(flux) & (flux >= 0)), "a flux that is negative or not finite")
        if not 0 < whole < np.inf:
            raise InputError("holds no light: the flux of every ray is 0" if whole == 0 else "holds more flux than can be added up")
        if self.unit not in ("W", "lm"):
            raise InputError(f"the unit of flux must be W or lm, got {self.unit!r}")
        for name, value in (
            ("positions", positions),
            ("directions", directions / length[:, None]),
            ("flux", flux),
            ("total", float(self.total) if 0 < self.total < np.inf else whole),
        ):
            object.__setattr__(self, name, value)
        if self.wavelengths is not None:
            wavelengths = np.asarray(self.wavelengths, dtype=np.float64)
            if wavelengths.shape != (n,):
                raise InputError(f"wavelengths must be {n}, got {wavelengths.shape}")
            _refuse(~((wavelengths >= SHORTEST) & (wavelengths <= LONGEST)), f"a wavelength outside {SHORTEST:g} to {LONGEST:g} nm")
            object.__setattr__(self, "wavelengths", wavelengths)

    def turned(self, axes: Sequence[Sequence[float]] | np.ndarray) -> RaySet:
        """The rays after the rotation about the origin that takes x, y and z to these unit vectors."""
        positions, directions = (a @ np.asarray(axes) for a in (self.positions, self.directions))
        return replace(self, positions=positions, directions=directions)

    @property
    def count(self) -> int:
        """Number of rays."""
        return len(self.flux)

    @cached_property
    def digest(self) -> str:
        """sha256 of the rays, whatever the format of their file."""
        digest = hashlib.sha256()
        for values in (self.positions, self.directions, self.flux, self.wavelengths):
            digest.update(b"" if values is None else np.ascontiguousarray(values, "<f8").tobytes())
        return digest.hexdigest()

    def batch(self, k: int, of: int) -> RaySet:
        """The k-th batch of a fixed random partition of the rays into `of` sets; all rays where there are too few."""
        if self.count < LEAST_SHARED * of:
            return self
        mine = np.sort(np.random.default_rng(0).permutation(self.count)[k::of])
        wavelengths = None if self.wavelengths is None else self.wavelengths[mine]
        return RaySet(self.positions[mine], self.directions[mine], self.flux[mine], self.total, self.unit, wavelengths)

    @cached_property
    def forward(self) -> np.ndarray:
        """Flux of the rays towards +z, 0 for the others, (N,).

        Raises:
            InputError: there is none.
        """
        flux = np.where(self.directions[:, 2] > 0, self.flux, 0.0)
        if not flux.any():
            raise InputError("has no ray that carries light towards +z, the direction of emission here")
        return flux

    @cached_property
    def nearest(self) -> float:
        """Largest z of the starting points of rays that carry light towards +z, mm."""
        return float(self.positions[self.forward > 0, 2].max())

    @cached_property
    def focus(self) -> np.ndarray:
        """Point of closest approach c of the rays towards +z, weighted by flux, (3,) mm.

        For nearly parallel rays it is at most PARALLEL_AT from their mean starting point.
        """
        lit = self.forward > 0
        p, d, w = self.positions[lit], self.directions[lit], self.forward[lit] / self.forward.sum()
        mean = w @ p
        p = p - mean
        across = p - d * (p * d).sum(1)[:, None]
        normal = np.eye(3) - (d * w[:, None]).T @ d
        values, axes = np.linalg.eigh(normal)
        values = np.maximum(values, np.finfo(float).eps)
        off = axes @ ((axes.T @ (w @ across)) / values)
        axis = w @ d  # behind parallel rays, not before them
        size = float(np.linalg.norm(off))
        if values[0] < 1.0 / PARALLEL_AT**2 * max(1.0, float(w @ (p * p).sum(1))):
            off, size = -axis / np.linalg.norm(axis) * PARALLEL_AT, PARALLEL_AT
        return mean + off * min(1.0, PARALLEL_AT / size if size > 0 else 1.0)

    @cached_property
    def spread(self) -> tuple[float, float]:
        """Half widths along x and y of the beam waist: twice the root mean square distance from `focus` of the rays' intersections
        with its transverse plane, mm.  For an ellipse of uniform radiance these are its half axes.

        Rays are weighted by (cos theta)^4, since the depth of a source widens it for oblique rays.
        """
        lit = self.forward > 0
        p, d, c = self.positions[lit], self.directions[lit], self.focus
        w = self.forward[lit] * d[:, 2] ** 4
        sizes = []
        for k in (0, 1):
            off = p[:, k] + (c[2] - p[:, 2]) * d[:, k] / d[:, 2] - c[k]
            sizes.append(2.0 * float(np.sqrt(w @ (off * off) / w.sum())))
        return sizes[0], sizes[1]


def _refuse(wrong: np.ndarray, what: str) -> None:
    """Raise an error that names the first invalid ray."""
    if wrong.any():
        raise InputError(f"ray {int(np.argmax(wrong)) + 1} of {len(wrong):,} has {what}")
