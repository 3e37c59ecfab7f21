"""The solid of a lamp as a closed triangle mesh: the outer surface, the inner one, and between them the ring of the base or
a foot.

Both surfaces are sampled on rings of the unit disc over which they lie, with equal steps of rho, between points at the same angles;
the innermost ring is a single point on the axis.  Vertices run counter-clockwise seen from outside.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Sequence

import numpy as np
import torch
from torch import Tensor

from caustic_cli.errors import InputError
from caustic_cli.export.mesh import walls
from caustic_cli.optics.lamp import surfaces_of
from caustic_cli.optics.lamp_side import InnerSide, PolarSide
from caustic_cli.optics.surfaces.polarfield import PolarField
from caustic_cli.scene.lamp import Lamp

#: Rings and points of a ring, unless given; and most of either.
SAMPLES, MOST = (150, 600), 4000
#: Points at which the greatest radius of a rim is looked for.
AROUND = 3600
#: Points of a ring of an array are a multiple of this, so that those of adjacent cells coincide; and points per mm that are told
#: apart.
FOLD, SAME = 4, 1e7


#: Vertices (V, 3) mm, triangles (F, 3), counter-clockwise seen from outside, and unit normals (V, 3) out of the glass, or None.
Part = tuple[np.ndarray, np.ndarray, np.ndarray | None]


def lamp_mesh(lamp: Lamp, field: PolarField, values: Tensor, samples: tuple[int, int] = SAMPLES) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (V, 3) float64 mm and triangles (F, 3) int64 of the solid; arguments and errors as in `lamp_parts`."""
    if lamp.count > 1:
        return merged(lamp_parts(lamp, field, values, samples))
    (inner, cap, _), (outer, top, _), (foot, strips, _) = lamp_parts(lamp, field, values, samples)
    around, count = samples[1], len(outer)
    rims = (np.arange(k * count - around, k * count) for k in (1, 2))
    between = 2 * count + np.arange(len(foot) - 2 * around)
    number = np.concatenate([next(rims), between, next(rims)])
    return np.concatenate([outer, inner, foot[around:-around]]), np.concatenate([top, cap + count, number[strips]])


def lamp_parts(lamp: Lamp, field: PolarField, values: Tensor, samples: tuple[int, int] = SAMPLES) -> tuple[Part, Part, Part]:
    """The inner surface, the outer one, and the foot between them, from the loop of the outer rim to that of the inner one; of an
    array those of all lamps, and its board.

    Args:
        samples: rings, and points of each.

    Raises:
        InputError: too few or too many samples, of an array also if the points of a ring are not a multiple of FOLD.
    """
    rings, around = samples
    if lamp.count > 1 and around % FOLD:
        raise InputError(f"⟨samples⟩ of an array of lamps must have a multiple of {FOLD} points on a ring, got {around}")
    if not (2 <= rings <= MOST and 3 <= around <= MOST):
        raise InputError(f"⟨samples⟩ of a lamp must be 2 to {MOST} rings of 3 to {MOST} points, got {rings} x {around}")
    rho = np.repeat(np.arange(1, rings + 1) / rings, around)
    angle = np.tile(2.0 * math.pi * np.arange(around) / around, rings)
    u, v = (torch.from_numpy(np.concatenate([[0.0], rho * f(angle)])) for f in (np.cos, np.sin))
    both = surfaces_of(lamp, field, values)
    outer, inner = (np.stack([c.numpy() for c in side.points(u, v)], 1) for side in both)
    outward, inward = (np.stack([c.numpy() for c in side.normals(u, v)], 1) for side in both)
    for points, side in zip((outer, inner), both, strict=True):
        points[-around:, 2] = side.rim  # the rim lies in a plane, but for rounding
    cap = _disc(rings, around)
    if lamp.count > 1:
        board = _board(lamp, outer[-around:], inner[-around:], angle[:around])
        return _tiled(lamp, (inner, cap[:, ::-1], -inward)), _tiled(lamp, (outer, cap, outward)), board
    between = _foot(lamp, outer[-around:], inner[-around:], flange_radius(lamp, both[0]), angle[:around])
    loops = [outer[-around:], *between, inner[-around:]]
    number = np.arange(len(loops) * around).reshape(len(loops), around)
    foot = np.concatenate([walls(one, other) for one, other in itertools.pairwise(number)])
    return (inner, cap[:, ::-1], -inward), (outer, cap, outward), (np.concatenate(loops), foot, None)


def merged(parts: Sequence[Part]) -> tuple[np.ndarray, np.ndarray]:
    """Vertices and triangles of parts that meet at common points, within 1 / SAME mm."""
    points = np.concatenate([points for points, _, _ in parts])
    starts = np.cumsum([0, *(len(points) for points, _, _ in parts)])
    faces = np.concatenate([faces + start for (_, faces, _), start in zip(parts, starts, strict=False)])
    _, first, number = np.unique(np.rint(points * SAME).astype(np.int64), axis=0, return_index=True, return_inverse=True)
    return points[first], number.reshape(-1)[faces]


