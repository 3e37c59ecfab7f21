"""The height field on a grid of points: heights -> z and its slopes, with kernels and adjoint.

The fused form of `heightfield.HeightField.prepare` for a tensor product of points: the net is contracted along v once, and each
row of points then combines p + 1 rows of it, where a product with the dense collocation matrix would use all rows.

Notation
    P           heights (n, m) mm;  B_u, B_v the basis values at the points u (a,) and v (b,)
    Q, Q_y      P B_v^T and P B_v'^T / (2 r_y), (n, b)
    z, zx, zy   B_u Q, B_u' Q / (2 r_x), B_u Q_y, each (a, b)

by_v is the derivative of whatever is differentiated by v.
"""

from __future__ import annotations

import numpy as np
from torch import Tensor

from caustic_cli.optics.bspline import SplineSpace
from caustic_cli.optics.kernels import blocks
from caustic_cli.optics.kernels.arguments import RowsOfSurface
from caustic_cli.optics.kernels.banded import AlongV
from caustic_cli.optics.kernels.jit import FAST, njit
from caustic_cli.optics.kernels.pixels import total
from caustic_cli.optics.kernels.rows import combine, spread
from caustic_cli.optics.kernels.stage import KernelStage, empty
from caustic_cli.optics.kernels.threads import ALL, on_threads


def rows_at(space: SplineSpace, u: Tensor, half: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The first three of `RowsOfSurface` for points u, of a surface of this half width, mm."""
    first, values = space.bases(u, (0, 1))
    return first.numpy(), values[0].contiguous().numpy(), (values[1] / (2.0 * half)).contiguous().numpy()


class GridSurface:
    """A height field on a fixed grid of points, prepared for any heights.

    Args:
        spaces, half_size: of the height field; half widths in mm.
        u, v: (a,), (b,) parameters of the points, which are all pairs of them.
    """

    def __init__(self, spaces: tuple[SplineSpace, SplineSpace], half_size: tuple[float, float], u: Tensor, v: Tensor):
        (su, sv), (rx, ry) = spaces, half_size
        self.rows = rows_at(su, u, rx)
        self.along_v = AlongV(sv, v, 1.0 / (2.0 * ry))

    def __call__(self, heights: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Heights (n, m) mm float64 -> z mm, dz/dx, dz/dy, each (a b,) float64, linear in the heights."""
        z, zx, zy = _ROWS(self.rows, *self.along_v(heights))
        return z, zx, zy


@njit(entry=True, **FAST)
def _combine(block, surface, z, zx, zy, blocks):
    """z and slopes (a, b)."""
    if on_threads(block, blocks, (surface, z, zx, zy, blocks)):
        return
    for i in range(block * len(z) // blocks, (block + 1) * len(z) // blocks):
        combine(i, 0, surface, z[i], zx[i], zy[i])


@njit(entry=True, **FAST)
def _spread(block, by_z, by_zx, by_zy, surface, nets):
    """Adjoint of `_combine`: derivatives by both nets, a set for each block; nets (3, blocks, n, b) are overwritten."""
    rows, blocks = len(by_z), nets.shape[1]
    if on_threads(block, blocks, (by_z, by_zx, by_zy, surface, nets)):
        return
    nets[:, block] = 0.0
    for i in range(block * rows // blocks, (block + 1) * rows // blocks):
        spread(i, 0, surface, by_z[i], by_zx[i], by_zy[i], nets[:, block], False)


def _forward(rows: tuple[np.ndarray, np.ndarray, np.ndarray], net, net_y):
    """z and slopes, (a b,), from Q, Q_y and the rows' basis values."""
    out = [empty(len(rows[0]), net.shape[1]) for _ in range(3)]
    _combine(ALL, RowsOfSurface(*rows, net, net, net_y), *out, blocks())
    return [t.reshape(-1) for t in out]


def _adjoint(rows: tuple[np.ndarray, np.ndarray, np.ndarray], inputs, _kept, by, _wanted):
    nets, shape, none = np.empty((3, blocks(), *inputs[0].shape)), (len(rows[0]), inputs[0].shape[1]), np.empty((0, 0))
    _spread(ALL, *(b.reshape(shape) for b in by), RowsOfSurface(*rows, none, none, none), nets)
    return total(nets[0]), total(nets[2])


_ROWS = KernelStage(_forward, _adjoint, 3)
