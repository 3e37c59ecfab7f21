"""Evaluation and intersection of a height field as differentiable torch functions of the control heights, by the CPU kernels."""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from caustic_cli.optics.bspline import SplineSpace
from caustic_cli.optics.kernels import batches, blocks, intersect, spline
from caustic_cli.optics.kernels.threads import ALL

#: Points per piece of the surface below which they are evaluated from the control heights instead of from all coefficients.
FEW = 1.0


class FusedSurface:
    """Kernel data of a height field of half widths (r_x, r_y) mm, for any heights."""

    def __init__(self, spaces: tuple[SplineSpace, SplineSpace], half_size: tuple[float, float]):
        self.axes = tuple(spline.axis(s) for s in spaces)
        self.shape = tuple(s.n for s in spaces)
        self.scale = (0.5 / half_size[0], 0.5 / half_size[1])
        self.linear = tuple(x for a in self.axes for x in (a.first, a.matrices))
        self.geometry = tuple(x for a in self.axes for x in a.geometry)
        self.grads: np.ndarray | None = None
        self.last: tuple[Tensor, np.ndarray] | None = None

    def coefficients(self, heights: Tensor) -> np.ndarray:
        """(n, m) mm -> the polynomial of every span product, (I, J, p + 1, q + 1) float64; cached for the last heights, since all
        rays of an image use the same."""
        heights = heights.detach().double()
        if self.last is not None and torch.equal(self.last[0], heights):
            return self.last[1]
        self.last, out = None, np.empty(self._coefficients())
        spline.coefficients(ALL, heights.contiguous().numpy(), *self.linear, out)
        self.last = heights.clone(), out
        return out

    def evaluate(self, heights: Tensor, u: np.ndarray, v: np.ndarray) -> tuple[Tensor, Tensor, Tensor]:
        """z mm, dz/dx and dz/dy at points in [0, 1]^2, all (N,) float64."""
        found = [torch.empty(len(u), dtype=torch.float64) for _ in range(3)]
        ends = (*self.geometry, *self.scale, *(t.numpy() for t in found), blocks())
        if len(u) < FEW * math.prod(self._coefficients()[:2]):
            spline.evaluate_net(ALL, u, v, heights.detach().double().contiguous().numpy(), *self.linear, *ends)
        else:
            spline.evaluate(ALL, u, v, self.coefficients(heights), *ends)
        return found[0], found[1], found[2]

    def order(self, x: Tensor, y: Tensor) -> tuple[np.ndarray, int]:
        """Points (N,), mm, in order of their span products, and how many of these there are."""
        u, v = ((c.double() * s + 0.5).contiguous().numpy() for c, s in zip((x, y), self.scale, strict=True))
        return batches.order(u, v, self.geometry[0], self.geometry[3])

    def slope_bounds(self, heights: Tensor) -> tuple[float, float]:
        """Bounds of |Z_u| and |Z_v| over [0, 1]^2, mm, from the control nets of the derivatives."""
        by_u, by_v = (float(a.space.differences(heights, axis).abs().max()) for axis, a in enumerate(self.axes))
        return by_u, by_v

    def workspace(self) -> np.ndarray:
        """Derivatives by the coefficients, a set for each block, to be overwritten."""
        shape = (blocks(), *self._coefficients())
        if self.grads is None or self.grads.shape != shape:
            self.grads = np.zeros(shape)
        return self.grads

    def pull(self, grads: np.ndarray) -> Tensor:
        """Derivatives by the coefficients, block by block -> by the heights, (n, m) float64."""
        (_, matrices, _, _), out = self.linear, np.zeros(self.shape)
        spline.pull_coefficients(ALL, grads, *self.linear, np.zeros((*matrices.shape[:2], self.shape[1])), out)
        return torch.from_numpy(out)

    def _coefficients(self) -> tuple[int, ...]:
        """Shape of all polynomials' coefficients."""
        return *(len(a.first) for a in self.axes), *(a.matrices.shape[1] for a in self.axes)


def scattered_surface(surface: FusedSurface, heights: Tensor, u: np.ndarray, v: np.ndarray):
    """Heights (n, m) mm, points in [0, 1]^2 (N,) -> z mm, dz/dx, dz/dy (N,) float64, linear in the heights."""
    return _ScatteredSurface.apply(heights, surface, u, v)


class _ScatteredSurface(torch.autograd.Function):
    @staticmethod
    def forward(heights: Tensor, surface: FusedSurface, u: np.ndarray, v: np.ndarray):
        return surface.evaluate(heights, u, v)

    @staticmethod
    def setup_context(ctx, inputs, output):
        heights, *ctx.rest = inputs
        ctx.heights_dtype = heights.dtype

    @staticmethod
    @once_differentiable
    def backward(ctx, *by):
        surface, u, v = ctx.rest
        grads = surface.workspace()
        spline.pull_back(ALL, u, v, *(g.contiguous().numpy() for g in by), *surface.geometry, *surface.scale, grads)
        return surface.pull(grads).to(ctx.heights_dtype), None, None, None


def _sag(heights: Tensor) -> tuple[Tensor, float]:
    """Heights (n, m) minus their mean, float64, and the mean, mm: a sag small compared with the thickness keeps all its digits."""
    h = heights.detach().double()
    middle = float(h.mean())
    return h - middle, middle


