"""Knot reduction: least-squares approximation of a B-spline surface on fewer knots, for smaller files.

Notation
    S           knot spans along an axis, before and after
    t           nodes of the fit: `degree` + 1 equal steps per span of the surface, knots included

The two axes are fitted one after the other, which is the tensor-product least-squares fit.  Creases are preserved: repeated knots
keep their multiplicity, and the simple knots between two of them are thinned out evenly.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise

import numpy as np
import torch
from scipy.interpolate import make_lsq_spline
from torch import Tensor

from caustic_cli.export.surface import along, knot_lines
from caustic_cli.optics.bspline import SplineSpace
from caustic_cli.optics.surfaces.heightfield import HeightField


def on_fewer_knots(field: HeightField, heights: Tensor, most: int) -> tuple[HeightField, Tensor]:
    """Least-squares surface of the same degrees with at most about `most` control points; unchanged if it has no more than these.
    heights: (n, m) mm."""
    if most >= math.prod(field.shape):
        return field, heights
    u, v = (coarsened(space, math.sqrt(most / math.prod(field.shape))) for space in field.spaces)
    net = _fitted(heights.detach().double().cpu(), field.spaces[0], u)
    return HeightField((u, v), field.half_size), _fitted(net.T, field.spaces[1], v).T.contiguous()


def coarsened(space: SplineSpace, part: float) -> SplineSpace:
    """Spline space of the same degree with about the fraction `part` of the control points; end knots and repeated knots are
    kept."""
    knots, times = np.unique(space.knots.numpy(), return_counts=True)
    kept = np.flatnonzero(times > 1)
    simple = len(knots) - len(kept)
    wanted = max(0.0, part * space.n - (space.n - simple))  # of the simple knots
    found = [np.zeros(space.degree + 1)]
    for a, b in pairwise(kept):
        spans = 1 + math.floor(wanted * (b - a - 1) / max(simple, 1))
        inner = np.interp(np.linspace(a, b, spans + 1)[1:-1], np.arange(len(knots)), knots)
        found += [inner, np.repeat(knots[b], times[b])]
    return SplineSpace(space.degree, torch.from_numpy(np.concatenate(found)))


def allocate_points(sizes: Sequence[int], most: int) -> list[int]:
    """Distribute at most `most` points over surfaces of these sizes: small ones keep all of theirs."""
    left, found = most, dict[int, int]()
    for rank, k in enumerate(sorted(range(len(sizes)), key=lambda k: sizes[k])):
        found[k] = min(sizes[k], left // (len(sizes) - rank))
        left -= found[k]
    return [found[k] for k in range(len(sizes))]


def _fitted(net: Tensor, old: SplineSpace, new: SplineSpace) -> Tensor:
    """Control values (n', k) of the least-squares approximations to splines with control values (n, k)."""
    t = knot_lines(old, old.degree + 1)
    return torch.from_numpy(make_lsq_spline(t.numpy(), along(old, t, net).numpy(), new.knots.numpy(), new.degree).c)
