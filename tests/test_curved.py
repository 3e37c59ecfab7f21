"""Curved screens: landing points and areas against closed forms, derivatives, the energy balance, and designs for them."""

import json
import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from helpers import write_blob
from PIL import Image
from scipy.integrate import dblquad
from torch.autograd import forward_ad

from caustic_cli import cli
from caustic_cli.config.wave_stages import without_waves
from caustic_cli.errors import InputError
from caustic_cli.export.lighttools import write_lighttools
from caustic_cli.export.zemax import write_zemax
from caustic_cli.inverse.initial_surface import _Grid, first_surface
from caustic_cli.inverse.projection import ScreenProjection
from caustic_cli.inverse.source_limits import etendue_limit
from caustic_cli.inverse.target import target_on_screen
from caustic_cli.io.archive import open_archive
from caustic_cli.io.sags import read_sags
from caustic_cli.optics.effects.screen_shape import displacement
from caustic_cli.optics.emission import rays_of
from caustic_cli.optics.frames import Pose
from caustic_cli.optics.misalignment import Misalignment, landing_points
from caustic_cli.optics.plan import compile_plan
from caustic_cli.optics.reconstruction import Filter
from caustic_cli.optics.screen_shape import areas, normals, points_in_space, reach, shape_of
from caustic_cli.optics.surfaces import HeightField
from caustic_cli.optics.system import EXIT, PlacedScreen, System
from caustic_cli.optics.trace import Tracer, expose, is_lowered, tracers
from caustic_cli.project.completion import complete
from caustic_cli.scene import Disc, Lens, Offset, PlaneWave, Points, Scene, Screen
from caustic_cli.scene.screen import Sags
from caustic_cli.studies.irradiance import irradiance, irradiance_figures
from caustic_cli.studies.retrace import retrace

SIZE = (16.0, 14.0)
SPHERE, DOME, CYLINDER, TUNNEL = (25.0, 25.0), (-30.0, -30.0), (20.0, math.inf), (math.inf, -18.0)
POINT = Points(((0.5, -0.3, -40.0),))


def bent(x, y):
    """A measured shape that is neither sphere nor cylinder, mm, and steep enough to matter."""
    return 0.8 * np.sin(0.4 * x + 0.3) * np.cos(0.3 * y) + 0.05 * x


def sags(f=bent, points=(65, 57), size=SIZE) -> Sags:
    x, y = (np.linspace(-0.5 * w, 0.5 * w, n) for w, n in zip(size, points, strict=True))
    return Sags(f(x[:, None], y[None, :]), size)


def screen_of(radius=(math.inf, math.inf), tilt=(0.0, 0.0), shift=(0.0, 0.0), *, z=60.0, pixels=(32, 28), sags=None) -> Screen:
    return Screen(SIZE, z, pixels, tilt, shift, radius, sags)


def scene_of(screen: Screen, source=None, *, control=(9, 8), **lens) -> Scene:
    """A lens of 10 x 8 mm, 3 mm thick, 60 mm before the screen."""
    return Scene(source or PlaneWave(), Lens((10.0, 8.0), 0.0, 1.5, control, (3, 3), offset=Offset(3.0), **lens), screen)


def bumpy(scene: Scene, bumps: float = 0.02) -> torch.Tensor:
    g = torch.Generator().manual_seed(1)
    return scene.lens.offset.thickness + bumps * torch.randn(scene.lens.control, generator=g, dtype=torch.float64)


def landing(scene: Scene, heights: torch.Tensor, count: int = 200):
    rays = next(iter(rays_of(scene, "stratified", count, 3).chunks()))
    tracer = Tracer(System.of(scene, HeightField.of(scene.lens)), rays)
    (state,), (at,) = tracer.land({EXIT: heights}, scene.screen), tracer({EXIT: heights})
    at = at.expanded()
    origin = [c + (at.datum if k == 2 else 0.0) for k, c in enumerate(at.full(at.origin))]
    return state, np.stack([c.numpy() for c in origin]), np.stack([c.numpy() for c in at.full(at.direction)])


