"""Derivative of a lamp's image with respect to one control value of r, by forward-mode differentiation, as `gradmap` has it of a
lens.

A surface answers with points and slopes in the frames of its directions, by which the light is refracted: nothing there is a height
over an aperture.  The rays are constants; those that meet the surface outside the support of the basis function have no derivative,
so that only the few within it are traced again with tangents.
"""

from __future__ import annotations

from collections.abc import Iterator

import torch
from torch import Tensor
from torch.autograd import forward_ad

from caustic_cli.errors import InputError
from caustic_cli.optics.backends import backend_for
from caustic_cli.optics.lamp import ChipRays, emissions, land, sides, through
from caustic_cli.optics.reconstruction import Filter
from caustic_cli.optics.surfaces.polarfield import PolarField, stereographic
from caustic_cli.scene import Screen
from caustic_cli.scene.lamp import Goal, Lamp
from caustic_cli.studies.gradmap import Comparison, in_support, refuse_steps

#: Step of a central difference over the mean control value.
STEP = 1e-8


def lamp_gradient(
    lamp: Lamp,
    goal: Goal,
    field: PolarField,
    values: Tensor,
    control: tuple[int, int],
    screen: Screen,
    filter: Filter,
    rays: int,
    seed: int,
) -> Tensor:
    """Change of the image by a control value of the outer surface: (n_x, n_y) float64, parts of the chip's light per mm.

    Args:
        control: (i, j) of the net, along u and v.
        screen: pixels of the target, in its unit.
        filter: gaussian or cosine, of size 3 or more along both axes.
        rays: about; those of one lamp of an array, without what is reflected.

    Raises:
        InputError: no such control value, or a filter without a derivative.
    """
    refuse_steps(filter)
    direction, total = _direction(field, values, control), torch.zeros(screen.resolution, dtype=torch.float64)
    for few in _under(lamp, field, values, control, rays, seed):
        with forward_ad.dual_level():
            image = _image(lamp, goal, field, forward_ad.make_dual(values, direction), few, screen, filter)
            tangent = forward_ad.unpack_dual(image).tangent
            total += 0.0 if tangent is None else tangent
    return total


def compare_lamp(
    gradient: Tensor,
    lamp: Lamp,
    goal: Goal,
    field: PolarField,
    values: Tensor,
    control: tuple[int, int],
    screen: Screen,
    filter: Filter,
    rays: int,
    seed: int,
) -> Comparison:
    """How far `gradient` (of `lamp_gradient` with the same arguments) is from central differences of images of all rays."""
    step = STEP * float(values.mean())
    direction, difference = _direction(field, values, control), torch.zeros_like(gradient)
    above, below = values + step * direction, values - step * direction
    distance = float((above - below)[direction > 0])
    with torch.no_grad():
        for part in emissions(lamp.chip, rays, seed):
            one, other = (_image(lamp, goal, field, net, part, screen, filter) for net in (above, below))
            difference += (one - other) / distance
    error, scale = gradient - difference, float(difference.norm())
    return Comparison(float(error.norm()) / scale if scale > 0 else None, float(error.abs().max()), step)


def _image(lamp: Lamp, goal: Goal, field: PolarField, values: Tensor, rays: ChipRays, screen: Screen, filter: Filter) -> Tensor:
    """The image of some rays."""
    light = through(lamp, field, rays, values)
    x, y, ahead = land(goal, light)
    arriving = torch.where(ahead, light.power, torch.zeros_like(light.power))
    return backend_for("cpu").splat(x, y, arriving, screen, filter)[0]


def _direction(field: PolarField, values: Tensor, control: tuple[int, int]) -> Tensor:
    """The unit net, 1 at the control value of the outer surface, of the shape of all values.

    Raises:
        InputError: there is no such value.
    """
    if not all(0 <= k < n for k, n in zip(control, field.shape, strict=True)):
        raise InputError(
            f"the control point of a lamp must be I,J with I 0 to {field.shape[0] - 1} and J 0 to {field.shape[1] - 1}, got"
            f" {control[0]},{control[1]}"
        )
    unit = torch.zeros_like(values)
    sides(unit)[1][control] = 1.0
    return unit


@torch.no_grad()
def _under(lamp: Lamp, field: PolarField, values: Tensor, control: tuple[int, int], rays: int, seed: int) -> Iterator[ChipRays]:
    """Those of the rays that meet the outer surface in the support of a basis function."""
    for part in emissions(lamp.chip, rays, seed):
        at = stereographic(*through(lamp, field, part, values).point)
        in_u, in_v = in_support(field.net, control, *(0.5 * (c + 1.0) for c in at))
        under = in_u & in_v
        if bool(under.any()):
            origin, way = (tuple(c[under] for c in vector) for vector in (part.origin, part.direction))
            yield ChipRays(origin, way, part.power[under])
