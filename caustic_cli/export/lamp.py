"""The solid of a lamp as a closed triangle mesh: the outer surface, the inner one, and between them the ring of the base or
a foot.

Both surfaces are sampled on rings of the stereographic disc with equal steps of rho, between points at the same angles; the
innermost ring is a single point on the axis.  Vertices run counter-clockwise seen from outside.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator

import numpy as np
import torch
from torch import Tensor

from caustic_cli.errors import InputError
from caustic_cli.export.mesh import walls
from caustic_cli.optics.lamp import surfaces_of
from caustic_cli.optics.surfaces.polarfield import PolarField
from caustic_cli.scene.lamp import Lamp

#: Rings and points of a ring, unless given; and most of either.
SAMPLES, MOST = (150, 600), 4000
#: Points at which the greatest radius of a rim is looked for.
AROUND = 3600


#: Vertices (V, 3) mm, triangles (F, 3), counter-clockwise seen from outside, and unit normals (V, 3) out of the glass, or None.
Part = tuple[np.ndarray, np.ndarray, np.ndarray | None]


def lamp_mesh(lamp: Lamp, field: PolarField, values: Tensor, samples: tuple[int, int] = SAMPLES) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (V, 3) float64 mm and triangles (F, 3) int64 of the solid; arguments and errors as in `lamp_parts`."""
    (inner, cap, _), (outer, top, _), (foot, strips, _) = lamp_parts(lamp, field, values, samples)
    around, count = samples[1], len(outer)
    rims = (np.arange(k * count - around, k * count) for k in (1, 2))
    between = 2 * count + np.arange(len(foot) - 2 * around)
    number = np.concatenate([next(rims), between, next(rims)])
    return np.concatenate([outer, inner, foot[around:-around]]), np.concatenate([top, cap + count, number[strips]])


def lamp_parts(lamp: Lamp, field: PolarField, values: Tensor, samples: tuple[int, int] = SAMPLES) -> tuple[Part, Part, Part]:
    """The inner surface, the outer one, and the foot between them, from the loop of the outer rim to that of the inner one.

    Args:
        samples: rings, and points of each.

    Raises:
        InputError: too few or too many samples.
    """
    rings, around = samples
    if not (2 <= rings <= MOST and 3 <= around <= MOST):
        raise InputError(f"⟨samples⟩ of a lamp must be 2 to {MOST} rings of 3 to {MOST} points, got {rings} x {around}")
    rho = np.repeat(np.arange(1, rings + 1) / rings, around)
    angle = np.tile(2.0 * math.pi * np.arange(around) / around, rings)
    u, v = (torch.from_numpy(np.concatenate([[0.0], rho * f(angle)])) for f in (np.cos, np.sin))
    both = surfaces_of(lamp, field, values)
    outer, inner = (np.stack([c.numpy() for c in own.points(net, u, v)], 1) for own, net in both)
    outward, inward = (np.stack([c.numpy() for c in own.normals(net, u, v)], 1) for own, net in both)
    for points in (outer, inner):
        points[-around:, 2] = 0.0  # the rim lies in the base plane, but for rounding
    cap = _disc(rings, around)
    between = _foot(lamp, outer[-around:], inner[-around:], flange_radius(lamp, *both[0]), angle[:around])
    loops = [outer[-around:], *between, inner[-around:]]
    number = np.arange(len(loops) * around).reshape(len(loops), around)
    foot = np.concatenate([walls(one, other) for one, other in itertools.pairwise(number)])
    return (inner, cap[:, ::-1], -inward), (outer, cap, outward), (np.concatenate(loops), foot, None)


def rim_points(field: PolarField, values: Tensor, angle: np.ndarray) -> np.ndarray:
    """Points (N, 3) mm of a surface in the plane of the chip."""
    x, y, _ = field.points(values, *(torch.from_numpy(f(angle)) for f in (np.cos, np.sin)))
    return np.stack([x.numpy(), y.numpy(), np.zeros(len(angle))], 1)


def flange_radius(lamp: Lamp, field: PolarField, values: Tensor) -> float:
    """Radius of the flange, mm: its width beyond the greatest radius of the rim."""
    angle = 2.0 * math.pi * np.arange(AROUND) / AROUND
    return lamp.flange + float(np.linalg.norm(rim_points(field, values, angle), axis=1).max())


def _foot(lamp: Lamp, rim: np.ndarray, hole: np.ndarray, radius: float, angle: np.ndarray) -> Iterator[np.ndarray]:
    """Loops of points (k, 3) between the rim of the outer surface and that of the inner one: a flange of this radius, lower edge,
    opening; at the angles of the rim."""
    down = np.array([0.0, 0.0, lamp.base])
    if lamp.flange > 0:
        rim = radius * np.stack([np.cos(angle), np.sin(angle), 0.0 * angle], 1)
        yield rim
    if lamp.base > 0:
        yield rim - down
        yield hole - down


def _disc(rings: int, around: int) -> np.ndarray:
    """Triangles of a disc of rings about point 0, counter-clockwise seen from +z: (F, 3)."""
    k = np.arange(around)
    ahead = np.roll(k, -1)
    parts = [np.stack([np.zeros_like(k), 1 + k, 1 + ahead], 1)]
    for ring in range(1, rings):
        low, high = 1 + (ring - 1) * around, 1 + ring * around
        parts += [np.stack([low + k, high + k, high + ahead], 1), np.stack([low + k, high + ahead, low + ahead], 1)]
    return np.concatenate(parts)
