"""Derivative of a lamp's image with respect to one control value of r, by forward-mode differentiation, as `gradmap` has it of a
lens.

A surface answers with points and slopes in the frames of its directions, by which the light is refracted: nothing there is a height
over an aperture.  The rays are constants; those that meet the surface outside the support of the basis function have no derivative,
so that only the few within it are traced again with tangents.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

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


@dataclass(frozen=True)
class LampRendering:
    """The image of a lamp as a function of control values.

    Args:
        values: of all surfaces; screen: pixels of the target, in its unit; filter: gaussian or cosine, of size 3 or more along both
            axes; rays: about; those of one lamp of an array, without what is reflected.
    """

    lamp: Lamp
    goal: Goal
    field: PolarField
    values: Tensor
    screen: Screen
    filter: Filter
    rays: int
    seed: int

    def derivative(self, control: tuple[int, int]) -> Tensor:
        """Change of the image by a control value (i, j), along u and v, of the outer surface: (n_x, n_y) float64, parts of the
        chip's light per mm.

        Raises:
            InputError: no such control value, or a filter without a derivative.
        """
        refuse_steps(self.filter)
        direction, total = self._direction(control), torch.zeros(self.screen.resolution, dtype=torch.float64)
        for few in self._under(control):
            with forward_ad.dual_level():
                image = self._of(forward_ad.make_dual(self.values, direction), few)
                tangent = forward_ad.unpack_dual(image).tangent
                total += 0.0 if tangent is None else tangent
        return total

    def compared(self, derivative: Tensor, control: tuple[int, int]) -> Comparison:
        """How far a `derivative` is from central differences of images of all rays."""
        step = STEP * float(self.values.mean())
        direction, difference = self._direction(control), torch.zeros_like(derivative)
        above, below = self.values + step * direction, self.values - step * direction
        distance = float((above - below)[direction > 0])
        with torch.no_grad():
            for part in emissions(self.lamp.chip, self.rays, self.seed):
                difference += (self._of(above, part) - self._of(below, part)) / distance
        error, scale = derivative - difference, float(difference.norm())
        return Comparison(float(error.norm()) / scale if scale > 0 else None, float(error.abs().max()), step)

    def _of(self, values: Tensor, rays: ChipRays) -> Tensor:
        """The image of some rays."""
        light = through(self.lamp, self.field, rays, values)
        x, y, ahead = land(self.goal, light)
        arriving = torch.where(ahead, light.power, torch.zeros_like(light.power))
        return backend_for("cpu").splat(x, y, arriving, self.screen, self.filter)[0]

    def _direction(self, control: tuple[int, int]) -> Tensor:
        """The unit net, 1 at the control value of the outer surface, of the shape of all values.

        Raises:
            InputError: there is no such value.
        """
        shape = self.field.shape
        if not all(0 <= k < n for k, n in zip(control, shape, strict=True)):
            raise InputError(
                f"the control point of a lamp must be I,J with I 0 to {shape[0] - 1} and J 0 to {shape[1] - 1}, got"
                f" {control[0]},{control[1]}"
            )
        unit = torch.zeros_like(self.values)
        sides(unit)[1][control] = 1.0
        return unit

    @torch.no_grad()
    def _under(self, control: tuple[int, int]) -> Iterator[ChipRays]:
        """Those of the rays that meet the outer surface in the support of a basis function."""
        for part in emissions(self.lamp.chip, self.rays, self.seed):
            at = stereographic(*through(self.lamp, self.field, part, self.values).point)
            in_u, in_v = in_support(self.field.net, control, *(0.5 * (c + 1.0) for c in at))
            under = in_u & in_v
            if bool(under.any()):
                origin, way = (tuple(c[under] for c in vector) for vector in (part.origin, part.direction))
                yield ChipRays(origin, way, part.power[under])
