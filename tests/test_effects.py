"""Every effect against its closed form, the energy balance of all of them together, and derivatives."""

import math
from dataclasses import replace
from itertools import product

import numpy as np
import pytest
import torch
from helpers import pairwise

from caustic_cli.optics.backends import plain
from caustic_cli.optics.effects import NO_REQUESTS, Requests
from caustic_cli.optics.emission import rays_of
from caustic_cli.optics.interface import reflectances
from caustic_cli.optics.rays import LOSSES, RayState
from caustic_cli.optics.reconstruction import Filter
from caustic_cli.optics.reintersection import next_intersection
from caustic_cli.optics.sampling import Sampler
from caustic_cli.optics.screen_shape import reach
from caustic_cli.optics.surfaces.heightfield import HeightField
from caustic_cli.optics.system import EXIT, System
from caustic_cli.optics.trace import Tracer, check_clearance, expose, tracers
from caustic_cli.scene import Disc, Lens, Light, Offset, PlaneWave, Points, Scene, Screen
from caustic_cli.scene.materials import refractive_index

N, R0 = 1.5, 0.04
POINT = Points(((0.5, -0.3, -40.0),))
DETOURS, STAGES = Requests.to("ghosts", "secondary-intersection"), Requests(stages=True)


def scene_of(source=None, *, degree=(2, 2), control=(9, 8), screen=None, light=None, **lens) -> Scene:
    """A 10 x 8 mm lens about 3 mm thick, 60 mm before a screen of 16 x 14 mm."""
    options = {"index": N, "offset": Offset(3.0), **lens}
    return Scene(
        source or PlaneWave(),
        Lens((10.0, 8.0), 0.0, control=control, degree=degree, **options),
        screen or Screen((16.0, 14.0), 60.0, (32, 28)),
        light or Light(),
    )


def heights_through(scene: Scene, f) -> torch.Tensor:
    """Heights of the spline that passes through f(x, y) over the control points; f itself where it is a spline of the degree."""
    field = HeightField.of(scene.lens)
    x, y = field.control_xy()
    at = [torch.linalg.inv(s.matrix(s.greville)) for s in field.spaces]
    return at[0] @ f(x[:, None], y[None, :]).expand(field.shape) @ at[1].T


def bumpy(scene: Scene, bumps: float, seed: int = 0) -> torch.Tensor:
    g = torch.Generator().manual_seed(seed)
    return 3.0 + bumps * torch.randn(scene.lens.control, generator=g, dtype=torch.float64)


def traced_through(scene: Scene, rays, requests: Requests = NO_REQUESTS) -> Tracer:
    return Tracer(System.of(scene, HeightField.of(scene.lens)), rays, requests=requests)


def land(scene: Scene, heights: torch.Tensor, requests: Requests = NO_REQUESTS, kind="grid", shape=(12, 10)):
    """One chunk of a plane wave's rays on the screen, and the rays."""
    (sample,) = Sampler(kind, shape).chunks()
    return traced_through(scene, sample, requests).land({EXIT: heights}, scene.screen), sample


def places(state: RayState, shape: tuple[int, int]) -> tuple[torch.Tensor, torch.Tensor]:
    """Where rays landed, in the shape of their sample."""
    return state.origin[0].view(shape), state.origin[1].view(shape)


def shine(scene: Scene, heights: torch.Tensor, requests: Requests = NO_REQUESTS, rays=4000, **options):
    return expose(scene, HeightField.of(scene.lens), heights, rays_of(scene, "stratified", rays, 3), requests=requests, **options)


def reflected(kind: str, inside: float, outside: float) -> float:
    """Part of the power that glass of index N reflects, by the textbook's formulas in the angles on its two sides; not at 0."""
    if kind == "schlick":
        return R0 + (1 - R0) * (1 - math.cos(outside)) ** 5
    less, more = inside - outside, inside + outside
    return 0.5 * ((math.sin(less) / math.sin(more)) ** 2 + (math.tan(less) / math.tan(more)) ** 2)


def sloped(g):
    return lambda x, y: 4.5 + g * x + 0 * y


# Fresnel and polarisation


