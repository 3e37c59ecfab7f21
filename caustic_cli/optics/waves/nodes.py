"""Functions known at nodes of an even grid: between these, and beside where they are known."""

from __future__ import annotations

import torch
from torch import Tensor

#: Points of the interpolation between nodes along an axis.
POINTS = 6


def between(nodes: int, low: float, step: float, fine_low: float, fine_step: float, count: int, like: Tensor):
    """First node and weights (count, POINTS) of Lagrange's interpolation at finer cells; None where they are the nodes."""
    if nodes == count:
        return None
    x = (fine_low + fine_step * (torch.arange(count, dtype=torch.float64, device=like.device) + 0.5) - low) / step - 0.5
    first = (torch.floor(x).long() - (POINTS // 2 - 1)).clamp(0, nodes - POINTS)
    t, k = x - first, range(POINTS)
    weights = torch.stack([_product([(t - j) / (i - j) for j in k if j != i]) for i in k], 1)
    return first, weights


def _product(factors: list[Tensor]) -> Tensor:
    found = factors[0]
    for f in factors[1:]:
        found = found * f
    return found


def interpolated(c: Tensor, along_x, along_y) -> Tensor:
    if along_x is not None:
        first, w = along_x
        c = sum(w[:, k, None] * c[first + k] for k in range(POINTS))
    if along_y is not None:
        first, w = along_y
        c = sum(w[None, :, k] * c[:, first + k] for k in range(POINTS))
    return c


def filled(c: Tensor, dark: Tensor) -> Tensor:
    """A function (n, m) with what it is beside the dark in a few cells of that, 0 beyond."""
    if not bool(dark.any()):
        return c
    known, c = (~dark).to(c), torch.where(dark, torch.zeros_like(c), c)
    for _ in range(POINTS // 2 + 1):
        around, count = (torch.nn.functional.avg_pool2d(t[None, None], 3, 1, 1)[0, 0] for t in (c * known, known))
        new = (known == 0) & (count > 0)
        c = torch.where(new, around / count.clamp_min(1e-9), c)
        known = torch.where(new, torch.ones_like(known), known)
    return c
