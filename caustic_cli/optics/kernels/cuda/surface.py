"""Height fields on a CUDA device: evaluation and ray intersection as differentiable functions of heights and rays.

The functions of `kernels.surface` and `kernels.ray_intersections`, with their notation; formulas are in `kernels.spline`,
`kernels.intersect` and `kernels.batches`.  Here each ray goes its own way, by the scalar functions of those files.

Derivatives by the polynomials' coefficients are sums over rays, in fixed point (`sums`).  With |xi|, |eta| <= 1/2 no power of them
and no derivative of a power exceeds 1, so that sum (|by_z| + |by_xi| + |by_eta|) bounds every one of them; where points lie beyond
the surface, at most |xi| = x > 1/2 from the middle of a piece, powers reach max(x, 1)^p and their derivatives p times that.
"""

from __future__ import annotations

from functools import cache, lru_cache
from typing import NamedTuple

import torch
from numba import cuda, float64
from torch import Tensor
from torch.autograd.function import once_differentiable

from caustic_cli.optics.bspline import SplineSpace
from caustic_cli.optics.kernels import batches, intersect, ray_intersections, spline
from caustic_cli.optics.kernels.cuda import sums
from caustic_cli.optics.kernels.cuda.launch import device, start
from caustic_cli.optics.kernels.intersect import HIT

place, push_powers, value_at = (device(f) for f in (spline.place, spline.push_powers, intersect.value_at))
first_hit, beyond, pull_alone = device(batches.first_hit), device(batches.beyond), device(batches.pull_alone)
enter_alone, units = device(ray_intersections.enter_alone), device(sums.units)


#: What xi may be beyond 1/2 by rounding, for which the bound of sums has room.
ROUNDING = 1e-3


class PolynomialAxis(NamedTuple):
    """One axis of the polynomials: of `spline.Axis` matrices (I, p + 1, p + 1) and geometry, and the control points (I, p + 1) that
    each piece takes, all on the device."""

    control: Tensor
    matrices: Tensor
    breaks: Tensor
    middles: Tensor
    inverse: Tensor

    @classmethod
    def of(cls, space: SplineSpace, place: torch.device) -> PolynomialAxis:
        """On a device."""
        axis = spline.axis(space)
        control = torch.from_numpy(axis.first)[:, None] + torch.arange(space.degree + 1)
        return cls(*(t.to(place) for t in (control, *(torch.from_numpy(a) for a in (axis.matrices, *axis.geometry)))))

    def contract(self, net: Tensor) -> Tensor:
        """Net (n, m) -> coefficients along this axis (I, p + 1, m)."""
        return self.matrices @ net[self.control]

    def spread(self, by: Tensor, n: int) -> Tensor:
        """Adjoint of `contract`, in the same order every time: no two pieces begin with the same control point."""
        rows, out = self.matrices.transpose(1, 2) @ by, by.new_zeros(n, by.shape[2])
        for k in range(rows.shape[1]):
            out[self.control[:, k]] += rows[:, k]
        return out

    def largest_power(self, at: Tensor) -> Tensor:
        """() bound of powers of xi at points (N,) in [0, 1] or beyond, and of their derivatives."""
        degree = self.matrices.shape[1] - 1
        x = 0.5 + ((at - 0.5).abs().max() - 0.5).clamp(min=0.0) * self.inverse.max()
        return torch.where(x > 0.5 + ROUNDING, degree * x.clamp(min=1.0) ** degree, torch.ones_like(x))


