"""Rays between two free-form sides, and what is known at the points where they meet one of them, carried to a grid."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from scipy.interpolate import LinearNDInterpolator, NearestNDInterpolator
from torch import Tensor

from caustic_cli.optics.emission import rays_of
from caustic_cli.optics.surfaces.heightfield import HeightField
from caustic_cli.optics.system import EXIT, split_heights
from caustic_cli.optics.trace import CHUNK, tracers
from caustic_cli.scene import Scene

#: Rays that `origins` are found from: so many for each of them, and their most.
AN_ORIGIN, MOST_RAYS = 8, 300_000


@dataclass(frozen=True, eq=False)
class Within:
    """Rays inside the glass that get to the exit: where they enter (2, N) and leave (3, N), mm, directions (3, N), powers (N,)."""

    entrance: np.ndarray
    exit: np.ndarray
    direction: np.ndarray
    power: np.ndarray


def rays_within(scene: Scene, field: HeightField, nets: Tensor, count: int) -> Within:
    """About so many regular rays of the source through a lens of these nets (2, n, m), mm."""
    lit, net = split_heights(scene, field, nets)
    found = []
    for traced in tracers(lit, field, rays_of(lit, "grid", count), torch.float64, CHUNK):
        last = traced.last({EXIT: net})
        full = [*last.state.full(last.local), *last.state.full(last.incoming), last.power_in, torch.as_tensor(last.length)]
        found.append(torch.stack(torch.broadcast_tensors(*full))[:, last.power_in > 0])
    rays = torch.cat(found, 1).numpy()
    exit, direction = rays[:3], rays[3:6]
    return Within((exit - rays[7] * direction)[:2], exit, direction, rays[6])


def spread(points: np.ndarray, values: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Values (k, N) at scattered points (2, N), linear between them and the nearest beyond, at x, y: (k, *x.shape)."""
    at = np.stack([x.ravel(), y.ravel()], -1)
    found = LinearNDInterpolator(points.T, values.T)(at)
    beyond = np.isnan(found).any(-1)
    if beyond.any():
        found[beyond] = NearestNDInterpolator(points.T, values.T)(at[beyond])
    return found.T.reshape(len(values), *x.shape)


def origins(scene: Scene, field: HeightField, nets: Tensor) -> Tensor:
    """Where light of each of the exit's controls enters, in parts of the half size along y and x: (n, m, 2) float64."""
    light = rays_within(scene, field, nets, min(MOST_RAYS, AN_ORIGIN * nets[1].numel()))
    x, y = np.meshgrid(*(c.numpy() for c in field.control_xy()), indexing="ij")
    u, v = (c / r for c, r in zip(spread(light.exit[:2], light.entrance, x, y), field.half_size, strict=True))
    return torch.from_numpy(np.stack([v, u], -1))
