"""Triangle mesh of a height field for ray intersection (thesis 4.3.2): vertices and bounding boxes.

The search is in `kernels.mesh`.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from caustic_cli.errors import InputError
from caustic_cli.optics.bspline import SplineSpace
from caustic_cli.optics.kernels import blocks
from caustic_cli.optics.surfaces.heightfield import HeightField

#: Padding of the boxes beyond the control net, relative to the largest height: rounding errors of the vertices at degree 15.
PADDING = 256 * 2.0**-52


def _bases(space: SplineSpace, n: int) -> Tensor:
    """Basis values at the grid lines of `space`, with every span subdivided into n parts: (a n + 1, control points)."""
    parts = torch.arange(n, dtype=torch.float64) / n
    inner = space.breaks[:-1, None] + space.breaks.diff()[:, None] * parts
    return space.matrix(torch.cat([inner.reshape(-1), space.breaks[-1:]]))


def vertices_of(space_u: SplineSpace, space_v: SplineSpace, heights: Tensor, n_u: int, n_v: int) -> Tensor:
    """Surface heights at the grid points, every non-empty span subdivided into n_u and n_v parts: (a n_u + 1, b n_v + 1), mm."""
    return _bases(space_u, n_u) @ heights.detach().double().cpu() @ _bases(space_v, n_v).T


def boxes_of(space_u: SplineSpace, space_v: SplineSpace, heights: Tensor) -> tuple[Tensor, Tensor]:
    """Lowest and highest control point of every non-empty knot span product (eq. 4.3.5), padded: (a, b) each, mm."""
    low = high = heights.detach().double().cpu()
    pad = PADDING * float(low.abs().max())
    for axis, space in enumerate((space_u, space_v)):
        first = space.span(space.breaks[:-1]) - space.degree
        low, high = (net.unfold(axis, space.degree + 1, 1) for net in (low, high))
        low, high = low.amin(-1).index_select(axis, first), high.amax(-1).index_select(axis, first)
    return low - pad, high + pad


def lines_of(breaks: np.ndarray, n: int) -> tuple[np.ndarray, np.ndarray]:
    """Grid lines that divide spans into n parts, and one over the widths of the cells above them."""
    inner = breaks[:-1, None] + np.diff(breaks)[:, None] * (np.arange(n) / n)
    lines = np.append(inner, breaks[-1])
    return lines, 1.0 / np.diff(lines)


def pyramid_of(low: np.ndarray, high: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Lowest and highest of 2^l x 2^l boxes, up to a single one: tree (., 2), and of each level l its beginning there and its
    columns."""
    tree, levels, total = [np.stack([low, high], -1)], [(0, low.shape[1])], low.size
    while tree[-1].shape[:2] != (1, 1):
        low, high = (
            np.pad(box, [(0, n % 2) for n in box.shape], constant_values=beyond) for box, beyond in ((low, np.inf), (high, -np.inf))
        )
        low, high = (np.minimum(low[::2], low[1::2]), np.maximum(high[::2], high[1::2]))
        low, high = (np.minimum(low[:, ::2], low[:, 1::2]), np.maximum(high[:, ::2], high[:, 1::2]))
        tree.append(np.stack([low, high], -1))
        levels.append((total, low.shape[1]))
        total += low.size
    return np.concatenate([level.reshape(-1, 2) for level in tree]), np.array(levels)


def search(rays, breaks, parts: tuple[int, int], vertices, low, high, recursive: bool, blocks: int) -> tuple[np.ndarray, ...]:
    """`kernels.mesh.intersect` of rays, six (N,), from the borders of the knot spans, mm, and their parts along x and y."""
    from caustic_cli.optics.kernels.mesh import intersect  # noqa: PLC0415 - numba is slow to load

    lines = [c for b, n in zip(breaks, parts, strict=True) for c in lines_of(b, n)]
    return intersect(*rays, *lines, *parts, vertices, low, high, *pyramid_of(low, high), recursive, blocks)


class TriangleMesh:
    """A height field approximated by triangles.

    Args:
        field: the height field.
        heights: (n, m) control heights, mm.
        n_u, n_v: subdivisions of each knot span along x and y.
    """

    def __init__(self, field: HeightField, heights: Tensor, n_u: int, n_v: int):
        if min(n_u, n_v) < 1:
            raise InputError(f"knot spans must be divided into at least 1 x 1 parts, got {n_u} x {n_v}")
        self.field, self.shape = field, (n_u, n_v)
        self._breaks = [((2.0 * s.breaks - 1.0) * r).numpy() for s, r in zip(field.spaces, field.half_size, strict=True)]
        self._vertices = vertices_of(*field.spaces, heights, n_u, n_v).numpy()
        self._low, self._high = (box.numpy() for box in boxes_of(*field.spaces, heights))

    def intersect(
        self, x: Tensor, y: Tensor, z: Tensor, dx: Tensor, dy: Tensor, dz: Tensor, recursive: bool = True
    ) -> tuple[Tensor, Tensor, Tensor]:
        """First intersections: parameters t (N,), infinite without one; status (N,) int8, 0 for a hit; triangles tested, (N,)
        int32.

        Args:
            x, y, z, dx, dy, dz: points and directions (of any length) of rays, mm; scalars where they agree.
            recursive: find knot span products by a quadtree, or by testing all of them.
        """
        rays = [a.detach().double().contiguous().numpy() for a in torch.broadcast_tensors(x, y, z, dx, dy, dz)]
        found = search(rays, self._breaks, self.shape, self._vertices, self._low, self._high, recursive, blocks())
        t, status, tests = (torch.from_numpy(a) for a in found)
        return t, status, tests
