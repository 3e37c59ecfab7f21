"""Rays between the two surfaces of a lens, and scattered-data interpolation of quantities known at their intersection points."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
import torch
from scipy.interpolate import LinearNDInterpolator, NearestNDInterpolator
from scipy.ndimage import distance_transform_edt, map_coordinates
from torch import Tensor

from caustic_cli.optics.emission import rays_of
from caustic_cli.optics.surfaces.heightfield import HeightField
from caustic_cli.optics.system import EXIT, split_heights
from caustic_cli.optics.trace import CHUNK, tracers
from caustic_cli.scene import Scene

#: Rays traced for `entrance_points`: per control point, and at most.
AN_ORIGIN, MOST_RAYS = 8, 300_000


@dataclass(frozen=True, eq=False)
class InternalRays:
    """Rays inside the glass that reach the exit: entrance points (2, N) and exit points (3, N), mm, unit directions (3, N), powers
    (N,)."""

    entrance: np.ndarray
    exit: np.ndarray
    direction: np.ndarray
    power: np.ndarray


def internal_rays(scene: Scene, field: HeightField, nets: Tensor, count: int) -> InternalRays:
    """About `count` rays of the source on a regular grid, traced inside a lens with these control nets (2, n, m), mm."""
    lit, net = split_heights(replace(scene, elements=scene.in_front), field, nets)
    found = []
    for traced in tracers(lit, field, rays_of(lit, "grid", count), torch.float64, CHUNK):
        last = traced.last({EXIT: net})
        hit = last.hit
        power = traced.weight * last.power_in
        full = [*last.state.full(hit.local), *last.state.full(hit.incoming), power, torch.as_tensor(hit.length)]
        found.append(torch.stack(torch.broadcast_tensors(*full))[:, last.power_in > 0])
    rays = torch.cat(found, 1).numpy()
    exit, direction = rays[:3], rays[3:6]
    return InternalRays((exit - rays[7] * direction)[:2], exit, direction, rays[6])


def interpolate_scattered(points: np.ndarray, values: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Values (k, N) given at scattered points (2, N), interpolated at x, y: linear within their convex hull, nearest neighbour
    beyond; (k, *x.shape)."""
    at = np.stack([x.ravel(), y.ravel()], -1)
    found = LinearNDInterpolator(points.T, values.T)(at)
    beyond = np.isnan(found).any(-1)
    if beyond.any():
        found[beyond] = NearestNDInterpolator(points.T, values.T)(at[beyond])
    return found.T.reshape(len(values), *x.shape)


def entrance_points(scene: Scene, field: HeightField, nets: Tensor) -> Tensor:
    """Entrance point of the ray that leaves at each control point of the exit, over the half size, y before x: (n, m, 2)
    float64.  Linear between the means of the rays in cells of AN_ORIGIN rays each, and those of the nearest cell where there is no
    light."""
    light = internal_rays(scene, field, nets, min(MOST_RAYS, AN_ORIGIN * nets[1].numel()))
    part = math.sqrt(min(1.0, light.power.size / (AN_ORIGIN * nets[1].numel())))
    cells = [max(2, round(part * n)) for n in field.shape]
    lines = [np.linspace(-r, r, n + 1) for r, n in zip(field.half_size, cells, strict=True)]
    count, *sums = (
        np.histogram2d(*light.exit[:2], bins=lines, weights=weights)[0] for weights in (None, light.entrance[0], light.entrance[1])
    )
    nearest = distance_transform_edt(count == 0, return_distances=False, return_indices=True)
    x, y = np.meshgrid(*(c.numpy() for c in field.control_xy()), indexing="ij")
    at = [0.5 * (c / r + 1.0) * n - 0.5 for c, r, n in zip((x, y), field.half_size, cells, strict=True)]
    means = [(total / np.maximum(count, 1))[tuple(nearest)] for total in sums]
    u, v = (map_coordinates(mean, at, order=1, mode="nearest") / r for mean, r in zip(means, field.half_size, strict=True))
    return torch.from_numpy(np.stack([v, u], -1))
