"""Evaluation of a height field as a differentiable torch function of the control heights, by the CPU kernels."""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor

from caustic_cli.optics.bspline import SplineSpace
from caustic_cli.optics.kernels import batches, blocks, intersect, spline
from caustic_cli.optics.kernels.stage import KernelStage, array
from caustic_cli.optics.kernels.threads import ALL

#: Points per piece of the surface up to which the coefficients of all pieces take longer than the reference takes for the points.
FEW = 0.1


class FusedSurface:
    """Kernel data of a height field of half widths (r_x, r_y) mm, for any heights."""

    def __init__(self, spaces: tuple[SplineSpace, SplineSpace], half_size: tuple[float, float]):
        self.axes = tuple(spline.axis(s) for s in spaces)
        self.shape = tuple(s.n for s in spaces)
        self.scale = (0.5 / half_size[0], 0.5 / half_size[1])
        self.linear = tuple(x for a in self.axes for x in (a.first, a.matrices))
        self.pieces = spline.Pieces._make((*(x for a in self.axes for x in a.geometry), *self.scale))
        self.grads: np.ndarray | None = None
        self.last: tuple[Tensor, np.ndarray] | None = None

    def few(self, points: int) -> bool:
        """Whether the reference is faster for so many points."""
        return points <= FEW * math.prod(self._coefficients()[:2])

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

    def evaluate(self, heights: np.ndarray, u: np.ndarray, v: np.ndarray) -> list[np.ndarray]:
        """z mm, dz/dx and dz/dy at points in [0, 1]^2, all (N,) float64."""
        found = [np.empty(len(u)) for _ in range(3)]
        if len(u) < math.prod(self._coefficients()[:2]):  # the coefficients of all pieces take longer, and much memory
            spline.evaluate_net(ALL, u, v, heights, self.linear, self.pieces, *found, blocks())
        else:
            spline.evaluate(ALL, u, v, self.coefficients(torch.from_numpy(heights)), self.pieces, *found, blocks())
        return found

    def pull_at(self, u: np.ndarray, v: np.ndarray, *by: np.ndarray) -> np.ndarray:
        """Adjoint of `evaluate`: derivatives by the heights, (n, m) float64."""
        grads = self.workspace()
        spline.pull_back(ALL, u, v, *by, self.pieces, grads)
        return self.pull(grads)

    def order(self, x: Tensor, y: Tensor) -> tuple[np.ndarray, int]:
        """Points (N,), mm, in order of their span products, and how many of these there are."""
        u, v = ((c.double() * s + 0.5).contiguous().numpy() for c, s in zip((x, y), self.scale, strict=True))
        return batches.order(u, v, self.pieces.breaks_u, self.pieces.breaks_v)

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

    def pull(self, grads: np.ndarray) -> np.ndarray:
        """Derivatives by the coefficients, block by block -> by the heights, (n, m) float64."""
        (_, matrices, _, _), out = self.linear, np.zeros(self.shape)
        spline.pull_coefficients(ALL, grads, *self.linear, np.zeros((*matrices.shape[:2], self.shape[1])), out)
        return out

    def _coefficients(self) -> tuple[int, ...]:
        """Shape of all polynomials' coefficients."""
        return *(len(a.first) for a in self.axes), *(a.matrices.shape[1] for a in self.axes)


def scattered_surface(surface: FusedSurface, heights: Tensor, u, v) -> tuple[Tensor, Tensor, Tensor]:
    """Heights (n, m) mm, points in [0, 1]^2 (N,) -> z mm, dz/dx, dz/dy (N,) float64, linear in the heights."""
    z, zx, zy = _SCATTERED((surface, u, v), heights)
    return z, zx, zy


def _pull_scattered(parameters, _inputs, _kept, by, _wanted):
    surface, u, v = parameters
    return (surface.pull_at(u, v, *by),)


_SCATTERED = KernelStage(lambda parameters, heights: parameters[0].evaluate(heights, *parameters[1:]), _pull_scattered, 3)


def sag_of(heights: Tensor) -> tuple[Tensor, float]:
    """Heights (n, m) minus their mean, float64, and the mean, mm: a sag small compared with the thickness keeps all its digits."""
    h = heights.detach().double()
    middle = float(h.mean())
    return h - middle, middle


def scaled(surface: FusedSurface, o, d) -> tuple[np.ndarray, ...]:
    """o, d mm -> o_u, o_v, o_z, d_u, d_v, d_z, float64."""
    (su, sv), (ox, oy, oz), (dx, dy, dz) = surface.scale, o, d
    return tuple(array(c) for c in (ox * su + 0.5, oy * sv + 0.5, oz, dx * su, dy * sv, dz))


def next_intersections(
    surface: FusedSurface, heights: Tensor, o, d, below: bool, round: bool, step: float, halvings: int, most: int
) -> Tensor:
    """The fused form of `reintersection.reference`: distances (N,) mm, 0 for none."""
    h, middle = sag_of(heights)
    limits, t = (float(h.min()), float(h.max())), np.empty(len(o[0]))
    rays, search = scaled(surface, (o[0], o[1], o[2] - middle), d), (round, step, halvings, most)
    c, slopes = surface.coefficients(h), surface.slope_bounds(h)
    intersect.intersect_again(ALL, rays, -1.0 if below else 1.0, limits, slopes, *search, c, surface.pieces, t, blocks())
    return torch.from_numpy(t)