def test_brewster():
    """At tan i = 1 / n inside, p-polarised light passes whole, and R_s = ((n^2 - 1) / (n^2 + 1))^2."""
    i = math.atan(1.0 / N)
    c, s = math.cos(i), math.sqrt(1 - (N * math.sin(i)) ** 2)
    rs, rp = reflectances(c, s, N)
    assert rp == pytest.approx(0.0, abs=1e-30)
    assert rs == pytest.approx(((N * N - 1) / (N * N + 1)) ** 2, rel=1e-13)
    for angle, part in ((0.0, 0.0), (90.0, rs), (45.0, rs / 2.0)):
        scene = scene_of(light=Light(angle))
        (landing,), _ = land(scene, heights_through(scene, sloped(1.0 / N)))
        assert float(landing.leaving) == pytest.approx((1 - R0) * (1 - part), rel=1e-12)


@pytest.mark.parametrize("source", [None, POINT])
def test_two_crossed_polarisations_are_unpolarised_light(source):
    """Exactly so for a plane wave; a oblique entrance polarises, which the average of R_s and R_p at each surface does not know."""
    heights = bumpy(scene_of(), 0.2)
    images = [shine(scene_of(source, light=Light(a)), heights, rays=20_000).image for a in (20.0, 110.0)]
    plain = shine(scene_of(source), heights, rays=20_000).image
    tracked = shine(scene_of(source, light=Light(tracked=True)), heights, rays=20_000).image
    difference = float((0.5 * (images[0] + images[1]) - plain).abs().sum())
    assert float((0.5 * (images[0] + images[1]) - tracked).abs().sum()) < (1e-12 if source is None else 1e-4)
    assert difference < (1e-12 if source is None else 1e-3)
    assert source is None or difference > 1e-9
    assert float((images[0] - images[1]).abs().sum()) > 1e-4


def test_polarised_light_through_a_slanted_entrance():
    """One ray in the x-z plane, p-polarised at entrance and exit of a plate: (1 - R_p)^2; s likewise."""
    for angle, k in ((0.0, 1), (90.0, 0)):
        scene = scene_of(Points(((-30.0, 0.0, -40.0),), cone=80.0), light=Light(angle))
        sample = rays_of(scene, "grid", 40_000)
        (rays,) = sample.chunks()
        one = (rays.origin[1].abs() < 0.02).nonzero()[:, 0][:5]
        traced = traced_through(scene, rays)
        inside = [traced.start.direction[k][one] for k in (0, 2)]
        sin = N * inside[0] / torch.hypot(*inside)
        rs_rp = reflectances(inside[1], torch.sqrt(1 - sin**2), N)
        (landing,) = traced.land({EXIT: bumpy(scene, 0.0)}, scene.screen)
        rs, rp = rs_rp
        emitted = rays.power[one]
        unpolarised = traced_through(replace(scene, light=Light()), rays).start.power[one]
        torch.testing.assert_close(unpolarised, emitted * (1 - 0.5 * (rs + rp)), rtol=1e-12, atol=0)
        torch.testing.assert_close(landing.power[one], emitted * (1 - rs_rp[k]) ** 2, rtol=2e-3, atol=0)
        assert float((rs - rp).min()) > 0.03


# Glass


@pytest.mark.parametrize("source", [None, POINT])
def test_beer_lambert(source):
    """A plate of thickness t: every ray is left with exp(-a t / cos)."""
    a, t = 0.1, 3.0
    clear, grey = (scene_of(source, absorption=x, fresnel="none") for x in (0.0, a))
    (rays,) = rays_of(clear, "stratified", 500, 1).chunks()
    heights = torch.full((9, 8), t, dtype=torch.float64)
    (before,), (after,) = (traced_through(s, rays).land({EXIT: heights}, s.screen) for s in (clear, grey))
    cosine = traced_through(clear, rays).start.direction[2] if source else torch.ones_like(after.power)
    torch.testing.assert_close(after.power, before.power * torch.exp(-a * t / cosine), rtol=1e-12, atol=0)
    assert float(after.lost["absorbed"]) == pytest.approx(float((before.power - after.power).sum()), rel=1e-12)


