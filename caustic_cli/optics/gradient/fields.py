"""Refractive-index fields n(q) with the derivatives in the ray equation (thesis 7.2.1).

Notation, in the medium's frame, that of the element in front of it
    q = (x, y, z)   a point, mm
    n(q)            refractive index;  F = n grad n = grad(n^2) / 2, 1/mm

    Selfoc          n^2 = n_0^2 (1 - g^2 (x^2 + y^2))
    Radial          n = n_0 + a_1 r^2 + a_2 r^4 + ...,  r^2 = x^2 + y^2
    Axial           n = n_0 + a_1 z + a_2 z^2 + ...
    FishEye         n = n_0 / (1 + rho^2 / a^2), rho the distance from the centre (Maxwell; Born & Wolf, 4.2.2)
    Luneburg        n^2 = 2 - rho^2 / a^2 within the ball of radius a, 1 beyond (Luneburg, Mathematical Theory of Optics)
    SplineIndex     n = sum_ijk c_ijk N_i(u) N_j(v) N_k(w), a tensor-product B-spline volume over a box, eq. 7.2.1 with a box for
                    its X, Y and Z; outside the box basis functions are extrapolated linearly, so that F is continuous
"""

from __future__ import annotations

import itertools
import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import torch
from torch import Tensor

from caustic_cli.errors import InputError
from caustic_cli.optics.bspline import SplineSpace
from caustic_cli.scene import Lens
from caustic_cli.scene.gradient import DEGREE, Gradient

#: Lower bound of n^2: the formula n_0^2 (1 - g^2 r^2) is invalid where it becomes smaller.
LEAST_SQUARE = 0.25
#: Points along each axis of a box at which bounds of a formula are sampled, and safety factor for the slopes in between.
SURVEY, BETWEEN = 33, 1.2

Point = Sequence[Tensor]


class Extremes(NamedTuple):
    """Bounds over a box: least and largest index, and the largest |grad n|, 1/mm."""

    least: float
    most: float
    steepest: float


class IndexField(ABC):
    """An index field n(q).  shape: of its free coefficients, None if there are none."""

    shape: tuple[int, ...] | None = None

    @property
    def formula(self) -> tuple[tuple[float, ...], bool, bool] | None:
        """Polynomial form: coefficients, whether the variable is z instead of r^2, whether the value is n^2 instead of n; None if
        the field is not polynomial."""
        return None

    @abstractmethod
    def at(self, point: Point, coefficients: Tensor | None = None) -> tuple[Tensor, tuple[Tensor, Tensor, Tensor]]:
        """n^2 and F at points, three (N,) mm; differentiable by points and coefficients (None: the field's own)."""

    def index(self, point: Point) -> Tensor:
        """n at points (N,)."""
        return self.at(point)[0].clamp_min(LEAST_SQUARE).sqrt()

    def extremes(self, half_size: tuple[float, float], depth: float) -> Extremes:
        """Bounds over [-r_x, r_x] x [-r_y, r_y] x [0, depth], mm, from sampled points, with a safety factor for the slope.

        Raises:
            InputError: the index falls below 0.5.
        """
        (rx, ry) = half_size
        lines = [torch.linspace(*ends, SURVEY, dtype=torch.float64) for ends in ((-rx, rx), (-ry, ry), (0.0, depth))]
        square, force = self.at([c.reshape(-1) for c in torch.meshgrid(*lines, indexing="ij")])
        if not float(square.min()) >= LEAST_SQUARE:
            raise InputError("⟨lens.gradient_terms⟩ must keep the index above 0.5 everywhere in the lens")
        n = square.sqrt()
        steepest = float((square_of(force).sqrt() / n).max()) * BETWEEN
        return Extremes(float(n.min()), float(n.max()), steepest)


