"""From rays to pixels: power is conserved ray by ray, shares follow the thesis' formulas, and derivatives are right."""

import math

import numpy as np
import pytest
import torch
from scipy.integrate import quad_vec

from caustic_cli.errors import InputError
from caustic_cli.optics.reconstruction import MAX_FILTER, Filter, splat
from caustic_cli.scene import Screen

#: Not square, neither in pixels nor in their shape: 2 x 1.25 mm pixels.
SCREEN = Screen((24.0, 8.75), 100.0, (12, 7))
SIZES = [(1, 1), (3, 3), (3, 11), (11, 3), (5, 1), (1, 7)]
FILTERS = (
    [Filter("bincount", s) for s in SIZES[:3]]
    + [Filter("cosine", s) for s in SIZES]
    + [Filter("gaussian", s, a) for s in SIZES for a in ((0.0, 0.0), (1.0, 0.3), (1e-9, 40.0))]
)
SMOOTH = [f for f in FILTERS if f.kind != "bincount" and max(f.size) > 1]


def name(f: Filter) -> str:
    return f"{f.kind}{f.size[0]}x{f.size[1]}a{f.alpha[0]:g}"


def rays(count: int, spread: float = 2.0, seed: int = 0) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Landing points over `spread` times the frame, and positive weights, float64."""
    g = torch.Generator().manual_seed(seed)
    u, v, w = torch.rand(3, count, generator=g, dtype=torch.float64)
    rx, ry = SCREEN.half_size
    return (2 * u - 1) * rx * spread, (2 * v - 1) * ry * spread, 0.1 + w


def awkward(f: Filter) -> tuple[torch.Tensor, torch.Tensor]:
    """All pairs of coordinates at pixel edges, the frame's edge, ghost pixels' edges, and beyond every number."""
    axes = []
    for axis in (0, 1):
        half, w, r = SCREEN.half_size[axis], SCREEN.pixel[axis], f.reach[axis]
        edge = half + r * w
        values = [0.0, w, 0.5 * w, half, -half, edge, -edge, edge + w, -edge - w, 1e30, -1e30, math.inf, -math.inf, math.nan]
        values += [math.nextafter(e, d) for e in (half, -half, edge, -edge) for d in (-math.inf, math.inf)]
        values += [half + 0.5 * w * r, -half - 0.5 * w * r, -1e-300]
        axes.append(torch.tensor(values, dtype=torch.float64))
    x, y = torch.meshgrid(*axes, indexing="ij")
    return x.reshape(-1), y.reshape(-1)


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
@pytest.mark.parametrize("f", FILTERS, ids=name)
def test_every_rays_power_is_on_the_image_or_counted_off_it(f, dtype):
    """Inside, in the ghost pixels, far outside, infinite or not a number; one rounding per share, so 1e-12 and 1e-6."""
    tolerance = 1e-12 if dtype == torch.float64 else 1e-6
    ax, ay = awkward(f)
    rx, ry, w = rays(500)
    x, y, w = torch.cat([ax, rx]).to(dtype), torch.cat([ay, ry]).to(dtype), torch.cat([torch.ones_like(ax), w]).to(dtype)
    image, off = splat(x, y, w, SCREEN, f)
    assert image.shape == (12, 7)
    assert bool(torch.isfinite(image).all())
    assert float(image.min()) >= 0
    assert 0 < float(image.sum()) < float(w.sum())
    assert abs(float(image.double().sum() + off.double() - w.double().sum())) < tolerance * float(w.sum())


def test_each_awkward_ray_alone_conserves_its_weight():
    checked = 0
    for f in (Filter("cosine", (3, 5)), Filter("gaussian", (3, 5), (1.0, 1.0)), Filter()):
        for x, y in zip(*awkward(f), strict=True):
            image, off = splat(x[None], y[None], torch.ones(1, dtype=torch.float64), SCREEN, f)
            assert float(image.sum() + off) == pytest.approx(1.0, abs=1e-14)
            checked += 1
    assert checked > 1500


@pytest.mark.parametrize("f", FILTERS, ids=name)
def test_rays_deep_inside_lose_nothing_and_rays_far_outside_give_nothing(f):
    """With the reach in mind: a ray r pixels from the edge keeps everything, one r + 1 pixels out reaches nothing."""
    small = Screen(SCREEN.size, 0.0, (40, 35))
    x, y, w = rays(200, 0.2)
    image, off = splat(x, y, w, small, f)
    assert float(off) == 0.0
    assert float(image.sum()) == pytest.approx(float(w.sum()), rel=1e-13)
    image, off = splat(x + 1000.0, y, w, small, f)
    assert not image.any()
    assert float(off) == pytest.approx(float(w.sum()), rel=1e-13)


def thesis_image(x, y, weight, f: Filter, alpha: tuple[float, float]) -> np.ndarray:
    """Equations 4.4.1 to 4.4.9 in mm, share by share, on a frame with room for shares of the outermost ghost pixels."""
    (nx, ny), (wx, wy), (rx, ry) = SCREEN.resolution, SCREEN.pixel, SCREEN.half_size
    gx, gy = (f.size[0] - 1) // 2, (f.size[1] - 1) // 2
    image = np.zeros((nx, ny))
    for px, py, w in zip(x.tolist(), y.tolist(), weight.tolist(), strict=True):
        i0, j0 = math.floor((px + rx) / wx), math.floor((py + ry) / wy)
        if not (-gx <= i0 < nx + gx and -gy <= j0 < ny + gy):
            continue
        values = {}
        for i in range(i0 - gx, i0 + gx + 1):
            for j in range(j0 - gy, j0 + gy + 1):
                dx, dy = px - ((i + 0.5) * wx - rx), py - ((j + 0.5) * wy - ry)
                fx = math.exp(-alpha[0] * dx**2) - math.exp(-alpha[0] * (f.size[0] * wx / 2) ** 2)
                fy = math.exp(-alpha[1] * dy**2) - math.exp(-alpha[1] * (f.size[1] * wy / 2) ** 2)
                values[i, j] = fx * fy
        total = sum(values.values())
        for (i, j), value in values.items():
            if 0 <= i < nx and 0 <= j < ny:
                image[i, j] += w * value / total
    return image


@pytest.mark.parametrize("size", [(1, 1), (3, 3), (3, 11), (5, 1)])
def test_gaussian_is_the_thesis_formula(size):
    """alpha = 0.4 per mm^2 is alpha w^2 per pixel^2, different along x and y (erratum E15)."""
    (wx, wy), alpha = SCREEN.pixel, (0.4, 0.4)
    f = Filter("gaussian", size, (alpha[0] * wx**2, alpha[1] * wy**2))
    x, y, w = rays(300, 1.6)
    image, _ = splat(x, y, w, SCREEN, f)
    np.testing.assert_allclose(image.numpy(), thesis_image(x, y, w, f, alpha), rtol=0, atol=1e-13)


@pytest.mark.parametrize("alpha", [0.0, 1e-12, 1e-9, 1e-6])
def test_small_alpha_is_a_parabola_without_noise(alpha):
    """Both exponentials are nearly 1: their difference is noise in float32 (shown for 1e-9), and 1e-6 of the shares here."""
    phi = torch.linspace(0, 1, 101)
    d = torch.arange(-2, 3) + 0.5 - phi.double()[:, None]
    parabola = (6.25 - d * d) / (6.25 - d * d).sum(-1, keepdim=True)
    ours = Filter("gaussian", (5, 5), (alpha, alpha)).weights(phi, 0)
    assert ours.dtype == torch.float32
    torch.testing.assert_close(ours.double(), parabola, rtol=0, atol=5e-7)
    ours = Filter("gaussian", (5, 5), (alpha, alpha)).weights(phi.double(), 1)
    torch.testing.assert_close(ours, parabola, rtol=0, atol=1e-14 + 2 * alpha)  # the parabola is the limit
    if alpha == 1e-9:
        naive = torch.exp(-alpha * d.float() ** 2) - math.exp(-alpha * 6.25)
        assert float(naive.abs().max()) == 0.0 or float((naive - parabola).abs().max()) > 1e-3


@pytest.mark.parametrize("alpha", [1e3, 1e6, 1e12, 1e30])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_huge_alpha_is_bincount(alpha, dtype):
    """exp(-alpha d^2) underflows in every pixel but the one nearest; on an edge the two nearest share alike."""
    f = Filter("gaussian", (5, 5), (alpha, alpha))
    phi = torch.linspace(0.1, 0.9, 33, dtype=dtype)
    shares = f.weights(phi, 0)
    expected = torch.zeros_like(shares)
    expected[:, 2] = 1.0
    torch.testing.assert_close(shares, expected, rtol=0, atol=1e-12)
    edge = f.weights(torch.zeros(1, dtype=dtype), 0)[0]
    torch.testing.assert_close(edge, torch.tensor([0, 0.5, 0.5, 0, 0], dtype=dtype), rtol=0, atol=1e-12)


@pytest.mark.parametrize("f", SMOOTH, ids=name)
def test_shares_are_continuous_across_pixels(f):
    """phi = 0 in one pixel is phi = 1 in the one before, and the pixel v / 2 away gets nothing there; shares sum to 1."""
    for axis in (0, 1):
        if f.size[axis] == 1:
            continue
        phi = torch.tensor([0.0, math.nextafter(1.0, 0.0), 0.37], dtype=torch.float64)
        at = f.weights(phi, axis)
        torch.testing.assert_close(at.sum(-1), torch.ones(3, dtype=torch.float64), rtol=0, atol=1e-14)
        assert float(at.min()) >= 0
        torch.testing.assert_close(at[0, :-1], at[1, 1:], rtol=0, atol=1e-12)
        assert abs(float(at[0, -1])) < 1e-15
        torch.testing.assert_close(f.weights(1.0 - phi, axis).flip(-1), at, rtol=0, atol=1e-12)  # symmetric


ONE_PIXEL = [Filter(), Filter("bincount", (3, 5)), Filter("gaussian", (1, 1), (2.0, 2.0)), Filter("cosine", (1, 1))]


@pytest.mark.parametrize("f", ONE_PIXEL, ids=name)
def test_size_one_is_numpys_histogram(f):
    x, y, w = rays(5000, 1.3)
    (rx, ry), (nx, ny) = SCREEN.half_size, SCREEN.resolution
    edges = np.linspace(-rx, rx, nx + 1), np.linspace(-ry, ry, ny + 1)
    expected = np.histogram2d(x.numpy(), y.numpy(), edges, weights=w.numpy())[0]
    image, off = splat(x, y, w, SCREEN, f)
    np.testing.assert_allclose(image.numpy(), expected, rtol=0, atol=1e-12)
    assert expected.min() > 0
    assert float(off) == pytest.approx(float(w.sum()) - expected.sum(), rel=1e-12)


def test_shape_of_the_rays_does_not_matter_and_rays_add_up():
    f, (x, y, w) = Filter("cosine", (3, 5)), rays(120)
    flat = splat(x, y, w, SCREEN, f)
    square = splat(x.view(10, 12), y.view(10, 12), w.view(10, 12), SCREEN, f)
    assert torch.equal(flat[0], square[0])
    parts = [splat(x[k], y[k], w[k], SCREEN, f) for k in (slice(0, 50), slice(50, None))]
    torch.testing.assert_close(parts[0][0] + parts[1][0], flat[0], rtol=0, atol=1e-14)
    torch.testing.assert_close(parts[0][1] + parts[1][1], flat[1], rtol=0, atol=1e-13)
    empty = splat(x[:0], y[:0], w[:0], SCREEN, f)
    assert not empty[0].any()
    assert float(empty[1]) == 0.0


KERNELS = [Filter("cosine", (3, 11)), Filter("gaussian", (3, 5), (0.0, 0.5)), Filter("gaussian", (5, 3), (1.0, 3.0)), Filter()]


@pytest.mark.parametrize("f", KERNELS, ids=name)
def test_kernel_is_the_mean_share_over_a_pixel(f):
    """By adaptive quadrature.  The midpoint rule with 512 points is off by |f''| / 24 / 512^2: 2e-6 up to |f''| = 12."""
    for axis in (0, 1):
        exact, _ = quad_vec(lambda phi, k=axis: f.weights(torch.tensor(phi, dtype=torch.float64), k).numpy(), 0, 1, epsabs=1e-10)
        kernel = f.kernel(axis)
        np.testing.assert_allclose(kernel.numpy(), exact, rtol=0, atol=2e-6)
        assert float(kernel.sum()) == pytest.approx(1.0, abs=1e-14)
        torch.testing.assert_close(kernel, kernel.flip(0), rtol=0, atol=1e-14)


SMOOTHED = [Filter("cosine", (3, 5)), Filter("gaussian", (5, 3), (0.7, 0.2)), Filter("gaussian", (3, 3)), Filter()]


@pytest.mark.parametrize("f", SMOOTHED, ids=name)
def test_smooth_is_the_image_of_very_many_rays(f):
    """Each pixel emits 48 x 48 evenly spread rays that share its power: light spreads, and leaves the frame, as in `smooth`.

    Midpoint rule again: |f''| / 24 / 48^2 < 1e-4 of a pixel's power.
    """
    target = torch.rand(SCREEN.resolution, dtype=torch.float64) + torch.eye(12, 7, dtype=torch.float64)
    (nx, ny), (wx, wy), fine = SCREEN.resolution, SCREEN.pixel, 48
    x = (torch.arange(nx * fine, dtype=torch.float64) + 0.5) * wx / fine - SCREEN.half_size[0]
    y = (torch.arange(ny * fine, dtype=torch.float64) + 0.5) * wy / fine - SCREEN.half_size[1]
    x, y = torch.meshgrid(x, y, indexing="ij")
    weight = target.repeat_interleave(fine, 0).repeat_interleave(fine, 1) / fine**2
    image, off = splat(x, y, weight, SCREEN, f)
    smooth = f.smooth(target)
    torch.testing.assert_close(image, smooth, rtol=0, atol=1e-4)
    assert float(off) == pytest.approx(float(target.sum() - smooth.sum()), abs=2e-3)
    assert (float(off) > 1.0) == (max(f.reach) > 0)


def functional(f: Filter, x0, y0, dx, dy):
    """t -> <random picture, image of rays at x0 + t dx>, a scalar function of one number."""
    w = torch.linspace(0.5, 1.5, len(x0), dtype=torch.float64)
    picture = torch.rand(SCREEN.resolution, generator=torch.Generator().manual_seed(3), dtype=torch.float64)
    return lambda t: (picture * splat(x0 + t * dx, y0 + t * dy, w, SCREEN, f)[0]).sum()


def remainder_order(function, steps: torch.Tensor) -> float:
    """Slope of log |f(h) - f(0) - h f'(0)| over log |h| by regression."""
    t = torch.zeros((), dtype=torch.float64, requires_grad=True)
    value = function(t)
    (slope,) = torch.autograd.grad(value, t)
    rest = [abs(float((function(h) - value - h * slope).detach())) for h in steps]
    return float(np.polyfit(np.log(steps.abs().numpy()), np.log(rest), 1)[0])