@pytest.fixture(params=["", "torch"])
def kernels(request, monkeypatch):
    """The device's own kernels, and the plain-torch reference."""
    monkeypatch.setenv("CAUSTIC_KERNELS", request.param)


# Where light lands


@pytest.mark.parametrize("source", [None, POINT])
@pytest.mark.parametrize("radius", [SPHERE, DOME, CYLINDER, TUNNEL])
@pytest.mark.parametrize(("tilt", "shift"), [((0.0, 0.0), (0.0, 0.0)), ((20.0, -15.0), (1.5, -2.0))])
def test_light_lands_on_spheres_and_cylinders(source, radius, tilt, shift, kernels):
    """Through a flat plate: |p + t d - centre| = |R| across the quadric's axis, the root next to the vertex, by NumPy alone."""
    scene = scene_of(screen_of(radius, tilt, shift), source)
    state, o, d = landing(scene, torch.full((9, 8), 3.0, dtype=torch.float64))
    a, b = np.radians(tilt)
    rx = np.array([[1, 0, 0], [0, np.cos(a), -np.sin(a)], [0, np.sin(a), np.cos(a)]])
    ry = np.array([[np.cos(b), 0, np.sin(b)], [0, 1, 0], [-np.sin(b), 0, np.cos(b)]])
    axes = ry @ rx
    o, d = axes.T @ (o - np.array([*shift, 60.0])[:, None]), axes.T @ d
    curved = [k for k in (0, 1) if math.isfinite(radius[k])]
    r, keep = radius[curved[0]], [*curved, 2]
    p, q = o[keep] - np.array([0.0] * len(curved) + [r])[:, None], d[keep]
    qq, pq, pp = (q * q).sum(0), (p * q).sum(0), (p * p).sum(0) - r * r
    root = np.sqrt(np.maximum(pq * pq - qq * pp, 0.0))
    both = np.stack([(-pq - root) / qq, (-pq + root) / qq])
    t = np.take_along_axis(both, np.abs(o[2] + both * d[2]).argmin(0)[None], 0)[0]
    x, y, on = o[0] + t * d[0] + shift[0], o[1] + t * d[1] + shift[1], state.power.numpy() > 0
    assert on.sum() > 60
    np.testing.assert_allclose(state.origin[0].numpy()[on], x[on], atol=1e-10)
    np.testing.assert_allclose(state.origin[1].numpy()[on], y[on], atol=1e-10)


@pytest.mark.parametrize("radius", [SPHERE, DOME, CYLINDER, TUNNEL])
def test_a_measured_sphere_is_a_sphere(radius, kernels):
    """Sags of the quadric on a grid: the spline through them is off by its fourth-order error, but for the two cells at the border,
    behind which it bends the other way."""
    quadric = shape_of(screen_of(radius))
    off = []
    for n in (33, 65):
        measured = screen_of(sags=sags(lambda x, y: quadric.at(*np.broadcast_arrays(x, y))[0], (n, n)), tilt=(5.0, -10.0))
        pair = [landing(scene_of(s, POINT), bumpy(scene_of(s)))[0] for s in (measured, replace(measured, sags=None, radius=radius))]
        on = (pair[1].power > 0) & (pair[1].origin[0].abs() < 6.0) & (pair[1].origin[1].abs() < 5.0)
        assert int(on.sum()) > 20 and bool((pair[0].power == pair[1].power)[on].all())
        off.append(max(float((p - q)[on].abs().max()) for p, q in zip(pair[0].origin[:2], pair[1].origin[:2], strict=True)))
    assert off[0] < 2e-5 and off[1] < off[0] / 8.0


def test_both_sides_of_a_mirror():
    """A mirror's light comes back to a curved screen: the same points as on a sphere of brute force."""
    scene = scene_of(screen_of(SPHERE, z=-60.0), mirror=True)
    state, o, d = landing(scene, bumpy(scene, 0.002))
    x, y = state.origin[0].numpy(), state.origin[1].numpy()
    z = -60.0 + shape_of(scene.screen).at(x, y)[0]
    t = (z - o[2]) / d[2]
    assert (t > 0).all() and (state.power > 0).all()
    np.testing.assert_allclose(o[:2] + t * d[:2], [x, y], atol=1e-10)