@dataclass(frozen=True)
class Selfoc(IndexField):
    """n^2 = n_0^2 (1 - g^2 r^2): a GRIN rod, in which rays are sinusoidal."""

    n0: float
    g: float

    @property
    def formula(self):
        """n^2 as a polynomial in r^2."""
        return (self.n0**2, -((self.n0 * self.g) ** 2)), False, True

    def at(self, point: Point, coefficients: Tensor | None = None):
        """See the module."""
        x, y, _ = point
        k = self.n0 * self.n0 * self.g * self.g
        return self.n0 * self.n0 - k * (x * x + y * y), (-k * x, -k * y, torch.zeros_like(x))


@dataclass(frozen=True)
class Radial(IndexField):
    """n = n_0 + a_1 r^2 + a_2 r^4 + ..."""

    n0: float
    terms: tuple[float, ...]

    @property
    def formula(self):
        """n as a polynomial in r^2."""
        return (self.n0, *self.terms), False, False

    def at(self, point: Point, coefficients: Tensor | None = None):
        """See the module."""
        x, y, _ = point
        n, slope = _polynomial(self.n0, self.terms, x * x + y * y)
        by_square = 2.0 * n * slope
        return n * n, (by_square * x, by_square * y, torch.zeros_like(x))


@dataclass(frozen=True)
class Axial(IndexField):
    """n = n_0 + a_1 z + a_2 z^2 + ..."""

    n0: float
    terms: tuple[float, ...]

    @property
    def formula(self):
        """n as a polynomial in z."""
        return (self.n0, *self.terms), True, False

    def at(self, point: Point, coefficients: Tensor | None = None):
        """See the module."""
        n, slope = _polynomial(self.n0, self.terms, point[2])
        return n * n, (torch.zeros_like(n), torch.zeros_like(n), n * slope)


@dataclass(frozen=True)
class FishEye(IndexField):
    """Maxwell's fish-eye: rays are circles; a point q is imaged to -a^2 q / |q|^2, relative to the centre."""

    n0: float
    radius: float
    centre: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def at(self, point: Point, coefficients: Tensor | None = None):
        """See the module."""
        away = [q - c for q, c in zip(point, self.centre, strict=True)]
        n = self.n0 / (1.0 + square_of(away) / self.radius**2)
        k = n * n * n * (-2.0 / (self.n0 * self.radius**2))
        return n * n, tuple(k * v for v in away)


@dataclass(frozen=True)
class Luneburg(IndexField):
    """The Luneburg lens: collimated light is focused on the opposite point of its surface."""

    radius: float
    centre: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def at(self, point: Point, coefficients: Tensor | None = None):
        """See the module."""
        away = [q - c for q, c in zip(point, self.centre, strict=True)]
        part = square_of(away) / self.radius**2
        k = (part < 1.0).to(part) * (-1.0 / self.radius**2)
        return 2.0 - part.clamp_max(1.0), tuple(k * v for v in away)


