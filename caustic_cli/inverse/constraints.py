"""The last word of a design on what a lens may not exceed: its surface is moved, as little as it takes, within all limits.

While a design runs, limits of slope and concave radius are penalties: the picture may win a little over them.  Here rays have no
say any more.  The sum of squares

    max(0, |grad z| / slope - 1)^2 + max(0, k r - 1)^2 + max(0, (low - P) / scale)^2 + max(0, (P - high) / scale)^2

over the surface is brought to zero by L-BFGS.  Slopes and largest principal curvatures k are those at some points a knot span, with
a little room to spare for the places between, which grows until finer points obey too; P are the control heights.
"""

from __future__ import annotations

from collections.abc import Iterator

import torch
from torch import Tensor

from caustic_cli.errors import CausticError
from caustic_cli.inverse.lbfgs import LBFGS
from caustic_cli.optics import curvature
from caustic_cli.optics.bspline import SplineSpace
from caustic_cli.optics.surfaces.heightfield import HeightField

#: Points a knot span at which limits are kept and at which that is checked in the end, and most along an axis.
A_SPAN, CHECKED, MOST = 4, 10, 4001
#: The part by which limits are kept tighter than asked at first, for the places between points, and how often more is tried.
ROOM, TRIES = 2e-3, 6
#: The part of a limit by which it may be exceeded where it is kept, and by which the checked points must stay below it.
LEFT, SPARE = 1e-3, 1e-3
STEPS = 400
#: Points looked at together.
BLOCK = 400_000


def within_limits(
    field: HeightField, heights: Tensor, bounds: tuple[Tensor, Tensor], max_slope: float = 0.0, min_radius: float = 0.0
) -> Tensor:
    """Heights (n, m) mm that obey all limits, as near to `heights` as a descent leaves them; the same where these do already.

    Args:
        bounds: least and largest height of each control point, mm.
        max_slope: of |grad z|, 0 for none.
        min_radius: least radius of curvature of concave places, mm, 0 for any.

    Raises:
        CausticError: no such surface was found.
    """
    if not (max_slope > 0 or min_radius > 0):
        return heights
    asked = _Limits(field, bounds, max_slope * (1.0 - SPARE), min_radius / (1.0 - SPARE), CHECKED)
    found, room = heights, LEFT + ROOM
    for _ in range(TRIES):
        over = asked.excess(found)
        if over <= 0:
            return found
        if found is not heights:
            room += max(1.5 * over, LEFT)
        found = _descend(_Limits(field, bounds, max_slope * (1.0 - room), min_radius / (1.0 - room), A_SPAN), found)
    if asked.excess(found) <= 0:
        return found
    raise _none(asked.excess(found))


def _descend(limits: _Limits, heights: Tensor) -> Tensor:
    def evaluate(flat: Tensor) -> tuple[float, Tensor]:
        value, gradient = limits.violation(flat.view(heights.shape))
        return value, gradient.reshape(-1)

    method = LBFGS(evaluate, heights.detach().double().reshape(-1).clone())
    for _ in range(STEPS):
        moved = method.step()
        found = method.x.view(heights.shape)
        if limits.excess(found) <= LEFT:
            return found.clone()
        if not moved:
            break
    raise _none(limits.excess(found))


def _none(excess: float) -> CausticError:
    return CausticError(
        f"no surface near the designed one obeys the limits: it still exceeds them by {excess:.1%};"
        " a larger ⟨max_slope⟩, a smaller ⟨min_radius⟩ or ⟨min_thickness⟩ may do"
    )


class _Limits:
    """What exceeds the limits, on points (a, b) of an even grid with `a_span` of them a knot span."""

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
        """Points a, a block at a time, which bounds the memory and what of it is written anew."""
        count, step = self.u[0].shape[0], max(1, BLOCK // self.v[0].shape[0])
        return (slice(start, start + step) for start in range(0, count, step))

    def _shape(self, along: list[Tensor]) -> Iterator[Tensor]:
        """Slopes and radii beyond their limits, as parts of these."""
        need = curvature.ORDERS if self.radius > 0 else curvature.ORDERS[:2]
        zx, zy, *second = (torch.sparse.mm(self.v[b], along[a].T).T for a, b in need)
        if self.slope > 0:
            yield (zx * zx + zy * zy).clamp_min(1e-300).sqrt() / self.slope - 1.0
        if self.radius > 0:
            yield curvature.largest(zx, zy, *second) * self.radius - 1.0

    def violation(self, heights: Tensor) -> tuple[float, Tensor]:
        """Sum of squares of what exceeds, and its gradient (n, m); heights are asked to keep off their bounds, too, by more than is
        left in the end."""
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
        """The largest excess, 0 or less where all is obeyed."""
        along = self._along(heights)
        beyond = max(float((self.low - heights).max()), float((heights - self.high).max())) / self.scale
        return max(beyond, *(float(t.max()) for rows in self._blocks() for t in self._shape([a[rows] for a in along])))


def _grid(space: SplineSpace, a_span: int) -> Tensor:
    """Even points on [0, 1]: all knots among them where these are equispaced."""
    spans = len(space.breaks) - 1
    return torch.linspace(0.0, 1.0, max(1, min(a_span, MOST // spans)) * spans + 1, dtype=torch.float64)