def test_a_placed_screen_is_the_same_screen():
    """A system's screen by its pose, the scene's by tilt and shift: the same image."""
    scene = scene_of(screen_of(SPHERE, (10.0, 20.0)))
    system = System.of(scene, HeightField.of(scene.lens))
    placed = PlacedScreen(replace(scene.screen, tilt=(0.0, 0.0), shift=(1.0, -0.5)), Pose((0.0, 0.0, 60.0), (10.0, 20.0)))
    middle = points_in_space(replace(scene.screen, radius=(math.inf, math.inf)), np.array(1.0), np.array(-0.5))
    moved = replace(scene.screen, shift=(float(middle[0]), float(middle[1])), z=float(middle[2]))
    rays, heights = next(iter(rays_of(scene, "stratified", 500, 1).chunks())), {EXIT: bumpy(scene)}
    images = [Tracer(system, rays).expose(heights, s, Filter("cosine", (3, 3))).image for s in (placed, moved)]
    torch.testing.assert_close(*images, rtol=0, atol=1e-14)
    assert float(images[0].sum()) > 0.1


@pytest.mark.parametrize("screen", [screen_of(SPHERE), screen_of(TUNNEL), screen_of(sags=sags()), screen_of((11.0, 11.0), (0, 60))])
def test_the_energy_balance_closes(screen):
    """Image and losses sum to 1, although rays miss a small sphere that is turned away."""
    scene = Scene(POINT, scene_of(screen).lens, replace(screen, size=(12.0, 7.0)))
    heights = bumpy(scene, 0.1)
    found = expose(scene, HeightField.of(scene.lens), heights, rays_of(scene, "stratified", 4000, 2))
    assert float(found.image.sum()) + sum(found.lost.values()) == pytest.approx(1.0, abs=1e-12)
    assert found.lost["off_screen"] > 0.01 and float(found.image.sum()) > 0.01
    assert not is_lowered(scene, HeightField.of(scene.lens))


def test_light_beside_a_measured_shape_is_seen():
    """It goes on beyond its borders, as steep as there; dark pixels around the screen catch light there."""
    plane = sags(lambda x, y: 0.1 * x + 0.0 * y, (9, 9))
    x, y = np.array([9.9, -9.9]), np.array([8.6, -8.6])
    np.testing.assert_allclose(shape_of(screen_of(sags=plane)).at(x, y)[0], 0.1 * x, atol=1e-12)


# Derivatives

SHAPES = [
    screen_of(SPHERE, (10.0, -20.0)),
    screen_of(DOME),
    screen_of(CYLINDER, (0.0, 30.0), (1.0, 0.5)),
    screen_of(TUNNEL),
    screen_of(sags=sags(), tilt=(15.0, 10.0)),
]


@pytest.mark.parametrize("screen", SHAPES)
@pytest.mark.parametrize("source", [None, POINT])
def test_derivatives_of_landing_points(screen, source, kernels):
    """A smooth function of them: Taylor's remainder falls with the square of the step; forward mode says the same slope."""
    scene = scene_of(screen, source)
    rays = next(iter(rays_of(scene, "stratified", 60, 3).chunks()))
    tracer = Tracer(System.of(scene, HeightField.of(scene.lens)), rays)
    heights = bumpy(scene).requires_grad_()
    g = torch.Generator().manual_seed(2)
    along = torch.randn(heights.shape, generator=g, dtype=torch.float64)

    def value(h):
        x, y = tracer.land({EXIT: h}, scene.screen)[0].origin[:2]
        return (torch.sin(0.3 * x + 0.1) * torch.cos(0.2 * y) + 0.05 * x * y).mean()

    first = value(heights)
    first.backward()
    slope = float((heights.grad * along).sum())
    steps = 1e-3 * 0.5 ** np.arange(4)
    with torch.no_grad():
        left = [abs(float(value(heights + s * along)) - float(first) - s * slope) for s in steps]
    order = np.polyfit(np.log(steps), np.log(left), 1)[0]
    assert abs(order - 2.0) < 0.1
    with forward_ad.dual_level():
        pushed = forward_ad.unpack_dual(value(forward_ad.make_dual(heights.detach(), along))).tangent
    assert float(pushed) == pytest.approx(slope, rel=1e-10)


