"""Designs for extended sources: deconvolution bounds, the convolution kernel, rays of few points, the designs."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from scipy.optimize import nnls

from caustic_cli import cli
from caustic_cli.commands.figures import figures_rows
from caustic_cli.config import settings
from caustic_cli.errors import at_most
from caustic_cli.inverse import source_limits
from caustic_cli.inverse.deconvolution import Blur, _cells, deconvolved, error_bound
from caustic_cli.inverse.objective import Objective, SourceBlur
from caustic_cli.inverse.schedule import LossImage
from caustic_cli.inverse.source_image import source_images
from caustic_cli.inverse.source_limits import etendue_limit, performance_limits, source_spread
from caustic_cli.optics.emission import rays_of
from caustic_cli.optics.emission.coherent import modes, outermost_modes, vogel_disc
from caustic_cli.optics.emission.regular import RegularGrid
from caustic_cli.optics.reconstruction import Filter
from caustic_cli.optics.spread import Convolution, Spread, point_source
from caustic_cli.optics.surfaces import HeightField
from caustic_cli.optics.system import EXIT, System
from caustic_cli.optics.trace import Tracer, expose
from caustic_cli.scene import Component, Disc, FoldMirror, Lens, Offset, PlaneWave, Points, Scene, Screen
from caustic_cli.scene.sources.distribution import Distribution
from caustic_cli.scene.sources.several import Several
from caustic_cli.studies.metrics import relative_rms

SMALL = ["--lens-size", "2", "--throw", "60", "--mag", "2", "--resolution", "32", "--quiet", "--threads", "1"]


def disc_on(pixels: int, radius: float = 0.6) -> np.ndarray:
    x = np.linspace(-1.0, 1.0, pixels)
    return (np.hypot(x[:, None], x[None, :]) < radius).astype(float)


def spread(half: float, cut: int = 1, pixel: float = 0.1) -> Convolution:
    whole = Spread((half, half), ((0.0, 0.0, 1.0),), 0.0)
    return Convolution(torch.from_numpy(whole.kernel((pixel / cut,) * 2)), cut)


# The best light behind a blur


@pytest.mark.parametrize(("half", "cut"), [(0.03, 4), (0.13, 2), (0.32, 1), (0.2, 3)])
def test_the_blur_of_even_pixels_is_that_of_their_cells(half, cut):
    kernel = Spread((half, 1.3 * half), ((-0.02, 0.0, 0.25), (0.01, 0.03, 0.75)), 0.0).on((0.1, 0.12), cut)
    whole = kernel.of_even_pixels
    light = torch.rand(20, 23, dtype=torch.float64, generator=torch.Generator().manual_seed(3))
    cells = light.repeat_interleave(kernel.cut, 0).repeat_interleave(kernel.cut, 1) / kernel.cut**2
    seen, expected = (
        blur(torch.nn.functional.pad(image, (blur.beside[1],) * 2 + (blur.beside[0],) * 2))
        for blur, image in ((whole, light), (kernel, cells))
    )
    torch.testing.assert_close(seen, expected, rtol=0.0, atol=1e-14)


def test_the_light_behind_a_blur_of_a_pixel_is_sharper_than_the_picture():
    """As light that is even over pixels, which is what a transport map gives; points within them would not be blurred at all."""
    scene = Scene(Disc(position=(0.0, 0.0, -500.0), size=(1.0, 1.0)), Lens((50.0, 50.0)), Screen((100.0, 100.0), 300.0, (80, 80)))
    picture = np.random.default_rng(5).uniform(0.5, 1.5, (80, 80))
    blur = Spread((0.4, 0.4), ((0.0, 0.0, 1.0),), 0.0)
    light, fine = source_limits.best_irradiance(scene, picture, blur, 60).light, blur.on(scene.screen.pixel)

    def error(light: np.ndarray) -> float:
        a, b = (n // fine.cut - (len(light) - 80) // 2 for n in fine.beside)
        cells = np.pad(light, ((a, a), (b, b))).repeat(fine.cut, 0).repeat(fine.cut, 1)
        return relative_rms(fine(torch.from_numpy(cells)).numpy(), picture)

    assert error(light) < 0.3 * error(picture)


@pytest.mark.parametrize("cut", [1, 2])
@pytest.mark.parametrize("half", [0.15, 0.5])
def test_no_light_comes_closer_than_the_bound(half, cut):
    """Not the best that was found, nor the picture itself, nor any of many random ones."""
    target, kernel = disc_on(40), spread(half, cut)
    found = deconvolved(target, kernel, 600)
    assert 0.0 < found.bound <= found.error
    assert found.bound > 0.9 * found.error
    b, rng = target / target.mean(), np.random.default_rng(1)
    shape = tuple(cut * n + 2 * a for n, a in zip(target.shape, kernel.beside, strict=True))
    inside = np.pad(b, tuple((a // cut,) * 2 for a in kernel.beside)).repeat(cut, 0).repeat(cut, 1)
    for k in range(20):
        light = inside * rng.uniform(1.0 - k / 20.0, 1.0 + k / 20.0, shape) + 1e-3 * k * rng.random(shape)
        seen = kernel(torch.from_numpy(light)).numpy()
        assert math.sqrt(((seen / seen.mean() - b) ** 2).mean()) >= found.bound


def test_light_that_was_spread_is_found_again():
    """A picture that is some light spread has no least error; its light comes back."""
    kernel = spread(0.3)
    light = np.pad(disc_on(40, 0.4) + 0.3, 4)
    light[:4] = light[-4:] = light[:, :4] = light[:, -4:] = 0.0
    a, b = kernel.beside
    picture = kernel(torch.nn.functional.pad(torch.from_numpy(light), (b, b, a, a))).numpy()
    found = deconvolved(picture, kernel, 2000)
    assert found.error < 5e-3 and found.light.min() >= 0.0
    assert 0.9 < found.kept <= 1.0 + 1e-12


def test_light_lost_beside_the_screen_is_accounted_for():
    """A picture bright to its edges: some of the best light's spread lies beside the screen."""
    assert deconvolved(np.ones((40, 40)), spread(0.5), 200).kept < 0.97