def test_dispersion_of_a_prism():
    """Every wavelength leaves a prism by its own sin b = n(lambda) sin a."""
    lines, weights = (450.0, 550.0, 650.0), (1.0, 2.0, 1.0)
    index = refractive_index("N-SF11")
    scene = scene_of(light=Light(wavelengths=lines, weights=weights), glass="N-SF11", index=index)
    a, heights = math.atan(0.2), heights_through(scene, sloped(0.2))
    field = HeightField.of(scene.lens)
    found = list(tracers(scene, field, Sampler("grid", (12, 10)), torch.float64, 1 << 20))
    assert [t.media[1].index_at(t.start.wavelength) for t in found] == [refractive_index("N-SF11", line) for line in lines]
    assert [t.weight for t in found] == pytest.approx([0.25, 0.5, 0.25])
    for line, band in zip(lines, found, strict=True):
        x = (torch.arange(12).double() + 0.5) / 12 * 10.0 - 5.0
        turn = math.asin(refractive_index("N-SF11", line) * math.sin(a)) - a
        at = x + (60.0 - 4.5 - 0.2 * x) * math.tan(turn)
        landed = places(band.land({EXIT: heights}, scene.screen)[0], (12, 10))
        torch.testing.assert_close(landed[0], at[:, None].expand(12, 10), rtol=0, atol=1e-11)
    parts = [replace(b.scene, light=Light()) for b in scene.bands]
    whole = sum(w * shine(p, heights).image for w, p in zip((0.25, 0.5, 0.25), parts, strict=True))
    torch.testing.assert_close(shine(scene, heights).image, whole, rtol=0, atol=1e-15)


def test_roughness_spreads_by_throw_times_slope():
    """A window of microfacets: landing points scatter by (throw (n - 1) sigma)^2 along either axis; 3 % of 40,000 rays' noise."""
    sigma, scene = 1e-3, scene_of(roughness=1e-3)
    for kind in ("grid", "stratified"):
        (landing,), sample = land(scene, torch.full((9, 8), 3.0, dtype=torch.float64), kind=kind, shape=(200, 200))
        x, y = (10 * sample.u - 5, 8 * sample.v - 4)
        if sample.tensor:
            x, y = x[:, None], y[None, :]
        dx, dy = (there - here for there, here in zip(places(landing, sample.shape), (x, y), strict=True))
        for d in (dx, dy):
            assert float(d.var()) == pytest.approx((57.0 * (N - 1) * sigma) ** 2, rel=0.03)
            assert abs(float(d.mean())) < 5 * float(d.std()) / 200
        assert abs(float((dx * dy).mean())) < 5 * float(dx.var()) / 200


# Mirror and screen


def test_a_parabolic_mirror_has_a_focus():
    """z = z_0 - r^2 / (4 f) sends a plane wave to the point f before its vertex."""
    f, scene = 25.0, scene_of(screen=Screen((4.0, 4.0), -22.0, (8, 8)), mirror=True)
    heights = heights_through(scene, lambda x, y: 3.0 - (x * x + y * y) / (4.0 * f))
    (landing,), _ = land(scene, heights)
    assert float(torch.hypot(*landing.origin[:2]).max()) < 1e-12
    assert float(landing.leaving) == pytest.approx(1.0, rel=1e-14)
    away = replace(scene, screen=replace(scene.screen, z=-10.0))
    (landing,), _ = land(away, heights)
    assert float(torch.hypot(*landing.origin[:2]).max()) > 1.0


def test_an_elliptic_mirror_is_met_from_a_point():
    """A plane mirror shows the source behind itself: a point 43 mm before it lights the screen as if from 86 mm away."""
    scene = scene_of(Points(((0.0, 0.0, -40.0),)), screen=Screen((40.0, 40.0), -40.0, (8, 8)), mirror=True)
    (rays,) = rays_of(scene, "stratified", 300, 1).chunks()
    (landing,) = traced_through(scene, rays).land({EXIT: torch.full((9, 8), 3.0).double()}, scene.screen)
    on = landing.power > 0
    assert int(on.sum()) > 200
    dx, _, dz = rays.direction
    torch.testing.assert_close(landing.origin[0][on], 86.0 * (dx / dz)[on], rtol=1e-11, atol=1e-11)


@pytest.mark.parametrize(
    ("source", "most"), [(Points(((0.0, 0.0, -20.0),)), 0.01), (PlaneWave(tilt=(0.0, 60.0)), 0.01), (PlaneWave(), 0.0)]
)
@pytest.mark.parametrize("radius", [-40.0, math.inf, 60.0])
def test_light_fills_a_mirror(source, most, radius):
    """Its aperture lies at the mean height of the edge: hardly any light passes a curved one, none of a rectangle a flat one."""
    scene = scene_of(source, screen=Screen((500.0, 500.0), -40.0, (8, 8)), mirror=True, offset=Offset(3.0, (radius, radius)))
    field, base = HeightField.of(scene.lens), scene.lens.offset
    z = heights_through(scene, lambda x, y: torch.from_numpy(base.heights(x[:, 0].numpy(), y[0].numpy())))
    found = expose(scene, field, z, rays_of(scene, "stratified", 40_000), Filter("bincount"))
    assert abs(found.lost["missed_surface"]) <= most * (1.0 if math.isfinite(radius) else 1e-9)
    assert float(found.image.sum()) + sum(found.lost.values()) == pytest.approx(1.0, abs=1e-12)


