"""Optimal transport and the surface made from it: closed forms, mass, convexity, zeros, bad input, and traced light."""

import numpy as np
import pytest
from scipy.interpolate import RectBivariateSpline
from scipy.sparse import coo_matrix, csr_matrix, diags

from caustic_cli.errors import InputError
from caustic_cli.inverse import surface_from_map, transport
from caustic_cli.inverse.multigrid import Multigrid
from caustic_cli.inverse.scattered import Pixels, Scattered
from caustic_cli.optics.kernels import laguerre

A, B, C, D = 5.0, 4.0, 15.0, 9.0


def solve(target, n=64, m=48, source=None, half=(C, D), **options):
    return transport.solve(np.ones((n, m)) if source is None else source, target, (A, B), half, **options)


def corners(n, m):
    return transport.corners(n, A)[:, None], transport.corners(m, B)[None, :]


def flame(size=(60, 50)):
    """Two bright bodies on black."""
    x, y = np.meshgrid(*(transport.centres(s, 1.0) for s in size), indexing="ij")
    return ((x + 0.5) ** 2 + y**2 < 0.09) + 0.5 * ((x - 0.4) ** 2 + (y - 0.3) ** 2 < 0.12)


def smooth(size=(50, 50)):
    x, y = np.meshgrid(*(transport.centres(s, 1.0) for s in size), indexing="ij")
    return 1.0 + 0.6 * np.sin(3.0 * x) * np.cos(2.0 * y) + np.exp(-8.0 * (x * x + (y - 0.2) ** 2))


def image(x, y, shape, half, power=None):
    """Light a pixel gets from points (x, y), relative to the mean."""
    edges = [np.linspace(-h, h, s + 1) for h, s in zip(half, shape, strict=True)]
    out = np.histogram2d(x.ravel(), y.ravel(), edges, weights=None if power is None else power.ravel())[0]
    return out / out.mean()


def fine(field, samples, half=(A, B)):
    """Corner values, interpolated linearly at `samples` x `samples` points of the aperture."""
    at = [np.linspace(-h, h, s) for h, s in zip(half, field.shape, strict=True)]
    x = [transport.centres(samples, h) for h in half]
    return RectBivariateSpline(*at, field, kx=1, ky=1)(*x)


def difference(got, target):
    return np.sqrt(np.mean((got - target / target.mean()) ** 2))


def test_uniform_light_is_scaled():
    found = solve(np.ones((30, 20)))
    x, y = corners(64, 48)
    inner = (slice(3, -3), slice(3, -3))  # the average over phi reaches two cells beyond the edge
    np.testing.assert_allclose(found.x[inner], np.broadcast_to(C / A * x, (65, 49))[inner], atol=0.15)
    np.testing.assert_allclose(found.y[inner], np.broadcast_to(D / B * y, (65, 49))[inner], atol=0.15)
    assert abs(found.potential.mean()) < 1e-9
    assert found.error < 5e-3


def test_a_bright_corner_is_scaled_and_shifted():
    target = np.zeros((40, 40))
    target[20:, 30:] = 2.0  # x from 0 to C, y from D / 2 to D
    found = solve(target)
    x, y = corners(64, 48)
    inner = (slice(3, -3), slice(3, -3))
    np.testing.assert_allclose(found.x[inner], np.broadcast_to(C * (0.5 + 0.5 * x / A), (65, 49))[inner], atol=0.08)
    np.testing.assert_allclose(found.y[inner], np.broadcast_to(D * (0.75 + 0.25 * y / B), (65, 49))[inner], atol=0.03)
    assert found.x.min() > 0
    assert found.y.min() > D / 2


def test_one_dimension_follows_the_quantiles():
    """Along x a picture with a gap; T is the picture's quantile function of the source's distribution."""
    weight = np.array([1.0, 3.0, 0.0, 0.0, 2.0, 2.0, 0.5, 1.5])
    found = solve(np.repeat(weight[:, None], 6, 1), n=96)
    quantile = (transport.corners(96, A) + A) / (2 * A)
    cumulated = np.append(0.0, np.cumsum(weight)) / weight.sum()
    edges = np.linspace(-C, C, 9)
    low, high = np.interp(quantile, cumulated[:3], edges[:3]), np.interp(quantile, cumulated[4:], edges[4:])
    exact = np.where(quantile < cumulated[2], low, high)
    gap = np.abs(quantile - cumulated[2]) < 3 / 96
    error = np.abs(found.x - exact[:, None])[3:-3][~gap[3:-3]]
    assert error.max() < 0.35
    assert error.mean() < 0.06


