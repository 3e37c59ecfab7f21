"""The screen imaged through the lenses and mirrors behind the lens, for the initial surface of a design.

Notation
    p = (x, y, z)   a point of the exit, from its middle; q = (q_x, q_y), tangents of the direction of a ray that leaves it, and
                    t = q / sqrt(1 + |q|^2), its direction cosines
    X(p, t)         landing point of that ray in the coordinates of the screen, mm, traced through the following elements
    t_0             the chief ray: that from the middle of the exit to the centre X_0 of the screen
    A, B            first-order (ABCD matrix) coefficients about it, (2, 2): X = X_0 + A x + B (t - t_0)
    L               distance of the screen along the axis
    u = s L B^-1 (X - X_0 + B t_0)    coordinates of an equivalent bare screen at L, s = +-1: u = X without elements behind the exit
                    and along the axis

A surface of slope g deflects light to t = t_in + (n c' - c) g, with c, c' the cosines to the axis of undeflected light behind and
in front of the exit (n - 1 along the axis), so that u = s (L B^-1 A x + L t): to first order the map x -> u is the gradient of a
potential, as for a bare screen (`surface_from_map`), with L A / B in place of 1. The sign s is that of A / B, which minimises the
deflection, since the elements may invert the image. Beyond the first order, q is found by Newton's method with finite-difference
derivatives.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import torch

from caustic_cli.errors import InputError
from caustic_cli.inverse.projected_cells import cells_on_plane
from caustic_cli.optics.rays import RayState
from caustic_cli.optics.system import EXIT, System
from caustic_cli.optics.trace import Tracer
from caustic_cli.scene import Aperture, Scene

#: Finite-difference step of tangents, most Newton iterations, and their tolerance in pixels.
STEP, NEWTON, LEFT = 1e-6, 8, 1e-6
#: |B| / L below which the exit is conjugate to the screen, where its slopes do not move light.
IMAGED = 1e-3
#: Off-diagonal part of the derivatives of u by X that is rounding, and the least squared cosine of a first estimate to the axis.
ALIGNED, GRAZING = 1e-6, 1e-2
UNSEEN = "[[element]] light through the middle of the lens does not reach the screen; check tilts and radii"


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
    """The equivalent screen u for an exit at the height `centre_z` whose middle is at `middle` from the axis, mm; same interface as
    `projection.ScreenProjection`."""

    scene: Scene
    centre_z: float
    middle: tuple[float, float] = (0.0, 0.0)

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
        c = self.scene.source.axis[2]
        return (math.sqrt((index - 1.0) * (index + 1.0) + c * c) - c) * self.distance

    def lean(self, index: float) -> list[float]:
        """Slopes along x and y of a plane surface that sends light along the source's axis to the centre of the screen, to first
        order."""
        wanted, came = _cosines(self._chief[:, 0]), self.scene.source.axis
        return [self.distance * float(t - d) / self.gain(index) for t, d in zip(wanted, came[:2], strict=True)]

    def landing(self, origin: tuple, direction: tuple, stopped: bool = False) -> tuple[np.ndarray, np.ndarray]:
        """X of rays, from the axis, NaN where they do not reach the screen; stopped: also of those that an aperture stops."""
        shape = np.broadcast_shapes(*map(np.shape, (*origin, *direction)))
        system = self.with_apertures if stopped else self.system
        state = trace_through(system, origin, direction)
        tracer = Tracer(system, RayState(state.origin, state.direction, state.power))
        ray = tracer.onto(state, self.scene.screen)
        x, y = (torch.where(ray.power > 0, c, torch.nan).numpy().reshape(shape) for c in ray.origin[:2])
        return x, y

    def _from(self, x, y, z, q) -> np.ndarray:
        return np.stack(self.landing((x + self.middle[0], y + self.middle[1], z), _direction(q)))

    @cached_property
    def _chief(self) -> np.ndarray:
        """q of t_0, (2, 1)."""
        at = (np.zeros(1), np.zeros(1), np.full(1, self.centre_z))
        return self._aimed(np.array(self.scene.screen.shift)[:, None], at, np.zeros((2, 1)))

    @cached_property
    def _linear(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """X_0 - B t_0 (2,), A and B.

        Raises:
            InputError: the exit is conjugate to the screen, or the chief ray does not reach the screen.
        """
        reach = 1e-3 * min(self.scene.lens.half_size)
        x, y = reach * np.eye(5)[1:3]
        chief = _cosines(self._chief)  # (2, 1)
        t = chief + reach / self.distance * np.eye(5)[3:]
        found = self._from(x, y, np.full(5, self.centre_z), _tangents(t))
        if not np.isfinite(found).all():
            raise InputError(UNSEEN)
        moved = found[:, 1:] - found[:, :1]
        a, b = moved[:, :2] / reach, moved[:, 2:] / (reach / self.distance)
        if (np.abs(b.diagonal()) < IMAGED * self.distance).any():
            raise InputError(
                f"⟨screen.z⟩ of {self.scene.screen.z:g} mm is conjugate to the lens through the elements behind it, so that its"
                " slopes do not move light there; another distance is needed"
            )
        return found[:, 0] - b @ chief[:, 0], a, b

    @property
    def first_order(self) -> tuple[np.ndarray, np.ndarray]:
        """A and B along x and along y, (2,) each.

        Raises:
            InputError: as of a chief ray that does not arrive, or a conjugate screen.
        """
        _, a, b = self._linear
        return a.diagonal(), b.diagonal()

    @property
    def sign(self) -> float:
        """s."""
        a, b = self.first_order
        return math.copysign(1.0, float((a / b).sum())) if (a / b).any() else 1.0

    @property
    def axial_scale(self) -> tuple[float, float]:
        """L A / B along x and y: u / (s x) of light that leaves parallel to the chief ray."""
        _, a, b = self._linear
        x, y = self.distance * np.linalg.solve(b, a).diagonal()
        return float(x), float(y)

    @cached_property
    def scale(self) -> np.ndarray:
        """Derivatives of u by X, (2, 2)."""
        return self.sign * self.distance * np.linalg.inv(self._linear[2])

    @property
    def aligned(self) -> bool:
        """As of a `ScreenProjection`."""
        return float(np.abs(self.scale[[0, 1], [1, 0]]).max()) <= ALIGNED * float(np.abs(self.scale).max())

    def projected_target(self, target: np.ndarray) -> tuple[np.ndarray, tuple[float, float], tuple[float, float]]:
        """Power on the pixels in coordinates u, (n_x, n_y), the half width and height of their frame, and its centre, mm; on a
        regular grid of cells where they are no lattice there."""
        (fx, fy), screen = np.where(self.scale.diagonal() > 0, 1, -1).tolist(), self.scene.screen
        turned = target[::fx, ::fy]
        if not self.aligned:

            def turned_back(u: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
                x, y = self.screen_coordinates(u, v)
                return fx * x, fy * y

            return cells_on_plane(turned, screen, lambda x, y: self.project(fx * x, fy * y), turned_back)
        half, (cx, cy) = np.abs(self.scale.diagonal()) * screen.half_size, self.project(np.zeros(()), np.zeros(()))
        return turned, (float(half[0]), float(half[1])), (float(cx), float(cy))

    def project(self, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """u of points x, y of the screen, from its centre, mm."""
        return self._of(x + self.scene.screen.shift[0], y + self.scene.screen.shift[1])

    def _of(self, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """u of X."""
        (cx, cy), by = self._linear[0], self.scale
        return by[0, 0] * (x - cx) + by[0, 1] * (y - cy), by[1, 0] * (x - cx) + by[1, 1] * (y - cy)

    def intersections(self, origin: tuple, direction: tuple) -> tuple[np.ndarray, np.ndarray]:
        """u of rays that leave the exit, NaN where they do not reach the screen."""
        x, y, z = origin
        return self._of(*self.landing((x + self.middle[0], y + self.middle[1], z), direction))

    def _landing_of(self, u: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """X of u."""
        (cx, cy), by = self._linear[0], np.linalg.inv(self.scale)
        return by[0, 0] * u + by[0, 1] * v + cx, by[1, 0] * u + by[1, 1] * v + cy

    def screen_coordinates(self, u: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Coordinates X of the screen for given u, from its centre, mm."""
        (x, y), shift = self._landing_of(u, v), self.scene.screen.shift
        return x - shift[0], y - shift[1]

    def directions_to(self, u: np.ndarray, v: np.ndarray) -> Callable[..., tuple]:
        """A function of points x, y, z of the exit that returns the directions, of any length, of rays that land at u; to first
        order where Newton's method finds none."""
        goal, found = np.stack(self._landing_of(u, v)).reshape(2, -1), None
        middle, a, b = self._linear

        def directions(x, y, z):
            nonlocal found
            at = tuple(np.broadcast_to(c, u.shape).ravel() for c in (x, y, z))
            begun = _tangents(np.linalg.solve(b, goal - middle[:, None] - a @ np.stack(at[:2]))) if found is None else found
            found = self._aimed(goal, at, begun)
            return tuple(c.reshape(u.shape) for c in (*found, np.ones(goal.shape[1])))

        return directions

    def _aimed(self, goal: np.ndarray, at: tuple, q: np.ndarray) -> np.ndarray:
        """q (2, N) of rays from points of the exit, three (N,), to points X (2, N), by Newton's method from others."""
        steps, pixel = STEP * np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])[:, :, None], min(self.scene.screen.pixel)  # (2, 3, 1)
        for _ in range(NEWTON):
            landed = self._from(*(np.broadcast_to(c, (3, *c.shape)) for c in at), q[:, None] + steps)  # (2, 3, N)
            (j00, j01), (j10, j11) = ((landed[i, 1:] - landed[i, 0]) / STEP for i in (0, 1))
            off = goal - landed[:, 0]
            determinant = j00 * j11 - j01 * j10
            with np.errstate(divide="ignore", invalid="ignore"):
                move = np.stack([j11 * off[0] - j01 * off[1], j00 * off[1] - j10 * off[0]]) / determinant
            known = np.isfinite(move).all(0)
            q = q + np.where(known, move, 0.0)
            if not known.any() or np.abs(off[:, known]).max() <= LEFT * pixel:
                break
        return q


def _direction(q: np.ndarray) -> tuple:
    """Unit vectors with tangents q to the axis."""
    length = np.sqrt(1.0 + q[0] ** 2 + q[1] ** 2)
    return q[0] / length, q[1] / length, 1.0 / length


def _cosines(q: np.ndarray) -> np.ndarray:
    """Direction cosines (2, ...) of tangents."""
    return q / np.sqrt(1.0 + (q * q).sum(0))


def _tangents(t: np.ndarray) -> np.ndarray:
    """Tangents (2, ...) of direction cosines, of those of nearly grazing rays where there are none."""
    return t / np.sqrt(np.maximum(1.0 - (t * t).sum(0), GRAZING))
