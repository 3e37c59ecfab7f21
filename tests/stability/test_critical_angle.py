"""Light leaving near the critical angle, from both sides down to 1e-12 rad.

dt/di = n cos(i) / cos(t) is infinite there; with Fresnel's transmittance, which goes to 0 as cos(t) does, only dT/di is.
A slope of k roundings is worth k eps / (2 r) of relative error, r = cos(t)^2: the bound that holds, and the best there is.
"""

import math

import numpy as np
import pytest
import torch
from exact import exactly, mp, ours, refracted

from caustic_cli.optics.interface import refract

N = 1.5
MARGINS = [10.0**-k for k in range(1, 13)]
EPS = {torch.float32: 2.0**-23, torch.float64: 2.0**-52}


def slopes(side: int, dtype: torch.dtype, d=None) -> np.ndarray:
    """Slopes g at which rays of direction d (None for +z) meet the surface MARGINS before (-1) or beyond (1) the critical angle."""
    lean = 0.0 if d is None else math.atan2(d[0], d[2])
    g = [mp.tan(mp.asin(1 / mp.mpf(N)) + side * mp.mpf(m) - lean) for m in MARGINS]
    return np.array([float(torch.tensor(float(v)).to(dtype)) if dtype == torch.float32 else float(v) for v in g])


def radicand(g: float, d) -> float:
    found = refracted(mp.mpf(N), tuple(map(mp.mpf, d or (0, 0, 1))), mp.mpf(float(g)), mp.mpf(0))
    return 0.0 if found is None else float(found[2])


@pytest.mark.parametrize("d", [None, (0.28, 0.0, 0.96)], ids=["plane", "oblique"])
def test_before_the_critical_angle(kernels, dtype, d, compare):
    d = d and tuple(float(torch.tensor(c).to(dtype)) for c in d)
    if d:
        d = (d[0], 0.0, math.sqrt(1.0 - d[0] ** 2))
    g = slopes(-1, dtype, d)
    r = np.array([radicand(v, d) for v in g])
    passing = r > 1e-15
    assert passing.sum() >= (6 if dtype == torch.float32 else 12)
    g, r = g[passing], r[passing]
    t, zero = np.full(len(g), 0.25), np.zeros(len(g))
    value, found = ours(kernels, dtype, N, d, t, g, zero, zero, zero)
    assert np.isfinite(found).all() and math.isfinite(value)
    expected = [exactly(N, d or (0, 0, 1), *row) for row in zip(t, g, zero, zero, zero, strict=True)]
    by = np.array([[float(v) for v in row[1:]] for row in expected]).T
    # the kernel reckons in double whatever it stores, the reference in the rays' own precision
    eps = EPS[torch.float64 if kernels == "fused" else dtype]
    scale = np.abs(by).max(0)
    error = np.abs(found - by).max(0) / scale
    allowed = 30.0 * eps / r + (1e-6 if dtype == torch.float32 else 1e-13)
    near = eps / r < 0.03  # nearer than that no digit is left of cos(t) in this precision: finite is all that can be asked
    assert near.sum() >= (4 if eps > 1e-10 else len(r) - 1)
    assert (error[near] <= allowed[near]).all(), (error, allowed)
    if near.all():
        total = float(sum(row[0] for row in expected))
        assert value == pytest.approx(total, rel=1e-5 if dtype == torch.float32 else 1e-6)
    compare(
        "critical angle, 0.1 to 1e-12 rad",
        "derivatives, in units of 30 eps / cos²(t)",
        naive(dtype),
        float((error / allowed)[near].max()),
        1.0,
    )


def naive(dtype: torch.dtype) -> float:
    """cos(t) by the textbook, masked afterwards: what its derivative is at one ray beyond the critical angle."""
    sine = torch.tensor((1.0 + 1e-6) / N, dtype=dtype, requires_grad=True)
    square = 1.0 - N * N * sine * sine
    return float(torch.autograd.grad(torch.where(square > 0, torch.sqrt(square), torch.zeros_like(square)), sine)[0])


@pytest.mark.parametrize("d", [None, (0.28, 0.0, 0.96)], ids=["plane", "oblique"])
def test_beyond_the_critical_angle(kernels, dtype, d):
    g = slopes(1, dtype, d)
    g = g[[radicand(v, d) == 0.0 for v in g]]
    assert len(g) >= 6
    zero = np.zeros(len(g))
    if dtype == torch.float32 and kernels == "torch":  # a few roundings: such a ray may still pass, with next to no power
        g, zero = g[:5], zero[:5]
    value, found = ours(kernels, dtype, N, d, zero + 0.25, g, zero, zero, zero)
    assert value == 0.0
    assert not found.any()


@pytest.mark.parametrize("n", [1.0001, 1.5, 2.4, 5.0])
def test_the_sides_are_told_apart_to_1e_12(n):
    """Plane wave: where the exact radicand is beyond rounding, what passes is what should."""
    critical, checked = mp.asin(1 / mp.mpf(n)), 0
    for m in MARGINS:
        for side in (-1, 1):
            g = float(mp.tan(critical + side * mp.mpf(m))) if critical + side * mp.mpf(m) < mp.pi / 2 else 1e9
            exact = 1 - (mp.mpf(n) ** 2 - 1) * mp.mpf(g) ** 2
            if abs(exact) < 8 * n * n * (1 + g * g) * 2.0**-52:
                continue
            checked += 1
            slope = torch.tensor(g, dtype=torch.float64)
            assert bool(refract((0.0, 0.0, 1.0), slope, torch.zeros_like(slope), n)[1]) == (exact > 0), (n, m, side)
    assert checked >= 20


def test_transmittance_heals_the_gain():
    """The gain n cos(i) / cos(t) grows without bound; what carries power, T times the gain, does not."""
    gains, healed = [], []
    for m in MARGINS[:9]:
        i = mp.asin(1 / mp.mpf(N)) - mp.mpf(m)
        g = mp.tan(i)
        _, power, r = refracted(mp.mpf(N), (mp.mpf(0), mp.mpf(0), mp.mpf(1)), g, mp.mpf(0))
        gains.append(N * float(mp.cos(i) / mp.sqrt(r)))
        healed.append(float(power) * gains[-1])
        _, found = ours("fused", torch.float64, N, None, [0.25], [float(g)], [0.0], [0.0], [0.0])
        assert np.isfinite(found).all()
    assert gains[-1] > 1e4 and max(healed) < 8.0


def test_eps_bound_is_attained():
    """Not an idle bound: the slope's own rounding at 1e-12 from the angle is worth 1e-4 of the derivative."""
    g = slopes(-1, torch.float64)[-1]
    a, b = (exactly(N, (0, 0, 1), 0.25, v, 0.0, 0.0, 0.0)[2] for v in (g, np.nextafter(g, 0.0)))
    assert 1e-6 < float(abs(a - b) / abs(a)) < 1e-2
