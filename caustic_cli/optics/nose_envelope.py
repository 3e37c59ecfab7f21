"""The surface that a round nose leaves on a part that turns: the lowest of its arcs in each section through the axis.

Notation
    C           angle of the tool around the axis, radians, increasing;  X, Z  of the lowest point of the nose, mm, linear in C
    R           radius of the nose, mm;  rho, theta  polar coordinates of a point of the surface

In the section at theta the nose stands at C = theta + 2 pi k with X(C), and across the axis at C = theta + pi + 2 pi k with -X(C):
z = Z + R - sqrt(R^2 - (rho -+ X)^2), the least over k.  The turns must approach the axis steadily.
"""

from __future__ import annotations

import math

import numpy as np

from caustic_cli.errors import InputError

#: Turns to either side of that at rho which are compared: cusps lie between neighbours.
BESIDE = 2


class NoseEnvelope:
    """The surface left by a nose of a radius, mm, along points (k, 3) of X, mm, C, radians, and Z, mm.

    Raises:
        InputError: the tool does not move steadily towards the axis.
    """

    def __init__(self, radius: float, path: np.ndarray):
        ahead = np.concatenate([[True], np.diff(path[:, 1]) > 0.0])
        self.radius, (self.x, self.c, self.z) = radius, path[ahead].T.copy()
        if len(self.c) < 2 or (np.diff(self.x) > 0.0).any() or (np.diff(path[:, 1]) < 0.0).any():
            raise InputError("a program for a lathe must move its tool towards the axis, with C increasing")

    def surface(self, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Heights, mm, and slopes along x and y at points (N,) mm."""
        rho, theta = np.hypot(x, y), np.arctan2(y, x)
        z, along, around = (np.full(rho.shape, v) for v in (math.inf, 0.0, 0.0))
        for side, at in ((1.0, theta), (-1.0, theta + math.pi)):
            near = np.interp(-side * rho, -self.x, self.c)  # where X is there; beyond the axis at the end
            first = np.rint((near - at) / (2.0 * math.pi))
            for k in range(-BESIDE, BESIDE + 1):
                found = self._arc(rho, at + 2.0 * math.pi * (first + k), side)
                lower = found[0] < z
                z, along, around = (np.where(lower, new, own) for new, own in zip(found, (z, along, around), strict=True))
        over = around / np.maximum(rho, 1e-12)
        return z, along * np.cos(theta) - over * np.sin(theta), along * np.sin(theta) + over * np.cos(theta)

    def _arc(self, rho: np.ndarray, c: np.ndarray, side: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Of the nose at C: height, and its derivatives by rho and theta; infinite where it does not stand or reach."""
        k = np.clip(np.searchsorted(self.c, c, "right") - 1, 0, len(self.c) - 2)
        step = self.c[k + 1] - self.c[k]
        part = (c - self.c[k]) / step
        dx, dz = (self.x[k + 1] - self.x[k]) / step, (self.z[k + 1] - self.z[k]) / step
        off = rho - side * (self.x[k] + part * step * dx)
        root = np.sqrt(np.maximum(self.radius**2 - off * off, 1e-300))
        z = self.z[k] + part * step * dz + self.radius - root
        stands = (part >= -1e-9) & (part <= 1.0 + 1e-9) & (np.abs(off) < self.radius)
        return np.where(stands, z, math.inf), off / root, dz - side * dx * off / root
