"""The solid of a lamp as a closed triangle mesh: the outer surface, the inner one, and between them the ring of the base or
a foot.

Both surfaces are sampled on rings of the stereographic disc with equal steps of rho, between points at the same angles; the
innermost ring is a single point on the axis.  Vertices run counter-clockwise seen from outside.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from caustic_cli.errors import InputError
from caustic_cli.export import obj, ply, stl
from caustic_cli.export.mesh import walls
from caustic_cli.optics.lamp import sides
from caustic_cli.optics.surfaces.polarfield import PolarField
from caustic_cli.scene.lamp import Lamp

#: Format -> suffix, writer of vertices (V, 3) mm and triangles (F, 3), description.
MESHES = {
    "stl": (".stl", stl.write_mesh, "closed mesh"),
    "ply": (".ply", ply.write_mesh, "closed mesh"),
    "obj": (".obj", obj.write_mesh, "closed mesh"),
}
#: Rings and points of a ring, unless given; and most of either.
SAMPLES, MOST = (150, 600), 4000
#: Points at which the greatest radius of a rim is looked for.
AROUND = 3600


def lamp_mesh(lamp: Lamp, field: PolarField, values: Tensor, samples: tuple[int, int] = SAMPLES) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (V, 3) float64 mm and triangles (F, 3) int64 of the solid.

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
    for points in (outer, inner):
        points[-around:, 2] = 0.0  # the rim lies in the base plane, but for rounding
    cap, count = _disc(rings, around), len(outer)
    vertices, faces = [outer, inner], [cap, cap[:, ::-1] + count]
    loop, end, total = np.arange(count - around, count), np.arange(2 * count - around, 2 * count), 2 * count
    for points in _foot(lamp, outer[-around:], inner[-around:], flange_radius(lamp, *both[0]), angle[:around]):
        following = np.arange(total, total + around)
        vertices.append(points)
        faces.append(walls(loop, following))
        loop, total = following, total + around
    return np.concatenate(vertices), np.concatenate([*faces, walls(loop, end)])


def surfaces_of(lamp: Lamp, field: PolarField, values: Tensor) -> tuple[tuple[PolarField, Tensor], tuple[PolarField, Tensor]]:
    """The outer and the inner surface with their control values."""
    inner, outer = sides(values.detach())
    sphere = PolarField.uniform((4, 4))
    return (field, outer), (sphere, sphere.sphere(lamp.inner)) if inner is None else (field, inner)


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


def write_lamp(path: Path, format: str, lamp: Lamp, field: PolarField, values: Tensor, samples: tuple[int, int] | None) -> None:
    """Write the solid in one of the formats of MESHES, atomically."""
    MESHES[format][1](path, *lamp_mesh(lamp, field, values, samples or SAMPLES))