def _tiled(lamp: Lamp, part: Part) -> Part:
    """A part of one lamp at the places of all."""
    points, faces, normals = part
    moved = [points + np.array([x, y, 0.0]) for x, y in lamp.places]
    return (
        np.concatenate(moved),
        np.concatenate([faces + k * len(points) for k in range(lamp.count)]),
        None if normals is None else np.tile(normals, (lamp.count, 1)),
    )


def _board(lamp: Lamp, rim: np.ndarray, hole: np.ndarray, angle: np.ndarray) -> Part:
    """The board of an array around the rims of its lamps, with an opening below each: a cell for each lamp."""
    around, down, half = len(angle), np.array([0.0, 0.0, lamp.base]), lamp.board
    points, faces, number = [], [], np.arange(5 * around).reshape(5, around)
    for x, y in lamp.places:
        ends = []
        for c, n, p, edge in zip((x, y), lamp.array, lamp.pitch, half, strict=True):
            last = 0.5 * p * (n - 1) - 1e-9 * p
            ends.append((-edge - c if c <= -last else -0.5 * p, edge - c if c >= last else 0.5 * p))
        border, sides = _on_cell(ends, angle)
        at, start = np.array([x, y, 0.0]), len(points) * 5 * around
        points.append(at + np.concatenate([rim, border, border - down, _opening(lamp, hole), hole]))
        top, outer, low, below, inner = number + start
        faces += [walls(top, outer), walls(low, below), walls(below, inner)]
        outside = np.array([abs(abs((x, y)[axis] + ends[axis][way]) - half[axis]) < 1e-9 * half[axis] for axis, way in sides])
        faces.append(walls(outer, low)[np.tile(outside, 2)])
    return np.concatenate(points), np.concatenate(faces), None


def _on_cell(ends: Sequence[tuple[float, float]], angle: np.ndarray) -> tuple[np.ndarray, list[tuple[int, int]]]:
    """Points (N, 3) at these angles on the border of a rectangle around the origin, of which the nearest ones lie in its corners;
    and of the border behind each the axis to which its side is perpendicular, and whether that is at the lower or the upper end.

    ends: of the rectangle, along x and along y.
    """
    d = np.stack([np.cos(angle), np.sin(angle)], 1)
    reach = np.array([[end[int(c >= 0)] for end, c in zip(ends, row, strict=True)] for row in d])
    with np.errstate(divide="ignore"):
        border = d * np.where(np.abs(d) > 1e-12, reach / d, np.inf).min(1)[:, None]
    for x in ends[0]:
        for y in ends[1]:
            k = int(np.argmax(d @ (np.array([x, y]) / math.hypot(x, y)) + 1e-9 * abs(d[:, 0])))  # as mirrored
            border[k] = (x, y)
    sides = []
    for one, other in zip(border, np.roll(border, -1, 0), strict=True):
        axis, way = next(
            (axis, way)
            for axis, end in enumerate(ends)
            for way in (0, 1)
            if abs(one[axis] - end[way]) < 1e-9 * abs(end[way]) and abs(other[axis] - end[way]) < 1e-9 * abs(end[way])
        )
        sides.append((axis, way))
    return np.append(border, np.zeros((len(angle), 1)), 1), sides


def rim_points(side: InnerSide, angle: np.ndarray) -> np.ndarray:
    """Points (N, 2) mm of the rim of a side, seen along the axis."""
    x, y, _ = side.points(*(torch.from_numpy(f(angle)) for f in (np.cos, np.sin)))
    return np.stack([x.numpy(), y.numpy()], 1)


def flange_radius(lamp: Lamp, outer: PolarSide) -> float:
    """Radius of the flange, mm: its width beyond the greatest radius of the rim."""
    angle = 2.0 * math.pi * np.arange(AROUND) / AROUND
    return lamp.flange + float(np.linalg.norm(rim_points(outer, angle), axis=1).max())


def _foot(lamp: Lamp, rim: np.ndarray, hole: np.ndarray, radius: float, angle: np.ndarray) -> Iterator[np.ndarray]:
    """Loops of points (k, 3) between the rim of the outer surface and that of the inner one: a flange of this radius, lower edge,
    opening; at the angles of the rim."""
    down, opening = np.array([0.0, 0.0, lamp.base]), _opening(lamp, hole)
    if lamp.flange > 0:
        rim = radius * np.stack([np.cos(angle), np.sin(angle), 0.0 * angle], 1)
        yield rim
    if lamp.base > 0:
        yield rim - down
    if (opening != hole).any():
        yield opening


def _opening(lamp: Lamp, hole: np.ndarray) -> np.ndarray:
    """The rim of the inner side (k, 3), projected onto the lower side of the base."""
    return np.column_stack([hole[:, :2], np.full(len(hole), -lamp.base)])


def _disc(rings: int, around: int) -> np.ndarray:
    """Triangles of a disc of rings about point 0, counter-clockwise seen from +z: (F, 3)."""
    k = np.arange(around)
    ahead = np.roll(k, -1)
    parts = [np.stack([np.zeros_like(k), 1 + k, 1 + ahead], 1)]
    for ring in range(1, rings):
        low, high = 1 + (ring - 1) * around, 1 + ring * around
        parts += [np.stack([low + k, high + k, high + ahead], 1), np.stack([low + k, high + ahead, low + ahead], 1)]
    return np.concatenate(parts)
