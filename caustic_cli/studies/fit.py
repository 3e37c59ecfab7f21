"""Convergence orders by regression, and the Pareto front of error against cost.

Order k means error = C n^-k: minus the slope of the least-squares line through (log n, log error).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

#: Least number of settings for a fit: two always lie on a line, and leave no residual.
MIN_POINTS = 3


@dataclass(frozen=True)
class Order:
    """A fitted order: exponent k, its standard error of the regression, points used, and the range of n they cover."""

    exponent: float
    deviation: float
    points: int
    low: float
    high: float


def order(n: Sequence[float], error: Sequence[float], least: float = 0.0) -> Order | None:
    """Order k of error = C n^-k over the settings with n >= `least`, or over all if those are fewer than MIN_POINTS.

    Errors of exactly 0 are left out.  None when fewer than MIN_POINTS remain, or all n are equal.
    """
    n, error = np.asarray(n, float), np.asarray(error, float)
    use = error > 0
    if np.count_nonzero(use & (n >= least)) >= MIN_POINTS:
        use &= n >= least
    x, y = np.log(n[use]), np.log(error[use])
    if len(x) < MIN_POINTS or np.ptp(x) == 0:
        return None
    dx = x - x.mean()
    slope = float(dx @ y / (dx @ dx))
    residual = y - y.mean() - slope * dx
    deviation = float(np.sqrt(residual @ residual / (len(x) - 2) / (dx @ dx)))
    return Order(-slope, deviation, len(x), float(n[use].min()), float(n[use].max()))


def pareto(cost: Sequence[float], error: Sequence[float], gain: float = 0.0, alike: float = 0.0) -> list[bool]:
    """For every setting, whether it is Pareto optimal in cost and error; of identical settings, the first is.

    gain: relative reduction of the error that a more expensive setting must reach over the front, such as the noise of the errors.
    alike: relative difference below which costs count as equal; of such settings the one with the least error is on the front.
    """
    front: list[int] = []
    cheapest = 0.0  # of the settings that cost the same as the last on the front
    for k in sorted(range(len(cost)), key=lambda k: (cost[k], error[k])):
        if front and not error[k] < (1.0 - gain) * error[front[-1]]:
            continue
        if front and cost[k] < (1.0 + alike) * cheapest:
            front[-1] = k
        else:
            front.append(k)
            cheapest = cost[k]
    return [k in front for k in range(len(cost))]


def knee(cost: Sequence[float], error: Sequence[float], near: float = 0.25) -> int:
    """Index of the cheapest setting whose error exceeds the least by at most this fraction."""
    enough = (1.0 + near) * min(error)
    return min((k for k in range(len(cost)) if error[k] <= enough), key=lambda k: cost[k])