def next_intersections(
    surface: FusedSurface, heights: Tensor, o, d, below: bool, round: bool, step: float, halvings: int, most: int
) -> Tensor:
    """The fused form of `reintersection.reference`: distances (N,) mm, 0 for none."""
    h, middle = _sag(heights)
    rays = (
        o[0] * surface.scale[0] + 0.5,
        o[1] * surface.scale[1] + 0.5,
        o[2] - middle,
        d[0] * surface.scale[0],
        d[1] * surface.scale[1],
        d[2],
    )
    t = np.empty(len(o[0]))
    intersect.intersect_again(
        ALL,
        *(c.contiguous().numpy() for c in rays),
        -1.0 if below else 1.0,
        (float(h.min()), float(h.max())),
        surface.slope_bounds(h),
        round,
        step,
        halvings,
        most,
        surface.coefficients(h),
        *surface.geometry,
        t,
        blocks(),
    )
    return torch.from_numpy(t)


class RayIntersections:
    """Intersections of fixed rays from below with a height field: the fused form of `intersection.reference`.

    Args:
        origin, direction: (N,) float64 each, mm, inside the aperture, and unit vectors; z of the origins may be one number.
        radius: of a circular aperture, mm, or None.
    """

    def __init__(self, surface: FusedSurface, origin, direction, radius: float | None):
        self.surface = surface
        (x, y, self.z), (dx, dy, dz), (su, sv) = origin, direction, surface.scale
        if isinstance(self.z, Tensor):
            self.z = self.z.double().numpy()
        self.rays = tuple(
            t.double().contiguous().numpy() for t in (x * su + 0.5, y * sv + 0.5, torch.empty_like(x), dx * su, dy * sv, dz)
        )
        self.radius = np.inf if radius is None else radius
        self.t, self.status = np.zeros(len(x)), np.zeros(len(x), np.int8)
        self.order, used = surface.order(x, y)
        self.batched = len(x) >= batches.CROWD * used
        if not self.batched:
            self.order = np.arange(len(x), dtype=np.int32)

    def __call__(self, heights: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Heights (n, m) mm -> distance along each ray to its hit (mm; -1 for none), dz/dx and dz/dy there, (N,) float64."""
        return _Hits.apply(heights, self)[:3]

    def find(self, heights: Tensor, start: np.ndarray | None = None) -> np.ndarray:
        """Fill t (mm) and status of every ray; returns the coefficients of the surface, counted from the heights' mean.

        start: estimates of the distances (N,), infinite for none; None if unknown.
        """
        if start is None:
            c, self.status, reach, *_ = self.search(heights)
            self.t = np.maximum(reach, 0.0)
            return c
        c, limits, slopes = self._shape(heights)
        intersect.intersect(ALL, *self.rays, start, limits, slopes, c, *self.surface.geometry, self.t, self.status, blocks())
        x, y = ((o - 0.5 + self.t * d) / s for o, d, s in zip(self.rays[:2], self.rays[3:5], self.surface.scale, strict=True))
        beyond = (x * x + y * y > self.radius**2) & (self.status == 0)  # the ray has left the lens
        self.t[beyond], self.status[beyond] = 0.0, 1
        return c

    def search(self, heights: Tensor) -> tuple[np.ndarray, ...]:
        """Coefficients of the surface, and the results of `batches.first_hits`."""
        c, *bounds = self._shape(heights)
        out = batches.found(len(self.t))
        batches.first_hits(
            ALL,
            self.order,
            self.batched,
            *self.rays,
            *bounds,
            self.radius,
            c,
            *self.surface.geometry,
            *self.surface.scale,
            *out,
            blocks(),
        )
        return c, *out

    def _shape(self, heights: Tensor) -> tuple:
        """Coefficients counted from the heights' mean, from which the rays then start; limits and slopes, as of
        `batches.first_hits`."""
        h, middle = _sag(heights)
        self.rays[2][:] = self.z - middle
        return self.surface.coefficients(h), (float(h.min()), float(h.max())), self.surface.slope_bounds(h)


class _Hits(torch.autograd.Function):
    @staticmethod
    def forward(heights: Tensor, rays: RayIntersections):
        c, _, *out = rays.search(heights)
        return *(torch.from_numpy(a) for a in out), torch.from_numpy(c)

    @staticmethod
    def setup_context(ctx, inputs, output):
        heights, ctx.rays = inputs
        ctx.save_for_backward(heights, *output)
        ctx.mark_non_differentiable(*output[3:])

    @staticmethod
    @once_differentiable
    def backward(ctx, *by):
        heights, *found, met, where, c = ctx.saved_tensors
        surface, (ou, ov, _, *directions) = ctx.rays.surface, ctx.rays.rays
        grads, none = surface.workspace(), np.empty(0)
        batches.pull_back(
            ALL,
            met.numpy(),
            where.numpy(),
            *(g.contiguous().numpy() for g in by[:3]),
            ou,
            ov,
            *directions,
            *(t.detach().numpy() for t in found),
            c.numpy(),
            *surface.geometry,
            *surface.scale,
            grads,
            none,
            none,
            none,
        )
        return surface.pull(grads).to(heights.dtype), None
