"""What a difference would lose: light bent by n - 1, relief thin against the glass, several scales in one scene."""

import math

import numpy as np
import pytest
import torch
from exact import exactly, mp, ours

from caustic_cli.optics.emission import rays_of
from caustic_cli.optics.reconstruction import Filter
from caustic_cli.optics.sampling import Sampler
from caustic_cli.optics.surfaces.heightfield import HeightField
from caustic_cli.optics.system import EXIT, System
from caustic_cli.optics.trace import Tracer, expose
from caustic_cli.scene import Disc, Lens, PlaneWave, Points, Scene, Screen


@pytest.mark.parametrize("index", [1.0 + 1e-12, 1.0 + 1e-9, 1.0 + 1e-6, 1.001])
@pytest.mark.parametrize("d", [None, (0.28, 0.0, 0.96)], ids=["plane", "oblique"])
def test_index_close_to_one(index, d, kernels, dtype, compare):
    """The deflection is (n - 1) times the slope: its derivative by the slope, of which (s - n c) / |N|^2 leaves nothing."""
    g = np.array([0.05, 0.4, -0.3])
    zero = np.zeros(3)
    _, found = ours(kernels, dtype, index, d, zero + 0.1, g, zero + 0.1, zero, zero)
    direction = d or (0.0, 0.0, 1.0)
    exact = np.array([[float(v) for v in exactly(index, direction, 0.1, a, 0.1, 0.0, 0.0)[2:]] for a in g]).T
    error = np.abs(found[1:] - exact).max() / np.abs(exact).max()
    slope = torch.linspace(0.05, 0.4, 20, dtype=dtype, requires_grad=True)
    norm2, n = 1.0 + slope * slope, torch.tensor(index, dtype=dtype)
    gamma = (torch.sqrt(norm2 + n * n * (1.0 - norm2)) - n) / norm2
    (bend,) = torch.autograd.grad((gamma * slope).sum(), slope)
    naive = float((bend / (1.0 - index) - 1.0).abs().max())  # 1 + O(n - 1) in exact arithmetic
    eps = torch.finfo(dtype).eps
    bound = 300 * eps if d is None or kernels == "fused" else 300 * eps + 30 * eps / (index - 1.0)
    if d is None and index < 1.0 + 1e-8:
        compare(
            "index 1 + 1e-12 to 1.001", "derivative by the slope, relative", naive, error, 1e-4 if dtype == torch.float32 else 1e-12
        )
    else:
        assert error < max(bound, 1e-4 if dtype == torch.float32 else 0.0)


