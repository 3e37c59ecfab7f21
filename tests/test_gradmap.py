"""The derivative of the image along one control height: three ways, its symmetries, its refusals, its picture."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from helpers import looked_up_in
from PIL import Image

from caustic_cli.errors import InputError
from caustic_cli.optics.emission import rays_of
from caustic_cli.optics.gradient import RayFlow
from caustic_cli.optics.reconstruction import Filter, splat
from caustic_cli.optics.sampling import SAMPLERS, Sampler
from caustic_cli.optics.surfaces.heightfield import HeightField
from caustic_cli.optics.system import EXIT, System
from caustic_cli.optics.trace import Tracer, tracers
from caustic_cli.scene import Component, Disc, FreeForm, Lens, Light, PlaneWave, Points, Scene, Screen
from caustic_cli.scene.gradient import Gradient
from caustic_cli.scene.sources.several import Several
from caustic_cli.studies import gradmap
from caustic_cli.studies.gradmap import compare, difference_step, finite_difference, gradient_image, plot_gradient, shown_part

COSINE = Filter("cosine", (3, 5))  # C1: central differences are sharp
PROFILE = torch.tensor([[1.0, 0.2, 0.0], [0.5, 2.0, 1.0]], dtype=torch.float64)


def bumpy(fresnel="exact", control=(9, 8), degree=(3, 2), amplitude=0.03):
    """A lens with smooth bumps, 100 mm before a screen that most of its light reaches."""
    lens = Lens((10.0, 8.0), 0.0, 1.5443, control, degree, fresnel=fresnel)
    scene = Scene(PlaneWave(), lens, Screen((14.3, 11.7), 100.0, (23, 19)))
    field = HeightField.of(lens)
    x, y = field.control_xy()
    heights = 5.0 + amplitude * torch.sin(x[:, None]) * torch.cos(0.7 * y) + 0.01 * amplitude * x[:, None] ** 2
    return scene, field, heights


@pytest.mark.parametrize("fresnel", ["none", "schlick", "exact"])
@pytest.mark.parametrize("kind", SAMPLERS)
def test_equals_central_differences(kind, fresnel):
    scene, field, heights = bumpy(fresnel)
    checked = 0
    for control, profile in (((4, 3), None), ((0, 0), PROFILE), ((8, 4), PROFILE)):
        sampler = Sampler(kind, (61, 53), seed=3, profile=None if profile is None else looked_up_in(profile))
        gradient = gradient_image(scene, field, heights, control, sampler=sampler, filter=COSINE)
        found = compare(gradient, scene, field, heights, control, sampler=sampler, filter=COSINE)
        # rounding of slopes over a step of 1e-4 pixels: measured 1e-10 to 2e-8 here
        assert found.relative_error < 1e-6
        checked += int((gradient != 0).sum())
    assert checked > 100


@pytest.mark.parametrize("filter", [COSINE, Filter("gaussian", (3, 3), (1.0, 1.0)), Filter("gaussian", (7, 5))])
@pytest.mark.parametrize("kind", ["lines", "stratified"])
def test_dot_product_identity_with_reverse_mode(kind, filter):
    """<y, J e_ij> = <J' y, e_ij> for random images y: forward and reverse mode are the same linear map."""
    scene, field, heights = bumpy()
    sampler = Sampler(kind, (60, 50), seed=1)
    leaf = heights.clone().requires_grad_()
    (sample,) = sampler.chunks()
    (landed,) = Tracer(System.of(scene, field), sample).land({EXIT: leaf}, scene.screen)
    image = splat(*landed.origin[:2], landed.power, scene.screen, filter)[0]
    for seed, control in enumerate([(4, 3), (0, 7), (8, 0), (2, 5)]):
        y = torch.randn(image.shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
        (pulled,) = torch.autograd.grad(image, leaf, y, retain_graph=True)
        forward = gradient_image(scene, field, heights, control, sampler=sampler, filter=filter)
        assert forward.abs().sum() > 0
        scale = float(y.norm() * forward.norm())
        assert float((y * forward).sum()) == pytest.approx(float(pulled[control]), abs=1e-12 * scale)


def volume(least: float, by: float) -> Gradient:
    """Indices between `least` and `least` + 2 `by`."""
    return Gradient("volume", volume=least + by * (1.0 + np.sin(np.arange(7.0 * 6 * 4)).reshape(7, 6, 4)))


def scenes() -> dict[str, Scene]:
    """Scenes in which rays meet the exit elsewhere than where they are sampled, and others, by name."""
    scene, _, _ = bumpy()
    lens, screen, point = scene.lens, scene.screen, Points(((0.5, -0.3, -40.0),))
    front = FreeForm(0.02 * np.sin(np.arange(42.0)).reshape(7, 6), (3, 3))
    mirror = Lens((10.0, 8.0), 0.0, 1.5443, (9, 8), (3, 2), mirror=True)
    return {
        "point": replace(scene, source=point),
        "round": replace(scene, source=point, lens=replace(lens, size=(8.0, 8.0), aperture="circle", fresnel="schlick")),
        "disc": replace(scene, source=Disc((0.0, 0.1, -30.0), (2.0, 1.0))),
        "sun": replace(scene, source=Disc(angle=2.0)),
        "several": replace(scene, source=Several((PlaneWave(), point), (((), ()),) * 2)),
        "polarised": replace(scene, source=point, light=Light(polarisation=30.0)),
        "coloured": replace(scene, source=point, lens=replace(lens, glass="N-BK7"), light=Light(wavelengths=(450.0, 650.0))),
        "absorbing and rough": replace(scene, source=point, lens=replace(lens, absorption=0.02, roughness=0.01)),
        "tilted": replace(scene, source=point, screen=replace(screen, tilt=(20.0, -10.0))),
        "curved": replace(scene, screen=replace(screen, radius=(80.0, 80.0))),
        "two sides": replace(scene, lens=replace(lens, entrance=front)),
        "radial index": replace(scene, lens=replace(lens, gradient=Gradient("radial", (-2e-3, 1e-5)))),
        "rod": replace(scene, source=point, lens=replace(lens, gradient=Gradient("selfoc", (0.08,)), absorption=0.02)),
        "index volume": replace(scene, source=point, lens=replace(lens, gradient=volume(1.5, 0.05))),
        "lens in front": replace(scene, elements=(Component(-12.0, (14.0, 14.0), 3.0, (60.0, -80.0)),)),
        "mirror": Scene(PlaneWave(), mirror, Screen((14.3, 11.7), -100.0, (23, 19))),
        "mirror, point": Scene(point, mirror, Screen((14.3, 11.7), -100.0, (23, 19))),
    }


@pytest.mark.parametrize("kind", ["lines", "stratified"])
@pytest.mark.parametrize("name", scenes())
def test_rays_under_the_control_point_are_all_that_matter(name, kind, monkeypatch):
    """<y, J e_ij> = <J' y, e_ij> with all rays traced by the kernels; a few of them by plain torch are enough."""
    monkeypatch.setattr(RayFlow, "steps_for", lambda *_: 8)  # otherwise some rays may need fewer steps than all
    scene, (_, _, heights) = scenes()[name], bumpy()
    field = HeightField.of(scene.lens)
    rays, traced = rays_of(scene, kind, 3000, 3), []
    leaf, y = heights.clone().requires_grad_(), torch.randn(23, 19, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    for tracer in tracers(scene, field, rays, torch.float64, 1000, gradmap.STAGES):
        image = tracer.expose({EXIT: leaf}, scene.screen, COSINE).image
        (y * (image.sum(0) if scene.colored else image)).sum().backward()

    def tracer(*arguments, **options):
        made = Tracer(*arguments, **options)
        traced.append((made.start.count, torch.is_grad_enabled()))
        return made

    monkeypatch.setattr(gradmap, "Tracer", tracer)
    for control in ((4, 3), (3, 2), (5, 5)):
        forward = gradient_image(scene, field, heights, control, sampler=rays, filter=COSINE, chunk=1000)
        scale = float(y.norm() * forward.norm())
        assert scale > 0.0
        assert float((y * forward).sum()) == pytest.approx(float(leaf.grad[control]), abs=1e-11 * scale)
    differentiated = sum(count for count, gradient in traced if gradient)
    assert 0 < differentiated < 0.6 * 3 * rays.count * len(scene.bands)


@pytest.mark.parametrize("name", ["radial index", "rod", "index volume"])
def test_an_index_that_varies_against_central_differences(name, monkeypatch):
    monkeypatch.setattr(RayFlow, "steps_for", lambda *_: 8)
    scene, (_, _, heights) = scenes()[name], bumpy()
    field, rays = HeightField.of(scene.lens), rays_of(scene, "stratified", 3000, 3)
    for control in ((4, 3), (2, 5)):
        gradient = gradient_image(scene, field, heights, control, sampler=rays, filter=COSINE)
        found = compare(gradient, scene, field, heights, control, sampler=rays, filter=COSINE)
        assert int((gradient != 0).sum()) > 20 and found.relative_error < 1e-7  # measured 1e-9


def test_a_volume_of_one_index_has_the_derivative_of_glass():
    scene, field, heights = bumpy()
    rays = rays_of(scene, "stratified", 3000, 3)
    gradients = [
        gradient_image(replace(scene, lens=lens), field, heights, (4, 3), sampler=rays, filter=COSINE)
        for lens in (scene.lens, replace(scene.lens, gradient=volume(scene.lens.index, 0.0)))
    ]
    assert float((gradients[1] - gradients[0]).norm()) < 1e-9 * float(gradients[0].norm())


@pytest.mark.parametrize(("degree", "size"), [((3, 3), (3, 3)), ((3, 3), (11, 11)), ((5, 3), (3, 3))])
@pytest.mark.parametrize("fresnel", ["none", "exact"])
def test_flat_lens_moves_light_and_makes_none(degree, size, fresnel):
    """Thesis fig. 6.1.1: a bright mountain in a dark valley, of sum zero; Fresnel is flat about normal incidence."""
    lens = Lens((4.0, 4.0), control=(13, 13), degree=degree, fresnel=fresnel)
    scene = Scene(PlaneWave(), lens, Screen((8.0, 8.0), 30.0, (41, 41)))
    field = HeightField.of(lens)
    heights = torch.full(field.shape, 5.0, dtype=torch.float64)
    filter = Filter("gaussian", size)
    g = gradient_image(scene, field, heights, (6, 6), sampler=Sampler("grid", (300, 300)), filter=filter)
    assert abs(float(g.sum())) < 1e-12 * float(g.abs().sum())
    assert g[20, 20] == g.max() and g.min() < 0
    for mirrored in (g.flip(0), g.flip(1), *([g.T] if degree[0] == degree[1] else [])):
        torch.testing.assert_close(g, mirrored, atol=1e-6 * float(g.max()), rtol=0)


def test_reach_is_the_support_of_the_basis_function():
    """On a flat lens rays go straight on: exact zeros outside the support grown by the filter, none left out within."""
    lens = Lens((4.0, 4.0), control=(12, 12), degree=(2, 2), fresnel="none")
    scene = Scene(PlaneWave(), lens, Screen((4.0, 4.0), 30.0, (40, 40)))
    field = HeightField.of(lens)
    heights = torch.full(field.shape, 5.0, dtype=torch.float64)
    filter = Filter("cosine", (3, 3))
    g = gradient_image(scene, field, heights, (4, 5), sampler=Sampler("grid", (330, 330)), filter=filter)
    touched = g != 0
    assert int(touched.sum()) > 100
    t = field.spaces[0].knots
    for axis, k in ((0, 4), (1, 5)):
        low, high = 40 * float(t[k]), 40 * float(t[k + 3])
        hit = torch.nonzero(touched.any(1 - axis)).flatten()
        assert [int(hit[0]), int(hit[-1])] == [int(low) - 1, int(high - 1e-9) + 1]


def test_chunks_and_single_precision_change_nothing_that_matters():
    scene, field, heights = bumpy()
    for kind in ("lines", "uniform"):
        sampler = Sampler(kind, (71, 67))
        whole = gradient_image(scene, field, heights, (3, 3), sampler=sampler, filter=COSINE)
        parts = gradient_image(scene, field, heights, (3, 3), sampler=sampler, filter=COSINE, chunk=500)
        single = gradient_image(scene, field, heights, (3, 3), sampler=sampler, filter=COSINE, dtype=torch.float32)
        assert float((whole - parts).norm()) < 1e-13 * float(whole.norm())
        assert single.dtype == torch.float64
        assert float((whole - single).norm()) < 1e-4 * float(whole.norm())


def test_difference_step_moves_rays_by_that_part_of_a_pixel():
    scene, field, heights = bumpy()
    step = difference_step(scene, field, (4, 3), pixels=0.01)
    moved = heights.clone()
    moved[4, 3] += step
    (sample,) = Sampler("grid", (80, 80)).chunks()
    traced = Tracer(System.of(scene, field), sample)
    (a,), (b,) = (traced.land({EXIT: h}, scene.screen) for h in (heights, moved))
    most = max(float((a.origin[k] - b.origin[k]).abs().max()) / scene.screen.pixel[k] for k in (0, 1))
    assert 0.001 < most < 0.011


def test_compare_sees_a_wrong_derivative():
    scene, field, heights = bumpy()
    sampler = Sampler("lines", (60, 60))
    right = finite_difference(scene, field, heights, (4, 3), sampler=sampler, filter=COSINE)
    found = compare(1.01 * right, scene, field, heights, (4, 3), sampler=sampler, filter=COSINE)
    assert found.relative_error == pytest.approx(0.01, rel=1e-6)
    assert found.largest_error == pytest.approx(0.01 * float(right.abs().max()), rel=1e-6)


@pytest.mark.parametrize("filter", [Filter(), *(Filter("cosine", size) for size in ((1, 1), (3, 1), (1, 5)))])
def test_bincount_is_refused(filter):
    scene, field, heights = bumpy()
    with pytest.raises(InputError, match="gaussian or cosine reconstruction with a filter size of 3 or more"):
        gradient_image(scene, field, heights, (0, 0), sampler=Sampler("grid", (4, 4)), filter=filter)


@pytest.mark.parametrize("control", [(-1, 0), (9, 0), (0, 8)])
def test_unknown_control_point_is_refused(control):
    scene, field, heights = bumpy()
    with pytest.raises(InputError, match="must be a whole number 0 to"):
        gradient_image(scene, field, heights, control, sampler=Sampler("grid", (4, 4)), filter=COSINE)


def test_plot_shows_the_screen_from_behind_and_repeats_byte_for_byte(tmp_path):
    scene = Scene(PlaneWave(), Lens(), Screen((4.0, 4.0), 300.0, (4, 4)))
    gradient = torch.zeros(4, 4, dtype=torch.float64)
    gradient[3, 0] = 1e-3  # +x, -y: the lower right corner
    for name in ("a.png", "b.png"):
        plot_gradient(tmp_path / name, gradient, scene.screen, "one pixel")
    assert (tmp_path / "a.png").read_bytes() == (tmp_path / "b.png").read_bytes()
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a.png", "b.png"]
    rgb = np.asarray(Image.open(tmp_path / "a.png").convert("RGB")).astype(int)
    map_only = rgb[:, : int(0.78 * rgb.shape[1])]  # the rest is the colour bar
    rows, columns = np.nonzero((map_only[..., 0] > 150) & (map_only[..., 1] < 60))
    assert len(rows) > 1000
    assert rows.min() > rgb.shape[0] / 2 and columns.min() > map_only.shape[1] / 2
    coloured = (map_only.max(-1) - map_only.min(-1) > 8).sum()  # zeros are white, so nothing else has a colour
    assert coloured < 1.1 * len(rows)


def test_a_plot_shows_what_is_not_zero():
    screen = Screen((40.0, 20.0), 300.0, (100, 50))  # pixels of 0.4 mm
    gradient = np.zeros((100, 50))
    assert shown_part(gradient, screen) == [(-20.0, 20.0), (-10.0, 10.0)]
    gradient[60:72, 20:25] = 1.0
    (x0, x1), (y0, y1) = shown_part(gradient, screen)
    np.testing.assert_allclose((x0, x1), (57 * 0.4 - 20.0, 75 * 0.4 - 20.0))
    assert y1 - y0 == pytest.approx(x1 - x0) and 0.5 * (y0 + y1) == pytest.approx(22.5 * 0.4 - 10.0)
    gradient[0, 0] = 1.0
    assert shown_part(gradient, screen)[0][0] == -20.0


def test_plot_of_nothing_is_a_plot(tmp_path):
    scene = Scene(PlaneWave(), Lens(), Screen((4.0, 2.0), 300.0, (4, 2)))
    plot_gradient(tmp_path / "zero.png", torch.zeros(4, 2), scene.screen, "all zero")
    with Image.open(tmp_path / "zero.png") as image:
        assert image.size[0] > 100
