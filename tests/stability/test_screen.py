"""Rays parallel to the screen, away from it, far beside it, on the borders of pixels and of the frame, at infinity."""

import math

import numpy as np
import pytest
import torch
from exact import FILTER, SCREEN, carried, exactly, mp, ours, splatted

from caustic_cli.optics.reconstruction import Filter, splat

N = 1.5
TILTS = [10.0**-k for k in range(1, 16)]
D = (0.6, 0.0, 0.8)
FILTERS = {
    "bincount": Filter(),
    "cosine": Filter("cosine", (3, 3)),
    "wide": Filter("cosine", (7, 5)),
    "gaussian": Filter("gaussian", (5, 5), (0.3, 0.3)),
    "narrow": Filter("gaussian", (3, 3), (1e4, 1e4)),
    "flat": Filter("gaussian", (11, 11), (1e-9, 1e-9)),
}


def slope_towards(tilt: float) -> float:
    """z_x at which the ray D leaves with a cosine of `tilt` to the screen's normal; mpf inside."""
    n, c = mp.mpf(N), mp.mpf(tilt)
    tx = mp.sqrt(1 - c * c)  # n d - t is parallel to the normal (-g, 1)
    return float(-(n * mp.mpf(D[0]) - tx) / (n * mp.mpf(D[2]) - c))


@pytest.mark.parametrize("side", [1, -1])
def test_parallel_to_the_screen(side, kernels, dtype, compare):
    """Cosines to the screen's normal from 0.1 to 1e-15, towards it and away: far beside it or never there, and no derivative."""
    g = np.array([slope_towards(side * tilt) for tilt in TILTS])
    zero = np.zeros(len(g))
    value, found = ours(kernels, dtype, N, D, zero + 0.1, g, zero, zero, zero)
    assert math.isfinite(value) and np.isfinite(found).all()
    exact = [exactly(N, D, 0.1, a, 0.0, 0.0, 0.0) for a in g]
    by = np.array([[float(v) for v in row[1:]] for row in exact]).T
    error = np.abs(found - by).max() / np.abs(by).max()
    slope = torch.tensor(g, dtype=dtype, requires_grad=True)
    away = torch.tensor([side * t for t in TILTS], dtype=dtype) * (1.0 + slope) * 0.0
    path = torch.where(away > 0, 10.0 / away, torch.zeros_like(away))
    (naive,) = torch.autograd.grad(path.sum(), slope)
    compare(
        "rays parallel to the screen",
        "derivatives, relative",
        float(naive.abs().max()),
        error,
        1e-3 if dtype == torch.float32 else 1e-12,
    )


def direct(kernels: str, dtype, x, y, filter: Filter, weights=None):
    """Image and power off the screen of rays of these weights that land at x, y: they run along z from a level surface."""
    x, y = (torch.tensor(a, dtype=dtype).view(1, -1) for a in (x, y))
    one = torch.ones_like(x) if weights is None else torch.tensor(weights, dtype=dtype).view(1, -1)
    if kernels == "torch":
        image, off = splat(x, y, one, SCREEN, filter)
        return image, float(off)
    x, y, one = x.double(), y.double(), one.double()
    image, _, lost = splatted([torch.zeros_like(x)] * 3, x, y, None, one, "none", N, filter)
    return image, float(lost["off_screen"])


@pytest.mark.parametrize("name", FILTERS)
def test_borders(name, kernels, dtype, compare):
    """On borders of pixels and frame, an ulp beside them, far outside and at infinity: what does not land is counted as lost."""
    half, pixel = SCREEN.half_size[0], SCREEN.pixel[0]
    edges = [-half, half, -half + pixel, half - pixel, 0.0, pixel, 1.5 * pixel, half + pixel, -half - 3.0 * pixel]
    tiny = np.float32 if dtype == torch.float32 else np.float64
    beside = [float(np.nextafter(tiny(e), tiny(s * 1e9))) for e in edges for s in (1, -1)]
    outside = [1e4, -1e9, 1e20, -1e30, math.inf, -math.inf, math.nan]
    at = np.array(edges + beside + outside)
    x, y = (a.ravel() for a in np.meshgrid(at, at))
    image, off = direct(kernels, dtype, x, y, FILTERS[name])
    assert bool(torch.isfinite(image).all()) and float(image.min()) >= -1e-15
    assert image.dtype == torch.float64
    assert float(image.sum()) > 50 and off > 100
    closes = abs(float(image.sum()) + off - len(x)) / len(x)
    f = FILTERS[name]
    inside = np.isfinite(x) & np.isfinite(y) & (np.abs(x) < half) & (np.abs(y) < half)
    if f.reach != (0, 0):  # naive: shares that leave the frame are given to the pixels that remain
        wrong = direct("torch", torch.float64, x[inside], y[inside], f)[1] / inside.sum()
        compare("landing on pixel and frame borders", "power on the screen, relative", wrong, closes, 1e-7)
    assert closes < 1e-7


def test_the_same_pixel_whichever_way(dtype):
    """Whole pixels: what lands strictly inside one is counted there by kernel and reference alike."""
    at = (np.arange(16) - 7.5) * SCREEN.pixel[0]
    x, y = (a.ravel() for a in np.meshgrid(at, at))
    for kernels in ("fused", "torch"):
        image, off = direct(kernels, dtype, x, y, Filter())
        assert bool((image == 1.0).all()) and off == 0.0


def test_far_landing_has_no_derivative(dtype):
    """A screen 1e12 mm away and slopes of 1e6: coordinates up to 1e18, nothing on the screen, no NaN in the derivative."""
    leaf = torch.linspace(-1e6, 1e6, 40, dtype=dtype).view(1, -1).requires_grad_()
    none = torch.zeros_like(leaf)
    x, y, power, leaving = carried((0.0, 0.0, 1.0), (1e-5 * leaf, none), none + 1.0, (none, none, none), 1.0001, 1e12)
    image, off = splat(x, y, power, SCREEN, FILTER)
    (by,) = torch.autograd.grad((image * torch.rand(image.shape)).sum() + leaving, leaf)
    assert bool(torch.isfinite(by).all()) and float(off.detach()) > 10


def test_at_pixel_borders_the_cosine_filter_has_one_slope(kernels):
    """It is C1: the derivative at a border is that from either side."""
    border, found = 2.0 * SCREEN.pixel[0], []
    for off in (-1e-9, 0.0, 1e-9):
        found.append(ours(kernels, torch.float64, N, None, [0.1], [0.2], [0.1], [border + off - 0.2], [0.3])[1])
    for k in (0, 2):
        assert np.abs(found[k] - found[1]).max() < 1e-6 * np.abs(found[1]).max()
