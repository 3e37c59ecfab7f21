"""Solids of the other lenses and mirrors of a scene, each in its own frame: a lens between two surfaces, a mirror as a plate behind
its surface.

All surfaces are B-splines.  A sphere is interpolated with degree DEGREE, doubling the number of knots until the deviation within
the aperture is at most CLOSE mm.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from functools import singledispatch

import numpy as np
import torch
from torch import Tensor

from caustic_cli.errors import InputError
from caustic_cli.optics.bspline import SplineSpace
from caustic_cli.optics.frames import AxisSegment, Pose, rotate_to_global, to_global
from caustic_cli.optics.surfaces import Sphere
from caustic_cli.optics.surfaces.heightfield import HeightField
from caustic_cli.optics.system import fixed_surface, freeform_of
from caustic_cli.scene import Component, FoldMirror, FreeForm, Lens, Scene
from caustic_cli.scene.elements import PLATE, SIDES

#: Spline of a sphere: degree, first and largest number of control points along an axis, and largest deviation, mm.
DEGREE, FIRST, MOST, CLOSE = 5, 16, 256, 1e-8


@dataclass(frozen=True, eq=False)
class Body:
    """A solid between the free-form entrance of a lens and an exit, field and heights (n, m) mm, placed at `pose`.

    component: the element; number: its index, from 0.
    """

    component: Component
    number: int
    lens: Lens
    field: HeightField
    heights: Tensor
    pose: Pose

    def placed(self, points: np.ndarray) -> np.ndarray:
        """Points (..., 3) of its own frame in that of the scene, mm."""
        return np.stack(to_global(self.pose, tuple(np.moveaxis(points, -1, 0)), 0.0), -1)

    def turned(self, vectors: np.ndarray) -> np.ndarray:
        """Vectors (..., 3) of its own frame in that of the scene."""
        return np.stack(rotate_to_global(self.pose, tuple(np.moveaxis(vectors, -1, 0))), -1)


def bodies(scene: Scene) -> Iterator[Body]:
    """The solids beside the free-form lens, in the order in which light meets them.

    Raises:
        InputError: a sphere is too steep to be approximated by a spline.
    """
    leg = AxisSegment()
    for number, component in enumerate(scene.elements):
        entrance = _side(component, "front")
        exit = _back(component, entrance)
        surface = fixed_surface(exit, component.half_size)
        lens = Lens(
            component.size,
            0.0,
            max(component.index, 1.0 + 1e-9),
            surface.field.shape,
            exit.degree,
            exit.knots,
            aperture=component.aperture,
            entrance=entrance,
        )
        pose = leg.pose(component.z, component.tilt)
        yield Body(component, number, lens, surface.field, surface.heights, pose)
        leg = component.axis_behind(leg)


@singledispatch
def _back(component: Component, entrance: FreeForm) -> FreeForm:
    """The back of a solid behind its entrance, with heights from the first vertex, mm: of a lens its second surface."""
    exit = _side(component, "back")
    return FreeForm(exit.heights + component.thickness, exit.degree, exit.knots)


@_back.register(FoldMirror)
def _(component: FoldMirror, entrance: FreeForm) -> FreeForm:
    return _constant(max(0.0, float(entrance.heights.max())) + PLATE)


def _side(component: Component, side: str) -> FreeForm:
    """A surface of a lens or mirror, with heights from its vertex plane, mm."""
    front, radius = component.surfaces[SIDES.index(side)], component.radius[SIDES.index(side)]
    if front is not None:
        return front
    if math.isinf(radius):
        return _constant(0.0)
    sphere, count = Sphere(radius, component.reach), FIRST
    while count <= MOST:
        space = SplineSpace.uniform(count, DEGREE)
        field = HeightField((space, space), component.half_size)
        x, y = field.control_xy()
        inverse = torch.linalg.inv(space.matrix(space.greville))
        net = inverse @ _sag(sphere, x, y) @ inverse.T
        line = [torch.linspace(-h, h, 4 * count + 1, dtype=torch.float64) for h in component.half_size]
        fine = [0.5 * (c / h + 1.0) for c, h in zip(line, component.half_size, strict=True)]
        off = (space.matrix(fine[0]) @ net @ space.matrix(fine[1]).T - _sag(sphere, *line)).abs()
        off = off[component.opening.contains(line[0][:, None], line[1][None, :])]
        if float(off.max()) <= CLOSE:
            return freeform_of(field, net)
        count *= 2
    raise InputError(f"⟨element.radius⟩ of {radius:g} mm is too steep within its aperture to be approximated by a spline")


def _sag(sphere: Sphere, x: Tensor, y: Tensor) -> Tensor:
    """Sag of a sphere on a grid, (n, m) mm."""
    a, b = torch.broadcast_tensors(x[:, None], y[None, :])
    return sphere.at(None, a.reshape(-1), b.reshape(-1), ((0, 0),))[0].reshape(a.shape)


def _constant(z: float) -> FreeForm:
    """A plane at z, mm."""
    return FreeForm(np.full((2, 2), z), (1, 1))