@pytest.mark.parametrize("tilt", [(25.0, 0.0), (0.0, -35.0), (20.0, 40.0)])
def test_a_tilted_screen(tilt):
    """Rays along z: the plane through (s_x, s_y, z) with axes R e_x, R e_y, R = R_y R_x, met by 3 x 3 linear algebra."""
    screen = Screen((30.0, 30.0), 60.0, (10, 10), tilt, (1.5, -2.0))
    scene = scene_of(screen=screen)
    (landing,), sample = land(scene, torch.full((9, 8), 3.0, dtype=torch.float64))
    x, y = places(landing, sample.shape)
    a, b = np.radians(tilt)
    rx = np.array([[1, 0, 0], [0, np.cos(a), -np.sin(a)], [0, np.sin(a), np.cos(a)]])
    ry = np.array([[np.cos(b), 0, np.sin(b)], [0, 1, 0], [-np.sin(b), 0, np.cos(b)]])
    axes = ry @ rx
    np.testing.assert_allclose(np.array(screen.axes).T, axes, atol=1e-15)
    for i in (0, 5, 11):
        for j in (0, 9):
            start = np.array([float(10 * sample.u[i] - 5), float(8 * sample.v[j] - 4), 0.0])
            # start + t z = middle + p axes_x + q axes_y
            p, q, _ = np.linalg.solve(np.column_stack([axes[:, 0], axes[:, 1], [0, 0, -1.0]]), start - [1.5, -2.0, 60.0])
            assert float(x[i, j]) == pytest.approx(1.5 + p, abs=1e-11)
            assert float(y[i, j]) == pytest.approx(-2.0 + q, abs=1e-11)
    depth = float(np.abs(axes[2, :2]) @ [15.0, 15.0])
    assert reach(screen) == (pytest.approx(-depth), pytest.approx(depth))


@pytest.mark.parametrize("source", [None, POINT])
def test_a_shifted_screen_sees_the_same_light_elsewhere(source, kernels):
    """A shift of 3 x 2 pixels moves the image by as much; the fused path does it."""
    scene = scene_of(source)
    heights = bumpy(scene, 0.1)
    moved = replace(scene, screen=replace(scene.screen, shift=(1.5, -1.0)))
    filter = Filter("cosine", (3, 3))
    here, there = (shine(s, heights, filter=filter).image for s in (scene, moved))
    torch.testing.assert_close(there[:-3, 2:], here[3:, :-2], rtol=0, atol=1e-15)
    assert float(here[3:, :-2].sum()) > 0.1


def test_a_tilted_screen_that_cuts_into_the_lens_is_refused():
    scene = scene_of(screen=Screen((16.0, 14.0), 9.0, (8, 8), (0.0, 60.0)))
    with pytest.raises(ValueError, match=r"its tilt takes it 6\.928 mm nearer"):
        check_clearance(scene, torch.full((9, 8), 3.0), scene.screen)


# Stray light


@pytest.mark.parametrize("absorption", [0.0, 0.05])
@pytest.mark.parametrize("source", [None, Points(((0.5, -0.3, -40.0),), cone=3.0)])
def test_ghost_of_a_plate(source, absorption):
    """Plane-parallel plate, normal incidence: (1 - R)^2 R^2 exp(-3 a t) more on the screen; in a narrow cone, nearly that."""
    scene = scene_of(source, absorption=absorption, screen=Screen((40.0, 40.0), 60.0, (4, 4)))
    heights = torch.full((9, 8), 3.0, dtype=torch.float64)
    plain, ghostly = (shine(scene, heights, requests) for requests in (NO_REQUESTS, Requests.to("ghosts")))
    more = float((ghostly.image - plain.image).sum())
    exact = (1 - R0) ** 2 * R0**2 * math.exp(-9.0 * absorption)
    assert more == pytest.approx(exact, rel=1e-12 if source is None else 1e-3)
    assert more == pytest.approx(plain.lost["fresnel"] - ghostly.lost["fresnel"], rel=1e-9)


