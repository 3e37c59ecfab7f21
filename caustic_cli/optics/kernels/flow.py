"""Ray integration in a gradient-index medium, with the adjoint: `gradient.integrator` compiled, for any compiled index.

Each ray is integrated individually from beginning to end and stays in registers.  Notation and formulas are those of `integrator`;
an index is given by two functions of its coefficients c, of further data, of a point and of scratch memory:

    index(c, medium, x, y, z, room)                                 n^2, n and F
    adjoint(c, medium, x, y, z, mx, my, mz, s, t, b, room, by_c)    these, and (dF/dq)^T m + s F + t grad n

the second adds b d(F . m + s n^2 / 2 + t n)/dc to by_c, unless that is empty.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from torch import Tensor

from caustic_cli.optics.kernels import blocks
from caustic_cli.optics.kernels.jit import FAST, njit
from caustic_cli.optics.kernels.stage import KernelStage
from caustic_cli.optics.kernels.threads import ALL, on_threads

#: Most basis functions that do not vanish at a point, along one axis: the scratch memory has (3, WIDE) numbers for each of three.
WIDE = 16


def _forward(index):
    @njit(entry=True, **FAST)
    def flow(block, c, medium, ray, time, weights, steps, out, blocks):
        """q, p, S and L (8, N), from ray: q and p, six components."""
        if on_threads(block, blocks, (c, medium, ray, time, weights, steps, out, blocks)):
            return
        room, count = (np.empty((3, WIDE)), np.empty((3, WIDE)), np.empty((3, WIDE))), len(time)
        for at in range(block * count // blocks, (block + 1) * count // blocks):
            x, y, z, px, py, pz = ray[0][at], ray[1][at], ray[2][at], ray[3][at], ray[4][at], ray[5][at]
            path, length, h = 0.0, 0.0, time[at] / steps
            for _ in range(steps):
                for w in weights:
                    b = w * h
                    a = 0.5 * b
                    path += 0.5 * a * (px * px + py * py + pz * pz)
                    x, y, z = x + a * px, y + a * py, z + a * pz
                    square, n, fx, fy, fz = index(c, medium, x, y, z, room)
                    path += 0.5 * b * square
                    length += b * n
                    px, py, pz = px + b * fx, py + b * fy, pz + b * fz
                    path += 0.5 * a * (px * px + py * py + pz * pz)
                    x, y, z = x + a * px, y + a * py, z + a * pz
            out[0][at], out[1][at], out[2][at], out[3][at], out[4][at], out[5][at] = x, y, z, px, py, pz
            out[6][at], out[7][at] = path, length

    return flow


def _backward(adjoint):
    @njit(entry=True, **FAST)
    def flow_adjoint(block, c, medium, ends, time, weights, steps, by, out, by_c):
        """Derivatives by q, p and time into out (7, N), by c into by_c (blocks, ...), from those by q, p, S and L."""
        count, blocks = len(time), len(by_c)
        if on_threads(block, blocks, (c, medium, ends, time, weights, steps, by, out, by_c)):
            return
        room, own = (np.empty((3, WIDE)), np.empty((3, WIDE)), np.empty((3, WIDE))), by_c[block]
        for at in range(block * count // blocks, (block + 1) * count // blocks):
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
                    square, n, fx, fy, fz, gx, gy, gz = adjoint(c, medium, x, y, z, mx, my, mz, s, t, b, room, own)
                    rate += fx * mx + fy * my + fz * mz + 0.5 * s * square + t * n
                    lx, ly, lz = lx + b * gx, ly + b * gy, lz + b * gz
                    px, py, pz = px - b * fx, py - b * fy, pz - b * fz
                    # drift
                    rate += 0.5 * (lx * px + ly * py + lz * pz + 0.5 * s * (px * px + py * py + pz * pz))
                    mx, my, mz = mx + a * (lx + s * px), my + a * (ly + s * py), mz + a * (lz + s * pz)
                    x, y, z = x - a * px, y - a * py, z - a * pz
                    by_time += w * rate
            out[0][at], out[1][at], out[2][at], out[3][at], out[4][at], out[5][at] = lx, ly, lz, mx, my, mz
            out[6][at] = by_time / steps

    return flow_adjoint


class IndexFlow(NamedTuple):
    """The integrator for an index: its two kernels."""

    forward: Any
    backward: Any

    @classmethod
    def of(cls, index, adjoint) -> IndexFlow:
        """For an index, by its functions."""
        return cls(_forward(index), _backward(adjoint))

    def __call__(self, coefficients: Tensor, medium: tuple, ray, time: Tensor, weights: tuple, steps: int) -> tuple[Tensor, ...]:
        """q, p, S and L, eight (N,), of rays q and p, six (N,) float64, after `time` (N,): `integrator.flow`.

        Differentiable once, in reverse mode, by coefficients, rays and time.
        """
        return _FLOW((self, medium, np.array(weights), steps), coefficients, time, *ray)


def _flow(parameters: tuple[IndexFlow, tuple, np.ndarray, int], coefficients, time, *ray):
    (flow, medium, weights, steps), out = parameters, np.empty((8, len(time)))
    flow.forward(ALL, coefficients, medium, np.stack(ray), time, weights, steps, out, blocks())
    return tuple(out)


def _flow_adjoint(parameters: tuple[IndexFlow, tuple, np.ndarray, int], inputs, kept, by, wanted):
    (flow, medium, weights, steps), (coefficients, time, *_) = parameters, inputs
    out, by_c = np.empty((7, len(time))), np.zeros((blocks(), *(n if wanted[0] else 0 for n in coefficients.shape)))
    flow.backward(ALL, coefficients, medium, np.stack(kept[:6]), time, weights, steps, np.stack(by), out, by_c)
    return by_c.sum(0), out[6], *out[:6]


_FLOW = KernelStage(_flow, _flow_adjoint, 8, keeps=True)
