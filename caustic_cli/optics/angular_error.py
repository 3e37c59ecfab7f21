"""Angular error of collimated or focused light: the angle of rays behind the lens to the screen's normal, or to the direction of
the focus."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from caustic_cli.optics.frames import AxisSegment
from caustic_cli.optics.rays import RayState
from caustic_cli.optics.receiver import Receiver, dot
from caustic_cli.optics.trace import Tracer
from caustic_cli.scene import Scene


def squared_angular_error(traced: Tracer, state: RayState, scene: Scene) -> Tensor:
    """Sum over rays on the screen of power times the squared tangent of their angle to the intended direction, ();
    differentiable.

    Tangents are those along the axes of the screen, towards a focus from where rays cross its tangent plane.
    """
    receiver, power = Receiver.of(traced.system, scene.screen), traced.onto(state, scene.screen).power
    (px, py, pz), direction = receiver.middle, state.direction
    u, v, along = (_dot(direction, axis) for axis in receiver.axes)
    tangents = [u / along, v / along]
    if scene.second_target is not None and scene.second_target.focus is not None:
        focus, (x, y, z) = (traced.system.leg or AxisSegment()).at(*scene.second_target.focus), state.expanded().origin
        a, b, before = (_dot((x - px, y - py, z + state.datum - pz), axis) for axis in receiver.axes)
        fx, fy, fz = (dot((focus[0] - px, focus[1] - py, focus[2] - pz), axis) for axis in receiver.axes)
        places = [c - before * t for c, t in zip((a, b), tangents, strict=True)]
        tangents = [t - (f - c) / fz for t, f, c in zip(tangents, (fx, fy), places, strict=True)]
    squares = torch.zeros((), dtype=torch.float64)
    for tangent in tangents:
        squares = squares + (power * tangent * tangent).sum(dtype=torch.float64)
    return squares


def rms_angle(squares: float, power: float) -> float:
    """Root mean square angle, rad, from such a sum and the total power."""
    return math.sqrt(squares / power) if power > 0 else math.nan


def _dot(vector, axis):
    """Scalar product of a vector of tensors or numbers with a constant one, of which zeros cost nothing."""
    return sum(c * a for c, a in zip(vector, axis, strict=True) if a)
