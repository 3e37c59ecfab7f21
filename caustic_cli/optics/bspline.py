"""B-spline spaces (thesis 2.4 and appendix A; Piegl & Tiller, The NURBS Book, 1997).

Notation
    p, q    degrees along u and v
    t       knot vector, open: the end knots have multiplicity p + 1; domain [t_p, t_n] (here [0, 1])
    n       number of control points along one axis, len(t) = n + p + 1
    s       knot span: t_s <= x < t_{s+1}; the last span is closed, so x = 1 belongs to it
    N       basis values, (..., p + 1): N_{s-p..s, p}(x), the only ones that do not vanish

Values come from the triangular left/right scheme on a non-empty span: it never divides by zero, however
often knots repeat.  A derivative is a difference of the basis of lower degree (eq. 2.4.9).  Positions are
float64; callers round the finished basis values to float32 if they want to, which keeps the cancellation
in x - t_i out of single precision.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np
import torch
from torch import Tensor

from caustic_cli.errors import InputError

MAX_DEGREE = 15
#: Least distance of distinct knots on the domain [0, 1]: closer knots are not resolved by float64 basis values.
KNOT_RESOLUTION = 1e-12


def open_knots(n: int, degree: int, parts: int = 1) -> Tensor:
    """Open, equispaced knot vector on [0, 1] for `n` control points of `degree`: (n + degree + 1,), float64.

    parts: number of pieces of equal width that join with C0 continuity: their borders are knots of multiplicity `degree`, so that
    each piece of s spans is an independent spline over an open, equispaced knot vector and shares one control point with the next:
    n = parts (s + degree - 1) + 1.
    """
    if n < degree + 1:
        raise InputError(f"a spline of degree {degree} needs at least {degree + 1} control points, got {n}")
    spans, rest = divmod(n - 1, parts)
    spans -= degree - 1
    if rest or spans < 1:
        raise InputError(
            f"{parts} splines of degree {degree} side by side need {parts} times {degree} or more control points, and one, got {n}"
        )
    inner = torch.linspace(0.0, 1.0, parts * spans + 1, dtype=torch.float64)
    times = torch.ones(len(inner), dtype=torch.int64)
    times[::spans] = degree
    inner = inner.repeat_interleave(times)
    return torch.cat([inner.new_zeros(1), inner, inner.new_ones(1)])


@dataclass(frozen=True, eq=False)
class SplineSpace:
    """The B-splines of one degree over one open knot vector on [0, 1].

    Raises:
        InputError: the degree or the knot vector is not of that form.
    """

    #: Polynomial degree p, 1 to 15.
    degree: int
    #: (n + p + 1,) non-decreasing; end knots 0 and 1 with multiplicity p + 1, inner ones at most p (multiplicity p + 1 makes the
    #: surface discontinuous and is rejected).
    knots: Tensor

    def __post_init__(self):
        p, t = self.degree, torch.as_tensor(self.knots, dtype=torch.float64).detach().cpu()
        object.__setattr__(self, "knots", t)
        if not 1 <= p <= MAX_DEGREE:
            raise InputError(f"spline degree must be 1 to {MAX_DEGREE}, got {p}")
        if t.ndim != 1 or len(t) < 2 * (p + 1):
            raise InputError(f"a knot vector of degree {p} needs at least {2 * (p + 1)} knots, got {tuple(t.shape)}")
        if not bool(torch.isfinite(t).all()) or bool((t.diff() < 0).any()):
            raise InputError("a knot vector must be finite and non-decreasing")
        if bool((t[: p + 1] != 0).any()) or bool((t[-p - 1 :] != 1).any()):
            raise InputError(f"a knot vector of degree {p} must begin with {p + 1} zeros and end with {p + 1} ones")
        inner = t[p + 1 : -p - 1]
        if len(inner):
            values, counts = torch.unique(inner, return_counts=True)
            if bool((values <= 0).any()) or bool((values >= 1).any()):
                raise InputError(f"inner knots must lie strictly between 0 and 1 for degree {p}")
            if bool((counts > p).any()):
                raise InputError(
                    f"an inner knot may be repeated at most {p} times for degree {p}: more makes the surface discontinuous"
                )
            gaps = torch.cat([values.new_zeros(1), values, values.new_ones(1)]).diff()
            if bool((gaps < KNOT_RESOLUTION).any()):
                raise InputError(f"distinct knots must be at least {KNOT_RESOLUTION:g} apart")

    @classmethod
    @lru_cache(maxsize=16)  # so that quantities derived from a space are computed once for all its surfaces
    def uniform(cls, n: int, degree: int, parts: int = 1) -> SplineSpace:
        """The space over open, equispaced knots for `n` control points (the lenses of the thesis); parts: as for `open_knots`."""
        if not 1 <= degree <= MAX_DEGREE:
            raise InputError(f"spline degree must be 1 to {MAX_DEGREE}, got {degree}")
        return cls(degree, open_knots(n, degree, parts))

    @classmethod
    def through(cls, points: Tensor) -> SplineSpace:
        """The space of the interpolating spline through values at ascending points (n,) from 0 to 1: cubic, with a third derivative
        that is continuous at the second point and the last but one (de Boor, A Practical Guide to Splines, 2001, ch. IV), or of
        lower degree for fewer than four points."""
        degree = min(3, len(points) - 1)
        inner = points[2:-2] if degree == 3 else points[:0]
        return cls(degree, torch.cat([points.new_zeros(degree + 1), inner, points.new_ones(degree + 1)]))

    @property
    def n(self) -> int:
        """Number of control points."""
        return len(self.knots) - self.degree - 1

    @cached_property
    def derivative(self) -> SplineSpace:
        """The space of the derivatives, of degree p - 1, for the control points of `differences`; p > 1, and knots inside at most
        p - 1 times."""
        return SplineSpace(self.degree - 1, self.knots[1:-1])

    @cached_property
    def breaks(self) -> Tensor:
        """The distinct knots, ascending: the breakpoints of the polynomial pieces."""
        return torch.unique(self.knots)

    @cached_property
    def greville(self) -> Tensor:
        """Greville abscissae u*_i = (t_{i+1} + ... + t_{i+p}) / p, eq. 4.1.1: (n,)."""
        return self.knots[1:-1].unfold(0, self.degree, 1).mean(-1)

    def span(self, x: Tensor) -> Tensor:
        """Index s of the knot span of every x: (...) int64, t_s <= x < t_{s+1}; x outside [0, 1] takes the end span."""
        inside = torch.searchsorted(self.knots.to(x.device), x.detach().double().contiguous(), right=True) - 1
        return inside.clamp(self.degree, self.n - 1)

    def basis(self, x: Tensor, derivative: int = 0) -> tuple[Tensor, Tensor]:
        """Index of the first non-vanishing basis function and the p + 1 values there.

        Args:
            x: (...) positions in [0, 1]; differentiable (a NURBS or an intersection may move along the surface).
            derivative: order of the derivative, 0 or more.

        Returns:
            first (...) int64, values (..., p + 1) float64.
        """
        first, values = self.bases(x, [derivative])
        return first, values[derivative]

    def bases(self, x: Tensor, orders: Iterable[int]) -> tuple[Tensor, dict[int, Tensor]]:
        """`basis` for every order of derivative in `orders`, by one triangular scheme."""
        x, orders = x.double(), list(orders)
        s = self.span(x)
        p, t = self.degree, self.knots.to(x.device)
        near = {k: t[s + k] for k in range(1 - p, p + 1)}
        of_degree = [[torch.ones_like(x)]]  # values on the span, of degree 0, 1, ...
        for k in range(1, p - min(orders) + 1):  # raise the degree one at a time
            nxt, saved = [], torch.zeros_like(x)
            for r, value in enumerate(of_degree[-1]):
                right, left = near[r + 1], near[r + 1 - k]
                term = value / (right - left)  # t_{s+1} > t_s lies inside: never 0
                nxt.append(saved + (right - x) * term)
                saved = (x - left) * term
            of_degree.append([*nxt, saved])
        out = {}
        for order in orders:
            values = of_degree[p - order] if order <= p else [torch.zeros_like(x)] * (p + 1)
            for k in range(len(values), p + 1):  # eq. 2.4.9: N'_{i,k} = k N_{i,k-1} / (t_{i+k} - t_i) - k N_{i+1,k-1} / (...)
                nxt, saved = [], torch.zeros_like(x)
                for r, value in enumerate(values):
                    term = k * value / (near[r + 1] - near[r + 1 - k])
                    nxt.append(saved - term)
                    saved = term
                values = [*nxt, saved]
            out[order] = torch.stack(values, -1)
        return s - p, out

    def matrix(self, x: Tensor, derivative: int = 0) -> Tensor:
        """Collocation matrix of all n basis functions at the points x (m,): (m, n) float64, dense."""
        first, values = self.basis(x, derivative)
        columns = first[:, None] + torch.arange(self.degree + 1, device=x.device)
        return values.new_zeros(len(x), self.n).scatter(1, columns, values)

    def banded(self, x: Tensor, derivative: int = 0) -> Tensor:
        """`matrix` as a sparse tensor: its product with a net takes p + 1 operations per point instead of n."""
        first, values = self.basis(x, derivative)
        columns = first[:, None] + torch.arange(self.degree + 1, device=x.device)
        rows = torch.arange(len(x), device=x.device)[:, None].expand_as(columns)
        at = torch.stack([rows.reshape(-1), columns.reshape(-1)])
        return torch.sparse_coo_tensor(at, values.reshape(-1), (len(x), self.n), check_invariants=False).coalesce()

    def interpolated(self, values: Tensor, points: Tensor | None = None) -> Tensor:
        """Control points (n, ...) float64 of the spline with the values (n, ...) at the Greville abscissae, or at points (n,) that
        lie in the supports of the basis functions one by one.

        The matrix is banded and totally positive, so Gaussian elimination needs no pivoting (de Boor, Pinkus, SIAM J. Numer. Anal.
        14, 1977).  It works on whole rows of the values, which for many columns is much faster than LAPACK's column by column.
        """
        p, n = self.degree, self.n
        first, basis = self.basis(self.greville if points is None else points)
        rows, columns = torch.arange(n)[:, None].expand_as(basis), first[:, None] + torch.arange(p + 1)
        bands = np.zeros((n, 2 * p + 1))  # row i holds columns i - p to i + p
        bands[rows, p + columns - rows] = basis
        out = np.array(values.double().numpy(), order="C")
        for i in range(n):
            for k in range(1, min(p, n - 1 - i) + 1):
                if factor := bands[i + k, p - k] / bands[i, p]:
                    bands[i + k, p - k + 1 : 2 * p + 1 - k] -= factor * bands[i, p + 1 :]
                    out[i + k] -= factor * out[i]
        for i in reversed(range(n)):
            for k in range(1, min(p, n - 1 - i) + 1):
                out[i] -= bands[i, p + k] * out[i + k]
            out[i] /= bands[i, p]
        return torch.from_numpy(out)

    def differences(self, points: Tensor, axis: int = 0, order: int = 1) -> Tensor:
        """Control points of the derivative of this order, a spline of degree p - order, from `points`: n - order along `axis`.

        At knots of multiplicity p - order + 1 or more the derivative may jump; the jump itself is omitted.  order: at most p.
        """
        for k in range(order):
            p, t, n = self.degree - k, self.knots[k : len(self.knots) - k], self.n - k
            step = t[p + 1 : p + n] - t[1:n]
            scale = torch.where(step > 0, p / step.clamp_min(KNOT_RESOLUTION), 0.0)
            shape = [1] * points.ndim
            shape[axis] = -1
            points = points.diff(dim=axis) * scale.to(points).view(shape)
        return points

    def insert(self, new_knots) -> tuple[SplineSpace, Tensor]:
        """Boehm's knot insertion: the finer space and the matrix T (n', n) with T @ P the same spline in it."""
        p = self.degree
        matrix = torch.eye(self.n, dtype=torch.float64)
        t = self.knots
        for x in torch.as_tensor(new_knots, dtype=torch.float64).reshape(-1).sort().values:
            if not 0 < float(x) < 1:
                raise InputError(f"a knot to insert must lie strictly between 0 and 1, got {float(x):g}")
            s = int(torch.searchsorted(t, x, right=True)) - 1
            n = len(t) - p - 1
            left = torch.arange(s - p + 1, s + 1)
            ratio = (x - t[left]) / (t[left + p] - t[left])
            step = torch.zeros(n + 1, n, dtype=torch.float64)
            keep = torch.arange(0, s - p + 1)
            step[keep, keep] = 1.0
            step[left, left], step[left, left - 1] = ratio, 1.0 - ratio
            tail = torch.arange(s + 1, n + 1)
            step[tail, tail - 1] = 1.0
            matrix, t = step @ matrix, torch.cat([t[: s + 1], x[None], t[s + 1 :]])
        return SplineSpace(p, t), matrix

    def change_of_basis(self, finer: SplineSpace) -> Tensor:
        """Matrix T (n', n) that maps control points to another spline space.

        Exact (knot insertion) where `finer` has the same degree and all these knots; otherwise the interpolant at the
        new Greville abscissae.
        """
        if finer.degree == self.degree:
            missing, it = [], 0
            for x in finer.knots.tolist():
                if it < len(self.knots) and abs(x - float(self.knots[it])) < KNOT_RESOLUTION:
                    it += 1
                else:
                    missing.append(x)
            if it == len(self.knots):
                return self.insert(missing)[1]
        return torch.linalg.solve(finer.matrix(finer.greville), self.matrix(finer.greville))


def over_grid(u: Tensor, net: Tensor, v: Tensor) -> Tensor:
    """u net v^T, (a, b): a net (n, m) evaluated on a grid, from collocation matrices u (a, n) and v (b, m) of `banded`."""
    return derivatives_over_grid([u], net, [v], [(0, 0)])[0]


def derivatives_over_grid(u: Sequence[Tensor], net: Tensor, v: Sequence[Tensor], orders: Iterable[tuple[int, int]]) -> list[Tensor]:
    """`over_grid` for every (j, k) in `orders`, with u[j] and v[k] the collocation matrices of derivatives of these orders."""
    orders = list(orders)
    along = {j: (u[j] @ net).T.contiguous() for j in {j for j, _ in orders}}
    return [(v[k] @ along[j]).T for j, k in orders]


class GridSpline:
    """The interpolating spline through values (n, m) at ascending points x (n,), y (m,), of the degree of `SplineSpace.through`."""

    def __init__(self, x: np.ndarray, y: np.ndarray, values: np.ndarray):
        self.first, self.length = (x[0], y[0]), (x[-1] - x[0], y[-1] - y[0])
        points = [self._within(k, c) for k, c in enumerate((x, y))]
        self.spaces = [SplineSpace.through(p) for p in points]
        along = self.spaces[0].interpolated(torch.from_numpy(values), points[0])
        self.net = self.spaces[1].interpolated(along.T, points[1]).T

    def _within(self, axis: int, at: np.ndarray) -> Tensor:
        """Points as fractions of the length; those beyond the ends there."""
        return torch.from_numpy((at - self.first[axis]) / self.length[axis]).clamp_(0.0, 1.0)

    def derivatives(self, x: np.ndarray, y: np.ndarray, orders: Iterable[tuple[int, int]]) -> list[np.ndarray]:
        """Derivatives of these orders on the grid of points x (a,), y (b,): (a, b) each; those beyond the ends have the values
        there."""
        orders = list(orders)
        most = max(map(max, orders))
        rows, columns = (
            [space.banded(self._within(k, c), order) / self.length[k] ** order for order in range(most + 1)]
            for k, (space, c) in enumerate(zip(self.spaces, (x, y), strict=True))
        )
        return [d.numpy() for d in derivatives_over_grid(rows, self.net, columns, orders)]

    def __call__(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """Values on the grid of points x (a,), y (b,): (a, b)."""
        return self.derivatives(x, y, [(0, 0)])[0]