@pytest.mark.parametrize("fresnel", ["exact", "schlick"])
def test_ghost_of_a_slanted_plate(fresnel):
    """Light that meets a plane-parallel plate at i leaves (1 - R)^2 R^2 of itself as a ghost, 2 t tan r beside the straight light.

    At 35 degrees Schlick's formula and Fresnel's are a quarter apart.
    """
    scene = scene_of(Points(((-30.0, 0.0, -40.0),)), fresnel=fresnel, screen=Screen((200.0, 200.0), 60.0, (4, 4)))
    (rays,) = rays_of(scene, "stratified", 300, 1).chunks()
    heights = torch.full((9, 8), 3.0, dtype=torch.float64)
    straight, ghost = traced_through(scene, rays, Requests.to("ghosts")).land({EXIT: heights}, scene.screen)
    (x, y, _), (dx, dy, _) = rays.origin, rays.direction
    checked, sin = 0, torch.hypot(dx, dy)
    for k in range(len(x)):
        out = math.asin(float(sin[k]))
        inside, turn = math.asin(math.sin(out) / N), [float(c[k] / sin[k]) for c in (dx, dy)]
        r, tangent = reflected(fresnel, inside, out), math.tan(inside)
        ways = [(float(x[k]) + 3.0 * m * tangent * turn[0], float(y[k]) + 3.0 * m * tangent * turn[1]) for m in (1, 2, 3)]
        if all(abs(p) <= 5 and abs(q) <= 4 for p, q in ways):
            assert float(straight.power[k]) == pytest.approx(float(rays.power[k]) * (1 - r) ** 2, rel=1e-12)
            assert float(ghost.power[k]) == pytest.approx(float(rays.power[k]) * (1 - r) ** 2 * r**2, rel=1e-11)
            assert float(ghost.origin[0][k]) == pytest.approx(ways[2][0] + 57.0 * math.tan(out) * turn[0], abs=1e-10)
            other = reflected({"exact": "schlick", "schlick": "exact"}[fresnel], inside, out)
            checked += abs(other / r - 1.0) > 0.05
    assert checked > 50


@pytest.mark.parametrize(
    ("fresnel", "a", "whole"), [("exact", 0.05, 30), ("schlick", 0.05, 30), ("exact", 0.15, 25), ("schlick", 0.15, 25)]
)
def test_ghost_of_a_wedge(fresnel, a, whole):
    """A wedge of angle a: the ghost meets the entrance at 2 a and the exit at 3 a, so it leaves at asin(n sin 3 a) - a."""
    scene = scene_of(fresnel=fresnel)
    heights = heights_through(scene, sloped(math.tan(a)))
    (_, ghost), sample = land(scene, heights, Requests.to("ghosts"), shape=(41, 2))
    x0 = (10 * sample.u - 5).numpy()[:, None]
    z0 = 4.5 + math.tan(a) * x0
    x1 = x0 + z0 * math.tan(2 * a)  # down to the entrance, turned towards the thick edge
    x2 = (x1 + 4.5 * math.tan(2 * a)) / (1 - math.tan(a) * math.tan(2 * a))  # up again as far as the wedge
    z2 = 4.5 + math.tan(a) * x2
    out = math.asin(N * math.sin(3 * a)) - a
    at = x2 + (60.0 - z2) * math.tan(out)
    kept = (np.abs(x1) <= 5) & (np.abs(x2) <= 5)
    x = ghost.origin[0].reshape(41, 2).numpy()
    np.testing.assert_allclose(np.where(kept, x, 0), np.where(kept, at, 0) + 0 * x, atol=1e-10)
    assert kept.sum() > whole
    weight = ghost.power.reshape(41, 2).numpy()
    assert (weight[~kept[:, 0]] == 0).all()

    def r(i):
        return reflected(fresnel, i, math.asin(N * math.sin(i)))

    expected = (1 - R0) * r(a) * r(2 * a) * (1 - r(3 * a)) / 82
    np.testing.assert_allclose(weight[kept[:, 0]], expected, rtol=1e-11)


def cliff() -> tuple[Scene, torch.Tensor]:
    """A ramp of slope 0.8 up to x = 0, a cliff of slope 4 up to x = 1, and down again: rays leaving the ramp run into the cliff."""
    scene = scene_of(control=(11, 2), degree=(1, 1), screen=Screen((80.0, 20.0), 60.0, (40, 4)))
    x = torch.linspace(-5, 5, 11, dtype=torch.float64)[:, None]
    return scene, (5.0 + torch.where(x <= 0, 0.8 * x, torch.minimum(4.0 * x, 4.8 - 0.8 * x))).expand(11, 2)


