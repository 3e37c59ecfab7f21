"""Light of an array of lamps: behind the lens of each as behind that of one, displaced by its place.

Light that meets the lens of another lamp is booked as lost to `neighbours`: where it goes from there is not followed.
"""

from __future__ import annotations

import itertools
import math

import numpy as np
import torch
from torch import Tensor

from caustic_cli.optics.lamp import LampLight, sides
from caustic_cli.optics.surfaces.polarfield import PolarField, Vectors, stereographic
from caustic_cli.scene.lamp import Goal, Lamp

#: Points of a ray within the ball around a neighbour at which it is tested against its surface.
PROBES = 32
#: Largest angle from the axis for which a distance is given, degrees.
STEEPEST = 85.0


def clear_pitch(lamp: Lamp, goal: Goal) -> tuple[float, float]:
    """Distances of lamps along x and y, mm, at which all light for the target passes the neighbours.

    Of the light that leaves the upper half of a ball of radius R at an angle t from the axis, that of the rim passes R cos t below
    its centre; the ball around a neighbour at the distance p reaches up to p cos t - R below it: p = R (1 + 1 / cos t).
    """
    tangents = [math.tan(math.radians(min(0.5 * a, STEEPEST))) for a in goal.angles] if goal.far else goal.slopes
    across, along = (lamp.radius * (1.0 + math.hypot(1.0, t)) for t in tangents)
    return across, along


def among(lamp: Lamp, field: PolarField, values: Tensor, light: LampLight, rng: np.random.Generator) -> LampLight:
    """The light of an array from that behind the lens of one lamp, each ray of a lamp drawn at random."""
    which = torch.from_numpy(rng.integers(lamp.count, size=len(light.power)))
    blocked = meets_neighbour(lamp, field, sides(values)[1], light, which)
    at = torch.from_numpy(lamp.places)[which]
    (x, y, z), zero = light.point, torch.zeros_like(light.power)
    return light._replace(
        point=(x + at[:, 0], y + at[:, 1], z),
        power=torch.where(blocked, zero, light.power),
        lost=light.lost | {"neighbours": torch.where(blocked, light.power, zero)},
    )


def meets_neighbour(lamp: Lamp, field: PolarField, outer: Tensor, light: LampLight, which: Tensor) -> Tensor:
    """Whether light from a lamp of these numbers (N,) meets the free-form surface of another one.

    outer: its control values (n, m) mm.
    """
    radius, found = field.extent(outer)[1], torch.zeros_like(light.power, dtype=torch.bool)
    (x, y, z), (dx, dy, dz) = light.point, light.direction
    # It rises above all lenses within the distance to the nearest ball around another one, unless it is flat.
    nearest = min(p for n, p in zip(lamp.array, lamp.pitch, strict=True) if n > 1) - radius - (x * x + y * y).sqrt()
    flat = ((light.power > 0) & (dz > 0) & (nearest * dz < (radius - z) * (dx * dx + dy * dy).sqrt())).nonzero()[:, 0]
    if not len(flat):
        return found
    row, column = which[flat] // lamp.array[1], which[flat] % lamp.array[1]
    for i, j in itertools.product(*(range(1 - n, n) for n in lamp.array)):
        there = (row + i >= 0) & (row + i < lamp.array[0]) & (column + j >= 0) & (column + j < lamp.array[1])
        own = flat[there] if (i, j) != (0, 0) else flat[:0]
        start = (x[own] - i * lamp.pitch[0], y[own] - j * lamp.pitch[1], z[own])
        found[own] |= _meets(field, outer, radius, start, (dx[own], dy[own], dz[own]))
    return found


def _meets(field: PolarField, outer: Tensor, radius: float, origin: Vectors, direction: Vectors) -> Tensor:
    """Whether rays from outside lie within a surface at one of PROBES points of their way through the ball around it."""
    (ox, oy, oz), (dx, dy, dz) = origin, direction
    along = ox * dx + oy * dy + oz * dz
    square = along * along - (ox * ox + oy * oy + oz * oz) + radius * radius
    near = ((square > 0) & (along < 0)).nonzero()[:, 0]
    found = torch.zeros_like(square, dtype=torch.bool)
    if len(near):
        half, middle = square[near].sqrt(), -along[near]
        for k in range(PROBES):
            t = middle + half * ((2 * k + 1) / PROBES - 1.0)
            x, y, z = (o[near] + t * d[near] for o, d in zip(origin, direction, strict=True))
            r = field.net.evaluate(outer, *stereographic(x, y, z))[0]
            found[near] |= (t > 0) & (z >= 0) & (x * x + y * y + z * z < r * r)
    return found
