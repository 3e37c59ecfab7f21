"""Geometry of curved screens: ray intersection, points and normals in space, and pixel areas.

Notation, in the screen's frame, with its origin at the screen's centre and the axes of its tangent plane (`Screen.axes`)
    x, y    coordinates in the tangent plane, in which pixels are equal cells;  S(x, y) the screen's height, mm, see `scene.screen`
    A       sqrt(1 + S_x^2 + S_y^2), surface area per area of the tangent plane

Images are power per pixel; irradiance is power over the true area of the pixel, A times that of its cell.  On a Lambertian screen
the luminance is proportional to the irradiance from every direction.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import torch
from torch import Tensor

from caustic_cli.optics.surfaces import HeightField, Sphere, Surface
from caustic_cli.optics.surfaces.cylinder import Cylinder
from caustic_cli.scene import Screen
from caustic_cli.scene.screen import PLANE, Sags

#: Extension of a measured shape beyond each border, as a fraction of its width, by point reflection: it catches light off the
#: screen.
BESIDE = 0.25
#: Gauss points of a pixel along each axis, as fractions of its width, for the quadrature of its area.
GAUSS = (0.5 - 0.5 / math.sqrt(3.0), 0.5 + 0.5 / math.sqrt(3.0))
#: Points along each axis at which the axial extent of a screen is evaluated.
SURVEY = 129


class PlaneScreen:
    """The shape of a plane screen, in the screen's frame; curved ones are subclasses."""

    #: Flat pieces along each axis by which it is represented where a plane is needed; whether it is flat.
    pieces = 1
    flat = True

    def land(self, backend, origin, direction, point, axes, forward: float) -> tuple[Tensor, Tensor, Tensor]:
        """Landing points of rays: arguments and results as for the backend's `land`, with the screen's centre for `point`."""
        return backend.land(origin, direction, point, axes, forward)

    def at(self, x: np.ndarray, y: np.ndarray) -> list[np.ndarray]:
        """S, S_x and S_y at points of a common shape, float64."""
        return [np.zeros(np.broadcast_shapes(np.shape(x), np.shape(y)))] * 3

    def points(self, x: np.ndarray, y: np.ndarray, middle, axes, beyond: float) -> np.ndarray:
        """Points in space (..., 3), mm, from coordinates x, y of a common shape, of a screen with this centre and these axes;
        beyond: see `FarField.points`."""
        away = zip((x, y, self.at(x, y)[0]), axes, strict=True)
        return sum((np.multiply.outer(c, axis) for c, axis in away), np.array(middle, dtype=np.float64))

    def coordinates(self, points: np.ndarray, middle, axes) -> tuple[np.ndarray, np.ndarray]:
        """The inverse of `points`, of points (3, N)."""
        away = points - np.array(middle)[:, None]
        x, y = (np.array(axis) @ away for axis in axes[:2])
        return x, y


@dataclass(frozen=True, eq=False)
class CurvedScreen(PlaneScreen):
    """A surface in the screen's frame, with its control heights if it has any."""

    surface: Surface
    heights: Tensor | None = None

    pieces = 16
    flat = False

    def land(self, backend, origin, direction, point, axes, forward: float) -> tuple[Tensor, Tensor, Tensor]:
        """By intersection with the surface, whatever the backend."""
        like = next(c for c in (*origin, *direction) if isinstance(c, Tensor))
        o = tuple(_dot([_double(c) - p for c, p in zip(origin, point, strict=True)], axis) for axis in axes)
        d = tuple(_dot([_double(c) for c in direction], axis) for axis in axes)
        o, d = (tuple(torch.as_tensor(c, dtype=torch.float64, device=like.device).expand(like.shape) for c in v) for v in (o, d))
        heights = None if self.heights is None else self.heights.to(like.device)
        hit = self.surface.intersect(heights, o, d, forward)
        x, y = (torch.where(hit.valid, a + hit.t * b, a).to(like.dtype) for a, b in zip(o[:2], d[:2], strict=True))
        return x, y, hit.valid

    def at(self, x: np.ndarray, y: np.ndarray) -> list[np.ndarray]:
        """S, S_x and S_y at points of a common shape, float64."""
        rx, ry = self.surface.half_size
        u, v = (torch.from_numpy(np.clip(c, -r, r).ravel()) for c, r in zip(np.broadcast_arrays(x, y), (rx, ry), strict=True))
        return [c.numpy().reshape(np.broadcast_shapes(np.shape(x), np.shape(y))) for c in self.surface.at(self.heights, u, v)]


