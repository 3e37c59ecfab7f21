"""Ray integration through a B-spline volume of refractive index, with the adjoint: `gradient.integrator` compiled.

Each ray is integrated individually from beginning to end and stays in registers.  Notation and formulas are those of `integrator`;
with n a spline, F = n grad n and

    (dF/dq)^T l = grad n (grad n . l) + n H l,    H the second derivatives of n
    d(F . l)/dc = (grad n . l) B + n (grad B . l),    B(q) the product of three basis functions

An axis of a spline space has pieces, on each of which a basis function is a polynomial (`spline.Axis`); one along which the field
does not change has a single piece and the function 1.  Outside the box basis functions are extrapolated linearly.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from caustic_cli.optics.bspline import SplineSpace
from caustic_cli.optics.kernels import blocks
from caustic_cli.optics.kernels.jit import FAST, njit
from caustic_cli.optics.kernels.spline import axis, piece
from caustic_cli.optics.kernels.stage import component
from caustic_cli.optics.kernels.threads import ALL, on_threads

#: Most basis functions that do not vanish at a point, along one axis.
WIDE = 16


class VolumeAxis:
    """Kernel data of one axis: breaks, first basis functions and their polynomials, and the map x -> u = (x - low) / width."""

    def __init__(self, space: SplineSpace | None, middle: float, half: float):
        if space is None:
            self.breaks, self.middles, self.over = np.array([0.0, 1.0]), np.array([0.5]), np.array([1.0])
            self.first, self.matrices = np.zeros(1, np.int64), np.ones((1, 1, 1))
        else:
            own = axis(space)
            (self.breaks, self.middles, self.over), self.first, self.matrices = own.geometry, own.first, own.matrices
        self.place = np.array([middle - half, 1.0 / (2.0 * half)])

    @property
    def arrays(self) -> tuple[np.ndarray, ...]:
        """As the kernels take them."""
        return self.breaks, self.middles, self.over, self.first, self.matrices, self.place


@njit(inline="always", **FAST)
def _along(x, axis, out):
    """First basis function at x, and into out (3, p + 1) the values, first and second derivatives by mm."""
    breaks, middles, over, first, matrices, place = axis
    v = (x - place[0]) * place[1]
    u = min(max(v, 0.0), 1.0)
    beyond = v - u
    i = piece(u, breaks)
    xi, by = (u - middles[i]) * over[i], over[i] * place[1]
    count = matrices.shape[1]
    for k in range(count):
        value, slope, curve = 0.0, 0.0, 0.0
        for a in range(count - 1, -1, -1):
            curve = curve * xi + 2.0 * slope
            slope = slope * xi + value
            value = value * xi + matrices[i, a, k]
        out[0, k], out[1, k] = value + slope * over[i] * beyond, slope * by
        out[2, k] = curve * by * by if beyond == 0.0 else 0.0
    return first[i]


@njit(inline="always", **FAST)
def _slope(c, i, j, k, bu, bv, bw, nu, nv, nw):
    """n and grad n."""
    n, nx, ny, nz = 0.0, 0.0, 0.0, 0.0
    for a in range(nu):
        r, ry, rz = 0.0, 0.0, 0.0
        for b in range(nv):
            s, sz = 0.0, 0.0
            for d in range(nw):
                value = c[i + a, j + b, k + d]
                s += value * bw[0, d]
                sz += value * bw[1, d]
            r += bv[0, b] * s
            ry += bv[1, b] * s
            rz += bv[0, b] * sz
        n += bu[0, a] * r
        nx += bu[1, a] * r
        ny += bu[0, a] * ry
        nz += bu[0, a] * rz
    return n, nx, ny, nz


@njit(inline="always", **FAST)
def _curve(c, i, j, k, bu, bv, bw, nu, nv, nw):
    """n, grad n and the six second derivatives."""
    n, nx, ny, nz = 0.0, 0.0, 0.0, 0.0
    xx, xy, xz, yy, yz, zz = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for a in range(nu):
        r, ry, rz, ryy, ryz, rzz = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
        for b in range(nv):
            s, sz, szz = 0.0, 0.0, 0.0
            for d in range(nw):
                value = c[i + a, j + b, k + d]
                s += value * bw[0, d]
                sz += value * bw[1, d]
                szz += value * bw[2, d]
            r += bv[0, b] * s
            ry += bv[1, b] * s
            rz += bv[0, b] * sz
            ryy += bv[2, b] * s
            ryz += bv[1, b] * sz
            rzz += bv[0, b] * szz
        n += bu[0, a] * r
        nx += bu[1, a] * r
        ny += bu[0, a] * ry
        nz += bu[0, a] * rz
        xx += bu[2, a] * r
        xy += bu[1, a] * ry
        xz += bu[1, a] * rz
        yy += bu[0, a] * ryy
        yz += bu[0, a] * ryz
        zz += bu[0, a] * rzz
    return n, nx, ny, nz, xx, xy, xz, yy, yz, zz


@njit(**FAST)
def _flow_some(begin, end, c, u, v, w, ray, time, weights, steps, out):
    bu, bv, bw = np.empty((3, WIDE)), np.empty((3, WIDE)), np.empty((3, WIDE))
    nu, nv, nw = u[4].shape[1], v[4].shape[1], w[4].shape[1]
    for at in range(begin, end):
        x, y, z, px, py, pz = ray[0][at], ray[1][at], ray[2][at], ray[3][at], ray[4][at], ray[5][at]
        path, length, h = 0.0, 0.0, time[at] / steps
        for _ in range(steps):
            for part in weights:
                b = part * h
                a = 0.5 * b
                path += 0.5 * a * (px * px + py * py + pz * pz)
                x, y, z = x + a * px, y + a * py, z + a * pz
                i = _along(x, u, bu)
                j = _along(y, v, bv)
                k = _along(z, w, bw)
                n, nx, ny, nz = _slope(c, i, j, k, bu, bv, bw, nu, nv, nw)
                path += 0.5 * b * n * n
                length += b * n
                px, py, pz = px + b * n * nx, py + b * n * ny, pz + b * n * nz
                path += 0.5 * a * (px * px + py * py + pz * pz)
                x, y, z = x + a * px, y + a * py, z + a * pz
        out[0][at], out[1][at], out[2][at], out[3][at], out[4][at], out[5][at] = x, y, z, px, py, pz
        out[6][at], out[7][at] = path, length


@njit(entry=True, **FAST)
def _flow(block, c, u, v, w, ray, time, weights, steps, out, blocks):
    """q, p, S and L (8, N), from ray: q and p, six components."""
    if block == ALL:
        on_threads(
            blocks,
            (c, u, v, w, ray, time, weights, steps, out, blocks),
        )
        return
    count = len(time)
    begin, end = block * count // blocks, (block + 1) * count // blocks
    _flow_some(begin, end, c, u, v, w, ray, time, weights, steps, out)


@njit(**FAST)
def _pull_some(begin, end, c, u, v, w, ends, time, weights, steps, by, out, by_c):
    bu, bv, bw = np.empty((3, WIDE)), np.empty((3, WIDE)), np.empty((3, WIDE))
    nu, nv, nw = u[4].shape[1], v[4].shape[1], w[4].shape[1]
    free = by_c.size > 0
    for at in range(begin, end):
        x, y, z, px, py, pz = ends[0][at], ends[1][at], ends[2][at], ends[3][at], ends[4][at], ends[5][at]
        lx, ly, lz, mx, my, mz = by[0][at], by[1][at], by[2][at], by[3][at], by[4][at], by[5][at]
        s, t, by_time, h = by[6][at], by[7][at], 0.0, time[at] / steps
        for _ in range(steps):
            for part in weights:
                b = part * h
                a = 0.5 * b
                # drift
                rate = 0.5 * (lx * px + ly * py + lz * pz + 0.5 * s * (px * px + py * py + pz * pz))
                mx, my, mz = mx + a * (lx + s * px), my + a * (ly + s * py), mz + a * (lz + s * pz)
                x, y, z = x - a * px, y - a * py, z - a * pz
                # kick
                i = _along(x, u, bu)
                j = _along(y, v, bv)
                k = _along(z, w, bw)
                n, nx, ny, nz, xx, xy, xz, yy, yz, zz = _curve(c, i, j, k, bu, bv, bw, nu, nv, nw)
                dot = nx * mx + ny * my + nz * mz
                rate += n * dot + 0.5 * s * n * n + t * n
                whole = dot + s * n + t
                lx += b * (nx * whole + n * (xx * mx + xy * my + xz * mz))
                ly += b * (ny * whole + n * (xy * mx + yy * my + yz * mz))
                lz += b * (nz * whole + n * (xz * mx + yz * my + zz * mz))
                if free:
                    gx, gy, gz, g = b * n * mx, b * n * my, b * n * mz, b * whole
                    for p in range(nu):
                        for q in range(nv):
                            level = g * bu[0, p] * bv[0, q] + gx * bu[1, p] * bv[0, q] + gy * bu[0, p] * bv[1, q]
                            along = gz * bu[0, p] * bv[0, q]
                            for r in range(nw):
                                by_c[i + p, j + q, k + r] += level * bw[0, r] + along * bw[1, r]
                px, py, pz = px - b * n * nx, py - b * n * ny, pz - b * n * nz
                # drift
                rate += 0.5 * (lx * px + ly * py + lz * pz + 0.5 * s * (px * px + py * py + pz * pz))
                mx, my, mz = mx + a * (lx + s * px), my + a * (ly + s * py), mz + a * (lz + s * pz)
                x, y, z = x - a * px, y - a * py, z - a * pz
                by_time += part * rate
        out[0][at], out[1][at], out[2][at], out[3][at], out[4][at], out[5][at] = lx, ly, lz, mx, my, mz
        out[6][at] = by_time / steps


@njit(entry=True, **FAST)
def _flow_adjoint(block, c, u, v, w, ends, time, weights, steps, by, out, by_c, blocks):
    """Derivatives by q, p and time into out (7, N), by the coefficients into by_c (blocks, n, m, k), from those by q, p, S, L."""
    if block == ALL:
        on_threads(
            blocks,
            (
                c,
                u,
                v,
                w,
                ends,
                time,
                weights,
                steps,
                by,
                out,
                by_c,
                blocks,
            ),
        )
        return
    count = len(time)
    begin, end = block * count // blocks, (block + 1) * count // blocks
    _pull_some(
        begin,
        end,
        c,
        u,
        v,
        w,
        ends,
        time,
        weights,
        steps,
        by,
        out,
        by_c[block],
    )


def volume_flow(
    axes: tuple[VolumeAxis, VolumeAxis, VolumeAxis],
    coefficients: Tensor,
    ray: tuple[Tensor, ...],
    time: Tensor,
    weights: tuple[float, ...],
    steps: int,
) -> tuple[Tensor, ...]:
    """q, p, S and L, eight (N,), of rays q and p, six (N,) float64, after `time` (N,): `integrator.flow` of a `SplineIndex`."""
    return _VolumeFlow.apply(axes, weights, steps, coefficients, time, *ray)


class _VolumeFlow(torch.autograd.Function):
    """See `volume_flow`."""

    @staticmethod
    def forward(axes, weights, steps, coefficients, time, *ray):
        out = np.empty((8, len(time)))
        geometry = [axis.arrays for axis in axes]
        rays = np.stack([component(v) for v in ray])
        _flow(ALL, component(coefficients), *geometry, rays, component(time), np.array(weights), steps, out, blocks())
        return tuple(torch.from_numpy(row) for row in out)

    @staticmethod
    def setup_context(ctx, inputs, output):
        ctx.axes, ctx.weights, ctx.steps, coefficients, time, *_ = inputs
        ctx.save_for_backward(coefficients, time, *output[:6])

    @staticmethod
    @once_differentiable
    def backward(ctx, *by):
        coefficients, time, *ends = ctx.saved_tensors
        count, threads, free = len(time), blocks(), ctx.needs_input_grad[3]
        out = np.empty((7, count))
        by_c = np.zeros((threads, *coefficients.shape) if free else (threads, 0, 0, 0))
        geometry = [axis.arrays for axis in ctx.axes]
        stacked = [np.stack([component(v) for v in values]) for values in (ends, by)]
        _flow_adjoint(
            ALL,
            component(coefficients),
            *geometry,
            stacked[0],
            component(time),
            np.array(ctx.weights),
            ctx.steps,
            stacked[1],
            out,
            by_c,
            threads,
        )
        rows = [torch.from_numpy(row) for row in out]
        return None, None, None, torch.from_numpy(by_c.sum(0)) if free else None, rows[6], *rows[:6]
