"""Interpolation of functions on a uniform grid, and extrapolation into dark regions."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor

#: Stencil points of the interpolation along an axis.
POINTS = 6
#: Fine rows that are computed at a time.
BLOCK = 64


def lagrange_weights(nodes: int, low: float, step: float, fine_low: float, fine_step: float, count: int, like: Tensor):
    """Lagrange interpolation at `count` fine cells: first node (count,) and weights (count, POINTS); None if they are the nodes."""
    if nodes == count:
        return None
    x = (fine_low + fine_step * (torch.arange(count, dtype=torch.float64, device=like.device) + 0.5) - low) / step - 0.5
    first = (torch.floor(x).long() - (POINTS // 2 - 1)).clamp(0, nodes - POINTS)
    t, k = x - first, range(POINTS)
    weights = torch.stack([_product([(t - j) / (i - j) for j in k if j != i]) for i in k], 1)
    return first, weights


def _combined_rows(c: Tensor, first: Tensor, weights: Tensor) -> Tensor:
    """Linear combinations (count, m) of rows of c (n, m), block by block, each with a dense matrix of the rows that it needs."""
    found = []
    for start in range(0, len(first), BLOCK):
        at, w = first[start : start + BLOCK], weights[start : start + BLOCK]
        low, high = int(at.min()), int(at.max()) + POINTS
        matrix = torch.zeros(len(at), high - low, dtype=w.dtype, device=w.device)
        matrix.scatter_(1, (at - low)[:, None] + torch.arange(POINTS, device=at.device), w)
        found.append(matrix @ c[low:high])
    return torch.cat(found)


def _product(factors: list[Tensor]) -> Tensor:
    found = factors[0]
    for f in factors[1:]:
        found = found * f
    return found


def interpolate(c: Tensor, along_x, along_y) -> Tensor:
    """A function (n, m) at fine rows and columns, with the results of `lagrange_weights` for each axis."""
    if along_x is not None:
        c = _combined_rows(c, *along_x)
    if along_y is not None:
        c = _combined_rows(c.T, *along_y).T.contiguous()
    return c


def extrapolated(c: Tensor, dark: Tensor) -> Tensor:
    """A function (n, m) extrapolated by neighbourhood averages into the nearest cells of the dark region; 0 farther inside."""
    if not bool(dark.any()):
        return c
    known, c = (~dark).to(c), torch.where(dark, torch.zeros_like(c), c)
    for _ in range(POINTS // 2 + 1):
        around, count = (torch.nn.functional.avg_pool2d(t[None, None], 3, 1, 1)[0, 0] for t in (c * known, known))
        new = (known == 0) & (count > 0)
        c = torch.where(new, around / count.clamp_min(1e-9), c)
        known = torch.where(new, torch.ones_like(known), known)
    return c


@dataclass(frozen=True)
class Lit:
    """What is lit of a grid on the reference plane, (n, m) each."""

    #: Signed distances to the pupil's edges, mm on this plane, positive inside; `edge_y` None for a circle.
    edge_x: Tensor
    edge_y: Tensor | None
    #: 0 where light is blocked behind the pupil, 1 elsewhere; None if nothing is blocked.
    shade: Tensor | None
    #: Signed distance to the edges of a mask on the exit, mm, positive where it is clear; None without one.
    mask: Tensor | None = None

    def mapped(self, function: Callable[[Tensor], Tensor]) -> Lit:
        """The same with a function applied to everything."""
        return Lit(*(None if c is None else function(c) for c in vars(self).values()))  # type: ignore[arg-type]

    def fraction(self, step: tuple[float, float]) -> Tensor:
        """Lit fraction of each cell of widths `step`, mm."""
        mean = 0.5 * (step[0] + step[1])
        lit = _within(self.edge_x, step[0] if self.edge_y is not None else mean)
        if self.edge_y is not None:
            lit = lit * _within(self.edge_y, step[1])
        if self.mask is not None:
            lit = lit * _within(self.mask, mean)
        return lit if self.shade is None else lit * self.shade.clamp(0.0, 1.0)


def _within(distance: Tensor, width: float) -> Tensor:
    """Lit fraction of cells of a width whose middles are at signed distances from an edge, mm."""
    return (distance / width + 0.5).clamp(0.0, 1.0)


@dataclass
class FineWavefront:
    """A wavefront on a fine grid: columns are interpolated already, rows on demand.

    root: square root of the power of a fully lit cell; step: of the fine grid; along_x: weights of the rows, see
    `lagrange_weights`.
    """

    path: Tensor
    root: Tensor
    lit: Lit
    step: tuple[float, float]
    along_x: tuple[Tensor, Tensor] | None

    def rows(self, part: slice = slice(None)) -> tuple[Tensor, Tensor, Tensor]:
        """Path, mm; square root of the power of a fully lit cell; lit fraction of the cell: (rows, m) float64 each."""
        lit = self.lit.mapped(lambda c: self._at(c, part))
        return self._at(self.path, part), self._at(self.root, part), lit.fraction(self.step)

    @cached_property
    def whole(self) -> tuple[Tensor, Tensor]:
        """Path, mm, and amplitude of every cell, (n, m) float64."""
        if torch.is_grad_enabled() and self.path.requires_grad:
            path, root, lit = self.rows()
            return path, root * lit
        count = len(self.path) if self.along_x is None else len(self.along_x[0])
        path, amplitude = (self.path.new_empty(count, self.path.shape[1]) for _ in range(2))
        for start in range(0, count, BLOCK):  # what they are made of takes as much memory again
            part = slice(start, start + BLOCK)
            path[part], root, lit = self.rows(part)
            amplitude[part] = root * lit
        return path, amplitude

    def _at(self, c: Tensor, part: slice) -> Tensor:
        return c[part] if self.along_x is None else interpolate(c, tuple(t[part] for t in self.along_x), None)
