"""The luminous intensity of a lamp in the angles of type C photometry, by independent rays.

Notation
    gamma   angle from the lamp's axis, +z, in which it shines: 0 to 180 degrees
    C       half plane about that axis, atan2(y, x): 0 to 360 degrees
    I       intensity, cd per 1000 lm of the chip

The value at a node of the table is the mean intensity over its cell, which reaches half a step to all sides: the power in the cell
over its solid angle.  So the sum of values times solid angles is the flux.  At the poles the cells of all planes are one cap,
and near them values are means over several planes.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
import torch
from scipy.ndimage import uniform_filter1d
from torch import Tensor

from caustic_cli.optics.lamp import LampLight
from caustic_cli.optics.surfaces.polarfield import PolarField
from caustic_cli.scene.lamp import Lamp
from caustic_cli.studies.lamp import RAYS, traced

#: Flux of the chip to which intensities refer, lm, and steps of gamma and C, degrees.
FLUX, STEPS = 1000.0, (1.0, 5.0)
#: Least length of the arc along C over which intensities are averaged, in steps of gamma.
ARC = 2.0


class IntensityTable(NamedTuple):
    """Intensities cd per 1000 lm of the chip, (planes, angles), at C and gamma, degrees, each (planes,) and (angles,)."""

    planes: np.ndarray
    angles: np.ndarray
    values: np.ndarray

    @property
    def solid_angles(self) -> np.ndarray:
        """Of the cells of the nodes, sr, (angles,): equal for all planes."""
        edges = np.radians(np.clip(np.append(self.angles, 180.0) - 0.5 * self.angles[1], 0.0, 180.0))
        edges[-1] = math.pi
        return -np.diff(np.cos(edges)) * 2.0 * math.pi / len(self.planes)

    @property
    def flux(self) -> float:
        """Total flux, lm per 1000 lm of the chip."""
        return float((self.values * self.solid_angles).sum())

    @property
    def figures(self) -> dict[str, Any]:
        """peak_candela, and beam_angles and field_angles in the planes C 0 - 180 and C 90 - 270, degrees: full angles of half and
        of a tenth of the peak in each."""
        planes = (0, len(self.planes) // 4)
        angles = {name: [self.full_angle(part, k) for k in planes] for name, part in (("beam", 0.5), ("field", 0.1))}
        return {"peak_candela": self.peak, **{f"{name}_angles": found for name, found in angles.items()}}

    @property
    def peak(self) -> float:
        """Largest intensity."""
        return float(self.values.max())

    def full_angle(self, fraction: float, plane: int) -> float:
        """Full angle, degrees, within which the intensity in a plane and the opposite one is at least this fraction of the peak in
        them: of 0.5 the beam angle, of 0.1 the field angle."""
        half = len(self.planes) // 2
        both = [self.values[plane % len(self.planes)], self.values[(plane + half) % len(self.planes)]]
        least = fraction * max(side.max() for side in both)
        return sum(self._last(side, least) for side in both)

    def _last(self, side: np.ndarray, least: float) -> float:
        """The largest angle, degrees, at which the intensity in a plane is `least`, by linear interpolation; 0 without one."""
        bright = np.flatnonzero(side >= least)
        if not len(bright):
            return 0.0
        k = int(bright[-1])
        part = (side[k] - least) / (side[k] - side[k + 1]) if k + 1 < len(side) else 0.0
        return float(self.angles[k] + part * self.angles[1])


class IntensitySum:
    """Sums light into the cells of a table; steps: of gamma and C, degrees, which divide 180 and 360."""

    def __init__(self, steps: tuple[float, float] = STEPS):
        self.steps = steps
        self.angles = np.linspace(0.0, 180.0, round(180.0 / steps[0]) + 1)
        self.planes = np.arange(round(360.0 / steps[1])) * steps[1]
        self.power = torch.zeros(len(self.planes) * len(self.angles), dtype=torch.float64)

    def add(self, light: LampLight) -> None:
        """Add the light of half of the rays, of `studies.lamp.traced`."""
        x, y, z = light.direction
        gamma = torch.rad2deg(torch.atan2((x * x + y * y).sqrt(), z))
        plane = torch.rad2deg(torch.atan2(y, x))
        k = (gamma / self.steps[0]).round().long()
        j = (plane / self.steps[1]).round().long() % len(self.planes)
        self.power.scatter_add_(0, j * len(self.angles) + k, light.power)

    def table(self) -> IntensityTable:
        """The intensities of the light of both halves."""
        found = 0.5 * FLUX * self.power.view(len(self.planes), len(self.angles)).numpy()
        found[:, [0, -1]] = found[:, [0, -1]].mean(0)  # the caps
        for k in range(1, len(self.angles) - 1):  # near the poles cells are narrow: arcs of ARC steps of gamma are averaged
            reach = round(0.5 * ARC * self.steps[0] / self.steps[1] / math.sin(math.radians(self.angles[k])))
            if reach:
                found[:, k] = uniform_filter1d(found[:, k], min(2 * reach + 1, len(self.planes)), mode="wrap")
        table = IntensityTable(self.planes, self.angles, found)
        return table._replace(values=found / table.solid_angles)


def intensity_table(
    lamp: Lamp, field: PolarField, values: Tensor, steps: tuple[float, float] = STEPS, rays: int = RAYS, seed: int = 0
) -> IntensityTable:
    """The table of a lamp; steps: as of `IntensitySum`."""
    found = IntensitySum(steps)
    for _, light in traced(lamp, field, values, rays, seed):
        found.add(light)
    return found.table()