@pytest.mark.parametrize("screen", SHAPES)
def test_derivatives_of_an_image(screen):
    """Of a weighted sum of pixels, against central differences."""
    scene, filter = scene_of(screen), Filter("cosine", (5, 5))
    weights = torch.randn(screen.resolution, generator=torch.Generator().manual_seed(3), dtype=torch.float64)
    heights = bumpy(scene).requires_grad_()
    along = torch.randn(heights.shape, generator=torch.Generator().manual_seed(4), dtype=torch.float64)

    def value(h):
        parts = tracers(scene, HeightField.of(scene.lens), rays_of(scene, "stratified", 2000, 1), torch.float64, 1 << 19)
        return sum((part.expose({EXIT: h}, scene.screen, filter).image * weights).sum() for part in parts)

    value(heights).backward()
    with torch.no_grad():
        difference = float(value(heights + 1e-6 * along) - value(heights - 1e-6 * along)) / 2e-6
    assert float((heights.grad * along).sum()) == pytest.approx(difference, rel=1e-5)


# Area and irradiance


@pytest.mark.parametrize("radius", [SPHERE, CYLINDER, TUNNEL])
def test_areas(radius):
    """All pixels' true area: of a cylinder's arc in closed form, of a sphere by quadrature."""
    screen = screen_of(radius)
    (rx, ry), (wx, wy) = screen.half_size, screen.pixel
    if radius == SPHERE:
        exact = dblquad(lambda y, x: 25.0 / math.sqrt(625.0 - x * x - y * y), -rx, rx, -ry, ry)[0]
    else:
        half, other, r = (rx, ry, 20.0) if radius == CYLINDER else (ry, rx, 18.0)
        exact = 2.0 * r * math.asin(half / r) * 2.0 * other
    assert areas(screen).sum() * wx * wy == pytest.approx(exact, rel=1e-6)
    x, y = np.random.default_rng(0).uniform(-6.0, 6.0, (2, 50))
    step, (nx, ny, nz) = 1e-5, normals(replace(screen, tilt=(20.0, 10.0)), x, y)
    a, b = (
        (
            np.stack(points_in_space(replace(screen, tilt=(20.0, 10.0)), x + step * i, y + step * j))
            - np.stack(points_in_space(replace(screen, tilt=(20.0, 10.0)), x - step * i, y - step * j))
        )
        / (2 * step)
        for i, j in ((1, 0), (0, 1))
    )
    np.testing.assert_allclose(np.cross(a.T, b.T).T, [nx, ny, nz], atol=1e-8)


def test_even_light_on_a_sphere():
    """Parallel light: each pixel gets as much as on a plane screen, its irradiance falls with the cosine of incidence."""
    scene = scene_of(Screen((8.0, 6.0), 60.0, (16, 12), radius=(6.0, 6.0)))
    heights, field = torch.full((9, 8), 3.0, dtype=torch.float64), HeightField.of(scene.lens)
    image, plane = (
        expose(s, field, heights, rays_of(s, "grid", 400 * 320)).image.numpy()
        for s in (scene, replace(scene, screen=scene.screen.uncurved))
    )
    np.testing.assert_allclose(image, plane, atol=1e-15)
    x, y = ((np.arange(n) + 0.5) * 0.5 - 0.25 * n for n in (16, 12))
    cosine = np.sqrt(1.0 - (x[:, None] ** 2 + y[None, :] ** 2) / 36.0)
    seen = irradiance(image, scene.screen)
    np.testing.assert_allclose(seen / seen.max(), cosine / cosine.max(), rtol=0.01)
    figures, flat = (
        irradiance_figures(s, torch.from_numpy(i))
        for s, i in ((scene, image), (replace(scene, screen=scene.screen.uncurved), plane))
    )
    assert flat["peak_irradiance"] == pytest.approx(flat["mean_irradiance"], rel=0.02)
    assert figures["peak_irradiance"] == pytest.approx(flat["peak_irradiance"] * cosine.max(), rel=0.02)
    true = areas(scene.screen).sum() * 0.25
    assert figures["mean_irradiance"] == pytest.approx(image.sum() / true, rel=1e-12)


