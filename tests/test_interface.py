"""Refraction and reflection against Snell's law, the angle form of Fresnel's equations, and a sphere by trigonometry."""

import math

import numpy as np
import pytest
import torch

from caustic_cli.optics.interface import reflectance, refract

INDICES = (1.1, 1.33, 1.5, 1.5443, 1.8, 2.4)


def random_rays(count: int, steepness: float, seed: int = 0):
    """Unit directions over a cone of half angle 70 degrees, and slopes; float64, those that meet the surface from behind."""
    rng = np.random.default_rng(seed)
    slopes = torch.from_numpy(rng.normal(size=(2, count)) * steepness)
    polar, azimuth = np.arccos(rng.uniform(math.cos(math.radians(70)), 1, count)), rng.uniform(0, 2 * np.pi, count)
    d = torch.from_numpy(np.stack([np.sin(polar) * np.cos(azimuth), np.sin(polar) * np.sin(azimuth), np.cos(polar)]))
    forward = d[2] - d[0] * slopes[0] - d[1] * slopes[1] > 1e-3
    return d[:, forward], slopes[:, forward]


def unit_normal(slopes: torch.Tensor) -> torch.Tensor:
    normal = torch.stack([-slopes[0], -slopes[1], torch.ones_like(slopes[0])])
    return normal / normal.norm(dim=0)


@pytest.mark.parametrize("index", INDICES)
@pytest.mark.parametrize("outwards", [True, False])
def test_snell_invariant(index, outwards):
    """n1 d x N = n2 t x N, |t| = 1 and t goes through the surface: components of unit vectors, so a few roundings."""
    eta = index if outwards else 1.0 / index
    d, slopes = random_rays(4000, 0.7)
    t, passes, c, s = refract(tuple(d), slopes[0], slopes[1], eta)
    t, normal = torch.stack(t), unit_normal(slopes)
    assert int(passes.sum()) > 500
    assert bool(passes.all()) == (not outwards)  # into the denser side everything passes; out of it some is reflected
    keep = passes.nonzero()[:, 0]
    d, t, normal = d[:, keep], t[:, keep], normal[:, keep]
    length = torch.sqrt(1 + slopes[0] ** 2 + slopes[1] ** 2)[keep]
    invariant = eta * torch.linalg.cross(d, normal, dim=0) - torch.linalg.cross(t, normal, dim=0)
    assert float(invariant.abs().max()) < 5e-15
    assert float((t.norm(dim=0) - 1.0).abs().max()) < 5e-14  # |t| carries the rounding of s times |N|
    assert float((t * normal).sum(0).min()) > 0
    torch.testing.assert_close(c[keep] / length, (d * normal).sum(0), rtol=0, atol=1e-14)
    torch.testing.assert_close(s[keep] / length, (t * normal).sum(0), rtol=0, atol=1e-10)  # s is a root: 1e-14 / s at grazing


@pytest.mark.parametrize("index", INDICES)
@pytest.mark.parametrize("outwards", [True, False])
def test_refraction_is_reversible(index, outwards):
    """Through and back is the ray that came: the rounding of the grazing root s enters times s again, so no digits go."""
    eta = index if outwards else 1.0 / index
    d, slopes = random_rays(4000, 0.7, seed=1)
    t, passes, _, _ = refract(tuple(d), slopes[0], slopes[1], eta)
    back, returns, _, _ = refract(t, slopes[0], slopes[1], 1.0 / eta)
    keep = passes & (torch.stack(t) * unit_normal(slopes)).sum(0).gt(1e-4)
    assert int(keep.sum()) > 500
    assert bool(returns[keep].all())
    torch.testing.assert_close(torch.stack(back)[:, keep], d[:, keep], rtol=0, atol=1e-12)


def test_equal_indices_bend_nothing():
    d, slopes = random_rays(1000, 1.0, seed=2)
    t, passes, c, s = refract(tuple(d), slopes[0], slopes[1], 1.0)
    assert bool(passes.all())
    torch.testing.assert_close(torch.stack(t), d, rtol=0, atol=1e-14)
    assert float(reflectance("exact", c, s, 1.0).max()) < 1e-19  # ((c - s) / 2c)^2 with s off by 1e-16 / c and c above 1e-3


