"""A screen seen through the lenses and mirrors behind a lens' exit, for the first surface of a design.

Notation
    p = (x, y, z)   a point of the exit; q = (q_x, q_y), tangents of a direction that light leaves it in
    X(p, q)         where that light lands, in the screen's own coordinates, mm, by tracing it through all that follows
    A, B            diagonal derivatives of X by (x, y) and by q, on the axis: X = A x + B q to first order
    L               distance of the screen along the axis
    u = s L X / B   the screen as a plane at L, s = +-1: without anything behind the exit, u = X

Light that a lens turns by a slope g leaves with q = q_0 + (n - 1) g, so that u = s ((L A / B) x + L q): the map x -> u that a
surface can make is, to first order, the gradient of a potential, as that to a bare screen is (`surface_from_map`), but with L A / B
for 1. The sign s is that of A / B, by which the map asks for least of the surface: lenses may turn the image over. Beyond the first
order, q is found by Newton's method, with derivatives by differences.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import torch

from caustic_cli.errors import InputError
from caustic_cli.optics.rays import RayState
from caustic_cli.optics.system import EXIT, System
from caustic_cli.optics.trace import Tracer
from caustic_cli.scene import Aperture, Scene

#: Steps of tangents over which X is differentiated, most of Newton's steps, and parts of a pixel that are left.
STEP, NEWTON, LEFT = 1e-6, 8, 1e-6
#: |B| / L below which the exit is imaged on the screen: no slope of it moves light there.
IMAGED = 1e-3


def bare(scene: Scene) -> Scene:
    """A scene whose other surfaces are the spheres that a design begins from."""
    return replace(scene, elements=tuple(replace(e, free="none", surfaces=(None, None)) for e in scene.elements))


def opened(system: System, first: int, last: int) -> System:
    """Elements first to last of a system without their apertures, lit beyond any bound."""
    elements = tuple(replace(e, aperture=Aperture()) for e in system.elements[first:last])
    return replace(system, elements=elements, lit=system.pupil, leg=system.leg if last == len(system.elements) else None)


def passed(system: System, origin: tuple, direction: tuple) -> RayState:
    """Rays, components of one shape each, behind a system that has nothing free."""
    like = np.broadcast_shapes(*map(np.shape, (*origin, *direction)))
    o, d = (tuple(torch.from_numpy(np.broadcast_to(c, like).astype(np.float64).ravel()) for c in v) for v in (origin, direction))
    return Tracer(system, RayState(o, d, torch.ones_like(o[0])))({})[0]


@dataclass(frozen=True, eq=False)
class Relayed:
    """The screen of a scene as its lens' exit, at height `eye` on the axis, mm, sees it; a `view.View` of what follows."""

    scene: Scene
    eye: float

    @cached_property
    def system(self) -> System:
        """What follows the exit."""
        whole = System.of(bare(self.scene))
        after = [e.name for e in whole.elements].index(EXIT) + 1
        return opened(whole, after, len(whole.elements))

    @property
    def distance(self) -> float:
        """L, mm."""
        return self.scene.screen.z - self.eye

    def landing(self, origin: tuple, direction: tuple) -> tuple[np.ndarray, np.ndarray]:
        """X of rays, NaN where they do not get to the screen."""
        shape = np.broadcast_shapes(*map(np.shape, (*origin, *direction)))
        state = passed(self.system, origin, direction)
        tracer = Tracer(self.system, RayState(state.origin, state.direction, state.power))
        ray = tracer.onto(state, self.scene.screen)
        x, y = (torch.where(ray.power > 0, c, torch.nan).numpy().reshape(shape) for c in ray.origin[:2])
        return x, y

    def _from(self, x, y, z, q) -> np.ndarray:
        return np.stack(self.landing((x, y, z), _direction(q)))

    @cached_property
    def first_order(self) -> tuple[np.ndarray, np.ndarray]:
        """A and B, (2,) each.

        Raises:
            InputError: the exit is imaged on the screen, or its axis does not get there.
        """
        reach = 1e-3 * min(self.scene.lens.half_size)
        x = reach * np.array([0.0, 1.0, 0.0, 0.0, 0.0])
        y = reach * np.array([0.0, 0.0, 1.0, 0.0, 0.0])
        q = reach / self.distance * np.array([[0.0, 0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 0.0, 1.0]])
        found = self._from(x, y, np.full(5, self.eye), q)
        if not np.isfinite(found).all():
            raise InputError(
                "[[element]] light along the axis does not get from the lens to the screen; its mirrors and radii bar it"
            )
        a = np.array([found[0, 1] - found[0, 0], found[1, 2] - found[1, 0]]) / reach
        b = np.array([found[0, 3] - found[0, 0], found[1, 4] - found[1, 0]]) / (reach / self.distance)
        if (np.abs(b) < IMAGED * self.distance).any():
            raise InputError(
                "⟨screen.z⟩ of"
                f" {self.scene.screen.z:g} mm is where the elements behind the lens image it: nothing of its surface shows there;"
                " another distance is needed"
            )
        return a, b

    @property
    def sign(self) -> float:
        """s."""
        a, b = self.first_order
        return math.copysign(1.0, float((a / b).sum())) if (a / b).any() else 1.0

    @property
    def straight(self) -> tuple[float, float]:
        """L A / B: u is s times so many times x for light that leaves along the axis."""
        a, b = self.first_order
        x, y = self.distance * a / b
        return float(x), float(y)

    @property
    def scale(self) -> np.ndarray:
        """u over X, (2,)."""
        return self.sign * self.distance / self.first_order[1]

    def picture(self, target: np.ndarray) -> tuple[np.ndarray, tuple[float, float], tuple[float, float]]:
        """Power on the pixels as u has them, (n_x, n_y), the half width and height of their frame, and its middle, mm."""
        sx, sy = self.scale
        turned = target[:: 1 if sx > 0 else -1, :: 1 if sy > 0 else -1]
        half, shift = self.scene.screen.half_size, self.scene.screen.shift
        return turned, (half[0] * abs(sx), half[1] * abs(sy)), (shift[0] * sx, shift[1] * sy)

    def seen(self, origin: tuple, direction: tuple) -> tuple[np.ndarray, np.ndarray]:
        """u of rays that leave the exit, NaN where they do not get to the screen."""
        x, y = self.landing(origin, direction)
        return x * self.scale[0], y * self.scale[1]

    def own(self, u: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The screen's own coordinates X behind u, counted from its middle."""
        shift = self.scene.screen.shift
        return u / self.scale[0] - shift[0], v / self.scale[1] - shift[1]

    def towards(self, u: np.ndarray, v: np.ndarray) -> Callable[..., tuple]:
        """Directions, of any length, that points x, y, z of the exit have to send light in for it to land at u; where none is
        found, those of the first order."""
        (a, b), scale, pixel = self.first_order, self.scale, min(self.scene.screen.pixel)
        aim, found = np.stack([u / scale[0], v / scale[1]]), None
        steps = STEP * np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])[:, :, None]  # (2, 3, 1)

        def directions(x, y, z):
            nonlocal found
            x, y, z = (np.broadcast_to(c, u.shape).ravel() for c in (x, y, z))
            goal = aim.reshape(2, -1)
            q = (goal - a[:, None] * np.stack([x, y])) / b[:, None] if found is None else found
            for _ in range(NEWTON):
                landed = self._from(*(np.broadcast_to(c, (3, len(x))) for c in (x, y, z)), q[:, None] + steps)  # (2, 3, N)
                (j00, j01), (j10, j11) = ((landed[i, 1:] - landed[i, 0]) / STEP for i in (0, 1))
                off = goal - landed[:, 0]
                determinant = j00 * j11 - j01 * j10
                with np.errstate(divide="ignore", invalid="ignore"):
                    move = np.stack([j11 * off[0] - j01 * off[1], j00 * off[1] - j10 * off[0]]) / determinant
                known = np.isfinite(move).all(0)
                q = q + np.where(known, move, 0.0)
                if not known.any() or np.abs(off[:, known]).max() <= LEFT * pixel:
                    break
            found = q
            return tuple(c.reshape(u.shape) for c in (*q, np.ones(len(x))))

        return directions


def _direction(q: np.ndarray) -> tuple:
    """Unit vectors with tangents q."""
    length = np.sqrt(1.0 + q[0] ** 2 + q[1] ** 2)
    return q[0] / length, q[1] / length, 1.0 / length
