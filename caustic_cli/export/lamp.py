"""The solid of a lamp as a closed triangle mesh: the outer surface, the inner one and the ring of the base between them.

Both surfaces are sampled on rings of the stereographic disc with equal steps of rho, between points at the same angles; the
innermost ring is a single point on the axis.  Vertices run counter-clockwise seen from outside.
"""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from caustic_cli.errors import InputError
from caustic_cli.export import obj, ply, stl
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
    inside, free = sides(values.detach())
    inside = field.sphere(lamp.inner) if inside is None else inside
    outer, inner = (np.stack([c.numpy() for c in field.points(net, u, v)], 1) for net in (free, inside))
    for points in (outer, inner):
        points[-around:, 2] = 0.0  # the rim lies in the base plane, but for rounding
    cap, count = _disc(rings, around), len(outer)
    rim = np.arange(count - around, count)
    following = np.roll(rim, -1)
    base = np.concatenate([np.stack([following, rim, rim + count], 1), np.stack([following, rim + count, following + count], 1)])
    return np.concatenate([outer, inner]), np.concatenate([cap, cap[:, ::-1] + count, base])


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
