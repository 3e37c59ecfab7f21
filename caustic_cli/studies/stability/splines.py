"""Difficult cases of B-splines: degrees up to 15, knots repeated up to the degree, points on the knots and beside them.

The truth is rational arithmetic.
"""

from __future__ import annotations

from fractions import Fraction

import numpy as np
import torch

from caustic_cli.optics.bspline import SplineSpace
from caustic_cli.optics.sampling import Sample
from caustic_cli.optics.surfaces.heightfield import HeightField
from caustic_cli.studies.stability.case import Case

#: Rounding of double precision.
EPS = 2.0**-52


def space(p: int, kind: str) -> SplineSpace:
    """A spline space of degree p with even knots, or with repeated ones."""
    if kind == "even":
        return SplineSpace.uniform(p + 9, p)
    inner = [0.25] * p + [0.25 + 1e-9] + [0.5] * max(1, p // 2) + [1.0 - 2.0**-30]  # repeated, nearly repeated, at the edge
    return SplineSpace(p, torch.tensor([0.0] * (p + 1) + inner + [1.0] * (p + 1), dtype=torch.float64))


def points(s: SplineSpace) -> torch.Tensor:
    """Knots, the floats beside them, and points in between."""
    b = s.breaks
    beside = torch.cat([torch.nextafter(b, torch.zeros_like(b))[::2], torch.nextafter(b, torch.ones_like(b))[1::2]])
    return torch.cat([b, beside, 0.5 * (b[1:] + b[:-1])[::2], torch.linspace(0.0, 1.0, 6, dtype=torch.float64)])


def exact(s: SplineSpace, x: float, heights) -> tuple[float, float, float]:
    """Value, slope and the sum of |N_i' P_i| of the spline at x, by rational arithmetic."""
    t, p, x = [Fraction(float(k)) for k in s.knots], s.degree, Fraction(x)
    last = max(i for i in range(len(t) - 1) if t[i] < t[i + 1])
    span = min(max(i for i in range(len(t) - 1) if t[i] <= x), last)
    n = [Fraction(int(i == span)) for i in range(len(t) - 1)]

    def ratio(a, b):
        return a / b if b else Fraction(0)

    for k in range(1, p + 1):
        before = n
        n = [
            ratio(x - t[i], t[i + k] - t[i]) * n[i] + ratio(t[i + k + 1] - x, t[i + k + 1] - t[i + 1]) * n[i + 1]
            for i in range(len(n) - 1)
        ]
    slopes = [p * (ratio(before[i], t[i + p] - t[i]) - ratio(before[i + 1], t[i + p + 1] - t[i + 1])) for i in range(len(n))]
    h = [Fraction(float(v)) for v in heights]
    value, slope = (sum(a * b for a, b in zip(w, h, strict=True)) for w in (n, slopes))
    return float(value), float(slope), float(sum(abs(a * b) for a, b in zip(slopes, h, strict=True)))


def heights_of(n: int, seed: int) -> torch.Tensor:
    """Control heights (n,) that float32 holds as they are."""
    return torch.rand(n, generator=torch.Generator().manual_seed(seed)).double() - 0.5


def naive_basis(s: SplineSpace, x: np.ndarray, dtype) -> np.ndarray:
    """Cox-de Boor as it is written down, quotients and all."""
    t, p = s.knots.numpy().astype(dtype), s.degree
    x = x.astype(dtype)[:, None]
    n = ((t[:-1] <= x) & (x < t[1:])).astype(dtype)
    with np.errstate(all="ignore"):
        for k in range(1, p + 1):
            n = (x - t[: -k - 1]) / (t[k:-1] - t[: -k - 1]) * n[:, :-1] + (t[k + 1 :] - x) / (t[k + 1 :] - t[1:-k]) * n[:, 1:]
    return n


def repeated(p: int) -> tuple[float, float]:
    """Values of a spline with repeated knots, naively by the recursion as it is printed."""
    s = space(p, "repeated")
    naive = naive_basis(s, points(s).numpy(), np.float64) @ heights_of(s.n, p).numpy()
    truth = np.array([exact(s, float(x), heights_of(s.n, p))[0] for x in points(s)])
    return float(np.abs(naive - truth).max()), rounded_off(s, truth)


def high_degree(p: int) -> tuple[float, float]:
    """Values of a spline on even knots, naively by powers of the global variable on its last span."""
    s, u = space(p, "even"), points(space(p, "even"))
    truth = np.array([exact(s, float(x), heights_of(s.n, p))[0] for x in u])
    x = np.linspace(float(s.breaks[-2]), 1.0, p + 1)
    piece = np.linalg.solve(np.vander(x, increasing=True), [exact(s, float(a), heights_of(s.n, p))[0] for a in x])
    there = (u >= s.breaks[-2]).numpy()
    found = (np.vander(u.numpy(), p + 1, increasing=True) @ piece)[there]
    return float(np.abs(found - truth[there]).max()) / EPS, rounded_off(s, truth)


def rounded_off(s: SplineSpace, truth: np.ndarray) -> float:
    """Error of the values that a surface has along u, in roundings."""
    u, flat, share = points(s), SplineSpace.uniform(2, 1), torch.ones((), dtype=torch.float64)
    net = heights_of(s.n, s.degree)[:, None].expand(s.n, 2).contiguous()
    sample = Sample(u, torch.full_like(u, 0.3), False, share)
    found = HeightField((s, flat), (0.5, 0.5)).prepare(sample, torch.float64)(net)[0]
    return float(np.abs(found.numpy() - truth).max()) / EPS


CASES = (
    # a basis of positive terms: three roundings for each of p <= 9 degrees, and as many of the sums over it
    Case("knots repeated up to the degree", "value, roundings", "0 / 0 in the recursion", 100.0, repeated, (3, 5, 9)),
    # the same for p <= 15
    Case("degrees of 9 to 15", "value, roundings", "powers of x cancel", 100.0, high_degree, (9, 15)),
)