@pytest.mark.parametrize("sign", [1, -1])
@pytest.mark.parametrize("size", [(3, 3), (3, 11), (5, 1)])
def test_cosine_is_once_differentiable_everywhere(size, sign):
    """Taylor remainder of order 2 to 0.05 for rays anywhere and for rays exactly on pixel edges, in both directions.

    (Its second derivative jumps there, which bends the line a little.)  Along an axis of size 1 rays are binned: held still.
    """
    steps = sign * torch.logspace(-5, -2.5, 8, dtype=torch.float64)
    x, y, _ = rays(40, 1.2)
    on_edges = tuple(torch.arange(-5, 6, dtype=torch.float64) * w for w in SCREEN.pixel)
    for at in ((x, y), on_edges):
        dx = torch.linspace(0.2, 1.0, len(at[0]), dtype=torch.float64)
        order = remainder_order(functional(Filter("cosine", size), *at, dx, -dx if size[1] > 1 else 0 * dx), steps)
        assert order == pytest.approx(2.0, abs=0.05)


def test_gaussian_has_a_kink_at_its_edge():
    """The thesis' filter is C0: on a pixel's edge autograd gives the derivative to the right; to the left the order is 1."""
    x = torch.arange(-5, 6, dtype=torch.float64) * SCREEN.pixel[0]
    f = Filter("gaussian", (3, 3), (0.3, 0.3))
    function = functional(f, x, torch.full_like(x, 0.3), torch.ones_like(x), torch.zeros_like(x))
    steps = torch.logspace(-6, -3, 8, dtype=torch.float64)
    assert remainder_order(function, steps) == pytest.approx(2.0, abs=0.05)
    assert remainder_order(function, -steps) == pytest.approx(1.0, abs=0.05)