def test_the_target_is_power():
    """A white picture asks for power in proportion to true area, and is shown as white."""
    screen = screen_of(SPHERE)
    target = target_on_screen(np.ones((4, 4)), SIZE, screen)
    np.testing.assert_allclose(target, areas(screen))
    np.testing.assert_allclose(irradiance(target, screen), 1.0)
    plane = screen_of()
    assert irradiance(target, plane) is target and areas(plane) is None


def test_etendue_of_a_screen_around_the_lens():
    """A dome has more of the light from an even disc at infinity than a plane; a plane, tilted, less."""
    scene = scene_of(screen_of(z=20.0), Disc(angle=60.0))
    limits = [
        etendue_limit(replace(scene, screen=s))
        for s in (screen_of(DOME, z=20.0), scene.screen, screen_of(tilt=(60.0, 0.0), z=20.0))
    ]
    assert limits[0] > limits[1] > limits[2] > 0


# What a design and a plan know


@pytest.mark.parametrize("screen", [*SHAPES, screen_of(tilt=(0.0, 30.0))])
def test_a_projection_is_inverted_and_conserves_power(screen):
    """Points of the screen and of the plane are mapped to each other, and the power of the picture is conserved."""
    view = ScreenProjection(screen, 3.0)
    x, y = np.random.default_rng(1).uniform(-6.5, 6.5, (2, 100))
    u, v = view.project(x, y)
    np.testing.assert_allclose(view.screen_coordinates(u, v), [x, y], atol=1e-9)
    px, py, pz = view.points(u, v)
    np.testing.assert_allclose([px, py, pz], points_in_space(screen, x, y), atol=1e-9)
    np.testing.assert_allclose(np.cross(np.stack([px, py, pz - 3.0]).T, np.stack([u, v, 57.0 + 0.0 * u]).T), 0.0, atol=1e-7)
    spot = np.zeros(screen.resolution)
    spot[20, 9] = 1.0  # a pixel: its power, and its middle as seen
    picture, half, middle = view.projected_target(spot)
    cell = [2.0 * h / n for h, n in zip(half, picture.shape, strict=True)]
    assert picture.sum() == pytest.approx(1.0, rel=0.02)
    at = [(np.arange(n) + 0.5) * w - h + c for n, w, h, c in zip(picture.shape, cell, half, middle, strict=True)]
    place = [float((picture.sum(1 - k) * at[k]).sum() / picture.sum()) for k in (0, 1)]
    seen = view.project(*((np.array((k + 0.5) * w - h)) for k, w, h in zip((20, 9), screen.pixel, screen.half_size, strict=True)))
    np.testing.assert_allclose(place, seen, atol=0.1 * min(screen.pixel))


def test_a_screen_that_faces_away_is_refused():
    """Of a globe close by the lens sees less than the picture needs."""
    with pytest.raises(InputError, match="faces away from the lens"):
        ScreenProjection(Screen((16.0, 14.0), 12.0, (16, 14), radius=(10.9, 10.9)), 3.0).projected_target(np.ones((16, 14)))


def picture() -> np.ndarray:
    x, y = np.meshgrid(np.linspace(-1, 1, 64), np.linspace(-1, 1, 64), indexing="ij")
    return 0.2 + np.exp(-8 * ((x - 0.3) ** 2 + (y + 0.2) ** 2)) + 0.7 * ((x + 0.4) ** 2 + (y - 0.4) ** 2 < 0.06)


WIDE = {"plane": {}, "tilt": {"tilt": (0.0, 30.0)}, "sphere": {"radius": (45.0, 45.0)}, "dome": {"radius": (-45.0, -45.0)}}
WIDE |= {"cylinder": {"radius": (math.inf, 25.0)}}
WIDE |= {"shape": {"sags": sags(lambda x, y: 3 * np.sin(0.2 * x + 0.5) * np.cos(0.15 * y) + 0.1 * x, size=(30.0, 30.0))}}