def test_a_picture_of_dots_has_its_light_however_soon_the_bound_is_tight():
    target = np.zeros((48, 48))
    target[8::16, 8::16] = 1.0
    found = deconvolved(target, spread(1.5), 300)
    assert found.light.shape == tuple(48 + 2 * n for n in found.beside) and found.bound > 0.9 * found.error


# The source's kernel


@pytest.mark.parametrize("most", range(1, 9))
def test_a_pixel_is_cut_into_cells_that_its_render_has(most):
    """A render whose pixels are cut into `most` can be added up to the kernel's cells, as fine as is asked for or all of them."""
    for half, wanted in ((4.0, 1), (1.0, 2), (0.55, 3), (0.1, 4)):
        cut = Spread((half, half), ((0.0, 0.0, 1.0),), 0.0).on((0.1, 0.1), most).cut
        assert most % cut == 0 and (cut >= wanted or cut == most)


@pytest.mark.parametrize("half", [(0.35, 0.2), (0.9, 0.9), (2.0, 0.31)])
def test_kernel_has_the_moments_of_the_ellipse(half):
    """Sum 1, nowhere negative, second moments half^2 / 4."""
    cell = (0.1, 0.12)
    kernel = Spread(half, ((0.0, 0.0, 1.0),), 0.0).kernel(cell)
    assert kernel.min() >= 0.0 and kernel.sum() == pytest.approx(1.0)
    for axis in (0, 1):
        line, n = kernel.sum(1 - axis), kernel.shape[axis]
        x = cell[axis] * (np.arange(n) - n // 2)
        assert line @ x == pytest.approx(0.0, abs=1e-9)
        assert line @ (x * x) == pytest.approx(half[axis] ** 2 / 4.0, rel=0.02)


def test_parts_of_a_kernel_are_the_whole():
    """Each about its own point, put back where that stands."""
    whole, pixel, places = Spread((1.0, 1.0), ((0.0, 0.0, 1.0),), 0.0), (0.1, 0.1), vogel_disc(7)
    parts = whole.parts_on(pixel, places, most=1)
    picture = torch.zeros(81, 81, dtype=torch.float64)
    at, total, mean = np.arange(81) - 40, 0.0, np.zeros(2)
    for (x, y), part in zip(places, parts, strict=True):
        one = picture.clone()
        one[40, 40] = 1.0 / len(places)
        seen = part.whole(one).numpy()
        total += seen.sum()
        mean += [0.1 * (at @ seen.sum(1)) + x * seen.sum(), 0.1 * (at @ seen.sum(0)) + y * seen.sum()]
    assert total == pytest.approx(1.0, abs=1e-9)
    np.testing.assert_allclose(mean, 0.0, atol=0.01)


@pytest.mark.parametrize("half", [(0.26, 0.26), (0.46, 0.32)])
def test_parts_of_a_kernel_look_at_as_many_pixels(half):
    """A wave image takes as many cut pixels beside the screen for all of them; two halves of a disc reach beyond their points
    differently."""
    parts = Spread(half, ((0.0, 0.0, 1.0),), 0.0).parts_on((0.1536, 0.1536), vogel_disc(2))
    assert len({part.beside for part in parts}) == len({part.kernel.shape for part in parts}) == 1
    assert sum(float(part.kernel.sum()) for part in parts) == pytest.approx(len(parts))


def test_convolution_has_its_adjoint():
    kernel, g = Convolution(torch.rand(5, 7, dtype=torch.float64), 1), torch.Generator().manual_seed(3)
    a, b = (torch.rand(20, 31, dtype=torch.float64, generator=g) for _ in range(2))
    assert float((kernel.whole(a) * b).sum()) == pytest.approx(float((a * kernel.whole(b, adjoint=True)).sum()), rel=1e-12)


# Rays of few points


def scene_of(source) -> Scene:
    lens = Lens((2.0, 2.0), control=(19, 19), offset=Offset(1.5, (-16.0, -16.0)), height_range=(-0.3, 0.3), min_thickness=0.5)
    return Scene(source, lens, Screen((5.0, 5.0), 60.0, (32, 32)))


def heights_of(scene: Scene, relief: float = 2e-3) -> torch.Tensor:
    x, y = HeightField.of(scene.lens).control_xy()
    offset = scene.lens.offset
    bumps = torch.cos(3.0 * x)[:, None] * torch.cos(2.0 * y + 0.4)[None, :]
    return offset.thickness + torch.from_numpy(offset.sag(x[:, None].numpy(), y[None, :].numpy())) + relief * bumps


CHIP = np.outer([3.0, 1.0, 0.0], [1.0, 2.0, 0.0, 1.0])  # neither even nor symmetrical
SOURCES = {
    "sun": Disc(angle=1.5),
    "disc": Disc((0.0, 0.0, -80.0), (3.0, 2.0)),
    "chip": Disc((0.0, 0.0, -80.0), (3.0, 2.0), brightness=CHIP),
    "far chip": Disc(angle=1.5, brightness=CHIP),
}


@pytest.mark.parametrize("round_", [False, True])
@pytest.mark.parametrize("kind", SOURCES)
def test_regular_rays_carry_the_light_of_the_source(kind, round_):
    """Powers of all grids against those of rays drawn from the source."""
    scene = scene_of(SOURCES[kind])
    if round_:
        scene = replace(scene, lens=replace(scene.lens, aperture="circle"))
    grids = RegularGrid.of_modes(modes(scene, 12), 120_000)
    found = sum(float(state.power.sum()) for grid in grids for state in grid.chunks(5000))
    drawn = sum(float(state.power.sum()) for state in rays_of(scene, "stratified", 120_000).chunks())
    assert found == pytest.approx(drawn, rel=5e-3)


def test_a_blurred_render_is_added_up_to_pixels_whatever_it_is_cut_into():
    """Three cells a pixel, of a kernel that asks for two."""
    scene = scene_of(Disc((0.0, 0.0, -40.0), (2.2, 2.2)))
    field, heights = HeightField.of(scene.lens), heights_of(scene)
    traced, rays, kernels = source_spread(scene, field, heights).rays(scene, "grid", 40_000, 3, 0, "cpu")
    cosine, target = Filter("cosine", (3, 3)), torch.from_numpy(disc_on(32))
    made = Objective(
        traced,
        field,
        rays,
        target,
        "rms",
        LossImage(cosine, filter_target=False, oversample=3),
        dtype=torch.float64,
        blur=SourceBlur(kernels),
    )
    image = expose(scene, field, heights, rays_of(scene, "sobol", 1 << 18)).image
    assert kernels[0].cut == 3 and made(heights).loss * 32**2 == pytest.approx(relative_rms(image, target), rel=0.05)


#: Scenes in which light goes on behind the lens, or onto a screen that is not plane.
BEHIND = {
    "a lens": {"elements": (Component(20.0, (12.0, 12.0), 3.0, (60.0, -60.0)),)},
    "a mirror": {"elements": (FoldMirror(30.0, (20.0, 20.0), tilt=(45.0, 0.0)),)},
    "a sphere": {"screen": Screen((5.0, 5.0), 60.0, (32, 32), radius=(8.0, 8.0))},
}


@pytest.mark.parametrize("name", BEHIND)
def test_the_blur_is_that_on_the_screen_behind_everything(name):
    """The convolved image of the source's centre is that of very many rays drawn from all of the source."""
    scene = replace(scene_of(SOURCES["sun"]), **BEHIND[name])
    field, heights = HeightField.of(scene.lens), heights_of(scene)
    spread = source_spread(scene, field, heights)
    traced, rays, (kernel,) = spread.rays(scene, "grid", 200_000, 4, 0, "cpu")
    wide, cut = kernel.beside, kernel.cut
    own = scene.screen.grown((wide[0] // cut, wide[1] // cut))
    cells = replace(own, resolution=(own.resolution[0] * cut, own.resolution[1] * cut))
    found = kernel(expose(traced.onto(cells), field, heights, rays).image)
    drawn = expose(scene, field, heights, rays_of(scene, "sobol", 1 << 18)).image
    sharp = expose(traced, field, heights, rays).image
    assert relative_rms(found, drawn) < 0.08 and relative_rms(sharp, drawn) > 2.0 * relative_rms(found, drawn)


def test_limits_of_several_sources_hold_for_the_light_of_all():
    """Of a source twice it is that of it once; of another as well no more than that of either; of a point there is none."""
    wide, narrow = Disc(angle=2.0), Disc(angle=1.5)
    found = [performance_limits(scene_of(one), disc_on(32)).error for one in (wide, narrow)]
    both = [
        performance_limits(scene_of(Several(pair, (((), ()),) * 2)), disc_on(32)).error
        for pair in ((wide, wide), (wide, narrow), (narrow, PlaneWave()))
    ]
    assert both[0] == pytest.approx(found[0], rel=0.05) and 0.0 < both[1] <= 1.02 * min(found) and both[2] is None


@pytest.mark.parametrize("kind", SOURCES)
@pytest.mark.parametrize("exact", [10.0, 1e-5], ids=["middle", "points"])
def test_objective_sees_the_image_of_the_source(kind, exact, monkeypatch):
    """On its own regular rays, spread, the loss is that of very many rays drawn from all of the source; its gradient is right."""
    monkeypatch.setattr("caustic_cli.optics.spread.EXACT", exact)
    scene = scene_of(SOURCES[kind])
    field, heights = HeightField.of(scene.lens), heights_of(scene)
    shifts = source_spread(scene, field, heights)
    traced, rays, kernels = shifts.rays(scene, "grid", 200_000, 4, 0, "cpu")
    assert (len(kernels) > 1) == (exact < 1.0)
    target = torch.from_numpy(disc_on(32))
    made = Objective(
        traced,
        field,
        rays,
        target,
        "rms",
        LossImage(Filter("cosine", (3, 3)), filter_target=False, oversample=4),
        dtype=torch.float64,
        blur=SourceBlur(kernels),
    )
    image = expose(scene, field, heights, rays_of(scene, "sobol", 1 << 18)).image
    assert made(heights).loss * 32**2 == pytest.approx(relative_rms(image, target), rel=0.04)
    assert made(heights).on_screen == pytest.approx(float(image.sum()), rel=0.01)
    along = torch.randn(heights.shape, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    step = 1e-7
    slope = (made(heights + step * along).loss - made(heights - step * along).loss) / (2 * step)
    assert float((made(heights).gradient * along).sum()) == pytest.approx(slope, rel=2e-3)


def test_sources_that_do_more_than_shift():
    """Right before the lens, in depth, or apart: no kernel stands for them; a plane wave has none."""
    assert source_spread(scene_of(Disc((0.0, 0.0, -0.3), (2.0, 2.0)))) is None
    assert source_spread(scene_of(PlaneWave())) is None
    assert source_spread(scene_of(Points(((0.0, 0.0, -50.0), (0.3, 0.0, -60.0))))) is None
    assert source_spread(scene_of(SOURCES["sun"])) is not None


# What cannot be


def test_etendue_of_small_areas():
    """A screen that sees little of the lens gets its part of the sun's etendue; a large one all; a point has none."""
    scene = scene_of(Disc(angle=20.0))
    small = replace(scene, screen=replace(scene.screen, size=(0.5, 0.5)))
    expected = 0.25 / (60.0 - 1.5) ** 2 / (math.pi * math.sin(math.radians(10.0)) ** 2)
    assert etendue_limit(small) == pytest.approx(expected, rel=2e-3)
    assert etendue_limit(replace(scene, screen=replace(scene.screen, size=(60.0, 60.0)))) == 1.0
    assert etendue_limit(scene_of(PlaneWave())) is None
    near = scene_of(Disc((0.0, 0.0, -80.0), (3.0, 2.0)))
    area = math.pi * 3.0 * 2.0 / 4.0
    expected = (25.0 / 58.5**2) / (area / 80.0**2)
    assert etendue_limit(near) == pytest.approx(min(1.0, expected), rel=0.01)


@pytest.mark.parametrize(
    "light", [{"cone": 1.0}, {"intensity": Distribution((0.0, 1.0, 1.2, 90.0), (1.0, 1.0, 0.0, 0.0))}], ids=["cone", "table"]
)
def test_etendue_of_light_that_does_not_fill_the_lens(light):
    """A flat plate sends much of a narrow beam through a screen that sees little of the lens: the limit is no less."""
    lens = Lens((20.0, 20.0), control=(8, 8), offset=Offset(5.0))
    scene = Scene(Disc((0.0, 0.0, -50.0), (4.0, 4.0), **light), lens, Screen((10.0, 10.0), 300.0, (10, 10)))
    plate = torch.full((8, 8), 5.0, dtype=torch.float64)
    image = expose(scene, HeightField.of(lens), plate, rays_of(scene, "sobol", 1 << 14))
    on_screen, entered = float(image.image.sum()), 1.0 - image.lost.get("missed_lens", 0.0)
    assert on_screen > 0.3 and on_screen / entered < etendue_limit(scene) <= 1.0


@pytest.mark.parametrize("tilt", [(0.0, 0.0), (30.0, 0.0), (-20.0, 40.0)])
@pytest.mark.parametrize("kind", SOURCES)
def test_the_image_of_the_source_through_a_point_of_the_lens(kind, tilt):
    """By rays through a lens with relief: light of the outermost points of the source lands within the images that are said."""
    scene = scene_of(SOURCES[kind])
    scene = replace(scene, screen=replace(scene.screen, tilt=tilt))
    field, heights = HeightField.of(scene.lens), heights_of(scene)
    system, images = System.of(scene, field), source_images(scene)
    exit_x, exit_y = (torch.tensor(v, dtype=torch.float64) for v in ([0.0, 0.6, -0.5, 0.3], [0.0, 0.2, -0.7, 0.9]))

    def landing(mode):
        u, v = (exit_x / 2.0 + 0.5, exit_y / 2.0 + 0.5)
        for _ in range(4):  # until it leaves the lens there
            tracer = Tracer(system, mode.through(u, v, 1.0))
            left = tracer.last({EXIT: heights}).state.expanded()
            at = left.full(left.origin)
            u, v = u - (at[0] - exit_x) / 2.0, v - (at[1] - exit_y) / 2.0
        state = Tracer(system, mode.through(u, v, 1.0)).land({EXIT: heights}, scene.screen)[0].expanded()
        return torch.stack(state.full(state.origin)[:2])

    right, left, up, down = (landing(mode) for mode in outermost_modes(scene))
    moved = np.stack([((right - left) / 2).numpy(), ((up - down) / 2).numpy()], -1)  # (2, rays, 2): axis, ray, side of the source
    for ray in moved.transpose(1, 0, 2):
        off = []
        for image in images:
            (hx, hy), (a, b) = image.half, image.skew
            ellipse = np.array([[hx, a * hy], [b * hx, hy]])  # up to a rotation of the source, if that is round
            off.append(np.linalg.norm(ray @ ray.T - ellipse @ ellipse.T, 2) / np.linalg.norm(ray @ ray.T, 2))
        assert min(off) < 0.12


@pytest.mark.parametrize("tilt", [(0.0, 0.0), (30.0, 0.0), (-20.0, 40.0)])
@pytest.mark.parametrize("kind", ["sun", "disc"])
def test_no_lens_is_better_than_the_bound(kind, tilt):
    """The picture that a lens throws of a point: its own image of the source is no closer to it than the bound, which is not
    vacuous, on a tilted screen as on an upright one."""
    scene = scene_of(SOURCES[kind])
    scene = replace(scene, screen=Screen((6.0, 6.0), 60.0, (48, 48), tilt))
    field, heights = HeightField.of(scene.lens), heights_of(scene, relief=8e-3)
    point = replace(scene, source=point_source(scene))
    target = expose(point, field, heights, rays_of(point, "sobol", 1 << 18)).image.numpy()
    image = expose(scene, field, heights, rays_of(scene, "sobol", 1 << 18)).image.numpy()
    error, limits = relative_rms(image, target), performance_limits(scene, target)
    assert 0.8 * error < limits.error < error
    colours = performance_limits(scene, np.stack([target, 0.0 * target, target[::-1]]))
    assert 0.5 * limits.error < colours.error < 2.0 * limits.error  # the mean over those with light


def test_several_blurs_allow_for_more_than_one():
    """The error of the best sum of two is bounded from below by no more than either's, and reached by none alone."""
    target, one, two = disc_on(24), spread(0.3), spread(0.4)
    alone, both = (error_bound(target, [Blur((blur,)) for blur in blurs], 400) for blurs in ([one], [one, two]))
    assert 0.5 * alone < both <= alone * 1.001
    assert error_bound(target, [Blur((one,))], 400) == pytest.approx(deconvolved(target, one, 400).bound)
    mixed = 0.5 * (one(_cells(torch.from_numpy(target), one)) + two(_cells(torch.from_numpy(target), two)))
    assert error_bound(mixed.numpy(), [Blur((one,)), Blur((two,))], 400) < 0.02  # such a picture has no least error


@pytest.mark.parametrize("divided", [False, True])
def test_the_bound_is_that_of_the_least_squares_over_all_light(divided):
    """Against non-negative least squares over the pixels' light, of which the left half has one blur and the right half another, or
    all has both; what reaches only dark pixels may have any."""
    n, blurs = 14, [spread(0.15), spread(0.23)]
    target = disc_on(n)
    left = torch.zeros(n, n, dtype=torch.bool)
    left[: n // 2] = True
    parts = [left, ~left] if divided else [torch.ones_like(left)] * 2
    columns = []
    for blur, part in zip(blurs, parts, strict=True):
        a, b = blur.beside
        for i, j in torch.nn.functional.pad(part.double()[None, None], (b, b, a, a), mode="replicate")[0, 0].nonzero().tolist():
            light = torch.zeros(n + 2 * a, n + 2 * b, dtype=torch.float64)
            light[i, j] = 1.0
            columns.append(blur(light).flatten().numpy())
    b, matrix = (target / target.mean()).ravel(), np.stack(columns, 1)
    matrix = matrix[:, matrix.sum(0) > 1e-9].round(12)  # without light that reaches nothing but by rounding
    heavy = 1e3  # of the mean, which is to be 1
    seen = matrix @ nnls(np.vstack([matrix, heavy * matrix.mean(0)]), np.append(b, heavy))[0]
    least = math.sqrt(np.mean((seen / seen.mean() - b) ** 2))
    found = error_bound(target, [Blur((blur,), part) for blur, part in zip(blurs, parts, strict=True)], 2000)
    assert 0.97 * least < found <= least * (1.0 + 1e-3)


def test_limits_in_words():
    scene = scene_of(SOURCES["sun"])
    limits = performance_limits(scene, disc_on(32))
    words = limits.sentence()
    assert (
        f"relative RMS error of less than {at_most(limits.error, 3)}" in words
        and "etendue" in words
        and len(words.splitlines()) == 1
    )
    assert performance_limits(scene_of(PlaneWave()), disc_on(32)).sentence() == ""


def test_the_middle_shines_into_the_cone_of_the_whole():
    """So that as much of its light meets the lens."""
    scene = scene_of(SOURCES["disc"])
    middle = point_source(scene)
    assert middle.cone_over(scene.lens.pupil) == pytest.approx(scene.source.cone_over(scene.lens.pupil))
    assert point_source(scene_of(SOURCES["sun"])).collimated


# Designs


@pytest.fixture
def _here(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Image.fromarray((disc_on(32, 0.7) * 255).astype(np.uint8)).save("blob.png")
    monkeypatch.setenv("CAUSTIC_EFFORT", "test final_rays=200000")


def design(capfd, *arguments) -> dict:
    assert cli.run(["design", *map(str, arguments), "--json"]) == 0
    return json.loads(capfd.readouterr().out)


@pytest.mark.parametrize(
    "source",
    [["--source-angle", "0.8"], ["--source", "disc", "--source-position", "0,0,-100", "--source-size", "1"]],
    ids=["sun", "disc"],
)
def test_a_design_comes_close_to_the_least_error(source, _here, capfd):
    """Within a quarter of the bound at a small size, from stages that are spread; figures and report say the bound."""
    found = design(capfd, "blob.png", *SMALL, *source)
    stages = settings.read(Path("blob.caustic/project.toml"))["design"]["stages"]
    assert all(stage["spread"] for stage in stages)
    assert found["least_relative_rms"] <= found["relative_rms"] + 3 * found["noise"]
    assert found["relative_rms"] < 1.25 * found["least_relative_rms"] + 0.02
    assert 0.0 < found["etendue_limit"] <= 1.0
    rows = dict(figures_rows(found))
    assert f"{found['least_relative_rms']:.4f}" in rows["least possible"] and "%" in rows["etendue limit"]


def test_resumed_within_a_spread_stage(_here, capfd):
    """Bit for bit the design that was never stopped."""
    options = [*SMALL, "--source-angle", "0.8"]
    whole = design(capfd, "blob.png", *options, "--out", "whole", "--iterations", "14")
    design(capfd, "blob.png", *options, "--out", "parts", "--iterations", "9")
    again = design(capfd, "--resume", "parts", "--iterations", "14", "--quiet")
    assert again["relative_rms"] == whole["relative_rms"] and again["loss"] == whole["loss"]
