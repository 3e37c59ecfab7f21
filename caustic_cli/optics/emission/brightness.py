"""Importance sampling of a source's brightness picture by the inverse transform method.

A number a in [0, 1] selects a row of the picture from the cumulative power of the rows, and a position within it; b likewise
selects a pixel of the row from its conditional distribution.  Both maps are monotonic, so stratification and low discrepancy are
preserved.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor


def points_by_brightness(picture: np.ndarray, a: Tensor, b: Tensor) -> tuple[Tensor, Tensor]:
    """Points x, y (N,) of [-1, 1]^2, distributed like the brightness, from numbers a, b (N,) in [0, 1].

    picture: brightness (n, m), [i, j] with i along +x.
    """
    light = torch.as_tensor(np.asarray(picture, dtype=np.float64), device=a.device)
    rows = light.sum(1)
    i, x = _place(rows / rows.sum(), a, torch.zeros_like(a, dtype=torch.int64), len(rows))
    _, y = _place((light / torch.where(rows > 0, rows, 1.0)[:, None]).reshape(-1), b, i * light.shape[1], light.shape[1])
    return 2.0 * x - 1.0, 2.0 * y - 1.0


def _place(parts: Tensor, number: Tensor, first: Tensor, count: int) -> tuple[Tensor, Tensor]:
    """Inverse cumulative distribution over `count` cells from `first` on, whose probabilities sum to 1: cell, and position in [0,
    1]."""
    sums = torch.cat([parts.new_zeros(1), torch.cumsum(parts, 0)])
    before = sums[first]
    wanted = (before + number * (sums[first + count] - before)).contiguous()
    k = torch.searchsorted(sums, wanted, right=True) - 1
    k = torch.minimum(torch.maximum(k, first), first + count - 1)
    dark = parts[k] <= 0  # by rounding at the end of a row: take the last lit cell before it
    if bool(dark.any()):
        lit = torch.where(parts > 0, torch.arange(len(parts), device=parts.device), -1).cummax(0).values
        k = torch.where(dark, lit[k], k)
    within = ((wanted - sums[k]) / parts[k]).clamp(0.0, 1.0)
    return k - first, (k - first + within) / count