@pytest.fixture(scope="module")
def plane_error():
    return start_error("plane")


def start_error(name: str) -> float:
    """Of the first surface alone, by rays; its picture is 30 mm wide, 60 mm away."""
    lens = Lens((10.0, 10.0), index=1.5, control=(67, 67), offset=Offset.for_magnification((3.0, 3.0), 1.5, 60.0, 5.0))
    scene = Scene(PlaneWave(), lens, Screen((30.0, 30.0), 60.0, (64, 64), **WIDE[name]))
    target, field = target_on_screen(picture(), (30.0, 30.0), scene.screen), HeightField.of(lens)
    heights = first_surface(scene, target, field, 128).heights
    return retrace(scene, field, heights, target, rays=400_000, noise=False)[1]["relative_rms"]


@pytest.mark.parametrize("name", [n for n in WIDE if n != "plane"])
def test_the_first_surface_knows_tilt_and_shape(name, plane_error, monkeypatch):
    """Its error is nearly that on a plane screen, and less than by the transport to a plane in its place."""
    error = start_error(name)
    assert 0.01 < plane_error < error + 0.005 < 1.2 * plane_error + 0.005
    monkeypatch.setattr(_Grid, "projection", lambda self, mean: None)
    assert start_error(name) > {"tilt": 3.5, "dome": 2.5, "shape": 1.6, "cylinder": 1.2, "sphere": 1.1}[name] * error


def test_the_effect_says_how_far_light_would_land_elsewhere():
    """The bound of a sphere's corner, by hand; left out, the screen is plane."""
    scene = scene_of(screen_of(SPHERE))
    sag, far = 25.0 - math.sqrt(625.0 - 64.0 - 49.0), math.hypot(8.0, 7.0)
    along = sag * far / (57.0 + sag)
    assert displacement(scene) == pytest.approx(along / 0.5, rel=1e-12)
    plan = compile_plan(scene, HeightField.of(scene.lens), bumpy(scene))
    assert plan["screen-shape"].on and "sphere of radius 25 mm" in plan["screen-shape"].why
    assert plan.scene.screen is scene.screen
    without = compile_plan(scene, HeightField.of(scene.lens), bumpy(scene), ())
    assert not without["screen-shape"].on and not without.scene.screen.curved
    assert not compile_plan(scene_of(screen_of()), HeightField.of(scene.lens), bumpy(scene))["screen-shape"].present


def test_an_error_of_placing_meets_the_same_shape():
    """Without errors the rays of a study of tolerances land where a trace's do."""
    scene = scene_of(screen_of(SPHERE, (5.0, 10.0), (1.0, 2.0)), POINT)
    rays, field, heights = rays_of(scene, "stratified", 300, 1), HeightField.of(scene.lens), bumpy(scene)
    (found,) = landing_points(scene, field, heights, rays, Misalignment())
    (state,) = Tracer(System.of(scene, field), next(iter(rays.chunks()))).land({EXIT: heights}, scene.screen)
    torch.testing.assert_close(found.x + 1.0, state.origin[0], rtol=0, atol=1e-10)
    torch.testing.assert_close(found.y + 2.0, state.origin[1], rtol=0, atol=1e-10)
    assert float((found.power - state.power).abs().max()) < 1e-15


# Files, settings, refusals


@pytest.mark.parametrize("screen", [screen_of(CYLINDER, (5.0, 0.0), (1.0, 2.0)), screen_of(sags=sags())])
def test_an_archive_holds_the_screen(screen, tmp_path):
    scene = scene_of(screen)
    field, heights = HeightField.of(scene.lens), bumpy(scene)
    write_lighttools(tmp_path / "lens.npz", scene, field, heights)
    again, net, found = open_archive(tmp_path / "lens.npz")
    images = [
        expose(s, f, h, rays_of(s, "stratified", 2000, 1), Filter("cosine", (3, 3))).image
        for s, f, h in ((scene, field, heights), (again, net, found))
    ]
    torch.testing.assert_close(*images, rtol=0, atol=1e-12)
    assert again.screen.curved and float(images[0].sum()) > 0.1


