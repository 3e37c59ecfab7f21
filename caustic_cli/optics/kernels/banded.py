"""CPU kernels for the contraction of a control net along v with a banded collocation matrix: the p + 1 non-zero basis functions
only.

A dense product takes as many operations as there are control points along v; on a net of 500 it was half of an iteration.
"""

from __future__ import annotations

import numpy as np
from torch import Tensor

from caustic_cli.optics.bspline import SplineSpace
from caustic_cli.optics.kernels import blocks
from caustic_cli.optics.kernels.jit import FAST, njit
from caustic_cli.optics.kernels.stage import KernelStage
from caustic_cli.optics.kernels.threads import ALL, on_threads


class AlongV:
    """Basis values at points v (b,), and derivatives times `scale`, for nets (n, m) whose second axis is `space`'s."""

    def __init__(self, space: SplineSpace, v: Tensor, scale: float):
        first, values = space.bases(v, (0, 1))
        self.size = space.n
        self.arrays = (first.numpy(), *(t.contiguous().numpy() for t in (values[0], values[1] * scale)))

    def __call__(self, net: Tensor) -> tuple[Tensor, Tensor]:
        """Net (n, m) float64 -> the spline's values and scaled derivatives along v at every point: (n, b) each, differentiable."""
        value, slope = _CONTRACTION(self, net)
        return value, slope


@njit(entry=True, **FAST)
def _contract(i, net, first, values, slopes, out, out_slope):
    if on_threads(i, len(net), (net, first, values, slopes, out, out_slope)):
        return
    row, to, to_slope = net[i], out[i], out_slope[i]
    for j in range(len(first)):
        value, slope, at = 0.0, 0.0, first[j]
        for k in range(values.shape[1]):
            value += values[j, k] * row[at + k]
            slope += slopes[j, k] * row[at + k]
        to[j], to_slope[j] = value, slope


@njit(entry=True, **FAST)
def _spread(i, by_value, by_slope, first, values, slopes, out):
    if on_threads(i, len(out), (by_value, by_slope, first, values, slopes, out)):
        return
    to, value, slope = out[i], by_value[i], by_slope[i]
    for j in range(len(first)):
        at = first[j]
        for k in range(values.shape[1]):
            to[at + k] += values[j, k] * value[j] + slopes[j, k] * slope[j]


def _forward(along: AlongV, net):
    out = [np.empty((len(net), len(along.arrays[0]))) for _ in range(2)]
    blocks()
    _contract(ALL, net, *along.arrays, *out)
    return out


def _adjoint(along: AlongV, _inputs, _kept, by, _wanted):
    out = np.zeros((len(by[0]), along.size))
    blocks()
    _spread(ALL, *by, *along.arrays, out)
    return (out,)


_CONTRACTION = KernelStage(_forward, _adjoint, 2)