def test_a_ray_that_meets_the_surface_twice():
    """The ray from x leaves at tangent 0.6 and meets z = 5 + 4 x' where (x' - x) / tan = 4 x' - 0.8 x."""
    _, heights = cliff()
    field = HeightField.of(cliff()[0].lens)
    s = math.sqrt(1 - (N * N - 1) * 0.64)
    tangent = (N - s) / (N * 0.64 + s) * 0.8
    x = torch.tensor([-0.5, -0.2, -0.05, -4.0], dtype=torch.float64)
    at, none = (0.8 * x - x / tangent) / (4.0 - 1.0 / tangent), torch.zeros_like(x)
    length = math.hypot(1.0, tangent)
    o, d = (x, none, 5.0 + 0.8 * x), (none + tangent / length, none, none + 1.0 / length)
    t, found = next_intersection(field, heights, o, d, below=False)
    assert found.tolist() == [True, True, True, False]
    torch.testing.assert_close((x + t * d[0])[:3], at[:3], rtol=0, atol=1e-12)


@pytest.mark.parametrize("below", [False, True])
@pytest.mark.parametrize("round_", [False, True])
def test_secondary_intersections_by_kernel_and_by_reference(below, round_, monkeypatch):
    """The same distances to 1e-12 mm on a wild surface, and some of either kind of ray: 3000 of them, 500 and more each."""
    scene = replace(scene_of(), lens=replace(scene_of().lens, size=(10.0, 10.0)))
    heights, field, random = bumpy(scene, 2.0), HeightField.of(scene.lens), np.random.default_rng(5)
    angle, lean = random.uniform(0, 2 * math.pi, 3000), random.uniform(0.5, 1.5, 3000)
    d = np.stack([np.sin(lean) * np.cos(angle), np.sin(lean) * np.sin(angle), np.cos(lean) * random.choice([-1, 1], 3000)])
    x, y = (torch.from_numpy(random.uniform(-3.5, 3.5, 3000)) for _ in range(2))
    o = x, y, field.at(heights, x, y)[0]
    t, found = next_intersection(field, heights, o, tuple(torch.from_numpy(d)), below, round_)
    monkeypatch.setenv("CAUSTIC_KERNELS", "torch")
    other, found_too = next_intersection(field, heights, o, tuple(torch.from_numpy(d)), below, round_)
    assert bool((found == found_too).all())
    assert 500 < int(found.sum()) < 2500
    torch.testing.assert_close(t, other, rtol=0, atol=1e-12)


@pytest.mark.parametrize("fresnel", ["exact", "schlick"])
def test_the_way_of_a_ray_that_meets_the_surface_twice(fresnel):
    """From the ramp into the cliff and out on its far side: Snell's law in vector form, by hand, in two dimensions."""
    scene, heights = cliff()
    scene = replace(scene, lens=replace(scene.lens, fresnel=fresnel))
    (straight, late), sample = land(scene, heights, Requests.to("secondary-intersection"), shape=(2000, 1))
    x0 = (10 * sample.u - 5).numpy()
    s = math.sqrt(1 - (N * N - 1) * 0.64)
    tangent = (N - s) / (N * 0.64 + s) * 0.8
    d, normal = np.array([tangent, 1.0]) / math.hypot(tangent, 1.0), np.array([-4.0, 1.0]) / math.sqrt(17.0)
    cos_i = -d @ normal
    t = d / N + (cos_i / N - math.sqrt(1 - (1 - cos_i**2) / N**2)) * normal
    x1 = (0.8 * x0 - x0 / tangent) / (4.0 - 1.0 / tangent)  # on the cliff
    x2 = x1 + (4.8 - 4.8 * x1) / (t[1] / t[0] + 0.8)  # where 5 + 4 x1 + (x2 - x1) t_z / t_x = 9.8 - 0.8 x2
    a = math.atan(0.8)  # the normal leans forward by as much
    inner = math.atan2(t[0], t[1]) - a
    out = math.asin(N * math.sin(inner))
    at = x2 + (60.0 - 9.8 + 0.8 * x2) * math.tan(out + a)
    twice = (x0 < 0) & (x1 < 0.99) & (x2 > 1) & (x2 < 5)
    assert twice.sum() > 50
    assert (straight.power.numpy()[twice] == 0).all()
    late_x, late_power = late.origin[0].numpy(), late.power.numpy()
    found = [int(np.abs(late_x - x).argmin()) for x in at[twice]]
    np.testing.assert_allclose(late_x[found], at[twice], atol=1e-9)

    first, met = math.asin(N * math.sin(a)), math.acos(cos_i)
    power = (1 - R0) * (1 - reflected(fresnel, a, first)) / 2000
    power *= (1 - reflected(fresnel, math.asin(math.sin(met) / N), met)) * (1 - reflected(fresnel, inner, out))
    np.testing.assert_allclose(late_power[found], power, rtol=1e-10)


