"""What accuracy costs: the error of a lens against time and processor time, measured while its design runs.

The error is judged by light that the optimiser does not use, as that of the finished lens is, but with less of it: see
`kinds.OneSurface.error_of`.  These measurements are not part of the times.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterable, Sequence
from typing import Any, NamedTuple

import numpy as np

#: Rows at the end of a design whose slope gives the price of a smaller error; the reduction that is priced; and the exponent of the
#: error in time below which it no longer decreases.
LATEST, LESS, FLAT = 4, 0.1, 0.02
#: Measurements between the first and the last are left out once all took longer than these seconds and this part of the design's.
ALLOWED, PART = 3.0, 0.5


class Start(NamedTuple):
    """When a design was begun, by the clocks of wall time and of processor time, s."""

    wall: float
    processor: float

    @classmethod
    def now(cls) -> Start:
        """This moment."""
        return cls(time.monotonic(), time.process_time())

    @property
    def seconds(self) -> float:
        """Wall time since, s."""
        return time.monotonic() - self.wall

    @property
    def processor_seconds(self) -> float:
        """Processor time of this process since, of all its threads, s."""
        return time.process_time() - self.processor


class Row(NamedTuple):
    """The error after an iteration, and wall and processor time from the beginning of the design until then, s."""

    iteration: int
    seconds: float
    processor_seconds: float
    error: float


def iterations_to_measure(total: int, count: int) -> frozenset[int]:
    """`count` iterations from 0 to `total`, in geometric progression as far as these differ; all of them if they are fewer."""
    chosen = {0, total, *(round(total ** (k / max(1, count - 2))) for k in range(count - 1))}
    others = (k for k in range(total) if k not in chosen)
    while len(chosen) < min(count, total + 1):
        chosen.add(next(others))
    return frozenset(chosen)


class CostOfAccuracy:
    """Measures the error of a running design, and keeps the rows.

    error_of: the error of a lens, None where there is none; total: iterations expected; count: rows wanted; earlier: the rows of
    the run that is resumed, if any.
    """

    def __init__(self, start: Start, error_of: Callable[[Any], float | None], total: int, count: int, earlier: Iterable[Row]):
        self.start, self.error_of, self.due = start, error_of, iterations_to_measure(total, count)
        self.rows = list(earlier)
        before = self.rows[-1] if self.rows else Row(0, 0.0, 0.0, 0.0)
        self._offset = before.seconds, before.processor_seconds  # less what the measurements took
        self._begun = start.seconds, start.processor_seconds
        self._spent = 0.0

    def measure(self, iteration: int, lens: Any, always: bool = False) -> list[Row]:
        """Measure the lens after an iteration, unless that was done or, without `always`, takes too long; all rows."""
        late = self._spent > max(ALLOWED, PART * (self._offset[0] + self.start.seconds))
        if (always or not late) and (not self.rows or self.rows[-1].iteration < iteration):
            wall, processor = (a + b for a, b in zip(self._offset, (self.start.seconds, self.start.processor_seconds), strict=True))
            if (error := self.error_of(lens)) is not None:
                # the initial lens is measured when its objective is ready, which its iterations take the time of
                self.rows.append(Row(iteration, *(self._begun if iteration == 0 else (wall, processor)), error))
            self._spent += self._offset[0] + self.start.seconds - wall
            self._offset = wall - self.start.seconds, processor - self.start.processor_seconds
        return self.rows


class Aim(NamedTuple):
    """An independent error at which a design ends; and seconds that further iterations of its last stage may take to reach it."""

    error: float
    seconds: float

    def closer(self, judged: float) -> Aim:
        """The aim of a design that ended for this one and was judged to have a larger error by more light."""
        return self._replace(error=self.error * self.error / judged)


def seconds_to(rows: Sequence[Row], error: float) -> float | None:
    """Further seconds until an error is reached, extrapolated from the last rows: a power of the time from the initial lens;
    infinite where it no longer decreases, None for fewer than three rows."""
    if len(rows) < 3:
        return None
    first = rows[0]
    latest = [row for row in rows[-LATEST:] if row.seconds > first.seconds]
    spent = np.array([row.seconds - first.seconds for row in latest])
    errors = np.array([row.error for row in latest])
    if len(latest) < 2 or not (errors > 0).all():
        return None
    exponent = -float(np.polyfit(np.log(spent), np.log(errors), 1)[0])
    if exponent < FLAT:
        return math.inf
    return float(spent[-1]) * math.expm1(max(0.0, math.log(errors[-1] / error)) / exponent)


def price(rows: Sequence[Row]) -> str:
    """What a smaller error would cost, see `seconds_to`, in one sentence; "" for fewer than three rows."""
    more = seconds_to(rows, (1.0 - LESS) * rows[-1].error) if rows else None
    if more is None:
        return ""
    if math.isinf(more):
        return f"Further iterations of these stages would not lower the error of {rows[-1].error:.3g}."
    return f"The next {LESS:.0%} of the error of {rows[-1].error:.3g} would cost about {more:.2g} s more in these stages."


def as_table(rows: Iterable[Row]) -> list[dict[str, Any]]:
    """The rows for JSON."""
    return [row._asdict() for row in rows]