CHECKED = [Filter("cosine", (3, 5)), Filter("gaussian", (3, 5), (0.5, 1e-3)), Filter("gaussian", (5, 3), (0.0, 200.0)), Filter()]


@pytest.mark.parametrize("f", CHECKED, ids=name)
def test_gradcheck_in_reverse_and_forward_mode(f):
    """Rays inside, in the ghost pixels, outside and at infinity; off-screen power is differentiable too."""
    screen = Screen((4.0, 2.4), 0.0, (4, 3))
    x = torch.tensor([0.31, -1.13, 1.97, 2.4, 40.0], dtype=torch.float64, requires_grad=True)
    y = torch.tensor([0.11, 0.93, -1.13, -1.5, 0.0], dtype=torch.float64, requires_grad=True)
    w = torch.tensor([1.0, 0.5, 2.0, 0.3, 1.0], dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda *a: splat(*a, screen, f), (x, y, w), check_forward_ad=True, atol=1e-7, rtol=1e-6)


def test_rays_at_infinity_have_no_gradient_rather_than_nan():
    x = torch.tensor([math.inf, math.nan, -math.inf, 1e300], dtype=torch.float64, requires_grad=True)
    w = torch.ones(4, dtype=torch.float64, requires_grad=True)
    image, off = splat(x, torch.zeros_like(x), w, SCREEN, Filter("cosine", (3, 3)))
    assert not image.any()
    gx, gw = torch.autograd.grad(image.sum() + 2 * off, (x, w))
    assert not gx.any()
    torch.testing.assert_close(gw, torch.full_like(gw, 2.0))


BAD = {
    "kind": ({"kind": "box"}, "bincount, gaussian, cosine, got 'box'"),
    "even": ({"size": (3, 4)}, "odd number 1 to 63, got 4"),
    "zero": ({"size": (0, 3)}, "odd number"),
    "negative": ({"size": (-3, 3)}, "odd number"),
    "fraction": ({"size": (3.0, 3)}, "odd number"),
    "large": ({"size": (MAX_FILTER + 2, 3)}, "odd number"),
    "alpha": ({"alpha": (-1.0, 0.0)}, "not negative"),
    "nan": ({"alpha": (math.nan, 0.0)}, "finite"),
    "inf": ({"alpha": (0.0, math.inf)}, "finite"),
}


@pytest.mark.parametrize(("options", "sentence"), BAD.values(), ids=BAD.keys())
def test_bad_filters_are_refused(options, sentence):
    with pytest.raises(InputError, match=sentence):
        Filter(**options)
