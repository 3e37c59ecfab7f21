"""A B-spline surface on fewer knots, by least squares: what a file holds where the whole control net would be too much.

Notation
    S           knot spans along an axis, before and after
    t           the points of the fit: `degree` + 1 equal steps in every span of the surface, its knots among them

Both axes are fitted one after the other, each by its own least squares, which commute.  Folds stay: a knot that is repeated is
kept as often, and the simple ones between two of them are coarsened evenly.
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
    """The least-squares surface of the same degrees with at most about so many control points: as it is where those are not fewer
    than its own.  heights: (n, m) mm."""
    if most >= math.prod(field.shape):
        return field, heights
    u, v = (coarsened(space, math.sqrt(most / math.prod(field.shape))) for space in field.spaces)
    net = _fitted(heights.detach().double().cpu(), field.spaces[0], u)
    return HeightField((u, v), field.half_size), _fitted(net.T, field.spaces[1], v).T.contiguous()


def coarsened(space: SplineSpace, part: float) -> SplineSpace:
    """The same degree on at most `part` of the control points, as far as the ends and the repeated knots leave that open."""
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
    """How many points each of some surfaces may have for at most so many in all: the small ones keep theirs."""
    left, found = most, dict[int, int]()
    for rank, k in enumerate(sorted(range(len(sizes)), key=lambda k: sizes[k])):
        found[k] = min(sizes[k], left // (len(sizes) - rank))
        left -= found[k]
    return [found[k] for k in range(len(sizes))]


def _fitted(net: Tensor, old: SplineSpace, new: SplineSpace) -> Tensor:
    """Control values (n', k) of the splines nearest to those with control values (n, k)."""
    t = knot_lines(old, old.degree + 1)
    return torch.from_numpy(make_lsq_spline(t.numpy(), along(old, t, net).numpy(), new.knots.numpy(), new.degree).c)