@pytest.mark.parametrize("thickness", [1e2, 1e4, 1e6])
@pytest.mark.parametrize("source", ["plane", "point", "sun"])
def test_thickness_large_against_sag(thickness, source, kernels, dtype, compare):
    """Relief of 1e-3 mm on glass of up to 1 km: landing points and derivatives beside the same relief counted from its own mean.

    Naive: slopes by differences of absolute heights in the rays' precision.
    """
    lens = Lens(size=(2.0, 2.0), control=(12, 12), index=1.5, z_in=0.0)
    field = HeightField.of(lens)
    g = torch.Generator().manual_seed(3)
    grain = 2.0**-30  # heights that thick glass holds without rounding, so that both scenes are the same
    sag = (1e-3 * torch.rand(12, 12, generator=g, dtype=torch.float64) / grain).round() * grain
    x = torch.linspace(-0.9, 0.9, 25, dtype=torch.float64)
    slope = field.at(sag, x, 0.3 * x, ((1, 0),))[0]
    h = 1e-3
    z = [field.at(sag + thickness, x + s * h, 0.3 * x)[0].to(dtype) for s in (1, -1)]
    naive = float(((z[0] - z[1]).double() / (2 * h) - slope).abs().max() / slope.abs().max())
    light = {"plane": PlaneWave(), "point": Points(((0.0, 0.0, -10.0 * thickness),)), "sun": Disc(angle=1e-4)}[source]
    screen = Screen((3.0, 3.0), thickness + 50.0, (12, 12))
    weights = torch.rand(12, 12, generator=g, dtype=torch.float64)
    out = []
    for base, z_in in ((thickness, 0.0), (0.0, -thickness)):
        s = Scene(light, Lens(size=(2.0, 2.0), control=(12, 12), index=1.5, z_in=z_in), Screen((3.0, 3.0), base + 50.0, (12, 12)))
        if source == "point":
            s = Scene(Points(((0.0, 0.0, z_in - 10.0 * thickness),)), s.lens, s.screen)
        (rays,) = rays_of(s, "stratified", 900, 2).chunks()
        leaf = (sag + base).requires_grad_()
        part = Tracer(System.of(s, field), rays, torch.float64 if base == 0.0 else dtype).expose(
            {EXIT: leaf}, s.screen, Filter("cosine", (3, 3))
        )
        image = part.image.double()
        (by,) = torch.autograd.grad((image * weights).sum(), leaf)
        out.append((image.detach(), by))
    assert float(out[0][0].sum()) > 0.2
    error = max(float((a - b).norm() / b.norm()) for a, b in zip(*out, strict=True))
    assert math.isfinite(error) and screen.z > thickness
    bound = 2e-4 if dtype == torch.float32 else 1e-8
    if naive > 10.0 * bound:
        compare("relief of 1e-3 mm on 0.1 m to 1 km of glass", "image and derivatives, relative", naive, error, bound)
    assert error <= bound


def test_slopes_of_hits_do_not_see_the_thickness(kernels):
    """dz/dx at hits of rays through a kilometre of glass, to 1e-12 of the largest."""
    lens = Lens(size=(2.0, 2.0), control=(9, 9), index=1.5)
    field = HeightField.of(lens)
    sag = (1e-4 * torch.rand(9, 9, dtype=torch.float64) * 2.0**33).round() * 2.0**-33
    s = Scene(Disc(angle=1e-6), lens, Screen((3.0, 3.0), 2e6))
    b = Tracer(System.of(s, field), next(rays_of(s, "stratified", 400, 2).chunks())).start
    _, gx, gy, hit = field.intersect(sag + 1e6, b.origin, b.direction, 1.0)
    t = (1e6 + 5e-5) / b.direction[2]
    expected = field.at(sag, *(o + t * d for o, d in zip(b.origin[:2], b.direction[:2], strict=True)), ((1, 0), (0, 1)))
    assert int(hit.sum()) > 300
    for a, e in zip((gx, gy), expected, strict=True):
        assert float((a - e)[hit].abs().max()) < 1e-9 * float(e.abs().max())


@pytest.mark.parametrize("scale", [1e-5, 1e-2, 1e3, 1e5])
def test_lengths_from_nanometres_to_kilometres(scale, kernels, dtype):
    """A scene scaled by a power of ten has the same image, and derivatives scaled by the inverse."""
    out = []
    for k in (1.0, scale):
        lens = Lens(size=(10.0 * k, 8.0 * k), control=(7, 6), index=1.5)
        field, screen = HeightField.of(lens), Screen((14.0 * k, 14.0 * k), 60.0 * k, (10, 10))
        g = torch.Generator().manual_seed(4)
        leaf = (k * (3.0 + 0.2 * torch.rand(7, 6, generator=g, dtype=torch.float64))).requires_grad_()
        (rays,) = rays_of(Scene(Points(((1.0 * k, 0.0, -30.0 * k),)), lens, screen), "stratified", 900, 2).chunks()
        system = System.of(Scene(PlaneWave(), lens, screen), field)
        part = Tracer(system, rays, dtype).expose({EXIT: leaf}, screen, Filter("cosine", (3, 3)))
        (by,) = torch.autograd.grad((part.image * torch.linspace(0, 1, 100).view(10, 10)).sum(), leaf)
        out.append((part.image.detach().double(), by * k))
    close = 1e-4 if dtype == torch.float32 else 1e-9
    for a, b in zip(*out, strict=True):
        assert float((a - b).norm() / a.norm()) < close


