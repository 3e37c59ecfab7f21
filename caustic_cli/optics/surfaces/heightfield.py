"""A B-spline height field over a rectangle: z(x, y) = sum_ij P_ij N_i(u) N_j(v) (thesis 4.1).

The control points are placed at the Greville abscissae, so (u, v) -> (x, y) is linear, x = (2u - 1) r_x, and rays of an
axial plane wave need no intersection: they are sampled on the surface itself.

On a tensor-product sample the basis values are constants and the surface is three small matrix products,
    Z = B_u P B_v^T,    Z_x = B_u' P B_v^T / (2 r_x),    Z_y = B_u P B_v'^T / (2 r_y),
whose cost does not depend on the degree.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import cast

import numpy as np
import torch
from torch import Tensor

from caustic_cli.optics.backends import backend_for
from caustic_cli.optics.bspline import SplineSpace, over_grid
from caustic_cli.optics.sampling import Sample
from caustic_cli.optics.surfaces.base import FIRST, Surface, SurfaceIntersection
from caustic_cli.scene import Aperture, FreeForm, Lens


@dataclass(frozen=True, eq=False)
class HeightField(Surface[Tensor]):
    """Spline spaces over an aperture of half widths (r_x, r_y) mm."""

    spaces: tuple[SplineSpace, SplineSpace]
    half_size: tuple[float, float]

    @classmethod
    def of(cls, lens: Lens) -> HeightField:
        """The height field of a lens' exit."""
        if lens.knots is None:
            u, v = (SplineSpace.uniform(n, p, k) for n, p, k in zip(lens.control, lens.degree, lens.pieces, strict=True))
        else:
            u, v = (SplineSpace(p, torch.as_tensor(t, dtype=torch.float64)) for p, t in zip(lens.degree, lens.knots, strict=True))
        return cls((u, v), lens.half_size)

    @classmethod
    def through(cls, z: np.ndarray, half_size: tuple[float, float]) -> tuple[HeightField, Tensor]:
        """The interpolating spline of heights (a, b) mm on a uniform grid over the aperture, borders included, and its control
        heights: cubic, or of lower degree for fewer points."""
        points = [torch.linspace(0.0, 1.0, n, dtype=torch.float64) for n in z.shape]
        u, v = (SplineSpace.through(c) for c in points)
        return cls((u, v), half_size), v.interpolated(u.interpolated(torch.from_numpy(z), points[0]).T, points[1]).T.contiguous()

    @property
    def shape(self) -> tuple[int, int]:
        """Control points (n, m)."""
        return self.spaces[0].n, self.spaces[1].n

    def control_xy(self) -> tuple[Tensor, Tensor]:
        """Positions of the control points along x (n,) and y (m,), mm float64 (eq. 4.1.4)."""
        x, y = ((2.0 * s.greville - 1.0) * r for s, r in zip(self.spaces, self.half_size, strict=True))
        return x, y

    def interpolated(self, values: Tensor) -> Tensor:
        """Control heights (n, m) of the surface that has the values (n, m) float64 over its control points."""
        su, sv = self.spaces
        return sv.interpolated(su.interpolated(values).T).T.contiguous()

    def prepare(self, sample: Sample, dtype: torch.dtype) -> Evaluator:
        """Everything about the surface at these rays that does not depend on the heights; values in `dtype`."""
        (su, sv), (rx, ry) = self.spaces, self.half_size
        if sample.tensor:
            return _TensorEvaluator(
                *(
                    m.to(dtype)
                    for m in (
                        su.matrix(sample.u),
                        su.matrix(sample.u, 1) / (2 * rx),
                        sv.matrix(sample.v),
                        sv.matrix(sample.v, 1) / (2 * ry),
                    )
                )
            )
        (i, bu), (j, bv) = su.bases(sample.u, (0, 1)), sv.bases(sample.v, (0, 1))
        return _ScatteredEvaluator(i * sv.n + j, sv.n, *(b.to(dtype) for b in (bu[0], bu[1] / (2 * rx), bv[0], bv[1] / (2 * ry))))

    def at(self, heights: Tensor, x: Tensor, y: Tensor, orders: Sequence[tuple[int, int]] = FIRST) -> list[Tensor]:
        """Derivatives of these orders by x and y at points (N,) mm, each (N,) float64, mm^(1 - a - b); linear in the heights."""
        (su, sv), (rx, ry), flat = self.spaces, self.half_size, heights.double().reshape(-1)
        u, v = 0.5 * (x / rx + 1.0), 0.5 * (y / ry + 1.0)
        (i, bu), (j, bv) = (s.bases(c, {order[d] for order in orders}) for d, s, c in ((0, su, u), (1, sv, v)))
        corner = i * sv.n + j
        columns = torch.arange(sv.degree + 1, device=flat.device)
        totals: list[Tensor | float] = [0.0] * len(orders)
        for k in range(su.degree + 1):  # one row of the local net at a time bounds the memory
            at = (corner + k * sv.n)[:, None] + columns
            row = flat.index_select(0, at.reshape(-1)).view(at.shape)
            along = {b: (row * basis).sum(1) for b, basis in bv.items()}
            totals = [total + bu[a][:, k] * along[b] for total, (a, b) in zip(totals, orders, strict=True)]
        return [cast(Tensor, t) / ((2.0 * rx) ** a * (2.0 * ry) ** b) for t, (a, b) in zip(totals, orders, strict=True)]

    def slope_bounds(self, heights: Tensor) -> tuple[float, float]:
        """Upper bounds of |dz/dx| and |dz/dy|, by the convex hull property of the derivatives' control nets."""
        (su, sv), (rx, ry) = self.spaces, self.half_size
        h = heights.detach().double().cpu()
        return (
            float(su.differences(h).abs().max() / (2 * rx)),
            float(sv.differences(h, 1).abs().max() / (2 * ry)),
        )

    def hull(self, heights: Tensor) -> tuple[float, float]:
        """Least and largest control height, by the convex hull property."""
        low, high = torch.aminmax(heights.detach())
        return float(low), float(high)

    def least(self, heights: Tensor, aperture: Aperture, above: FreeForm | None = None) -> float:
        """Least height over an aperture of its half widths, mm, or above a surface over the same half widths, sampled at 8 points
        per knot span, at most 4001 along an axis, including the corners and the centre."""
        points = [torch.linspace(0.0, 1.0, min(4001, 8 * (len(s.breaks) - 1) + 1), dtype=torch.float64) for s in self.spaces]
        u, v = (s.banded(p) for s, p in zip(self.spaces, points, strict=True))
        z = over_grid(u, heights.detach().double().cpu(), v)
        if above is not None:
            z = z - torch.from_numpy(above.at(*(2.0 * p.numpy() - 1.0 for p in points)))
        return float(z[aperture.covers(2.0 * points[0][:, None] - 1.0, 2.0 * points[1][None, :] - 1.0)].min())

    def on_grid(self, heights: Tensor, shape: tuple[int, int]) -> Tensor:
        """Heights on an equidistant grid over the aperture, its borders included: of this shape, mm."""
        u, v = (s.banded(torch.linspace(0.0, 1.0, n, dtype=torch.float64)) for s, n in zip(self.spaces, shape, strict=True))
        return over_grid(u, heights.detach().double().cpu(), v)

    def centred(self, heights: Tensor) -> tuple[Tensor, float]:
        """Heights minus their mean, and the mean, mm: a sag small compared with the thickness keeps all its digits."""
        middle = float(heights.detach().double().mean())
        return heights.double() - middle, middle

    def evaluate(self, heights: Tensor, x: Tensor, y: Tensor) -> list[Tensor]:
        """As of any surface, by the kernels of the device's backend; linear in the heights."""
        return list(backend_for(x.device).spline_at(self, heights, x, y))

    def intersect(self, heights: Tensor, origin, direction, side: float) -> SurfaceIntersection:
        """As of any surface, by the kernels of the device's backend."""
        return backend_for(heights.device).intersect_spline(self, heights, origin, direction, side)

    def slope_bound(self, heights: Tensor) -> float:
        """An upper bound of |grad z|."""
        return math.hypot(*self.slope_bounds(heights))


