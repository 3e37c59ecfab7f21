"""Steep and grazing rays that meet the surface more than once: the first root, whatever it takes, and its derivatives.

The surface is a sine of amplitude / period 0.1 as a cubic spline over 4 periods, steepest slope about 0.6; rays run in x at 60, 75
and 85 degrees.  The reference marches densely with SciPy's splines and closes in by bisection.
"""

import functools
import math

import numpy as np
import pytest
import torch
from scipy.interpolate import BSpline

from caustic_cli.optics.bspline import SplineSpace
from caustic_cli.optics.intersection import Status, find
from caustic_cli.optics.rays import RayState
from caustic_cli.optics.surfaces.heightfield import HeightField

FIELD = HeightField((SplineSpace.uniform(43, 3), SplineSpace.uniform(4, 3)), (4.0, 1.0))
COUNT, Z = 400, -0.3


def surface(slope: float = 0.63) -> torch.Tensor:
    x, _ = FIELD.control_xy()
    return (slope / math.pi * torch.sin(math.pi * x)).double()[:, None].expand(43, 4).contiguous()


def rays(angle: float) -> RayState:
    z = torch.full((COUNT,), math.cos(math.radians(angle)), dtype=torch.float64)
    x = torch.linspace(-3.9, 1.0, COUNT, dtype=torch.float64)
    none = torch.zeros_like(x)
    return RayState((x, none + 0.1, Z), (torch.sqrt(1.0 - z * z), none, z), none + 1.0 / COUNT)


def spline(heights: torch.Tensor) -> BSpline:
    return BSpline(4.0 * (2.0 * FIELD.spaces[0].knots.numpy() - 1.0), heights[:, 0].numpy(), 3)


@functools.cache
def marched(slope: float, angle: float) -> tuple[np.ndarray, np.ndarray]:
    """First roots (infinite for none), and how far each is from being a matter of rounding."""
    z, b = spline(surface(slope)), rays(angle)
    x, dx, dz = b.origin[0].numpy()[:, None], b.direction[0].numpy()[:, None], b.direction[2].numpy()[:, None]
    t = np.linspace(0.0, 1.0, 10_001)[None, :] * (4.0 - x) / dx
    f = Z + t * dz - z(np.minimum(x + t * dx, 4.0))
    first = (f >= 0).argmax(1)
    hit, k = (f >= 0).any(1), np.arange(len(t))
    low, high = t[k, np.maximum(first - 1, 0)], t[k, first]
    for _ in range(60):
        middle = 0.5 * (low + high)
        below = Z + middle * dz[:, 0] - z(np.minimum(x[:, 0] + middle * dx[:, 0], 4.0)) < 0
        low, high = np.where(below, middle, low), np.where(below, high, middle)
    before = np.where(np.arange(t.shape[1])[None, :] < first[:, None] - 100, f, -np.inf).max(1)
    margin = np.where(hit, -before, -f.max(1))  # the nearest miss before the root
    return np.where(hit, high, np.inf), margin


def newton(z: BSpline, b: RayState) -> np.ndarray:
    """What the textbook does: Newton's method from the mean plane."""
    x, dx, dz = b.origin[0].numpy(), b.direction[0].numpy(), b.direction[2].numpy()
    t, slope = -Z / dz, z.derivative()
    for _ in range(50):
        at = np.clip(x + t * dx, -4.0, 4.0)
        t = t - (Z + t * dz - z(at)) / (dz - slope(at) * dx)
    return t


@pytest.mark.parametrize("angle", [60.0, 75.0, 85.0])
def test_the_first_of_several_roots(angle, kernels, compare):
    heights, b = surface(), rays(angle)
    z = spline(heights)
    expected, margin = marched(0.63, angle)
    clear = margin > 1e-5
    assert clear.sum() > 0.8 * COUNT and np.isfinite(expected[clear]).sum() > 200
    t, status = find(FIELD, heights, b.origin, b.direction)
    found = np.where(status.numpy() == Status.HIT, t.numpy(), np.inf)
    assert not (status == Status.UNRESOLVED).any()
    wrong = ~np.isclose(found, expected, rtol=1e-9, atol=1e-9)
    naive = ~np.isclose(newton(z, b), expected, rtol=1e-6, atol=1e-6)
    compare(
        "grazing hits, several roots, 60 to 85°",
        "part of the rays with a wrong hit",
        naive[clear].mean(),
        wrong[clear].mean(),
        1e-3,
    )


@pytest.mark.parametrize("angle", [60.0, 75.0, 85.0])
def test_derivatives_at_the_hits(angle, kernels, compare):
    """dt/dP = N_i N_j / c and what follows for the slopes, against SciPy's basis at the marched root."""
    heights, b = surface(), rays(angle)
    z = spline(heights)
    expected, margin = marched(0.63, angle)
    leaf = heights.clone().requires_grad_()
    t, gx, _, hit = FIELD.intersect(leaf, b.origin, b.direction, 1.0)
    use = np.isfinite(expected) & (margin > 1e-5) & hit.numpy()
    x = b.origin[0].numpy() + np.where(use, expected, 0.0) * b.direction[0].numpy()
    c = b.direction[2].numpy() - z.derivative()(x) * b.direction[0].numpy()
    use &= c > 1e-3
    assert use.sum() > 150
    keep = torch.from_numpy(use)
    (by,) = torch.autograd.grad(torch.where(keep, t, 0.0).sum() + 0.1 * torch.where(keep, gx, 0.0).sum(), leaf)
    knots = 4.0 * (2.0 * FIELD.spaces[0].knots.numpy() - 1.0)
    basis = BSpline.design_matrix(x[use], knots, 3).toarray()
    slopes = np.stack([BSpline(knots, e, 3).derivative()(x[use]) for e in np.eye(43)], 1)
    move = basis / c[use, None]
    total = move + 0.1 * (slopes + z.derivative(2)(x[use])[:, None] * b.direction[0].numpy()[use, None] * move)
    along_y = BSpline.design_matrix(np.array([0.1]), 2.0 * FIELD.spaces[1].knots.numpy() - 1.0, 3).toarray()
    exact = total.sum(0)[:, None] * along_y
    error = np.linalg.norm(by.numpy() - exact) / np.linalg.norm(exact)
    step = 1e-4  # the naive derivative: differences of a hit that may jump to another root
    shift = surface()
    shift[21] += step
    jump = (newton(spline(shift), b)[use] - newton(z, b)[use]).sum() / step
    compare(
        "grazing hits, several roots, 60 to 85°",
        "derivative by the heights, relative",
        abs(jump - exact[21].sum()) / np.linalg.norm(exact),
        error,
        1e-6,
    )


def test_gentle_slopes_are_proved_safe_and_steep_ones_are_not(kernels):
    """|grad h| tan(angle) < 1 rules several roots out; where it does not hold the search must not rely on it."""
    b, checked = rays(75.0), 0
    for slope in (0.02, 0.2, 0.63):
        heights = surface(slope)
        bound = FIELD.slope_bounds(heights)[0]
        expected, margin = marched(slope, 75.0)
        t, status = find(FIELD, heights, b.origin, b.direction)
        clear = (margin > 1e-5) & np.isfinite(expected)
        assert (status.numpy()[clear] == Status.HIT).all()
        assert np.abs(t.numpy()[clear] - expected[clear]).max() < 1e-9
        checked += clear.sum()
        assert bound >= slope * 0.99
    assert checked > 500
