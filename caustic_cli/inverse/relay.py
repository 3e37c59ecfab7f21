"""The screen imaged through the lenses and mirrors behind the lens, for the initial surface of a design.

Notation
    p = (x, y, z)   a point of the exit; q = (q_x, q_y), tangents of the direction of a ray that leaves it
    X(p, q)         landing point of that ray in the coordinates of the screen, mm, traced through the following elements
    A, B            first-order (ABCD matrix) coefficients on the axis: X = A x + B q, diagonal in x and y
    L               distance of the screen along the axis
    u = s L X / B   coordinates of an equivalent bare screen at L, s = +-1: without elements behind the exit, u = X

A surface of slope g deflects light to q = q_0 + (n - 1) g, so that u = s ((L A / B) x + L q): to first order the map x -> u is the
gradient of a potential, as for a bare screen (`surface_from_map`), with L A / B in place of 1.  The sign s is that of A / B, which
minimises the deflection, since the elements may invert the image.  Beyond the first order, q is found by Newton's method with
finite-difference derivatives.
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

#: Finite-difference step of tangents, most Newton iterations, and their tolerance in pixels.
STEP, NEWTON, LEFT = 1e-6, 8, 1e-6
#: |B| / L below which the exit is conjugate to the screen, where its slopes do not move light.
IMAGED = 1e-3
UNSEEN = "[[element]] the axial ray does not reach the screen from the lens; check the mirrors' tilts and the radii"


def without_freeforms(scene: Scene) -> Scene:
    """The scene with spheres, the initial surfaces, in place of the free-form surfaces of other elements."""
    return replace(scene, elements=tuple(replace(e, free="none", surfaces=(None, None)) for e in scene.elements))


def without_apertures(system: System, first: int, last: int) -> System:
    """Elements first to last of a system, without their apertures."""
    elements = tuple(replace(e, aperture=Aperture()) for e in system.elements[first:last])
    return replace(system, elements=elements, lit=system.pupil, leg=system.leg if last == len(system.elements) else None)


def trace_through(system: System, origin: tuple, direction: tuple) -> RayState:
    """Rays, given by components of one shape each, traced through a system without free parameters."""
    like = np.broadcast_shapes(*map(np.shape, (*origin, *direction)))
    o, d = (tuple(torch.from_numpy(np.broadcast_to(c, like).astype(np.float64).ravel()) for c in v) for v in (origin, direction))
    return Tracer(system, RayState(o, d, torch.ones_like(o[0])))({})[0]


@dataclass(frozen=True, eq=False)
class RelayedScreen:
    """The equivalent screen u for the exit at height `centre_z` on the axis, mm; same interface as
    `projection.ScreenProjection`."""

    scene: Scene
    centre_z: float
    aligned = True  # as of a `ScreenProjection`

    @cached_property
    def system(self) -> System:
        """The elements behind the exit."""
        return without_apertures(self._whole, self._after, len(self._whole.elements))

    @cached_property
    def with_apertures(self) -> System:
        """The same with their apertures."""
        return replace(self.system, elements=self._whole.elements[self._after :])

    @cached_property
    def _whole(self) -> System:
        return System.of(without_freeforms(self.scene))

    @property
    def _after(self) -> int:
        return [e.name for e in self._whole.elements].index(EXIT) + 1

    @property
    def distance(self) -> float:
        """L, mm."""
        return self.scene.screen.z - self.centre_z

    def gain(self, index: float) -> float:
        """As of a `ScreenProjection`."""
        return (index - 1.0) * self.distance

    def landing(self, origin: tuple, direction: tuple, stopped: bool = False) -> tuple[np.ndarray, np.ndarray]:
        """X of rays, NaN where they do not reach the screen; stopped: also of those that an aperture stops."""
        shape = np.broadcast_shapes(*map(np.shape, (*origin, *direction)))
        system = self.with_apertures if stopped else self.system
        state = trace_through(system, origin, direction)
        tracer = Tracer(system, RayState(state.origin, state.direction, state.power))
        ray = tracer.onto(state, self.scene.screen)
        x, y = (torch.where(ray.power > 0, c, torch.nan).numpy().reshape(shape) for c in ray.origin[:2])
        return x, y

    def _from(self, x, y, z, q) -> np.ndarray:
        return np.stack(self.landing((x, y, z), _direction(q)))

    @cached_property
    def first_order(self) -> tuple[np.ndarray, np.ndarray]:
        """A and B, (2,) each.

        Raises:
            InputError: the exit is conjugate to the screen, or the axial ray does not reach the screen.
        """
        reach = 1e-3 * min(self.scene.lens.half_size)
        x = reach * np.array([0.0, 1.0, 0.0, 0.0, 0.0])
        y = reach * np.array([0.0, 0.0, 1.0, 0.0, 0.0])
        q = reach / self.distance * np.array([[0.0, 0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 0.0, 1.0]])
        found = self._from(x, y, np.full(5, self.centre_z), q)
        if not np.isfinite(found).all():
            raise InputError(UNSEEN)
        a = np.array([found[0, 1] - found[0, 0], found[1, 2] - found[1, 0]]) / reach
        b = np.array([found[0, 3] - found[0, 0], found[1, 4] - found[1, 0]]) / (reach / self.distance)
        if (np.abs(b) < IMAGED * self.distance).any():
            raise InputError(
                f"⟨screen.z⟩ of {self.scene.screen.z:g} mm is conjugate to the lens through the elements behind it, so that its"
                " slopes do not move light there; another distance is needed"
            )
        return a, b

    @property
    def sign(self) -> float:
        """s."""
        a, b = self.first_order
        return math.copysign(1.0, float((a / b).sum())) if (a / b).any() else 1.0

    @property
    def axial_scale(self) -> tuple[float, float]:
        """L A / B along x and y: u / (s x) of light that leaves parallel to the axis."""
        a, b = self.first_order
        x, y = self.distance * a / b
        return float(x), float(y)

    @property
    def scale(self) -> np.ndarray:
        """Scale factors u / X along x and y, (2,)."""
        return self.sign * self.distance / self.first_order[1]

    def projected_target(self, target: np.ndarray) -> tuple[np.ndarray, tuple[float, float], tuple[float, float]]:
        """Power on the pixels in coordinates u, (n_x, n_y), the half width and height of their frame, and its centre, mm."""
        sx, sy = self.scale
        turned = target[:: 1 if sx > 0 else -1, :: 1 if sy > 0 else -1]
        half, shift = self.scene.screen.half_size, self.scene.screen.shift
        return turned, (half[0] * abs(sx), half[1] * abs(sy)), (shift[0] * sx, shift[1] * sy)

    def project(self, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """u of points x, y of the screen, from its centre, mm."""
        shift = self.scene.screen.shift
        return (x + shift[0]) * self.scale[0], (y + shift[1]) * self.scale[1]

    def intersections(self, origin: tuple, direction: tuple) -> tuple[np.ndarray, np.ndarray]:
        """u of rays that leave the exit, NaN where they do not reach the screen."""
        x, y = self.landing(origin, direction)
        return x * self.scale[0], y * self.scale[1]

    def screen_coordinates(self, u: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Coordinates X of the screen for given u, from its centre, mm."""
        shift = self.scene.screen.shift
        return u / self.scale[0] - shift[0], v / self.scale[1] - shift[1]

    def directions_to(self, u: np.ndarray, v: np.ndarray) -> Callable[..., tuple]:
        """A function of points x, y, z of the exit that returns the directions, of any length, of rays that land at u; to first
        order where Newton's method finds none."""
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
    """Unit vectors with tangents q to the axis."""
    length = np.sqrt(1.0 + q[0] ** 2 + q[1] ** 2)
    return q[0] / length, q[1] / length, 1.0 / length