@dataclass(frozen=True, eq=False)
class FarField(PlaneScreen):
    """The far field, in the screen's frame: its focal length, and its centre's coordinates along its axes, mm."""

    focal: float
    centre: tuple[float, float]

    flat = False

    def points(self, x: np.ndarray, y: np.ndarray, middle, axes, beyond: float) -> np.ndarray:
        """As of a plane screen: of a sphere of the radius |beyond|, mm, about the origin, on the side of the normal, or on the
        other one where it is negative."""
        p, q = ((c + at) / self.focal for c, at in zip((x, y), self.centre, strict=True))
        along = math.copysign(1.0, beyond) * np.sqrt(1.0 - p * p - q * q)
        return abs(beyond) * sum(np.multiply.outer(c, axis) for c, axis in zip((p, q, along), axes, strict=True))

    def coordinates(self, points: np.ndarray, middle, axes) -> tuple[np.ndarray, np.ndarray]:
        """As of a plane screen, of points far away."""
        away = points / np.maximum(np.linalg.norm(points, axis=0), np.finfo(float).tiny)
        x, y = (self.focal * (np.array(axis) @ away) - at for axis, at in zip(axes, self.centre, strict=False))
        return x, y

    def land(self, backend, origin, direction, point, axes, forward: float) -> tuple[Tensor, Tensor, Tensor]:
        """By direction alone."""
        like = next(c for c in (*direction, *origin) if isinstance(c, Tensor))
        x, y, along = (torch.as_tensor(_dot(direction, axis), dtype=like.dtype, device=like.device) for axis in axes)
        x, y = (self.focal * c.expand(like.shape) - at for c, at in zip((x, y), self.centre, strict=True))
        return x, y, (forward * along).expand(like.shape) > 0


def _double(value):
    return value.double() if isinstance(value, Tensor) else value


def _dot(vector: Sequence, axis: Sequence[float]):
    return sum(c * a for c, a in zip(vector, axis, strict=True))


@lru_cache(maxsize=16)
def _shape(radius: tuple[float, float], sags: Sags | None) -> PlaneScreen:
    if radius == PLANE and sags is None:
        return PlaneScreen()
    if sags is None:
        if radius[0] == radius[1]:
            return CurvedScreen(Sphere(radius[0]))
        bent = 0 if math.isfinite(radius[0]) else 1
        return CurvedScreen(Cylinder(radius[bent], bent))
    beside = [math.ceil(BESIDE * n) for n in sags.values.shape]
    values = np.pad(sags.values, [(k, k) for k in beside], mode="reflect", reflect_type="odd")
    half = (0.5 * w * (1.0 + 2.0 * k / (n - 1)) for w, k, n in zip(sags.size, beside, sags.values.shape, strict=True))
    return CurvedScreen(*HeightField.through(values, tuple(half)))


def shape_of(screen: Screen) -> PlaneScreen:
    """The shape of a screen."""
    if screen.far:
        x, y = (_dot(screen.centre, axis) for axis in screen.axes[:2])
        return FarField(abs(screen.z), (x, y))
    return _shape(tuple(screen.radius), screen.sags)


def points_in_space(screen: Screen, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points of a screen in space, mm, from its own coordinates x, y, mm, measured from its centre."""
    shape, (ax, ay, n) = shape_of(screen), screen.axes
    s = shape.at(x, y)[0]
    px, py, pz = (m + x * a + y * b + s * c for m, a, b, c in zip(screen.centre, ax, ay, n, strict=True))
    return px, py, pz


def normals(screen: Screen, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Normals in space, of length A, at points of a screen given by its own coordinates."""
    shape, (ax, ay, n) = shape_of(screen), screen.axes
    sx, sy = shape.at(x, y)[1:]
    nx, ny, nz = (c - sx * a - sy * b for a, b, c in zip(ax, ay, n, strict=True))
    return nx, ny, nz


def areas(screen: Screen) -> np.ndarray | None:
    """A of every pixel, (n_x, n_y); None for a plane screen, where it is 1."""
    if not screen.curved:
        return None
    x, y = (
        (np.arange(n)[:, None] + GAUSS).ravel() * w - h
        for n, w, h in zip(screen.resolution, screen.pixel, screen.half_size, strict=True)
    )
    _, sx, sy = shape_of(screen).at(x[:, None], y[None, :])
    (n, m), k = screen.resolution, len(GAUSS)
    return np.sqrt(1.0 + sx * sx + sy * sy).reshape(n, k, m, k).mean((1, 3))


@lru_cache(maxsize=16)
def reach(screen: Screen) -> tuple[float, float]:
    """Axial extent of a screen relative to its centre along the system's z, mm: (least, at most 0; greatest, at least 0)."""
    if screen.upright:
        return 0.0, 0.0
    x, y = (np.linspace(-h, h, SURVEY) for h in screen.half_size)
    z = points_in_space(screen, x[:, None], y[None, :])[2] - screen.z
    return min(0.0, float(z.min())), max(0.0, float(z.max()))
