"""Surfaces around a source, P = r d: the distance r from the origin is a B-spline over directions d.

Notation
    u, v    stereographic coordinates of a direction, rho^2 = u^2 + v^2: the hemisphere z >= 0 is the disc rho <= 1
    d       unit direction, (2 u, 2 v, 1 - rho^2) / (1 + rho^2)
    r       mm: a positive spline over the square [-1, 1]^2 with control values (n, m)
    a, b    unit vectors along d_u and d_v; (a, b, d) is a right-handed orthonormal frame, since the map is conformal:
            |d_u| = |d_v| = 2 / (1 + rho^2)
    p, q    (1 + rho^2) / 2 (r_u, r_v) / r, the slopes of the surface in that frame

The normal is N = d - p a - q b: in the frame (a, b, d) the surface is, to first order, a height field with slopes p, q, so that
Snell and Fresnel of height fields (`optics.interface`) apply there as they stand.  N . d = 1: seen from the origin no part of the
surface hides another, and light from there meets every point from within.

Stereographic coordinates have no pole within the hemisphere, and enlarge its rim no more than twofold.  P is rational, of degree
degree + 2 over the same knots: a NURBS surface (`export.lamp_step`).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import torch
from torch import Tensor

from caustic_cli.errors import InputError
from caustic_cli.optics.bspline import SplineSpace
from caustic_cli.optics.surfaces.base import FIRST, SECOND
from caustic_cli.optics.surfaces.heightfield import HeightField

Vectors = tuple[Tensor, Tensor, Tensor]
#: Largest number of iterations for an intersection, and relative error of r at which it ends.
MOST_STEPS, ENOUGH = 60, 1e-14
EXTENT_POINTS = 400


class PolarHit(NamedTuple):
    """Intersections of rays with a surface around the origin.

    point: P, mm; u, v: its stereographic coordinates; p, q: slopes in the frame there; valid: whether the ray meets it; (N,) each.
    """

    point: Vectors
    u: Tensor
    v: Tensor
    p: Tensor
    q: Tensor
    valid: Tensor


def direction_of(u: Tensor, v: Tensor) -> Vectors:
    """Unit directions d of stereographic coordinates."""
    k = 2.0 / (1.0 + u * u + v * v)
    return k * u, k * v, k - 1.0


def stereographic(x: Tensor, y: Tensor, z: Tensor) -> tuple[Tensor, Tensor]:
    """Coordinates (u, v) of the directions of points, z > -|P|."""
    k = 1.0 / ((x * x + y * y + z * z).sqrt() + z)
    return k * x, k * y


def frame(u: Tensor, v: Tensor) -> tuple[Vectors, Vectors, Vectors]:
    """The orthonormal frame (a, b, d), see the module."""
    k = 2.0 / (1.0 + u * u + v * v)
    cross = -k * u * v
    return (1.0 - k * u * u, cross, -k * u), (cross, 1.0 - k * v * v, -k * v), (k * u, k * v, k - 1.0)


def to_frame(axes: tuple[Vectors, Vectors, Vectors], w: Vectors) -> Vectors:
    """Components of vectors along the axes of a frame."""
    x, y, z = (e[0] * w[0] + e[1] * w[1] + e[2] * w[2] for e in axes)
    return x, y, z


def from_frame(axes: tuple[Vectors, Vectors, Vectors], w: Vectors) -> Vectors:
    """Vectors, from their components along the axes of a frame."""
    x, y, z = (w[0] * a + w[1] * b + w[2] * d for a, b, d in zip(*axes, strict=True))
    return x, y, z


@dataclass(frozen=True, eq=False)
class PolarField:
    """A surface r(u, v) around the origin, over the spline spaces of u and of v on [-1, 1]; methods take control values (n, m) of
    r, mm.

    Raises:
        InputError: a space does not belong to [0, 1], see `SplineSpace`.
    """

    spaces: tuple[SplineSpace, SplineSpace]

    @classmethod
    def uniform(cls, control: tuple[int, int], degree: tuple[int, int] = (3, 3)) -> PolarField:
        """Over equispaced knots."""
        u, v = (SplineSpace.uniform(n, p) for n, p in zip(control, degree, strict=True))
        return cls((u, v))

    @property
    def net(self) -> HeightField:
        """r, a height field over the square."""
        return HeightField(self.spaces, (1.0, 1.0))

    @property
    def shape(self) -> tuple[int, int]:
        """Control values (n, m)."""
        return self.net.shape

    def sphere(self, radius: float) -> Tensor:
        """Control values (n, m) of the sphere about the origin, radius in mm.

        Raises:
            InputError: the radius is not positive.
        """
        if not 0 < radius < math.inf:
            raise InputError(f"the radius of a sphere around the source must be greater than 0 mm, got {radius!r}")
        return torch.full(self.shape, float(radius), dtype=torch.float64)

    def at(self, values: Tensor, u: Tensor, v: Tensor, orders: Sequence[tuple[int, int]] = FIRST) -> list[Tensor]:
        """Derivatives of r of these orders by u and v at points (N,): (N,) float64 each; linear in the control values."""
        return self.net.at(values, u, v, orders)

    @cached_property
    def _slope_nets(self) -> tuple[HeightField, HeightField]:
        """r_u and r_v, height fields over the square of one degree less along u, and along v."""
        (u, v), square = self.spaces, (1.0, 1.0)
        return HeightField((u.derivative, v), square), HeightField((u, v.derivative), square)

    def second(self, values: Tensor, u: Tensor, v: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """r_uu, r_uv, r_vv at points (N,): first derivatives of the splines r_u and r_v."""
        if min(space.degree for space in self.spaces) == 1:
            ruu, ruv, rvv = self.at(values, u, v, SECOND)
            return ruu, ruv, rvv
        by_u, by_v = (0.5 * space.differences(values, axis) for axis, space in enumerate(self.spaces))
        _, ruu, ruv = self._slope_nets[0].evaluate(by_u, u, v)
        return ruu, ruv, self._slope_nets[1].evaluate(by_v, u, v)[2]

    def points(self, values: Tensor, u: Tensor, v: Tensor) -> Vectors:
        """P at (u, v), mm."""
        (r,) = self.at(values, u, v, [(0, 0)])
        x, y, z = (r * d for d in direction_of(u, v))
        return x, y, z

    def normals(self, values: Tensor, u: Tensor, v: Tensor) -> Vectors:
        """Unit normals at (u, v), away from the origin."""
        p, q = slopes(u, v, *self.at(values, u, v))
        k = 1.0 / (1.0 + p * p + q * q).sqrt()
        return from_frame(frame(u, v), (-k * p, -k * q, k))

    def hull(self, values: Tensor) -> tuple[float, float]:
        """Least and largest r that bound the surface, mm, by the convex hull property."""
        low, high = torch.aminmax(values.detach())
        return float(low), float(high)

    @staticmethod
    def sampled() -> tuple[Tensor, Tensor]:
        """EXTENT_POINTS^2 points (u, v) of the side z >= 0, on rings."""
        rho = torch.linspace(0.0, 1.0, EXTENT_POINTS, dtype=torch.float64)
        angle = torch.linspace(0.0, 2.0 * math.pi, EXTENT_POINTS, dtype=torch.float64)
        return (rho[:, None] * torch.cos(angle)).reshape(-1), (rho[:, None] * torch.sin(angle)).reshape(-1)

    def extent(self, values: Tensor) -> tuple[float, float]:
        """Least and greatest r on the side z >= 0, mm, at EXTENT_POINTS^2 points."""
        low, high = torch.aminmax(self.net.evaluate(values.detach(), *self.sampled())[0])
        return float(low), float(high)

    def from_origin(self, values: Tensor, u: Tensor, v: Tensor) -> PolarHit:
        """Where rays from the origin in these directions meet the surface: always, at r; differentiable by the values."""
        return polar_hit(u, v, *self.net.evaluate(values, u, v))

    def intersect(self, values: Tensor, origin: Vectors, direction: Vectors) -> PolarHit:
        """First intersections of rays that start within the surface, of the side z >= 0; differentiable by values, origins and
        directions, once.

        F(t) = |o + t d| - r(o + t d) is negative at the start and positive beyond the largest distance that the control
        values allow.  Newton's method in that bracket, with bisection where it leaves it.  A ray that meets the surface three times
        may end at any of the crossings of F outwards; `valid` is False where there is no root, or the ray starts outside.

        Args:
            origin: mm; direction: unit vectors; (N,) each.
        """
        differentiable = torch.is_grad_enabled()
        with torch.no_grad():
            (ox, oy, oz), (dx, dy, dz), net = origin, direction, values.detach()
            o, d = (ox.detach(), oy.detach(), oz.detach()), (dx.detach(), dy.detach(), dz.detach())
            t, valid = self._root(net, o, d)
            at = stereographic(*(s + t * c for s, c in zip(o, d, strict=True)))
            second = self.second(net, *at) if differentiable else None
        here = self.net.evaluate(values, *at)
        # One Newton step with the derivatives of the root gives t its derivatives by the implicit function theorem; r near the root
        # is a Taylor polynomial, exact there with its first derivatives by points.
        x, y, z = (s + t * c for s, c in zip(origin, direction, strict=True))
        (r, _, _), _ = _near(here, second, at, stereographic(x, y, z))
        f = (x * x + y * y + z * z).sqrt() - r
        with torch.no_grad():
            p, q = slopes(*at, *here)
            along = to_frame(frame(*at), d)
            slope = along[2] - p * along[0] - q * along[1]  # there |o + t d| is r
        t = t - torch.where(valid, f / slope, torch.zeros_like(f))
        x, y, z = (s + t * c for s, c in zip(origin, direction, strict=True))
        (r, ru, rv), (u, v) = _near(here, second, at, stereographic(x, y, z))
        p, q = slopes(u, v, r, ru, rv)
        return PolarHit((x, y, z), u, v, p, q, valid)

    def _residual(self, values: Tensor, at, direction) -> tuple[Tensor, Tensor]:
        """F and its derivative by t."""
        x, y, z = at
        distance = (x * x + y * y + z * z).sqrt()
        u, v = stereographic(x, y, z)
        r, ru, rv = self.net.evaluate(values, u, v)
        p, q = slopes(u, v, r, ru, rv)
        along = to_frame(frame(u, v), direction)
        return distance - r, along[2] - r / distance * (p * along[0] + q * along[1])

    def _root(self, values: Tensor, o, d) -> tuple[Tensor, Tensor]:
        """t of the intersection, and whether there is one."""
        low, high = self.hull(values)
        square, along = sum(c * c for c in o), sum(a * b for a, b in zip(o, d, strict=True))
        far = (along * along - square + (1.0 + 1e-12) * high * high).clamp_min(0.0).sqrt() - along  # on the sphere around it all
        bottom = torch.where(d[2] < 0, -o[2] / d[2].clamp_max(-1e-300), torch.full_like(far, math.inf))
        upper = torch.minimum(far, bottom).clamp_min(0.0)  # only its side z >= 0
        lower = torch.zeros_like(upper)
        begins = self._inside(values, o)
        ends = ~self._inside(values, tuple(s + upper * c for s, c in zip(o, d, strict=True)))
        valid = begins & ends
        t = (along * along - square + (0.5 * (low + high)) ** 2).clamp_min(0.0).sqrt() - along
        t = torch.where((t > lower) & (t < upper), t, 0.5 * (lower + upper))
        for _ in range(MOST_STEPS):
            f, slope = self._residual(values, [s + t * c for s, c in zip(o, d, strict=True)], d)
            lower, upper = torch.where(f < 0, t, lower), torch.where(f < 0, upper, t)
            newton = t - f / slope
            outside = ~((newton > lower) & (newton < upper))  # also where it is not a number
            step = torch.where(outside, 0.5 * (lower + upper), newton)
            close = f.abs() <= ENOUGH * high
            done = close | ~valid
            t = torch.where(close, t, step)
            if bool(done.all()):
                break
        return torch.where(valid, t, torch.zeros_like(t)), valid

    def _inside(self, values: Tensor, at) -> Tensor:
        """Whether points lie within the surface."""
        x, y, z = at
        r = (x * x + y * y + z * z).sqrt()
        central = r <= 1e-300  # the origin, which has no direction, lies within
        u, v = stereographic(x, y, torch.where(central, torch.ones_like(z), z))
        return central | (r < self.net.evaluate(values, u, v)[0])


def _near(here, second, at: tuple[Tensor, Tensor], to: tuple[Tensor, Tensor]):
    """r, r_u, r_v at points from those `here`, at coordinates `at`, and second derivatives there, None for zero; and the points."""
    (r, ru, rv), du, dv = here, to[0] - at[0], to[1] - at[1]
    if second is None:
        return (r, ru, rv), to
    ruu, ruv, rvv = second
    return (r + ru * du + rv * dv, ru + ruu * du + ruv * dv, rv + ruv * du + rvv * dv), to


def slopes(u: Tensor, v: Tensor, r: Tensor, ru: Tensor, rv: Tensor) -> tuple[Tensor, Tensor]:
    """Slopes p, q in the frame, from r and its derivatives."""
    k = 0.5 * (1.0 + u * u + v * v) / r
    return k * ru, k * rv


def polar_hit(u: Tensor, v: Tensor, r: Tensor, ru: Tensor, rv: Tensor) -> PolarHit:
    """Where rays from the origin in directions (u, v) meet a surface with these values and derivatives of r."""
    p, q = slopes(u, v, r, ru, rv)
    x, y, z = (r * d for d in direction_of(u, v))
    return PolarHit((x, y, z), u, v, p, q, torch.ones_like(r, dtype=torch.bool))