@pytest.mark.parametrize("rho", [20.0, -35.0])
@pytest.mark.parametrize("index", INDICES)
def test_sphere_by_trigonometry(index, rho):
    """Axial rays leave a sphere of radius rho at sin a = h / rho, refract to sin b = n sin a, and turn by b - a."""
    h = torch.linspace(-0.97, 0.97, 195, dtype=torch.float64) * abs(rho) / index
    slope = torch.sign(torch.tensor(rho)) * h / torch.sqrt(rho * rho - h * h)  # of rho - sign sqrt(rho^2 - h^2)
    a = torch.asin(h / rho)
    turn = torch.asin(index * torch.sin(a)) - a
    for axis in (0, 1):
        slopes = (slope, torch.zeros_like(slope)) if axis == 0 else (torch.zeros_like(slope), slope)
        t, passes, _, _ = refract((0.0, 0.0, 1.0), *slopes, index)
        assert bool(passes.all())
        torch.testing.assert_close(t[axis], torch.sin(turn), rtol=0, atol=1e-14)
        torch.testing.assert_close(t[2], torch.cos(turn), rtol=0, atol=1e-14)
    near_axis = slope.abs() < 0.02  # the paraxial power (n - 1) / rho, to third order
    torch.testing.assert_close(t[1][near_axis], ((index - 1) * h / rho)[near_axis], rtol=0, atol=5e-5)


@pytest.mark.parametrize("index", INDICES)
def test_total_internal_reflection_begins_at_the_critical_slope(index):
    """|g|^2 = 1 / (n^2 - 1), erratum E1: 1e-12 to either side decides (the radicand's rounding is 1e-15)."""
    critical = 1.0 / math.sqrt(index * index - 1.0)
    azimuth = torch.linspace(0, 2 * math.pi, 73, dtype=torch.float64)
    checked = 0
    for nudge in (1e-12, 1e-9, 1e-6, 1e-3, 0.5):
        for sign, expected in ((-1, True), (1, False)):
            g = critical * (1.0 + sign * nudge)
            passes = refract((0.0, 0.0, 1.0), g * torch.cos(azimuth), g * torch.sin(azimuth), index)[1]
            assert bool((passes == expected).all()), (nudge, sign)
            checked += len(passes)
    assert checked == 730


def test_total_internal_reflection_of_slanted_rays_begins_at_the_critical_angle():
    index, slope = 1.5, 0.4
    tilt = math.atan(slope)  # the normal leans to -x, so a ray leaning to +x by a meets it at a + tilt
    for sign, expected in ((-1, True), (1, False)):
        a = math.asin(1 / index) - tilt + sign * 1e-9
        d = (torch.tensor([math.sin(a)], dtype=torch.float64), 0.0, torch.tensor([math.cos(a)], dtype=torch.float64))
        passes = refract(d, torch.tensor([slope], dtype=torch.float64), torch.zeros(1, dtype=torch.float64), index)[1]
        assert bool(passes) is expected


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("kind", ["none", "schlick", "exact"])
def test_no_nan_at_or_beyond_the_critical_slope(dtype, kind):
    """Values and gradients stay finite at the critical slope itself, next to it, and far beyond."""
    index = 1.5
    critical = 1.0 / math.sqrt(index * index - 1.0)
    g = torch.tensor([critical * f for f in (0.999999, 1 - 1e-15, 1.0, 1 + 1e-15, 1.000001, 1.1, 3.0, 1e3, 1e6)], dtype=dtype)
    gx, gy = (0.6 * g).requires_grad_(), (0.8 * g).requires_grad_()
    t, passes, c, s = refract((0.0, 0.0, 1.0), gx, gy, index)
    length = torch.sqrt(1 + gx * gx + gy * gy)
    through = torch.where(passes, 1.0 - reflectance(kind, c / length, s / length, index), torch.zeros_like(s))
    assert 0 < int(passes.sum()) < len(g)
    total = through.sum() + sum((through * component).sum() for component in t)
    gradients = torch.autograd.grad(total, (gx, gy))
    for value in (*t, c, s, through, *gradients):
        assert bool(torch.isfinite(value).all())
    for gradient in gradients:
        assert not gradient[-4:].any()  # a reflected ray pulls at nothing


