"""Ray integration in a medium whose index is a polynomial of one variable, with the adjoint: `gradient.integrator` compiled.

Notation, beside that of `integrator`
    s       r^2 = x^2 + y^2, or z;  e = grad s, (2 x, 2 y, 0) or (0, 0, 1)
    v(s)    polynomial, which n is, or n^2
    G(s)    half the derivative of n^2 by s, so that F = G e: n v', or v' / 2

    (dF/dq)^T l = G' (e . l) e + G (2 l_x, 2 l_y, 0), the last for s = r^2
"""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from caustic_cli.optics.kernels import blocks
from caustic_cli.optics.kernels.jit import FAST, njit
from caustic_cli.optics.kernels.stage import component
from caustic_cli.optics.kernels.threads import ALL, on_threads


@njit(inline="always", **FAST)
def _medium(s, terms, squared, least):
    """n^2, n, G and G'; n^2 is cut off for n as in the reference."""
    v, slope, curve = 0.0, 0.0, 0.0
    for k in range(len(terms) - 1, -1, -1):
        curve = curve * s + 2.0 * slope
        slope = slope * s + v
        v = v * s + terms[k]
    if squared:
        return v, math.sqrt(max(v, least)), 0.5 * slope, 0.5 * curve
    return v * v, math.sqrt(max(v * v, least)), v * slope, slope * slope + v * curve


@njit(**FAST)
def _flow_some(begin, end, terms, axial, squared, least, ray, time, weights, steps, out):
    for at in range(begin, end):
        x, y, z, px, py, pz = ray[0][at], ray[1][at], ray[2][at], ray[3][at], ray[4][at], ray[5][at]
        path, length, h = 0.0, 0.0, time[at] / steps
        for _ in range(steps):
            for w in weights:
                b = w * h
                a = 0.5 * b
                path += 0.5 * a * (px * px + py * py + pz * pz)
                x, y, z = x + a * px, y + a * py, z + a * pz
                square, n, g, _ = _medium(z if axial else x * x + y * y, terms, squared, least)
                path += 0.5 * b * square
                length += b * n
                if axial:
                    pz += b * g
                else:
                    px, py = px + 2.0 * b * g * x, py + 2.0 * b * g * y
                path += 0.5 * a * (px * px + py * py + pz * pz)
                x, y, z = x + a * px, y + a * py, z + a * pz
        out[0][at], out[1][at], out[2][at], out[3][at], out[4][at], out[5][at] = x, y, z, px, py, pz
        out[6][at], out[7][at] = path, length


@njit(entry=True, **FAST)
def _flow(block, terms, axial, squared, least, ray, time, weights, steps, out, blocks):
    """q, p, S and L (8, N), from ray: q and p, six components."""
    if block == ALL:
        on_threads(blocks, (terms, axial, squared, least, ray, time, weights, steps, out, blocks))
        return
    count = len(time)
    _flow_some(block * count // blocks, (block + 1) * count // blocks, terms, axial, squared, least, ray, time, weights, steps, out)


@njit(**FAST)
def _pull_some(begin, end, terms, axial, squared, least, ends, time, weights, steps, by, out):
    for at in range(begin, end):
        x, y, z, px, py, pz = ends[0][at], ends[1][at], ends[2][at], ends[3][at], ends[4][at], ends[5][at]
        lx, ly, lz, mx, my, mz = by[0][at], by[1][at], by[2][at], by[3][at], by[4][at], by[5][at]
        s, t, by_time, h = by[6][at], by[7][at], 0.0, time[at] / steps
        for _ in range(steps):
            for w in weights:
                b = w * h
                a = 0.5 * b
                # drift
                rate = 0.5 * (lx * px + ly * py + lz * pz + 0.5 * s * (px * px + py * py + pz * pz))
                mx, my, mz = mx + a * (lx + s * px), my + a * (ly + s * py), mz + a * (lz + s * pz)
                x, y, z = x - a * px, y - a * py, z - a * pz
                # kick
                square, n, g, slope = _medium(z if axial else x * x + y * y, terms, squared, least)
                ex, ey, ez = (0.0, 0.0, 1.0) if axial else (2.0 * x, 2.0 * y, 0.0)
                dot = ex * mx + ey * my + ez * mz
                rate += g * dot + 0.5 * s * square + t * n
                along = slope * dot + s * g + (t * g / n if square > least else 0.0)
                lx, ly, lz = lx + b * along * ex, ly + b * along * ey, lz + b * along * ez
                if not axial:
                    lx, ly = lx + 2.0 * b * g * mx, ly + 2.0 * b * g * my
                px, py, pz = px - b * g * ex, py - b * g * ey, pz - b * g * ez
                # drift
                rate += 0.5 * (lx * px + ly * py + lz * pz + 0.5 * s * (px * px + py * py + pz * pz))
                mx, my, mz = mx + a * (lx + s * px), my + a * (ly + s * py), mz + a * (lz + s * pz)
                x, y, z = x - a * px, y - a * py, z - a * pz
                by_time += w * rate
        out[0][at], out[1][at], out[2][at], out[3][at], out[4][at], out[5][at] = lx, ly, lz, mx, my, mz
        out[6][at] = by_time / steps


@njit(entry=True, **FAST)
def _flow_adjoint(block, terms, axial, squared, least, ends, time, weights, steps, by, out, blocks):
    """Derivatives by q, p and time into out (7, N), from those by q, p, S and L."""
    if block == ALL:
        on_threads(blocks, (terms, axial, squared, least, ends, time, weights, steps, by, out, blocks))
        return
    count = len(time)
    _pull_some(
        block * count // blocks, (block + 1) * count // blocks, terms, axial, squared, least, ends, time, weights, steps, by, out
    )


def formula_flow(
    terms: tuple[float, ...],
    axial: bool,
    squared: bool,
    least: float,
    ray: tuple[Tensor, ...],
    time: Tensor,
    weights: tuple[float, ...],
    steps: int,
) -> tuple[Tensor, ...]:
    """q, p, S and L, eight (N,), of rays q and p, six (N,) float64, after `time` (N,): `integrator.flow` of a formula.

    terms: coefficients of v, the constant first; axial: s = z; squared: v is n^2; least: n^2 below which n is cut off.
    """
    return _FormulaFlow.apply((np.array(terms), axial, squared, least), np.array(weights), steps, time, *ray)


class _FormulaFlow(torch.autograd.Function):
    """See `formula_flow`."""

    @staticmethod
    def forward(medium, weights, steps, time, *ray):
        out = np.empty((8, len(time)))
        _flow(ALL, *medium, np.stack([component(v) for v in ray]), component(time), weights, steps, out, blocks())
        return tuple(torch.from_numpy(row) for row in out)

    @staticmethod
    def setup_context(ctx, inputs, output):
        ctx.medium, ctx.weights, ctx.steps, time, *_ = inputs
        ctx.save_for_backward(time, *output[:6])

    @staticmethod
    @once_differentiable
    def backward(ctx, *by):
        time, *ends = ctx.saved_tensors
        out = np.empty((7, len(time)))
        ends, by = (np.stack([component(v) for v in values]) for values in (ends, by))
        _flow_adjoint(ALL, *ctx.medium, ends, component(time), ctx.weights, ctx.steps, by, out, blocks())
        rows = [torch.from_numpy(row) for row in out]
        return None, None, None, rows[6], *rows[:6]