def test_formats_that_say_it_in_words(tmp_path):
    scene = scene_of(screen_of(SPHERE))
    field, heights = HeightField.of(scene.lens), bumpy(scene)
    write_zemax(tmp_path / "lens.dat", scene, field, heights)
    assert "sphere of radius 25 mm" in (tmp_path / "lens.dat").read_text()


def test_a_design_says_that_it_leaves_waves_out():
    """By default the wave image is refined where diffraction matters; not on a curved screen, and a line says why."""
    for screen, stages in (({}, True), ({"radius": [60.0, 60.0]}, False)):
        full = complete({"screen": screen}, 1.0)
        assert any(stage.waves for stage in full.design.stages) == stages
        assert without_waves(full, False).startswith("" if stages else "on a tilted or curved screen it takes many transforms")


def test_sags_from_files(tmp_path):
    """Both kinds hold the same shape: i along +x, j upwards."""
    values = sags().values.astype(np.float32)
    np.save(tmp_path / "shape.npy", values)
    Image.fromarray(values.T[::-1]).save(tmp_path / "shape.tif")
    for name in ("shape.npy", "shape.tif"):
        np.testing.assert_array_equal(read_sags(tmp_path / name)[1], values)
    np.save(tmp_path / "few.npy", values[:3])
    np.save(tmp_path / "nan.npy", np.where(values > 0.5, np.nan, values))
    Image.fromarray(np.zeros((8, 8), np.uint8)).save(tmp_path / "codes.tif")
    (tmp_path / "text.tif").write_text("no picture")
    for name, words in (("few.npy", "3 x 57"), ("nan.npy", "finite"), ("codes.tif", "no heights"), ("text.tif", "not a TIFF")):
        with pytest.raises(InputError, match=words):
            read_sags(tmp_path / name)


@pytest.mark.parametrize(
    ("screen", "words"),
    [
        ({"radius": (0.0, 0.0)}, "non-zero numbers of mm or inf"),
        ({"radius": (30.0, 40.0)}, "the same along x and y"),
        ({"radius": (10.0, 10.0)}, r"at least 10\.85 mm either way"),
        ({"radius": (7.0, math.inf)}, "to lie on the cylinder"),
        ({"radius": SPHERE, "sags": sags()}, "two shapes of one screen"),
    ],
)
def test_screens_that_cannot_be(screen, words):
    with pytest.raises(InputError, match=words):
        scene_of(Screen(SIZE, 60.0, (8, 8), **screen))


def test_reach():
    """How far a screen comes towards the lens, by which one that cuts into it is refused."""
    sag = 30.0 - math.sqrt(900.0 - 64.0 - 49.0)
    assert reach(screen_of(DOME)) == (pytest.approx(-sag), 0.0)
    assert reach(screen_of(tuple(-r for r in DOME))) == (0.0, pytest.approx(sag))
    scene = scene_of(screen_of(DOME, z=4.0))
    with pytest.raises(InputError, match=r"its shape takes it 1\.946 mm nearer"):
        expose(scene, HeightField.of(scene.lens), torch.full((9, 8), 3.0), rays_of(scene, "grid", 100))


TINY = ["--resolution", "32", "--control", "24", "--iterations", "2", "--lens-size", "6", "--throw", "100", "--waves", "off"]


def run(capfd, *args: str) -> tuple[int, str, str]:
    code = cli.run([*args])
    return code, *capfd.readouterr()