def test_secondary_intersections_are_taken_off_the_straight_light():
    scene, heights = cliff()
    straight, true = (shine(scene, heights, r, rays=20_000) for r in (STAGES, STAGES | Requests.to("secondary-intersection")))
    assert float((straight.image - true.image).abs().sum()) > 0.02
    for e in (straight, true):
        assert float(e.image.sum()) + sum(e.lost.values()) == pytest.approx(1.0, abs=1e-12)


# All together


EVERYTHING = {"absorption": 0.02, "roughness": 0.01}
SOURCES = [None, POINT, Disc((0.0, 0.0, -30.0), (2.0, 1.0))]


@pytest.mark.parametrize("source", SOURCES)
@pytest.mark.parametrize("bumps", [0.1, 1.5])
def test_the_energy_balance_closes_and_all_is_finite(source, bumps):
    """Image + losses = 1 to 1e-12 with every effect at once, with and without total reflection."""
    light = Light(30.0, (450.0, 600.0), (1.0, 2.0))
    scene = scene_of(
        source, light=light, glass="N-BK7", screen=Screen((16.0, 14.0), 60.0, (32, 28), (10.0, -20.0), (1.0, 0.5)), **EVERYTHING
    )
    for requests in (
        NO_REQUESTS,
        DETOURS,
        Requests.to(without=("total-reflection",)),
        Requests.to(without=("entrance", "intersection")),
        Requests.to("entrance", "intersection"),
    ):
        if "entrance" in requests.on and source is not None:
            continue
        found = shine(scene, bumpy(scene, bumps), requests, rays=2000)
        assert bool(torch.isfinite(found.image).all())
        assert float(found.image.sum()) + sum(found.lost.values()) == pytest.approx(1.0, abs=1e-12)
        assert bumps < 1 or found.lost["total_internal_reflection"] > 0.1 or "total-reflection" in requests.off
        assert found.lost["absorbed"] > 0.01


@pytest.mark.parametrize("source", SOURCES)
def test_a_circular_aperture_with_detours(source):
    """Stages equal the fused kernels there too, and the account closes with everything on."""
    scene = scene_of(source)
    scene = replace(scene, lens=replace(scene.lens, size=(8.0, 8.0), aperture="circle"))
    heights, filter = bumpy(scene, 0.6), Filter("cosine", (3, 3))
    a, b = (shine(scene, heights, requests, filter=filter) for requests in (NO_REQUESTS, STAGES))
    torch.testing.assert_close(b.image, a.image, rtol=0, atol=1e-13)
    all_on = shine(replace(scene, lens=replace(scene.lens, **EVERYTHING)), heights, DETOURS, rays=2000)
    assert float(all_on.image.sum()) + sum(all_on.lost.values()) == pytest.approx(1.0, abs=1e-12)


@pytest.mark.parametrize("source", SOURCES)
@pytest.mark.parametrize("bumps", [0.1, 1.0])
def test_stages_without_effects_are_the_fused_kernels(source, bumps):
    scene, filter = scene_of(source), Filter("cosine", (3, 3))
    heights = bumpy(scene, bumps)
    a, b = (shine(scene, heights, requests, filter=filter) for requests in (NO_REQUESTS, STAGES))
    torch.testing.assert_close(b.image, a.image, rtol=0, atol=1e-13)
    assert b.lost == pytest.approx(a.lost, abs=1e-12)
    assert b.leaving == pytest.approx(a.leaving, abs=1e-12)