def test_gaussian_to_gaussian():
    """Both cut off far out: T is linear where the light is."""
    x, y = transport.centres(64, A)[:, None], transport.centres(48, B)[None, :]
    source = np.exp(-(x**2) / 2 - y**2 / 2)
    u, v = transport.centres(80, C)[:, None], transport.centres(80, D)[None, :]
    found = solve(np.exp(-(u**2) / 18 - v**2 / 4.5), source=source)
    x, y = corners(64, 48)
    core = (x**2 + y**2) < 2.25
    assert np.abs(found.x - 3.0 * x)[core].max() < 0.25
    assert np.abs(found.y - 1.5 * y)[core].max() < 0.15


@pytest.mark.parametrize(
    "target", [flame(), smooth(), np.random.default_rng(1).random((33, 70)) ** 4], ids=["flame", "smooth", "rough"]
)
def test_convex_and_the_map_is_its_gradient(target):
    found = solve(target)
    z = found.potential
    scale = np.ptp(z)
    assert np.diff(z, 2, 0).min() > -1e-12 * scale
    assert np.diff(z, 2, 1).min() > -1e-12 * scale
    for diagonal in (z[2:, 2:] + z[:-2, :-2], z[2:, :-2] + z[:-2, 2:]):
        assert (diagonal - 2 * z[1:-1, 1:-1]).min() > -1e-12 * scale
    hx, hy = 2 * A / 64, 2 * B / 48
    # a convex function's difference lies between its derivatives at both ends
    for d, s, axis in ((np.diff(z, axis=0) / hx, found.x, 0), (np.diff(z, axis=1) / hy, found.y, 1)):
        low, high = (s.take(range(k, k + s.shape[axis] - 1), axis) for k in (0, 1))
        assert (d > low - 0.05).all()
        assert (d < high + 0.05).all()


def test_light_lands_where_the_picture_is_bright():
    target = flame()
    found = solve(target, 128, 128)
    got = image(fine(found.x, 1000), fine(found.y, 1000), target.shape, (C, D))
    bright = target > 0
    assert got[~bright].sum() / got.sum() < 0.03
    for body in (target == 1.0, target == 0.5):
        assert got[body].sum() / got.sum() == pytest.approx(target[body].sum() / target.sum(), abs=0.02)
    assert difference(got, target) < 0.35


def test_a_smooth_picture_is_matched():
    target = smooth()
    found = solve(target, 128, 128)
    assert difference(image(fine(found.x, 1000), fine(found.y, 1000), target.shape, (C, D)), target) < 0.06


def test_the_source_counts():
    x = transport.centres(64, A)[:, None]
    source = np.broadcast_to(1.5 + np.sin(x), (64, 48)).copy()
    found = solve(np.ones((40, 40)), source=source)
    cumulated = np.append(0.0, np.cumsum(source[:, 0])) / source[:, 0].sum()
    assert np.abs(found.x - C * (2 * cumulated - 1)[:, None])[3:-3].max() < 0.2


