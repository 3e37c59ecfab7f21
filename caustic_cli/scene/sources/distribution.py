"""Angular intensity distributions: isotropic, Lambertian, or tabulated.

Notation
    theta      angle from +z, rad; theta_c half-angle of the emission cone
    I(theta)   relative radiant intensity, power per solid angle; linear between the angles of a table, 0 beyond the last
    F(theta)   flux, 2 pi times the integral of I sin theta from 0 to theta, in closed form

From theta_0 on, with t = theta - theta_0 and I = I_0 + b t, F grows by 2 pi (I_0 C + b M), where
C = cos theta_0 - cos theta = 2 sin(theta_0 + t / 2) sin(t / 2) and M = sin theta_0 (t sin t - 2 sin^2(t / 2)) + cos theta_0
(sin t - t cos t), both of which are evaluated by their series for small t.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from caustic_cli.errors import InputError

#: Largest number of angles of a table.
MOST_ANGLES = 100_000
#: Steps t below which M is evaluated by its series, whose first omitted term is then below a rounding, rad.
SMALL = 0.05
#: Most iterations of the safeguarded Newton method that inverts F.
STEPS = 60


@dataclass(frozen=True)
class Distribution:
    """A tabulated intensity distribution.

    Raises:
        InputError: a condition is violated, or there is no light within 90 degrees.
    """

    #: Ascending from 0 to at most 180, degrees; values beyond 90 are ignored.
    angles: tuple[float, ...]
    #: Relative intensity at each angle, not negative.
    values: tuple[float, ...]

    def __post_init__(self):
        angles, values = np.asarray(self.angles, dtype=float), np.asarray(self.values, dtype=float)
        if not 2 <= len(angles) <= MOST_ANGLES or len(values) != len(angles):
            raise InputError(
                f"must name 2 to {MOST_ANGLES:,} angles and an intensity for each, got {len(angles)} and {len(values)}"
            )
        if angles[0] != 0 or not (np.diff(angles) > 0).all() or not angles[-1] <= 180:
            raise InputError("must have angles that ascend from 0 to at most 180 degrees")
        if not (np.isfinite(values) & (values >= 0) & (values <= 1e300)).all():
            raise InputError("must have intensities that are finite, at least 0 and at most 1e300")
        if not values[angles < 90].any():
            raise InputError("must have light within 90 degrees of the axis")

    def flux(self, cone: float) -> float:
        """F(theta_c) for a cone of half-angle `cone`, rad.

        Raises:
            InputError: there is no light within it.
        """
        return float(_table(self, cone)[2][-1])

    def relative(self, angle: np.ndarray) -> np.ndarray:
        """I(theta) at angles, rad."""
        return np.interp(angle, np.radians(self.angles), self.values, right=0.0)

    def angle_of(self, part: np.ndarray, cone: float) -> np.ndarray:
        """Inverse of the cumulative flux: angles, rad, that enclose the fractions `part`, in [0, 1], of the flux into a cone."""
        angles, values, sums = _table(self, cone)
        wanted = np.clip(part, 0.0, 1.0) * sums[-1]
        k = np.clip(np.searchsorted(sums, wanted, side="right") - 1, 0, len(angles) - 2)
        rest, first, slope = wanted - sums[k], angles[k], (np.diff(values) / np.diff(angles))[k]
        low, high = np.zeros_like(rest), np.diff(angles)[k]
        t = high * np.clip(rest / np.maximum(np.diff(sums)[k], np.finfo(float).tiny), 0.0, 1.0)
        for _ in range(STEPS):
            off = 2.0 * math.pi * _grown(first, t, values[k], slope) - rest
            low, high = np.where(off <= 0, t, low), np.where(off >= 0, t, high)
            steep = 2.0 * math.pi * (values[k] + slope * t) * np.sin(first + t)
            ahead = t - off / np.where(steep > 0, steep, np.inf)
            middle = 0.5 * (low + high)
            stepped = np.where((steep > 0) & (ahead >= low) & (ahead <= high), ahead, middle)
            if np.abs(stepped - t).max(initial=0.0) <= 1e-15 * angles[-1]:
                break
            t = stepped
        return first + t


@lru_cache(maxsize=64)
def _table(given: Distribution, cone: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Angles of the table within a cone, rad, with intensities and F there."""
    angles = np.radians(given.angles)
    last = min(cone, angles[-1])
    angles = np.append(angles[angles < last], last)
    values = given.relative(angles)
    grown = _grown(angles[:-1], np.diff(angles), values[:-1], np.diff(values) / np.diff(angles))
    sums = np.append(0.0, np.cumsum(2.0 * math.pi * grown))
    if not sums[-1] > 0:
        raise InputError(f"⟨source.intensity⟩: there is no light within the cone of {math.degrees(cone):.4g} degrees")
    return angles, values, sums


def _grown(first: np.ndarray, t: np.ndarray, value: np.ndarray, slope: np.ndarray) -> np.ndarray:
    """I_0 C + b M: the increase of F / (2 pi) over a step t from angle `first`, with I_0 = value and b = slope."""
    s = t * t
    along = np.where(t < SMALL, s * (1 / 2 - s * (1 / 8 - s * (1 / 144 - s / 5760))), t * np.sin(t) - 2.0 * np.sin(0.5 * t) ** 2)
    across = np.where(t < SMALL, t * s * (1 / 3 - s * (1 / 30 - s * (1 / 840 - s / 45360))), np.sin(t) - t * np.cos(t))
    moment = np.sin(first) * along + np.cos(first) * across
    return 2.0 * value * np.sin(first + 0.5 * t) * np.sin(0.5 * t) + slope * moment


def relative(intensity: str | Distribution, tangent: np.ndarray) -> np.ndarray | float:
    """Relative intensity in directions whose angles to the axis have these tangents."""
    if isinstance(intensity, Distribution):
        return intensity.relative(np.arctan(tangent))
    return 1.0 / np.sqrt(1.0 + tangent * tangent) if intensity == "lambertian" else 1.0
