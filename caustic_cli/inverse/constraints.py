"""Enforcement of the constraints of slope, concave radius and height on a finished surface, by minimising their violation.

During a design the limits of slope and concave radius are penalty terms, which the optimum may violate slightly.  Here the loss is
left out, and the sum of squares

    max(0, |grad z| / slope - 1)^2 + max(0, k r - 1)^2 + max(0, (low - P) / scale)^2 + max(0, (P - high) / scale)^2

over the surface is brought to zero by L-BFGS from the designed heights.  Slopes and largest principal curvatures k are evaluated at
a few points per knot span, with a safety margin that is increased until a finer grid satisfies the limits too; P are the control
heights.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import torch
from torch import Tensor

from caustic_cli.errors import CausticError
from caustic_cli.inverse.lbfgs import LBFGS
from caustic_cli.optics import curvature
from caustic_cli.optics.bspline import SplineSpace
from caustic_cli.optics.surfaces.heightfield import HeightField
from caustic_cli.schema.table import check_all

#: Points per knot span at which the limits are enforced and at which they are finally checked, and most along an axis.
A_SPAN, CHECKED, MOST = 4, 10, 4001
#: First relative safety margin for places between the points, and number of attempts with larger ones.
ROOM, TRIES = 2e-3, 6
#: Relative violation tolerated where the limits are enforced, and margin that the final check demands.
LEFT, SPARE = 1e-3, 1e-3
STEPS = 400
#: Points evaluated at a time, which bounds the memory.
BLOCK = 400_000


@dataclass(frozen=True)
class Limits:
    """Limits of a designed surface."""

    #: Of the slope |grad z|, 0 for none.
    max_slope: float = 0.0
    #: Least radius of curvature of concave regions, mm, 0 for any.
    min_radius: float = 0.0

    def __post_init__(self):
        check_all("design", self, "max_slope", "min_radius")

    def feasible(self, field: HeightField, heights: Tensor, bounds: tuple[Tensor, Tensor], side: int, rounded: bool) -> Tensor:
        """`within_limits` for a surface that is machined from +z, or from -z (side -1), where concave and convex are exchanged.

        rounded: False leaves the radius out.
        """
        radius = self.min_radius if rounded else 0.0
        if side > 0:
            return within_limits(field, heights, bounds, self.max_slope, radius)
        low, high = bounds
        return -within_limits(field, -heights, (-high, -low), self.max_slope, radius)


def within_limits(
    field: HeightField, heights: Tensor, bounds: tuple[Tensor, Tensor], max_slope: float = 0.0, min_radius: float = 0.0
) -> Tensor:
    """Feasible heights (n, m) mm near the given ones, which are returned unchanged if they are feasible.

    Args:
        bounds: least and largest height of each control point, mm.
        max_slope: of |grad z|, 0 for none.
        min_radius: least radius of curvature of concave regions, mm, 0 for any.

    Raises:
        CausticError: no feasible surface was found.
    """
    if not (max_slope > 0 or min_radius > 0):
        return heights
    asked = _Constraints(field, bounds, max_slope * (1.0 - SPARE), min_radius / (1.0 - SPARE), CHECKED)
    candidate, room = heights, LEFT + ROOM
    for _ in range(TRIES):
        over = asked.excess(candidate)
        if over <= 0:
            return candidate
        if candidate is not heights:
            room += max(1.5 * over, LEFT)
        if room >= 1.0:  # between the points it exceeds the limits many times over, as at the creases between lenslets
            break
        candidate = _descend(_Constraints(field, bounds, max_slope * (1.0 - room), min_radius / (1.0 - room), A_SPAN), candidate)
    if asked.excess(candidate) <= 0:
        return candidate
    raise _none(asked.excess(candidate))


def _descend(limits: _Constraints, heights: Tensor) -> Tensor:
    def evaluate(flat: Tensor) -> tuple[float, Tensor]:
        value, gradient = limits.violation(flat.view(heights.shape))
        return value, gradient.reshape(-1)

    method = LBFGS(evaluate, heights.detach().double().reshape(-1).clone())
    for _ in range(STEPS):
        moved = method.step()
        candidate = method.x.view(heights.shape)
        if limits.excess(candidate) <= LEFT:
            return candidate.clone()
        if not moved:
            break
    raise _none(limits.excess(candidate))


def _none(excess: float) -> CausticError:
    return CausticError(
        f"no surface near the designed one obeys the limits: it still exceeds them by {excess:.1%};"
        " a larger ⟨max_slope⟩, a smaller ⟨min_radius⟩ or ⟨min_thickness⟩ may do"
    )


class _Constraints:
    """Violation of the limits on a regular grid of `a_span` points per knot span."""

    def __init__(self, field: HeightField, bounds: tuple[Tensor, Tensor], slope: float, radius: float, a_span: int):
        self.low, self.high = bounds
        self.slope, self.radius, self.scale = slope, radius, 1e-3 * max(field.half_size)
        grids = [_grid(s, a_span) for s in field.spaces]
        self.u, self.v = (
            [s.banded(g, k) / (2.0 * r) ** k for k in range(3)]
            for s, g, r in zip(field.spaces, grids, field.half_size, strict=True)
        )

    def _along(self, heights: Tensor) -> list[Tensor]:
        """The surface's derivatives by x of order 0, 1 and 2 at the points a, as control heights along y: (points, m) each."""
        return [torch.sparse.mm(u, heights) for u in self.u]

    def _blocks(self) -> Iterator[slice]:
        """Slices of the rows of points, which bound the memory."""
        count, step = self.u[0].shape[0], max(1, BLOCK // self.v[0].shape[0])
        return (slice(start, start + step) for start in range(0, count, step))

    def _shape(self, along: list[Tensor]) -> Iterator[Tensor]:
        """Relative excess of slopes and curvatures over their limits, negative where they are satisfied."""
        need = curvature.ORDERS if self.radius > 0 else curvature.ORDERS[:2]
        zx, zy, *second = (torch.sparse.mm(self.v[b], along[a].T).T for a, b in need)
        if self.slope > 0:
            yield (zx * zx + zy * zy).clamp_min(1e-300).sqrt() / self.slope - 1.0
        if self.radius > 0:
            yield curvature.largest(zx, zy, *second) * self.radius - 1.0

    def violation(self, heights: Tensor) -> tuple[float, Tensor]:
        """Sum of squares of the excess, and its gradient (n, m) per mm; heights keep a margin to their bounds beyond the
        tolerance."""
        room = 2.0 * LEFT * self.scale
        short, tall = (t.clamp_min(0.0) / self.scale for t in (self.low + room - heights, heights - self.high + room))
        value, gradient = float(short.square().sum() + tall.square().sum()), 2.0 * (tall - short) / self.scale
        along = self._along(heights)
        pulls = [torch.zeros_like(t) for t in along]
        for rows in self._blocks():
            part = [t[rows].requires_grad_() for t in along]
            beyond = torch.stack([term.clamp_min(0.0).square().sum() for term in self._shape(part)]).sum()
            for pull, found in zip(pulls, torch.autograd.grad(beyond, part, allow_unused=True), strict=True):
                if found is not None:
                    pull[rows] = found
            value += float(beyond.detach())
        return value, gradient + sum(torch.sparse.mm(u.T, pull) for u, pull in zip(self.u, pulls, strict=True))

    @torch.no_grad()
    def excess(self, heights: Tensor) -> float:
        """The largest relative excess, 0 or less for feasible heights."""
        along = self._along(heights)
        beyond = max(float((self.low - heights).max()), float((heights - self.high).max())) / self.scale
        return max(beyond, *(float(t.max()) for rows in self._blocks() for t in self._shape([a[rows] for a in along])))


def _grid(space: SplineSpace, a_span: int) -> Tensor:
    """Equispaced points on [0, 1], which include all knots where these are equispaced."""
    spans = len(space.breaks) - 1
    return torch.linspace(0.0, 1.0, max(1, min(a_span, MOST // spans)) * spans + 1, dtype=torch.float64)