def test_by_the_command_line(tmp_path, monkeypatch, capfd):
    """Options make a project that keeps radius and shape, renders as it was designed, and is looked at under another screen."""
    monkeypatch.chdir(tmp_path)
    write_blob()
    code, out, _ = run(capfd, "design", "blob.png", *TINY, "--screen-radius", "-40,inf", "--json", "-o", "a.caustic")
    figures = json.loads(out)
    assert code == 0 and "radius = [-40.0, inf]" in (tmp_path / "a.caustic" / "project.toml").read_text()
    assert figures["on_screen"] + sum(figures["lost"].values()) == pytest.approx(1.0, abs=1e-9)
    code, out, _ = run(capfd, "render", "a.caustic", "--rays", "4000", "--json", "--explain", "--quiet")
    row = next(e for e in json.loads(out)["effects"] if e["name"] == "screen-shape")
    assert code == 0 and row["on"] and "cylinder of radius -40 mm" in row["why"] and row["error"] > 0.01
    np.save("shape.npy", bent(*np.meshgrid(np.linspace(-6, 6, 30), np.linspace(-6, 6, 30), indexing="ij")))
    code, out, _ = run(capfd, "design", "blob.png", *TINY, "--screen-shape", "shape.npy", "--json", "-o", "b.caustic")
    assert code == 0 and 'shape_file = "screen.npy"' in (tmp_path / "b.caustic" / "project.toml").read_text()
    (tmp_path / "shape.npy").unlink()
    code, out, _ = run(capfd, "render", "b.caustic", "--rays", "20000", "--json", "--quiet")
    assert code == 0 and json.loads(out)["on_screen"] > 0.8
    np.save("other.npy", np.zeros((5, 5)))
    code, out, _ = run(
        capfd, "render", "b.caustic", "--rays", "20000", "--json", "--quiet", "--screen-shape", "other.npy", "-o", "o.png"
    )
    assert code == 0


def test_pictures_by_rays_and_by_waves_show_irradiance(tmp_path, monkeypatch, capfd):
    """On a cylinder: the power of a pixel is the same by both, as are the codes of what is shown, power over area, which is up to
    1.5 times as large at the edges of the light as in the middle."""
    monkeypatch.chdir(tmp_path)
    light = np.ones((12, 12))
    light[6, 6] = 4.0  # white, beside which the rest is not cut off
    np.save("light.npy", light)
    lens = ["--lens-size", "4", "--mag", "1.45", "--throw", "40", "--screen-radius=-4,inf", "--resolution", "12", "--control", "10"]
    how = ["--start", "offset", "--iterations", "1", "--waves", "off", "--quiet", "-o", "c.caustic"]
    assert run(capfd, "design", "light.npy", *lens, *how)[0] == 0
    how = ["--effects", "diffraction", "--rays", "400000", "--npy", "c.npy", "-o", "c.png", "--quiet"]
    assert run(capfd, "render", "c.caustic", *how)[0] == 0
    by_rays, by_waves = np.load("c.npy"), np.load("c-wave.npy")
    assert np.abs(by_rays - by_waves).max() < 0.02 * by_rays.max()
    codes = [np.asarray(Image.open(name).convert("L"), float)[::-1].T for name in ("c.png", "c-wave.png")]  # [i, j]
    assert np.abs(codes[0] - codes[1]).max() < 6
    x = 2.0 * 1.45 * 1.28 * ((np.arange(12) + 0.5) / 6.0 - 1.0)
    lit = by_waves[:, 6] > 0.3 * by_waves.max()
    density = by_waves[lit, 6] * np.sqrt(1.0 - (x[lit] / 4.0) ** 2)
    assert codes[1][lit, 6] / codes[1][lit, 6].max() == pytest.approx(density / density.max(), abs=0.02)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--screen-radius", "5"], "--screen-radius must be at least"),
        (["--screen-radius", "40,50"], "--screen-radius must be the same along x and y"),
        (["--screen-radius", "a"], "like 60, 60,inf or -8cm"),
        (["--screen-radius", "1,2,3"], "like 60, 60,inf or -8cm"),
        (["--screen-shape", "none.npy"], "none.npy"),
    ],
)
def test_refusals_of_the_command_line(tmp_path, monkeypatch, capfd, options, words):
    monkeypatch.chdir(tmp_path)
    write_blob()
    small = TINY if "--waves" not in options else TINY[:-2]
    code, out, err = run(capfd, "design", "blob.png", *small, *options)
    assert code == 2 and not out and words in err and len(err.strip().splitlines()) == 1