@dataclass(frozen=True, eq=False)
class SplineIndex(IndexField):
    """A B-spline volume."""

    #: (n, m, k) float64 control values; a single value along an axis makes the field constant along it.
    coefficients: Tensor
    #: Of the box [-r_x, r_x] x [-r_y, r_y] x [0, depth], mm.
    half_size: tuple[float, float]
    depth: float
    #: Along every axis, reduced where there are too few control values.
    degree: int = DEGREE

    def __post_init__(self):
        if self.coefficients.ndim != 3 or not self.depth > 0:
            raise InputError(f"an index volume must have three axes and a depth, got {tuple(self.coefficients.shape)}")
        object.__setattr__(self, "coefficients", self.coefficients.double())

    @property
    def shape(self) -> tuple[int, ...]:  # type: ignore[override]  # read-only here
        """Shape of the control values."""
        return tuple(self.coefficients.shape)

    @cached_property
    def spaces(self) -> tuple[SplineSpace | None, ...]:
        """Spline space of each axis, None if the field is constant along it."""
        return tuple(None if n == 1 else SplineSpace.uniform(n, min(self.degree, n - 1)) for n in self.coefficients.shape)

    @property
    def frame(self) -> tuple[tuple[float, float], ...]:
        """(centre, half width) of the box along each axis, mm: u = (x - centre) / (2 half) + 1 / 2."""
        return (0.0, self.half_size[0]), (0.0, self.half_size[1]), (0.5 * self.depth, 0.5 * self.depth)

    def at(self, point: Point, coefficients: Tensor | None = None):
        """See the module; the reference for `kernels.spline_index`."""
        c = (self.coefficients if coefficients is None else coefficients).to(point[0].device)
        parts = [self._basis(k, q) for k, q in enumerate(point)]
        flat, (_, m, depth) = c.reshape(-1), self.coefficients.shape
        (i, bu, du), (j, bv, dv), (k, bw, dw) = parts
        columns = torch.arange(bw.shape[-1], device=flat.device)
        n, slopes = torch.zeros_like(point[0]), [torch.zeros_like(point[0]) for _ in range(3)]
        for a, b in itertools.product(range(bu.shape[-1]), range(bv.shape[-1])):
            at = ((((i + a) * m + j + b) * depth) + k)[:, None] + columns
            row = flat.index_select(0, at.reshape(-1)).view(at.shape)
            value, slope = (row * bw).sum(1), (row * dw).sum(1)
            n = n + bu[:, a] * bv[:, b] * value
            for axis, term in enumerate((du[:, a] * bv[:, b] * value, bu[:, a] * dv[:, b] * value, bu[:, a] * bv[:, b] * slope)):
                slopes[axis] = slopes[axis] + term
        return n * n, tuple(n * s for s in slopes)

    def _basis(self, axis: int, q: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """First basis function, values and derivatives per mm; linearly extrapolated outside the box."""
        space, (middle, half) = self.spaces[axis], self.frame[axis]
        if space is None:
            one = torch.ones_like(q)[:, None]
            return torch.zeros_like(q, dtype=torch.int64), one, 0.0 * one
        u = 0.5 * ((q - middle) / half + 1.0)
        within = u.clamp(0.0, 1.0)
        (first, values), slopes = space.basis(within), space.basis(within, 1)[1]
        return first, values + slopes * (u - within)[:, None], slopes / (2.0 * half)

    def extremes(self, half_size: tuple[float, float], depth: float) -> Extremes:
        """Over the whole box, by the convex hull property of the field and of its derivatives."""
        c, slopes = self.coefficients.detach().cpu(), []
        for axis, (space, (_, half)) in enumerate(zip(self.spaces, self.frame, strict=True)):
            if space is not None:
                slopes.append(float(space.differences(c, axis).abs().max()) / (2.0 * half))
        return Extremes(float(c.min()), float(c.max()), math.hypot(*slopes))


def index_field_of(lens: Lens) -> IndexField | None:
    """The index field of a lens, z measured from its entrance; None for a homogeneous lens."""
    gradient = lens.gradient
    if gradient is None:
        return None
    return _made(gradient, lens)


def _made(gradient: Gradient, lens: Lens) -> IndexField:
    if gradient.kind == "selfoc":
        return Selfoc(lens.index, gradient.terms[0])
    if gradient.kind == "volume":
        return SplineIndex(torch.as_tensor(gradient.volume), lens.half_size, lens.offset.thickness - lens.z_in)
    return (Radial if gradient.kind == "radial" else Axial)(lens.index, gradient.terms)


def square_of(v: Sequence[Tensor]) -> Tensor:
    """v . v of a vector with three components."""
    return v[0] * v[0] + v[1] * v[1] + v[2] * v[2]


def _polynomial(constant: float, terms: Sequence[float], x: Tensor) -> tuple[Tensor, Tensor]:
    """constant + t_1 x + t_2 x^2 + ... and its derivative, by Horner's scheme."""
    value, slope = torch.zeros_like(x), torch.zeros_like(x)
    for t in (*reversed(terms), constant):
        slope = slope * x + value
        value = value * x + t
    return value, slope