class Evaluator:
    """A function of heights (n, m): z (mm), dz/dx, dz/dy at the prepared points, linear in the heights."""

    def __call__(self, heights: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        raise NotImplementedError


class _TensorEvaluator(Evaluator):
    def __init__(self, bu: Tensor, du: Tensor, bv: Tensor, dv: Tensor):
        self.bu, self.du, self.bv_t, self.dv_t = bu, du, bv.T.contiguous(), dv.T.contiguous()

    def __call__(self, heights: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        rows = self.bu @ heights  # (m_u, m)
        return rows @ self.bv_t, (self.du @ heights) @ self.bv_t, rows @ self.dv_t  # (m_u, m_v) each


class _ScatteredEvaluator(Evaluator):
    def __init__(self, corner: Tensor, stride: int, bu: Tensor, du: Tensor, bv: Tensor, dv: Tensor):
        self.corner, self.stride, self.bu, self.du, self.bv, self.dv = corner, stride, bu, du, bv, dv

    def __call__(self, heights: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        flat = heights.reshape(-1)
        z: Tensor | float
        zx: Tensor | float
        zy: Tensor | float
        z = zx = zy = 0.0
        columns = torch.arange(self.bv.shape[1], device=flat.device)
        for a in range(self.bu.shape[1]):  # one row of the local net at a time bounds the memory
            at = (self.corner + a * self.stride)[:, None] + columns
            row = flat.index_select(0, at.reshape(-1)).view(at.shape)  # (N, q + 1)
            value, slope = (row * self.bv).sum(1), (row * self.dv).sum(1)
            z = z + self.bu[:, a] * value
            zx = zx + self.du[:, a] * value
            zy = zy + self.bu[:, a] * slope
        return cast("tuple[Tensor, Tensor, Tensor]", (z, zx, zy))
