"""Projections of a screen from the centre of the lens, in whose coordinates the map of a surface is close to optimal transport:
of a tilted or curved screen onto the plane z = z_screen, and for light that is tilted to the axis.

Notation
    c           centre of projection, the centre of the exit surface, on the axis
    x, y        coordinates on the screen from its centre, mm;  P(x, y) its points in space
    u, v        intersection of the line from c through P with the plane z = z_screen, mm

To first order a slope of the lens determines (u, v), whatever the shape of the screen.  So the map that a surface can realise is
close to optimal transport onto (u, v), not onto (x, y): the picture, power on the screen, is projected onto the plane cell by cell.
The depth of the screen beyond the first order is taken into account by `surface_from_map`, which aims at P itself.

Light from infinity along d, a unit vector at an angle to the axis, leaves the surface with the transverse direction cosines
t = d + (n c' - c) grad z to first order, where c = d_z, n c' = sqrt(n^2 - 1 + c^2), or d + 2 c grad z from a mirror.  These are
isotropic in the slope, as tangents are not: there (u, v) = R (t_x, t_y), with R the distance of the screen's centre from c, and the
point (x, y) of the lens adds (x, y) - t (t . (x, y)).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
import torch

from caustic_cli.inverse.projected_cells import cells_on_plane
from caustic_cli.optics.backends.reference import Torch
from caustic_cli.optics.screen_shape import points_in_space, shape_of
from caustic_cli.scene import Scene, Screen
from caustic_cli.scene.screen import tilt_to

if TYPE_CHECKING:  # another projection, of which this one knows no more
    from caustic_cli.inverse.relay import RelayedScreen

#: Skew of the pixels up to which they count as a lattice.
SQUARE = 1e-9


@dataclass(frozen=True, eq=False)
class ScreenProjection:
    """Projection of a screen from (0, 0, centre_z), mm, by light that travels towards +z (forward 1) or -z (-1)."""

    screen: Screen
    centre_z: float
    forward: float = 1.0

    def project(self, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(u, v) of points x, y of the screen, mm."""
        px, py, pz = points_in_space(self.screen, x, y)
        scale = (self.screen.z - self.centre_z) / (pz - self.centre_z)
        return px * scale, py * scale

    def screen_coordinates(self, u: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """x, y of the points of the screen that project to (u, v); NaN where there is none."""
        shape = np.shape(u)
        x, y, there = self.land((0.0, 0.0, self.centre_z), tuple(torch.from_numpy(self._ahead(u, v))))
        u, v = (torch.where(there, c, torch.nan).reshape(shape).numpy() for c in (x, y))
        return u, v

    def _ahead(self, u: np.ndarray, v: np.ndarray) -> np.ndarray:
        """Unit directions (3, N) from the centre to (u, v)."""
        ahead = np.stack([u, v, np.full(np.shape(u), self.screen.z - self.centre_z)]).reshape(3, -1)
        return ahead / np.sqrt((ahead * ahead).sum(0))

    def points(self, u: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Points in space of the screen that project to (u, v), mm; those of the plane where there is none."""
        x, y = self.screen_coordinates(u, v)
        there = np.isfinite(x)
        found = points_in_space(self.screen, np.where(there, x, 0.0), np.where(there, y, 0.0))
        px, py, pz = (np.where(there, a, b) for a, b in zip(found, (u, v, self.screen.z), strict=True))
        return px, py, pz

    sign, axial_scale = 1.0, (1.0, 1.0)  # as of `relay.RelayedScreen`, without elements between lens and screen
    aligned = False  # whether the pixels are a regular lattice on the plane

    def gain(self, index: float) -> float:
        """Change of (u, v) per slope of a surface, mm, to first order; index: as of `surface_from_map.surface`."""
        return (index - 1.0) * (self.screen.z - self.centre_z)

    def directions_to(self, u: np.ndarray, v: np.ndarray) -> Callable[..., tuple]:
        """A function of points x, y, z of the exit that returns directions, of any length, to the points that project to (u, v)."""
        px, py, pz = self.points(u, v)
        return lambda x, y, z: (px - x, py - y, pz - z)

    def intersections(self, origin: tuple, direction: tuple) -> tuple[np.ndarray, np.ndarray]:
        """(u, v) of rays, components (N,), NaN where they miss the screen."""
        *own, there = self.land(*(tuple(_tensor(c) for c in v) for v in (origin, direction)))
        u, v = self.project(*(c.numpy() for c in own))
        return np.where(there, u, np.nan), np.where(there, v, np.nan)

    def land(self, origin, direction) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Intersection of rays, components (N,) float64 or numbers, with the screen: x, y (N,) mm, and whether they reach it."""
        s = self.screen
        x, y, z = s.centre
        forward = math.copysign(1.0, float(np.dot(s.axes[2], (x, y, z - self.centre_z))))  # as the light meets its normal
        return shape_of(s).land(Torch(), origin, direction, (*s.shift, s.z), s.axes, forward)

    def projected_target(self, target: np.ndarray) -> tuple[np.ndarray, tuple[float, float], tuple[float, float]]:
        """Power on a regular grid of cells of the plane, FINER per pixel, from that on the screen's pixels (n_x, n_y), not all
        black; half width and height of the frame of these cells, which holds the bright pixels, and its centre, mm.

        Raises:
            InputError: part of the picture faces away from the lens.
        """
        return cells_on_plane(target, self.screen, self.project, self.screen_coordinates)


@dataclass(frozen=True, eq=False)
class BeamProjection(ScreenProjection):
    """Projection for light from infinity along a unit vector: onto direction cosines times the distance of the screen."""

    beam: tuple[float, float, float] = (0.0, 0.0, 1.0)

    @property
    def distance(self) -> float:
        """R, mm."""
        x, y, z = self.screen.centre
        return math.hypot(x, y, z - self.centre_z)

    @property
    def axial_scale(self) -> tuple[float, float]:  # type: ignore[override]  # a property instead of a constant
        """Changes of (u, v) per displacement on the lens along x and along y."""
        return 1.0 - self.beam[0] ** 2, 1.0 - self.beam[1] ** 2

    def gain(self, index: float) -> float:
        """As of a `ScreenProjection`."""
        c = self.beam[2]
        return self.distance * (2.0 * c if index < 0 else math.sqrt((index - 1.0) * (index + 1.0) + c * c) - c)

    def lean(self, index: float) -> list[float]:
        """Slopes along x and y of a plane surface that sends the light to the centre of the screen, to first order."""
        return [(c - self.distance * d) / self.gain(index) for c, d in zip(self._linear[0], self.beam[:2], strict=True)]

    @property
    def linear(self) -> np.ndarray:
        """Derivatives of (u, v) by the screen's coordinates at its centre, (2, 2)."""
        return self._linear[1]

    @cached_property
    def _linear(self) -> tuple[np.ndarray, np.ndarray]:
        """(u, v) of the screen's centre, mm, and its derivatives by the screen's coordinates, (2, 2)."""
        middle = np.array(self.screen.centre) - (0.0, 0.0, self.centre_z)
        ahead, along = middle / self.distance, np.array(self.screen.axes[:2]).T
        return middle[:2], (along - np.outer(ahead, ahead @ along))[:2]

    @property
    def aligned(self) -> bool:  # type: ignore[override]  # as above
        """Whether the pixels of a plane screen are a regular lattice along u and v in the linear approximation."""
        return not self.screen.curved and abs(self._linear[1][[0, 1], [1, 0]]).max() <= SQUARE

    def project(self, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(u, v) of points x, y of the screen, mm; to first order where its pixels are then a lattice."""
        if self.aligned:
            middle, by = self._linear
            return middle[0] + by[0, 0] * x + 0.0 * y, middle[1] + by[1, 1] * y + 0.0 * x
        px, py, pz = points_in_space(self.screen, x, y)
        scale = self.distance / np.sqrt(px * px + py * py + (pz - self.centre_z) ** 2)
        return px * scale, py * scale

    def screen_coordinates(self, u: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """As of a `ScreenProjection`."""
        if self.aligned:
            middle, by = self._linear
            return (u - middle[0]) / by[0, 0], (v - middle[1]) / by[1, 1]
        return super().screen_coordinates(u, v)

    def projected_target(self, target: np.ndarray) -> tuple[np.ndarray, tuple[float, float], tuple[float, float]]:
        """As of a `ScreenProjection`; of aligned pixels their power as it is."""
        if not self.aligned:
            return super().projected_target(target)
        (mx, my), by = self._linear
        return target, (abs(by[0, 0]) * self.screen.half_size[0], abs(by[1, 1]) * self.screen.half_size[1]), (mx, my)

    def _ahead(self, u: np.ndarray, v: np.ndarray) -> np.ndarray:
        a, b = u / self.distance, v / self.distance
        along = np.sqrt(np.maximum(1.0 - a * a - b * b, 0.0))
        return np.stack([a, b, self.forward * along]).reshape(3, -1)


@dataclass(frozen=True, eq=False)
class CrossedProjection:
    """A projection turned by half a turn, (-u, -v): optimal transport onto it is the map of light that crosses over.

    regular: the screen is upright and plane, so that its pixels are a lattice already.
    """

    of: ScreenProjection | RelayedScreen
    regular: bool = False

    @property
    def sign(self) -> float:
        """As of a `ScreenProjection`, opposite."""
        return -self.of.sign

    @property
    def axial_scale(self) -> tuple[float, float]:
        """As of the projection."""
        return self.of.axial_scale

    @property
    def aligned(self) -> bool:
        """As of the projection."""
        return self.regular or self.of.aligned

    def gain(self, index: float) -> float:
        """As of the projection."""
        return self.of.gain(index)

    def project(self, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(u, v) of points x, y of the screen, mm."""
        u, v = self.of.project(x, y)
        return -u, -v

    def screen_coordinates(self, u: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """x, y of the points of the screen that project to (u, v)."""
        return self.of.screen_coordinates(-u, -v)

    def directions_to(self, u: np.ndarray, v: np.ndarray) -> Callable[..., tuple]:
        """As of a `ScreenProjection`."""
        return self.of.directions_to(-u, -v)

    def intersections(self, origin: tuple, direction: tuple) -> tuple[np.ndarray, np.ndarray]:
        """(u, v) of rays, components (N,), NaN where they miss the screen."""
        u, v = self.of.intersections(origin, direction)
        return -u, -v

    def projected_target(self, target: np.ndarray) -> tuple[np.ndarray, tuple[float, float], tuple[float, float]]:
        """As of the projection; of an upright plane screen its pixels as they are."""
        if self.regular and isinstance(self.of, ScreenProjection):
            screen = self.of.screen
            power, half, (x, y) = target, screen.half_size, screen.shift
        else:
            power, half, (x, y) = self.of.projected_target(target)
        return np.ascontiguousarray(power[::-1, ::-1]), half, (-x, -y)


@dataclass(frozen=True, eq=False)
class FarProjection(BeamProjection):
    """Projection of the far field: onto direction cosines times its focal length, whatever the point of the lens."""

    axial_scale = (0.0, 0.0)  # type: ignore[assignment]  # a constant instead of a property

    @property
    def distance(self) -> float:
        """R, the focal length, mm."""
        return abs(self.screen.z)

    @cached_property
    def _linear(self) -> tuple[np.ndarray, np.ndarray]:
        """As of a `BeamProjection`."""
        axes, own = np.array(self.screen.axes).T, np.array(shape_of(self.screen).centre) / self.distance
        along = self.forward * math.sqrt(1.0 - own @ own)
        return self.distance * (axes @ (*own, along))[:2], (axes[:, :2] - np.outer(axes[:, 2], own / along))[:2]

    def directions_to(self, u: np.ndarray, v: np.ndarray) -> Callable[..., tuple]:
        """As of a `ScreenProjection`; exact, though (u, v) of a tilted screen are linear in its coordinates."""
        own = [(c + at) / self.distance for c, at in zip(self.screen_coordinates(u, v), shape_of(self.screen).centre, strict=True)]
        own.append(self.forward * np.sqrt(np.maximum(1.0 - own[0] ** 2 - own[1] ** 2, 0.0)))
        ahead = tuple(sum(c * axis[k] for c, axis in zip(own, self.screen.axes, strict=True)) for k in range(3))
        return lambda x, y, z: ahead

    def project(self, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """As of a `ScreenProjection`; linear, also of a screen that is tilted."""
        middle, by = self._linear
        return middle[0] + by[0, 0] * x + by[0, 1] * y, middle[1] + by[1, 0] * x + by[1, 1] * y

    def screen_coordinates(self, u: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """As of a `ScreenProjection`; the inverse of `project`."""
        middle, by = self._linear
        back = np.linalg.inv(by)
        a, b = u - middle[0], v - middle[1]
        return back[0, 0] * a + back[0, 1] * b, back[1, 0] * a + back[1, 1] * b


def projection_of(scene: Scene, mean: float) -> ScreenProjection | None:
    """Projection of a scene's screen for a surface of this mean height, mm; None for an upright plane screen."""
    screen, side = scene.screen, scene.lens.interaction.side
    if screen.far:
        return FarProjection(screen, mean, side, scene.source.axis)
    if scene.source.oblique:
        return BeamProjection(screen, mean, side, scene.source.axis)
    return None if screen.upright else ScreenProjection(screen, mean, side)


def stretching_surface(scene: Scene, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Heights (n, m), mm, at x (n,), y (m,) of the quadratic surface that in tilted light stretches the lens onto the screen, to
    first order: the optimal map between normal distributions of their second moments (Olkin & Pukelsheim, Linear Algebra Appl. 48,
    1982)."""
    screen, lens = scene.screen, scene.lens
    to = (FarProjection if screen.far else BeamProjection)(screen, lens.offset.thickness, lens.interaction.side, scene.source.axis)
    half, across = np.diag(lens.half_size), to.linear @ np.diag(screen.half_size)
    values, vectors = np.linalg.eigh(half @ across @ across.T @ half)
    stretch = np.linalg.solve(half, vectors @ np.diag(np.sqrt(values.clip(0.0))) @ vectors.T) @ np.linalg.inv(half) - np.diag(
        to.axial_scale
    )
    index = lens.effective_index
    at = np.stack(np.broadcast_arrays(x[:, None], y[None, :]))
    bent = 0.5 / to.gain(index) * np.einsum("iab,ij,jab->ab", at, stretch, at)
    return lens.offset.thickness + np.tensordot(to.lean(index), at, 1) + bent


def seen_by_light(scene: Scene, target: np.ndarray) -> tuple[Scene, np.ndarray]:
    """The scene with its screen's axes exchanged and reversed such that the light sees them along x and y of the lens, as nearly as
    may be, and the target (n_x, n_y) on its pixels; unchanged where they are, or on a curved screen or a folded axis."""
    screen, side = scene.screen, scene.lens.interaction.side
    if screen.curved or screen.windows or scene.elements:
        return scene, target
    light, axes = np.array(scene.undeviated), np.array(screen.axes)
    normal = axes[2] if side * (axes[2] @ light) > 0 else -axes[2]
    seen = axes - np.outer(axes @ light, light)

    def alike(choice: tuple[int, int, int]) -> float:
        first, a, b = choice
        return a * float(seen[first][0]) + b * float(seen[1 - first][1])

    choices = [(k, a, b) for k in (0, 1) for a in (1, -1) for b in (1, -1)]
    right = [(k, a, b) for k, a, b in choices if np.cross(a * axes[k], b * axes[1 - k]) @ normal > 0]
    best = max(right, key=alike)
    if best == (0, 1, 1):
        return scene, target
    first, a, b = best
    across = (float(c) for c in a * axes[first])
    pair = (lambda values: values[::-1]) if first else (lambda values: values)
    turned = replace(
        screen,
        tilt=tilt_to((next(across), next(across), next(across)), (float(normal[0]), float(normal[1]), float(normal[2]))),
        size=pair(screen.size),
        resolution=pair(screen.resolution),
    )
    target = target.T if first else target
    return replace(scene, screen=turned), np.ascontiguousarray(target[::a, ::b])


def _tensor(value):
    return value if isinstance(value, float) else torch.from_numpy(value)