class DeviceSurface:
    """Kernel data of a height field of half widths (r_x, r_y) mm, for any heights."""

    def __init__(self, spaces: tuple[SplineSpace, SplineSpace], half_size: tuple[float, float], place: torch.device):
        self.shape = tuple(s.n for s in spaces)
        self.scale = (0.5 / half_size[0], 0.5 / half_size[1])
        self.u, self.v = (PolynomialAxis.of(s, place) for s in spaces)
        self.pieces = spline.Pieces(*self.u[2:], *self.v[2:], *self.scale)
        self.spaces = spaces
        #: d xi / dx and d eta / dy in the narrowest piece, per mm.
        self.steepest = tuple(float(a.inverse.max()) * s for a, s in zip((self.u, self.v), self.scale, strict=True))

    def coefficients(self, heights: Tensor) -> Tensor:
        """(n, m) mm -> the polynomial of every span product, (I, J, p + 1, q + 1); linear."""
        along_u = self.u.contract(heights)  # (I, p + 1, m)
        pieces, order, _ = along_u.shape
        along_v = self.v.contract(along_u.reshape(pieces * order, -1).T)  # (J, q + 1, I (p + 1))
        return along_v.view(*along_v.shape[:2], pieces, order).permute(2, 0, 3, 1).contiguous()

    def pull(self, by: Tensor) -> Tensor:
        """Adjoint of `coefficients`: (I, J, p + 1, q + 1) -> (n, m)."""
        pieces, others, order, other = by.shape
        along_v = by.permute(1, 3, 0, 2).reshape(others, other, pieces * order)
        along_u = self.v.spread(along_v, self.shape[1]).T.reshape(pieces, order, self.shape[1])
        return self.u.spread(along_u, self.shape[0])

    def evaluate(self, heights: Tensor, u: Tensor, v: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """z mm, dz/dx and dz/dy at points in [0, 1]^2, all (N,) float64."""
        z, zx, zy = (torch.empty_like(u) for _ in range(3))
        start(_evaluate, len(u), (u, v), self.pieces, self.coefficients(heights.detach().double()), (z, zx, zy))
        return z, zx, zy

    def pull_at(self, u: Tensor, v: Tensor, by_z: Tensor, by_x: Tensor, by_y: Tensor) -> Tensor:
        """Adjoint of `evaluate`: derivatives by the heights, (n, m)."""
        steep_x, steep_y = self.steepest
        by = tuple(b.contiguous() for b in (by_z, by_x, by_y))
        bound = by_z.abs().sum() + steep_x * by_x.abs().sum() + steep_y * by_y.abs().sum()
        unit = sums.unit_of(bound * self.u.largest_power(u) * self.v.largest_power(v))
        shape = (len(self.u.control), len(self.v.control), self.u.control.shape[1], self.v.control.shape[1])
        total = torch.zeros(shape, dtype=torch.int64, device=u.device)
        start(_pull(*shape[2:]), len(u), (u, v, *by), self.pieces, unit, total)
        return self.pull(sums.value_of(total, unit))


@lru_cache(maxsize=8)
def surface_of(field, place: torch.device) -> DeviceSurface:
    """A `HeightField` on a device."""
    return DeviceSurface(field.spaces, field.half_size, place)


# At points.


@cuda.jit
def _evaluate(points, pieces, c, out):
    (u, v), (z, zx, zy) = points, out
    for k in range(cuda.grid(1), len(u), cuda.gridsize(1)):
        height, along, across = value_at(c, u[k], v[k], pieces)
        z[k], zx[k], zy[k] = height, along * pieces.scale_x, across * pieces.scale_y


@cache
def _pull(order_u: int, order_v: int):
    """The adjoint of values and slopes at points, by p + 1 and q + 1."""

    @cuda.jit
    def pull(points, pieces, unit, total):
        (u, v, by_z, by_x, by_y), by_u, by_v = points, pieces.scale_x, pieces.scale_y
        grad, powers = cuda.local.array((1, 1, order_u, order_v), float64), cuda.local.array((2, order_v), float64)
        for k in range(cuda.grid(1), len(u), cuda.gridsize(1)):
            i, j, xi, eta = place(u[k], v[k], pieces)
            for a in range(order_u):
                for b in range(order_v):
                    grad[0, 0, a, b] = 0.0
            by_xi, by_eta = by_x[k] * pieces.over_u[i] * by_u, by_y[k] * pieces.over_v[j] * by_v
            push_powers(grad, 0, 0, xi, eta, by_z[k], by_xi, by_eta, powers)
            for a in range(order_u):
                for b in range(order_v):
                    cuda.atomic.add(total, (i, j, a, b), units(grad[0, 0, a, b], unit[0]))

    return pull


# Ray intersections.


@cuda.jit
def _first_hits(rays, bounds, radius, pieces, c, out, where):
    (ox, oy, oz, dx, dy, dz), (t, gx, gy), scale_x, scale_y = rays, out, pieces.scale_x, pieces.scale_y
    low, high, slope_u, slope_v, floor = bounds[0], bounds[1], bounds[2], bounds[3], bounds[4]
    for k in range(cuda.grid(1), len(t), cuda.gridsize(1)):
        du, dv = dx[k] * scale_x, dy[k] * scale_y
        ou, ov, up, way = enter_alone((ox[k] * scale_x + 0.5, oy[k] * scale_y + 0.5, oz[k], du, dv, dz[k]), floor)
        status, here, reach, zx, zy = first_hit((ou, ov, up, du, dv, dz[k]), (low, high), (slope_u, slope_v), c, pieces)
        found = status == HIT and way + reach > 0.0 and not beyond(ou, ov, du, dv, reach, radius, pieces)
        t[k], gx[k], gy[k] = (way + reach, zx, zy) if found else (0.0, 0.0, 0.0)
        where[k] = here if found else -1


@cuda.jit
def _pull_rays(rays, found, where, given, pieces, c, out):
    """X + L_Z Z_x, Y + L_Z Z_y and L_Z in `out`, and u and v of the intersections."""
    (ox, oy, dx, dy, dz), (t, gx, gy), (by_t, by_gx, by_gy) = rays, found, given
    (_, mu, wu, _, mv, wv, scale_x, scale_y), (by_x, by_y, by_z, u, v) = pieces, out
    wide = len(mv)
    for k in range(cuda.grid(1), len(t), cuda.gridsize(1)):
        by_x[k], by_y[k], by_z[k], u[k], v[k] = 0.0, 0.0, 0.0, 0.5, 0.5
        if where[k] < 0:
            continue
        i, j = where[k] // wide, where[k] % wide
        d = (dx[k] * scale_x, dy[k] * scale_y, dz[k])
        u[k], v[k] = ox[k] * scale_x + 0.5 + t[k] * d[0], oy[k] * scale_y + 0.5 + t[k] * d[1]
        xi, eta, by_u, by_v = (u[k] - mu[i]) * wu[i], (v[k] - mv[j]) * wv[j], by_gx[k] * scale_x, by_gy[k] * scale_y
        along, across, up = pull_alone(c, i, j, xi, eta, by_t[k], by_u, by_v, d, gx[k], gy[k], pieces)
        by_x[k], by_y[k], by_z[k] = along * scale_x + up * gx[k], across * scale_y + up * gy[k], up


def hits_of_rays(
    surface: DeviceSurface, heights: Tensor, origin, direction, *, side: float = 1.0, radius: float | None = None
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """`kernels.ray_intersections.hits_of_rays` of a rectangle: t, dz/dx, dz/dy and found, (N,) each."""
    limit = torch.inf if radius is None else float(radius)
    (ox, oy, oz), (dx, dy, dz) = origin, direction
    if side < 0:
        heights, oz, dz = -heights, -oz, -dz
    t, gx, gy, found, _ = _Hits.apply(heights, ox, oy, oz, dx, dy, dz, surface, limit)
    return (t, -gx, -gy, found) if side < 0 else (t, gx, gy, found)


def _sag(heights: Tensor) -> tuple[Tensor, Tensor]:
    """Heights minus their mean, and the mean (), float64: a sag small compared with the thickness keeps all its digits."""
    h = heights.detach().double()
    return h - h.mean(), h.mean()


def _bounds(surface: DeviceSurface, h: Tensor) -> Tensor:
    """Least and largest height, bounds of |Z_u| and |Z_v|, and the floor where rays enter, as `ray_intersections` has them."""
    low, high = torch.aminmax(h)
    by_u, by_v = (s.differences(h, axis) for axis, s in enumerate(surface.spaces))
    under, narrow = ray_intersections.BELOW
    floor = low - torch.clamp(under * (high - low), min=narrow / min(surface.scale))
    return torch.stack([low, high + 1e-6 * (high - low), by_u.abs().max(), by_v.abs().max(), floor])


class _Hits(torch.autograd.Function):
    """Heights, o and d by components -> t, slopes, found and the span products met."""

    @staticmethod
    def forward(heights, ox, oy, oz, dx, dy, dz, surface: DeviceSurface, radius: float):
        h, middle = _sag(heights)
        rays = tuple(c.detach().contiguous() for c in (ox, oy, oz - middle, dx, dy, dz))
        out, where = tuple(torch.empty_like(ox) for _ in range(3)), torch.empty(ox.shape, dtype=torch.int64, device=ox.device)
        bounds, c = _bounds(surface, h), surface.coefficients(h)
        start(_first_hits, len(ox), rays, bounds, radius, surface.pieces, c, out, where)
        return *out, where >= 0, where

    @staticmethod
    def setup_context(ctx, inputs, output):
        *tensors, ctx.surface, _ = inputs
        ctx.save_for_backward(*tensors, *output)
        ctx.mark_non_differentiable(*output[3:])

    @staticmethod
    @once_differentiable
    def backward(ctx, *by):
        heights, ox, oy, _, dx, dy, dz, t, gx, gy, _, where = ctx.saved_tensors
        surface, wanted = ctx.surface, ctx.needs_input_grad
        found, none = tuple(a.detach() for a in (t, gx, gy)), torch.zeros((), dtype=t.dtype, device=t.device)
        c = surface.coefficients(_sag(heights)[0])
        out = tuple(torch.empty_like(t) for _ in range(5))
        rays, given = _whole((ox, oy, dx, dy, dz)), _whole(torch.where(where >= 0, b, none) for b in by[:3])
        start(_pull_rays, len(t), rays, found, where, given, surface.pieces, c, out)
        by_x, by_y, by_z, u, v = out
        net = surface.pull_at(u, v, by_z, *given[1:]).to(heights.dtype) if wanted[0] else None
        starts = (by_x, by_y, -by_z)
        return (
            net,
            *(a if w else None for a, w in zip(starts, wanted[1:4], strict=True)),
            *(found[0] * a if w else None for a, w in zip(starts, wanted[4:7], strict=True)),
            None,
            None,
        )


def _whole(values) -> tuple[Tensor, ...]:
    return tuple(v.detach().double().contiguous() for v in values)