@pytest.mark.parametrize("shape", [(1, 1), (30, 21)])
def test_one_bright_pixel(shape):
    target = np.zeros(shape)
    target[shape[0] // 3, shape[1] // 2] = 1.0
    found = solve(target)
    at = [transport.centres(s, h)[i] for s, h, i in zip(shape, (C, D), (shape[0] // 3, shape[1] // 2), strict=True)]
    assert np.abs(found.x - at[0]).max() <= C / shape[0]
    assert np.abs(found.y - at[1]).max() <= D / shape[1]
    assert np.isfinite(found.potential).all()


@pytest.mark.parametrize(("n", "m", "size"), [(40, 7, (3, 90)), (5, 64, (61, 2)), (1, 1, (4, 4)), (2, 3, (300, 1))])
def test_any_sizes(n, m, size):
    found = solve(np.random.default_rng(0).random(size), n, m)
    assert found.potential.shape == found.x.shape == found.y.shape == (n + 1, m + 1)
    assert np.abs(found.x).max() <= C
    assert np.abs(found.y).max() <= D


def test_sparse_stars():
    target = (np.random.default_rng(2).random((90, 90)) > 0.99) * 1.0
    found = solve(target, 96, 96)
    assert found.error < 0.02
    assert np.isfinite(found.x).all()


def test_deterministic():
    one, two = solve(flame()), solve(flame())
    np.testing.assert_array_equal(one.potential, two.potential)
    np.testing.assert_array_equal(one.x, two.x)


def test_a_start_saves_steps():
    target = smooth()
    cold = solve(target)
    warm = solve(target, start=cold.potential)
    assert warm.error < 5e-3
    assert warm.steps < cold.steps
    assert np.abs(warm.x - cold.x).max() < 0.5


def test_a_start_that_another_light_led_to_is_given_up():
    """Newton's method is lost where the source has become dark: it begins anew, on coarse sites."""
    left, bodies = np.repeat(np.arange(40) < 12, 30).reshape(40, 30).astype(float), flame((40, 34))
    other = solve(bodies, source=left, darkest=0.02)
    cold = solve(bodies, source=left[::-1], darkest=0.02)
    found = solve(bodies, source=left[::-1], darkest=0.02, start=other.potential)
    assert np.array_equal(found.potential, cold.potential) and found.error < 5e-3
    assert cold.steps < found.steps <= cold.steps + 10  # those of the finest level that led nowhere


def bad(value):
    out = np.ones((8, 8))
    out[3, 4] = value
    return out


@pytest.mark.parametrize(
    "call",
    [
        lambda: solve(np.zeros((5, 5))),
        lambda: solve(np.ones(5)),
        lambda: solve(bad(np.nan)),
        lambda: solve(bad(-1.0)),
        lambda: solve(np.ones((0, 4))),
        lambda: solve(np.ones((4, 4)), source=bad(np.inf)),
        lambda: solve(np.ones((4, 4)), smooth=0.1),
        lambda: solve(np.ones((4, 4)), half=(C, 0.0)),
        lambda: solve(np.ones((4, 4)), half=(C,)),
        lambda: solve(np.ones((4, 4)), half="x"),
        lambda: solve(np.ones((4, 4)), start=np.zeros((4, 4))),
        lambda: surface(np.ones((4, 4)), index=1.0),
        lambda: surface(np.ones((4, 4)), z_screen=4.0),
        lambda: surface(np.ones((4, 4)), directions=(np.zeros((65, 65)),) * 3),
        lambda: surface(np.ones((4, 4)), directions=(1.0, 2.0)),
        lambda: surface(np.ones((4, 4)), half=(800.0, 800.0)),
    ],
)
def test_bad_input_is_one_sentence(call):
    with pytest.raises(InputError) as caught:
        call()
    text = str(caught.value)
    assert "\n" not in text
    assert not text.endswith(".")


def surface(target, n=64, half=(C, C), index=1.5, z_screen=300.0, thickness=5.0, directions=None, source=None, **options):
    source = np.ones((n, n)) if source is None else source
    return surface_from_map.surface(source, target, (A, A), half, index, z_screen, thickness, directions, **options)


def traced(found, n, index, z_screen, samples=800):
    """Landing points of parallel light through the bicubic spline of the heights."""
    at = transport.corners(n, A)
    spline, x = RectBivariateSpline(at, at, found.heights), transport.centres(samples, A)
    slopes = spline(x, x, dx=1), spline(x, x, dy=1)
    return surface_from_map.refract_to_screen(x[:, None], x[None, :], spline(x, x), *slopes, (0.0, 0.0, 1.0), index, z_screen)[:2]


@pytest.mark.parametrize("z_screen", [300.0, 30.0])
def test_a_traced_surface_draws_the_picture(z_screen):
    target = smooth()
    found = surface(target, 128, z_screen=z_screen)
    assert found.heights.mean() == pytest.approx(5.0)
    x, y = traced(found, 128, 1.5, z_screen)
    got = image(x, y, target.shape, (C, C))
    assert difference(got, target) < 0.08
    assert np.mean((np.abs(x) < C) & (np.abs(y) < C)) > 0.995
    assert (found.corrections > 0) == (z_screen < 100)


def test_parallel_light_to_a_uniform_screen():
    """The surface is nearly the sphere that spreads the light: radius (n - 1) D / (magnification - 1)."""
    found = surface(np.ones((20, 20)))
    x = transport.corners(64, A)
    radius = 0.5 * 295.0 / (C / A - 1.0)
    fit = np.polyfit(x[4:-4], found.heights[4:-4, 32], 2)
    assert fit[0] == pytest.approx(0.5 / radius, rel=0.02)


def test_refraction_keeps_snells_law():
    """Against the angles: n sin(a) = sin(b)."""
    slope, index = 0.2, 1.5
    x, y, _ = surface_from_map.refract_to_screen(*np.zeros((3, 1)), np.full(1, slope), np.zeros(1), (0.0, 0.0, 1.0), index, 10.0)
    inside = np.arctan(slope)
    assert x[0] == pytest.approx(10.0 * np.tan(np.arcsin(index * np.sin(inside)) - inside), rel=1e-12)
    assert y[0] == 0.0


def test_diverging_rays_are_taken_as_they_are():
    """Rays that lean outwards need a surface that bends less, and land in the same place."""
    at = transport.corners(64, A)
    x, y = at[:, None] / 400.0, at[None, :] / 400.0
    length = np.sqrt(1.0 + x * x + y * y)
    rays = (x / length, y / length, 1.0 / length)
    target = smooth()
    found = surface(target, directions=rays)
    plain = surface(target)
    assert np.ptp(found.heights) < np.ptp(plain.heights)
    assert np.sqrt(np.mean((found.x - plain.x) ** 2)) < 0.1


def test_integration_is_exact_for_parabolas():
    x, y = np.arange(20.0)[:, None] * 0.3, np.arange(15.0)[None, :] * 0.2
    z = 0.7 * x * x - 0.2 * y * y + 0.4 * x * y + x
    got = surface_from_map.integrate(1.4 * x + 0.4 * y + 1.0, -0.4 * y + 0.4 * x, (0.3, 0.2))
    np.testing.assert_allclose(got, z - z.mean(), atol=1e-12)


def test_multigrid_solves_a_graph():
    n = 40
    index = np.arange(n * n).reshape(n, n)
    sides = [(index[1:], index[:-1]), (index[:, 1:], index[:, :-1])]
    pairs = np.concatenate([np.stack(side, -1).reshape(-1, 2) for side in sides])
    weight = np.random.default_rng(0).random(len(pairs)) + 0.01
    w = coo_matrix((np.r_[weight, weight], (np.r_[pairs[:, 0], pairs[:, 1]], np.r_[pairs[:, 1], pairs[:, 0]]))).tocsr()
    diagonal = np.asarray(w.sum(1)).ravel()
    r = np.random.default_rng(1).standard_normal(n * n)
    r -= r.mean()
    x, steps = Multigrid(csr_matrix(diags(diagonal) - w)).solve(r, 1e-8)
    assert steps < 30
    assert np.linalg.norm(diagonal * x - w @ x - r) < 1e-7 * np.linalg.norm(r)


def test_cells_fill_the_rectangle():
    """Any prices: the cells' areas sum to the whole, and their derivative is that of finite differences."""
    g = np.random.default_rng(3)
    rows, per = np.linspace(-1, 1, 12), 10
    first, y1 = np.arange(13) * per, np.repeat(rows, per)
    y2 = np.sort(g.uniform(-1, 1, (12, per)), 1).ravel()
    psi = 0.5 * (y1**2 + y2**2)
    raster = [transport.centres(300, 1.0)] * 2

    def areas(psi):
        _, site = laguerre.envelope(psi, rows, first, y2, *raster)
        net = laguerre.borders(site, len(psi))
        return net, laguerre.cells(
            psi, y1, y2, site, site, *net, np.full((1, 1), 0.25), np.full((1, 1), 0.25), 1.0, 1.0, transport.WHOLE
        )

    net, (mass, weight) = areas(psi)
    assert mass.sum() == pytest.approx(1.0, abs=1e-4)
    p, change = 55, np.zeros(len(psi))
    change[p] = 1e-5
    slope = (areas(psi + change)[1][0] - areas(psi - change)[1][0]) / 2e-5
    e = net[0][p]
    while e >= 0:
        assert slope[net[2][e]] == pytest.approx(weight[e], abs=2e-3)
        e = net[1][e]
    assert slope[p] < 0


def test_cells_fill_a_source_with_a_dark_edge():
    """Also narrow ones that the raster sees at a point: all vertices of a cell are cut where the raster gives them to another one,
    those beyond the edge as well, which fill the source twice otherwise."""
    g, half = np.random.default_rng(8), 0.9
    rows, per = np.linspace(-1, 1, 60), 60
    first, y1 = np.arange(61) * per, np.repeat(rows, per)
    y2 = np.sort(g.uniform(-1, 1, (60, per)), 1).ravel()
    psi = 0.5 * (y1**2 + y2**2) + 4e-4 * g.standard_normal(len(y1))
    raster = [transport.centres(200, 1.0)] * 2
    sides = np.array([[1.0, 0.0, half], [-1.0, 0.0, half], [0.0, 1.0, half], [0.0, -1.0, half]])
    _, site = laguerre.envelope(psi, rows, first, y2, *raster)
    x1, x2 = raster[0][:, None], raster[1]
    seen = np.where(np.maximum(abs(x1), abs(x2)) <= half, site, np.int32(-1))
    even = np.full((1, 1), 0.25)
    mass = laguerre.cells(psi, y1, y2, site, seen, *laguerre.borders(seen, len(psi)), even, even, 1.0, 1.0, sides)[0]
    points = np.bincount(seen[seen >= 0], minlength=len(psi)) * 0.25 * (2.0 / 200) ** 2
    assert mass.sum() == pytest.approx(half**2, abs=2e-3)
    assert np.abs(mass - points).max() < 6e-4


def test_a_finer_map_is_the_same_with_sharper_kinks():
    """Two bright halves with a gap between: the light that falls into it is that within the average's width of the kink."""
    target = np.zeros((30, 10))
    target[:10], target[20:] = 1.0, 1.0
    found = solve(target)
    sharp = found.finer(4)
    assert sharp.x.shape == (4 * 64 + 1, 4 * 48 + 1)
    x, y = corners(64, 48)
    away = np.abs(x[:, 0]) > 3 * 2 * A / 64
    inner = np.ix_(away & (np.abs(x[:, 0]) < A - 0.4), np.abs(y[0]) < B - 0.4)
    for a, b in ((found.x, sharp.x), (found.y, sharp.y)):
        assert np.abs(b[::4, ::4] - a)[inner].max() < C / 30  # the distance of two sites
    dark = [(np.abs(fine(m.x, 2000)) < 0.9 * C / 3).mean() for m in (found, sharp)]
    assert 0 < dark[1] < 0.3 * dark[0]
    z = sharp.potential
    assert min(np.diff(z, 2, axis).min() for axis in (0, 1)) > -1e-12 * np.ptp(z)


def test_the_average_does_not_depend_on_strips(monkeypatch):
    whole = solve(flame())
    monkeypatch.setattr(transport, "STRIP", 7)
    strips = solve(flame())
    np.testing.assert_array_equal(strips.potential, whole.potential)
    np.testing.assert_array_equal(strips.y, whole.y)


def scattered(n=300, half=(1.0, 0.8)):
    """Point masses anywhere, and prices of which some leave cells empty."""
    g = np.random.default_rng(5)
    y = g.normal(size=(2, n)) * np.array([[0.7], [0.5]])
    sites = Scattered(*y, np.full(n, 1.0 / n), half, y)
    return sites, 0.5 * (y * y).sum(0) + 0.02 * g.normal(size=n)


@pytest.mark.parametrize("n", [1, 2, 3, 300])
def test_the_envelope_of_scattered_sites(n):
    sites, psi = scattered(n)
    if n == 3:  # on one line
        sites = Scattered(np.zeros(3), np.array([0.3, -0.2, 0.0]), sites.mass, sites.half, np.zeros((2, 3)))
    x1, x2 = transport.centres(31, 1.0), transport.centres(27, 0.8)
    planes = x1[:, None, None] * sites.y1 + x2[None, :, None] * sites.y2 - psi
    phi, site = sites.envelope(psi).on(x1, x2)
    np.testing.assert_array_equal(site, planes.argmax(-1))
    np.testing.assert_allclose(phi, planes.max(-1), rtol=0, atol=1e-14)
    back, at = sites.prices(phi, [x1, x2])
    planes = sites.y1 * x1[:, None, None] + sites.y2 * x2[None, :, None] - phi[:, :, None]
    np.testing.assert_allclose(back, planes.reshape(-1, n).max(0), rtol=0, atol=1e-14)
    np.testing.assert_allclose(planes.reshape(-1, n)[at, np.arange(n)], back, rtol=0, atol=1e-14)


def covered(n: int, m: int, a: float, b: float, parts: int = 8) -> np.ndarray:
    """How much of each cell of a rectangle its ellipse covers, (n, m)."""
    x, y = transport.centres(n * parts, a)[:, None], transport.centres(m * parts, b)[None, :]
    return ((x / a) ** 2 + (y / b) ** 2 <= 1).reshape(n, parts, m, parts).mean((1, 3))


@pytest.mark.parametrize("bright", [0.0, 1.0])
def test_round_source(bright):
    """Uniform or brighter towards one side: onto its own light, enlarged, the map is the enlargement, and no step is wasted on the
    dark corners."""
    x, y = transport.centres(96, A)[:, None], transport.centres(80, B)[None, :]
    light = covered(96, 80, A, B) * (2.0 + bright * x / A)
    found = transport.solve(light, light, (A, B), (C, C * B / A), tolerance=1e-3)
    assert found.error < 1e-3
    assert found.steps < 15
    x, y = corners(96, 80)
    inside = (x / A) ** 2 + (y / B) ** 2 < 0.75
    for got, own in ((found.x, x), (found.y, y)):
        assert np.abs(got - C / A * own)[inside].max() < 0.6 * 2.0 * C / 96


def test_cells_between_the_points_of_the_raster():
    """Of scattered sites no cell is too small for it: masses are those that a raster finds which is 60 times as fine."""
    sites, psi = scattered()
    a, b = sites.half
    coarse = [transport.centres(20, h) for h in (a, b)]
    light = transport._light(np.full((1, 1), 0.25 / (a * b)), 0.0, coarse, a, b)
    masses = transport._cells(psi, sites, coarse, light)[1]
    _, site = sites.envelope(psi).on(*(transport.centres(1200, h) for h in (a, b)))
    counted = np.bincount(site.ravel(), minlength=len(psi)) / site.size
    seen = np.bincount(sites.envelope(psi).on(*coarse)[1].ravel(), minlength=len(psi)) > 0
    assert np.count_nonzero((counted > 0) & ~seen) > 10
    np.testing.assert_allclose(masses, counted, rtol=0, atol=2e-5)


def test_displaced_sites():
    """By a constant: the same map, displaced.  By a field: light lands where the displaced pixels are."""
    target = smooth((40, 30))
    sites = Pixels(target, (C, D)).sites(np.ones((64, 48)), (A, B))
    known = solve(target)
    same = transport.solve_displaced(np.ones((64, 48)), sites, (A, B), known.potential, np.full((2, 65, 49), 0.37), tolerance=1e-4)
    inner = (slice(3, -3), slice(3, -3))
    assert same.error < 1e-4
    for got, want in ((same.x, known.x), (same.y, known.y)):
        np.testing.assert_allclose((got + 0.37)[inner], want[inner], atol=0.15)
    x, y = corners(64, 48)
    field = np.stack(np.broadcast_arrays(0.02 * y * y + 0.0 * x, 0.03 * x * y))
    found = transport.solve_displaced(np.ones((64, 48)), sites, (A, B), known.potential, field, tolerance=1e-4)
    got = image(*(fine(c, 1600) for c in (found.x + field[0], found.y + field[1])), target.shape, (C, D))
    plain = image(*(fine(c, 1600) for c in (known.x, known.y)), target.shape, (C, D))
    assert difference(got, target) < 1.1 * difference(plain, target)
