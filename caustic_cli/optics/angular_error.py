"""Angular error of collimated or focused light: the angle of rays behind the lens to the axis, or to the direction of the focus."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from caustic_cli.optics.rays import RayState
from caustic_cli.optics.trace import Tracer
from caustic_cli.scene import Scene


def squared_angular_error(traced: Tracer, state: RayState, scene: Scene) -> Tensor:
    """Sum over rays on the screen of power times the squared tangent of their angle to the intended direction, ();
    differentiable."""
    ray = traced.onto(state, scene.screen)
    dz = torch.as_tensor(ray.direction[2])
    squares, focus = torch.zeros((), dtype=torch.float64), scene.second_target.focus if scene.second_target else None
    for k in (0, 1):
        tangent = ray.direction[k] / dz
        if focus is not None:
            tangent = tangent - (focus[k] - ray.origin[k]) / (focus[2] - scene.screen.z)
        squares = squares + (ray.power * tangent.square()).sum(dtype=torch.float64)
    return squares


def rms_angle(squares: float, power: float) -> float:
    """Root mean square angle, rad, from such a sum and the total power."""
    return math.sqrt(squares / power) if power > 0 else math.nan