@pytest.mark.parametrize("case", ["lens", "point", "mirror", "cliff"])
def test_gradients_against_differences(case, kernels):
    """Central differences over a random direction; the smooth filter's third derivative leaves some 1e-7."""
    light = Light(30.0, (450.0, 600.0), (1.0, 2.0))
    scene = scene_of(
        POINT if case == "point" else None,
        light=light,
        glass="N-BK7",
        screen=Screen((24.0, 24.0), 60.0, (12, 12), (10.0, -20.0), (1.0, 0.5)),
        **EVERYTHING,
    )
    heights, step = bumpy(scene, 0.15), 1e-6
    if case == "mirror":
        scene = scene_of(screen=Screen((24.0, 24.0), -40.0, (12, 12), (0.0, 10.0)), mirror=True)
    if case == "cliff":
        scene, heights = cliff()
        scene = replace(scene, screen=Screen((80.0, 40.0), 60.0, (6, 4)))
    field, filter = HeightField.of(scene.lens), Filter("cosine", (5, 3))
    sampler = rays_of(scene, "stratified", 400, 5)
    g = torch.Generator().manual_seed(1)
    toward = torch.randn(scene.screen.resolution, generator=g, dtype=torch.float64)
    along = torch.randn(heights.shape, generator=g, dtype=torch.float64)

    def value(h: torch.Tensor) -> torch.Tensor:
        parts = [t.expose({EXIT: h}, scene.screen, filter) for t in tracers(scene, field, sampler, torch.float64, 1 << 20, DETOURS)]
        return sum((p.image * toward).sum() for p in parts)

    h = heights.clone().requires_grad_()
    (gradient,) = torch.autograd.grad(value(h), h)
    with torch.no_grad():
        difference = float(value(heights + step * along) - value(heights - step * along)) / (2 * step)
    assert float((gradient * along).sum()) == pytest.approx(difference, rel=2e-5)
    assert abs(difference) > 1e-4


# All of them together

#: Kinds of light: rays of an axial plane wave remain a grid as long as they can, with one power for all or, through a circle or
#: with a profile, a power each.
SOURCES = (
    PlaneWave(),
    PlaneWave(profile=np.random.default_rng(0).uniform(0.1, 1.0, (6, 5))),
    Points(((0.5, -0.3, -40.0), (0.0, 1.0, -50.0))),
    Disc((0.0, 0.0, -40.0), (2.0, 1.0)),
    Disc(angle=0.5),
)
LIT = ((None, "none"), (None, "schlick"), (None, "exact"), (30.0, "exact"), (30.0, "schlick"))
SCREENS = ({}, {"tilt": (10.0, -20.0)}, {"shift": (1.0, 2.0)}, {"radius": (60.0, 60.0)})


@pytest.mark.parametrize(
    ("rays", "light", "lens", "screen", "requests"),
    pairwise(
        [*product(SOURCES, ("lines", "stratified"), ("rectangle", "circle"))],
        LIT,
        [{}, {"absorption": 0.05, "roughness": 0.01}, {"mirror": True}],
        SCREENS,
        [NO_REQUESTS, DETOURS, STAGES],
    ),
)
def test_every_combination_is_traced_as_by_plain_torch(rays, light, lens, screen, requests):
    """Image, losses and gradient by the kernels, as by the reference in plain torch: 1e-10 of the largest value."""
    (source, sampler, aperture), (polarisation, fresnel) = rays, light
    lens = Lens((10.0, 10.0), control=(9, 8), degree=(3, 2), offset=Offset(3.0), fresnel=fresnel, aperture=aperture, **lens)
    lit = Scene(source, lens, Screen((20.0, 20.0), -60.0 if lens.mirror else 60.0, (12, 12), **screen), Light(polarisation))
    by = torch.rand((12, 12), generator=torch.Generator().manual_seed(1), dtype=torch.float64)

    def traced() -> list[torch.Tensor]:
        heights, image, lost = bumpy(lit, 0.03).requires_grad_(), 0.0, {}
        for part in tracers(lit, HeightField.of(lens), rays_of(lit, sampler, 200, 1), torch.float64, 90, requests):
            found = part.expose({EXIT: heights}, lit.screen, Filter("cosine", (3, 3)))
            image = image + found.image
            lost = {name: lost.get(name, 0.0) + float(value) for name, value in found.lost.items()}
        assert float(image.detach().sum()) + sum(lost.values()) == pytest.approx(1.0, abs=1e-12)
        return [
            image.detach(),
            torch.tensor([lost.get(name, 0.0) for name in LOSSES]),
            *torch.autograd.grad((image * by).sum(), heights),
        ]

    compiled = traced()
    with plain():
        reference = traced()
    for a, b in zip(compiled, reference, strict=True):
        torch.testing.assert_close(a, b, rtol=0, atol=1e-10 * max(float(b.abs().max()), 1.0))