def angles(index_in: float, index_out: float, count: int = 200) -> tuple[np.ndarray, np.ndarray]:
    """Angles of incidence up to 0.999 of the critical one (or of 90 degrees), and of refraction."""
    top = math.asin(min(1.0, index_out / index_in))
    incident = np.linspace(0.01, 0.999 * top, count)
    return incident, np.arcsin(index_in / index_out * np.sin(incident))


@pytest.mark.parametrize("pair", [(1.5, 1.0), (1.0, 1.5), (1.33, 1.8), (2.4, 1.0)])
def test_exact_reflectance_is_the_textbooks_and_transmission_the_rest(pair):
    """Hecht, Optics, eqs. 4.42 to 4.45 and 4.57: reflected and transmitted power from separate formulas add up to 1."""
    i, t = angles(*pair)
    r_s, r_p = np.sin(i - t) / np.sin(i + t), np.tan(i - t) / np.tan(i + t)
    t_s = 2 * np.sin(t) * np.cos(i) / np.sin(i + t)
    t_p = t_s / np.cos(i - t)
    flux = pair[1] * np.cos(t) / (pair[0] * np.cos(i))
    ours = reflectance("exact", torch.from_numpy(np.cos(i)), torch.from_numpy(np.cos(t)), pair[0] / pair[1]).numpy()
    np.testing.assert_allclose(ours, 0.5 * (r_s**2 + r_p**2), rtol=0, atol=1e-13)
    np.testing.assert_allclose(ours + 0.5 * flux * (t_s**2 + t_p**2), 1.0, rtol=0, atol=1e-13)
    scaled = reflectance("exact", torch.from_numpy(3.7 * np.cos(i)), torch.from_numpy(3.7 * np.cos(t)), pair[0] / pair[1])
    np.testing.assert_allclose(scaled.numpy(), ours, rtol=0, atol=1e-15)  # any common factor of c and s


@pytest.mark.parametrize("index", INDICES)
@pytest.mark.parametrize("outwards", [True, False])
def test_brewster_and_normal_incidence(index, outwards):
    eta = index if outwards else 1.0 / index
    brewster = math.atan(1.0 / eta)  # incident and refracted rays at right angles: r_p = 0
    c, s = math.cos(brewster), math.sin(brewster)  # cos(refracted) = sin(brewster)
    r_s = (eta * c - s) / (eta * c + s)
    assert reflectance("exact", c, s, eta) == pytest.approx(0.5 * r_s**2, rel=1e-13)
    normal = ((index - 1.0) / (index + 1.0)) ** 2
    for kind in ("exact", "schlick"):
        assert reflectance(kind, 1.0, 1.0, eta) == pytest.approx(normal, rel=1e-14)
    assert reflectance("none", 1.0, 1.0, eta) == 0.0


@pytest.mark.parametrize("pair", [(1.5, 1.0), (1.0, 1.5), (1.0, 2.4)])
def test_schlick_uses_the_larger_angle(pair):
    i, t = angles(*pair)
    r0 = ((pair[0] - pair[1]) / (pair[0] + pair[1])) ** 2
    larger = np.maximum(i, t)
    ours = reflectance("schlick", torch.from_numpy(np.cos(i)), torch.from_numpy(np.cos(t)), pair[0] / pair[1]).numpy()
    np.testing.assert_allclose(ours, r0 + (1 - r0) * (1 - np.cos(larger)) ** 5, rtol=0, atol=1e-15)
    assert ours[-1] > 0.7  # it rises towards 1 at grazing exit, as Fresnel's does


def test_transmission_heals_the_gain_at_the_critical_angle():
    """d(theta_t)/d(theta_i) diverges there, but T times it tends to 2 (1 + n^2), the mean of 4 (s) and 4 n^2 (p): hard case 1."""
    index = 1.5
    critical = math.asin(1 / index)
    products = []
    for below in (1e-2, 1e-4, 1e-6, 1e-8):
        i = critical - below
        slope = torch.tensor([math.tan(i)], dtype=torch.float64)
        _, passes, c, s = refract((0.0, 0.0, 1.0), slope, torch.zeros_like(slope), index)
        assert bool(passes)
        length = math.sqrt(1 + float(slope) ** 2)
        gain = index * math.cos(i) / (float(s) / length)
        products.append((1.0 - float(reflectance("exact", c, s, index))) * gain)
    assert gain > 5000
    assert products == sorted(products)
    assert products[-1] == pytest.approx(2 * (1 + index**2), rel=1e-3)
