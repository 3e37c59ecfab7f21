"""Cutter-location surfaces of tools that come along the radius of a cylinder: the least distance of the tip from the axis at which
the tool does not gouge the panels on it (`export.panels`, whose notation is used).

A ball of radius R: with the height C(a, b) of its centre above a panel's plane (`offset`) no ball above it cuts into the panel,
from whatever side it comes, so that its surface also bounds the centres of balls that come along the radius.  Of several panels the
highest counts.

A flat end of radius R stands on the highest point under it, whose height along the tool is rho cos(theta' - theta) and its distance
from the tool's axis at least the hypotenuse of a' - a and rho_min sin(theta' - theta).  It is looked for among samples rho(a,
theta); a bound between samples is added.
"""

from __future__ import annotations

import math

import numpy as np

from caustic_cli.export.milling.offset import BallOffset, dilated, steps_of
from caustic_cli.export.panels import Panels, level


def _wrapped(theta: np.ndarray) -> np.ndarray:
    """Angles within -pi and pi."""
    return (theta + math.pi) % (2.0 * math.pi) - math.pi


class RadialBall:
    """Of a ball, mm; s = R_0 theta."""

    def __init__(self, panels: Panels, radius: float, allowance: float = 0.0):
        self.panels, self.radius, self.room = panels, radius, radius + allowance
        offsets = {id(side[1]): BallOffset(*side, self.room) for side in panels.unlike}
        self.offsets = [offsets[id(side[1])] for side in panels.sides]
        touches = panels.turn + math.asin(min(1.0, self.room / panels.low))
        #: Largest angle at which a ball touches a panel.
        self.reach = min(touches, 0.5 * math.pi * (1.0 - 1e-6))

    def __call__(self, along: np.ndarray, s: np.ndarray) -> np.ndarray:
        """(N,) mm at a, s (N,) mm; NaN where the ball does not touch the surface."""
        cylinder, found = self.panels.cylinder, np.full(len(s), np.nan)
        for k, offset in enumerate(self.offsets):
            theta = _wrapped(s / cylinder.radius - self.panels.angle(k))
            near = np.abs(theta) <= self.reach

            def centre(x: np.ndarray, y: np.ndarray, offset: BallOffset = offset) -> np.ndarray:
                return offset(x, y) + self.room

            far = cylinder.distance(centre, along[near], theta[near], cylinder.radius + self.room)
            found[near] = np.fmax(found[near], far)
        return found - self.radius


class RadialFlat:
    """Of a flat end, an upper bound; arguments as of `RadialBall`."""

    def __init__(self, panels: Panels, radius: float, allowance: float = 0.0):
        self.panels, cylinder = panels, panels.cylinder
        turn = panels.sector if panels.closed else panels.turn
        spaces = panels.sides[0][0].spaces
        rows, columns = (
            steps_of(spaces[axis], length, radius)
            for axis, length in ((cylinder.bent, 2.0 * cylinder.radius * turn), (1 - cylinder.bent, 2.0 * panels.half))
        )
        #: First row, and the angle and length between samples.
        self.first, self.step = -turn, np.array([2.0 * turn / rows, 2.0 * panels.half / columns])
        theta = np.linspace(-turn, turn, rows + 1)[: rows if panels.closed else rows + 1]
        along = np.linspace(-panels.half, panels.half, columns + 1)
        maps = {id(side[1]): panels.distances(level(side), theta, along) for side in panels.unlike}
        rho = np.concatenate([maps[id(side[1])] for side in panels.sides])
        self.rows, low, half = len(rho), float(rho.min()), 0.5 * math.hypot(float(rho.max()) * self.step[0], self.step[1])
        # the nearest sample of a point under the tool, on its own side of a mitre, and its axis in a cell
        reach = radius + 3.0 * half
        count = int(math.asin(min(1.0, reach / low)) / self.step[0]) + 1
        turns = np.arange(count) * self.step[0]
        chords = np.sqrt(np.maximum(0.0, reach**2 - (low * np.sin(turns)) ** 2)) / self.step[1]
        self.beside = np.array([count, int(chords[0]) + 1])
        rho = np.pad(rho, ((count, count), (0, 0)), **({"mode": "wrap"} if panels.closed else {"constant_values": -np.inf}))
        rho = np.pad(rho, ((0, 0), (self.beside[1],) * 2), constant_values=-np.inf)
        lean = np.cos(np.maximum(0.0, turns - 2.0 * self.step[0]))
        self.highest = dilated(rho, chords.astype(int).tolist(), lean.tolist())
        self.more = 2.0 * half * panels.slope + allowance

    def __call__(self, along: np.ndarray, s: np.ndarray) -> np.ndarray:
        """As of `RadialBall`."""
        turn = s / self.panels.cylinder.radius - self.first
        row = np.rint(turn % (2.0 * math.pi) / self.step[0]) % self.rows if self.panels.closed else np.rint(turn / self.step[0])
        at = np.stack([row, np.rint((along + self.panels.half) / self.step[1])], -1).astype(int) + self.beside
        outside = ((at < 0) | (at >= self.highest.shape)).any(1)
        i, j = np.where(outside[:, None], 0, at).T
        found = self.highest[i, j] + self.more
        found[outside | ~np.isfinite(found)] = np.nan
        return found