def test_shortest_normals_and_steepest(kernels, dtype):
    """Slopes from 1e-300 to 1e15: the height field's normal never vanishes, and nothing overflows."""
    lens = Lens(size=(1.0, 1.0), control=(4, 4), index=1.5)
    field, screen = HeightField.of(lens), Screen((10.0, 10.0), 1e9, (4, 4))
    x, _ = field.control_xy()
    (sample,) = Sampler("grid", (9, 9)).chunks()
    for slope in (0.0, 1e-300, 1e-40, 1e-8, 1.0, 1e4, 1e8):
        leaf = (slope * x)[:, None].expand(4, 4).contiguous().requires_grad_()
        system = System.of(Scene(PlaneWave(), lens, screen), field)
        part = Tracer(system, sample, dtype).expose({EXIT: leaf}, screen, Filter("cosine", (3, 3)))
        value = (part.image * torch.rand(4, 4)).sum() + part.leaving
        if value.requires_grad:
            (by,) = torch.autograd.grad(value, leaf)
            assert bool(torch.isfinite(by).all())
        total = float(part.image.detach().sum()) + sum(float(v.detach()) for v in part.lost.values())
        assert total == pytest.approx(1.0, abs=1e-6)


def test_random_numbers_stay_below_one():
    """A Sobol number k 2^-32 in float32 rounds to 1.0, outside the aperture; here none does, in any sampler."""
    naive = np.float32((2**32 - 1) * 2.0**-32)
    assert naive == 1.0
    for kind in ("sobol", "stratified", "uniform", "lines", "grid"):
        for sample in Sampler(kind, (300, 200), seed=7).chunks():
            for a in (sample.u, sample.v):
                assert a.dtype == torch.float64 and float(a.min()) >= 0.0 and float(a.max()) < 1.0


def test_landing_beside_mpmath(kernels, dtype):
    """Value and derivatives of ordinary rays: the bounds that hold where nothing is hard."""
    g = np.linspace(-0.5, 0.5, 11)
    zero = np.zeros(11)
    value, found = ours(kernels, dtype, 1.5, None, zero + 0.3, g, 0.5 * g, zero + 1.0, zero)
    rows = [
        exactly(
            1.5,
            (0, 0, 1),
            float(np.float32(0.3)) if dtype == torch.float32 else 0.3,
            *(float(np.float32(v)) if dtype == torch.float32 else float(v) for v in (a, 0.5 * a)),
            1.0,
            0.0,
        )
        for a in g
    ]
    exact = np.array([[float(v) for v in row[1:]] for row in rows]).T
    close = 1e-5 if dtype == torch.float32 else 1e-12
    assert value == pytest.approx(float(mp.fsum(row[0] for row in rows)), rel=close)
    assert np.abs(found - exact).max() < close * np.abs(exact).max()


def test_a_thousand_to_one(kernels, dtype):
    """An aperture 1000 times as wide as high, a screen 1e4 times as far as wide: energy closes."""
    lens = Lens(size=(10.0, 0.01), control=(8, 5), index=1.5)
    s = Scene(Points(((0.0, 0.0, -1.0),)), lens, Screen((1.0, 1e3), 1e4, (6, 7)))
    h = 2.0 + 1e-3 * torch.rand(8, 5, dtype=torch.float64)
    e = expose(s, HeightField.of(lens), h, rays_of(s, "stratified", 500, 1), Filter("gaussian", (5, 3), (0.1, 2.0)), dtype)
    assert float(e.image.sum()) + math.fsum(e.lost.values()) == pytest.approx(1.0, abs=1e-6 if dtype == torch.float32 else 1e-12)
