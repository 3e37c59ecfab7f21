"""The last word of a design on what a lens may not exceed: its surface is moved, as little as it takes, within all limits.

While a design runs, limits of slope and concave radius are penalties: the picture may win a little over them.  Here rays have no
say any more.  The sum of squares

    max(0, |grad z| / slope - 1)^2 + max(0, k r - 1)^2 + max(0, (low - P) / scale)^2 + max(0, (P - high) / scale)^2

over the surface is brought to zero by L-BFGS; slopes and largest principal curvatures k are those at some
points a knot span, with a little room to spare for the places between, P the control heights between their bounds.
"""

from __future__ import annotations

import torch
from torch import Tensor

from caustic_cli.errors import CausticError
from caustic_cli.inverse.lbfgs import LBFGS
from caustic_cli.optics import curvature
from caustic_cli.optics.bspline import SplineSpace
from caustic_cli.optics.heightfield import HeightField

#: Points a knot span at which limits are looked at, and most along an axis.
A_SPAN, MOST = 4, 2001
#: The part by which limits are kept tighter than asked, and by which they may then be exceeded where they are looked at.
ROOM, LEFT = 4e-3, 2e-3
STEPS = 400


def within_limits(field: HeightField, heights: Tensor, bounds: tuple[Tensor, Tensor], max_slope: float = 0.0,
                  min_radius: float = 0.0) -> Tensor:
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
    surface = _Limits(field, bounds, max_slope * (1.0 - ROOM), min_radius / (1.0 - ROOM))
    if surface.excess(heights) <= LEFT:
        return heights

    def evaluate(flat: Tensor) -> tuple[float, Tensor]:
        z = flat.view(field.shape).requires_grad_()
        value = surface.violation(z)
        (g,) = torch.autograd.grad(value, z)
        return float(value.detach()), g.reshape(-1)

    method = LBFGS(evaluate, heights.detach().double().reshape(-1).clone())
    for _ in range(STEPS):
        moved = method.step()
        found = method.x.view(field.shape)
        if surface.excess(found) <= LEFT:
            return found.clone()
        if not moved:
            break
    raise CausticError(f"no surface near the designed one obeys the limits: it still exceeds them by {surface.excess(found):.1%};"
                       " a larger --max-slope, a smaller --min-radius or --min-thickness may do")


class _Limits:
    def __init__(self, field: HeightField, bounds: tuple[Tensor, Tensor], slope: float, radius: float):
        self.scale = 1e-3 * max(field.half_size)
        self.low, self.high = bounds[0] + LEFT * self.scale, bounds[1] - LEFT * self.scale
        self.slope, self.radius = slope, radius
        (rx, ry), grids = field.half_size, [_grid(s) for s in field.spaces]
        self.u, self.v = ([s.matrix(g, k) / (2.0 * r) ** k for k in range(3)]
                          for s, g, r in zip(field.spaces, grids, (rx, ry), strict=True))

    def _terms(self, heights: Tensor):
        """What exceeds each limit, as parts of it."""
        need = curvature.ORDERS if self.radius > 0 else curvature.ORDERS[:2]
        zx, zy, *second = (self.u[a] @ heights @ self.v[b].T for a, b in need)
        if self.slope > 0:
            yield (zx * zx + zy * zy).clamp_min(1e-300).sqrt() / self.slope - 1.0
        if self.radius > 0:
            yield curvature.largest(zx, zy, *second) * self.radius - 1.0
        yield (self.low - heights) / self.scale
        yield (heights - self.high) / self.scale

    def violation(self, heights: Tensor) -> Tensor:
        return sum(term.clamp_min(0.0).square().sum() for term in self._terms(heights))

    @torch.no_grad()
    def excess(self, heights: Tensor) -> float:
        return max(float(term.max()) for term in self._terms(heights))


def _grid(space: SplineSpace) -> Tensor:
    """Even points on [0, 1]: all knots among them where these are equispaced."""
    spans = len(space.breaks) - 1
    return torch.linspace(0.0, 1.0, max(1, min(A_SPAN, MOST // spans)) * spans + 1, dtype=torch.float64)
