"""Figures corrected for Monte-Carlo noise, and their standard errors."""

from __future__ import annotations

import json
import math

import numpy as np
import pytest
import torch
from helpers import write_blob

from caustic_cli import cli
from caustic_cli.commands.figures import figures_rows
from caustic_cli.optics.emission import rays_of
from caustic_cli.optics.sampling import numbers, stream
from caustic_cli.optics.surfaces.heightfield import HeightField
from caustic_cli.optics.trace import expose
from caustic_cli.scene import Disc, Lens, Offset, PlaneWave, Points, Scene, Screen
from caustic_cli.studies import metrics, noise
from caustic_cli.studies.retrace import MOST_TIMES, evaluation_rays, retrace

PIXELS = (40, 36)
SOURCES = {"disc": Disc((0.0, 0.0, -100.0), (6.0, 6.0)), "point": Points(((0.0, 0.0, -100.0),)), "sun": Disc(angle=2.0)}


def lens(source):
    """A wavy lens, its field and heights, and a target that it does not quite make."""
    made = Lens(control=(9, 9), offset=Offset(5.0, (30.0, 30.0)))
    field = HeightField.of(made)
    x, y = (c.numpy() for c in field.control_xy())
    heights = 5.0 + made.offset.sag(x[:, None], y[None]) + 0.02 * np.sin(x[:, None]) * np.cos(0.7 * y)
    scene = Scene(source, made, Screen((44.0, 44.0), 100.0, PIXELS))
    u, v = (np.linspace(-1.0, 1.0, n) for n in PIXELS)
    target = 1.2 + np.cos(3.0 * u[:, None]) * np.cos(2.0 * v)
    target[:4] = target[16:20] = 0.0
    return scene, field, torch.from_numpy(heights), target


def smooth(seed=0):
    g = np.random.default_rng(seed)
    u, v = np.meshgrid(np.linspace(0, 7, 60), np.linspace(0, 5, 50), indexing="ij")
    target = 2.0 + np.sin(u) * np.cos(v)
    image = target + 0.2 * np.sin(3 * u + v)
    return g, 1e-4 * image, target


def test_figures_are_those_of_the_image_without_its_noise():
    """Poisson noise of 30 counts a pixel, in halves: what is left of it is what standard_error says."""
    g, image, target = smooth()
    exact = {f.__name__: f(image, target) for f in (metrics.loss, metrics.relative_rms, metrics.psnr_db, metrics.ssim)}
    plain, freed, said = [], [], []
    for _ in range(60):
        halves = [g.poisson(image / image.mean() * 15.0) / 15.0 for _ in range(2)]
        mean, variance = (halves[0] + halves[1]) / 2.0, noise.variance_of(*halves)
        plain.append(metrics.relative_rms(mean, target))
        freed.append([f(mean, target, variance) for f in (metrics.loss, metrics.relative_rms, metrics.psnr_db, metrics.ssim)])
        said.append(noise.standard_error(*halves, target, freed[-1][1]))
    scatter = np.std(freed, 0)
    assert min(plain) > 1.5 * exact["relative_rms"]
    for found, spread, (name, value) in zip(np.mean(freed, 0), scatter, exact.items(), strict=True):
        if name == "ssim":  # a ratio of what is without bias
            assert value - found < 0.25 * (value - metrics.ssim(mean, target))
        else:
            assert found == pytest.approx(value, abs=4.0 * spread / math.sqrt(60)), name
    assert np.mean(said) == pytest.approx(scatter[1], rel=0.25)


def test_pure_noise_and_darkness_are_no_error():
    g, _, target = smooth()
    one, other = (target + 0.1 * g.standard_normal(target.shape) for _ in range(2))
    variance, mean = noise.variance_of(one, other), (one + other) / 2.0
    found = metrics.relative_rms(mean, target, variance)
    assert found + noise.standard_error(one, other, target, found) < 0.5 * metrics.relative_rms(mean, target)
    assert metrics.relative_rms(mean, target, 2.0 * variance) == 0.0
    assert metrics.psnr_db(mean, target, 2.0 * variance) is None
    assert metrics.ssim(mean, target, 2.0 * variance) <= 1.0
    black = np.zeros_like(target)
    assert noise.image_noise(black, black) is None
    assert noise.standard_error(black, black, target, 1.0) == 0.0
    assert metrics.relative_rms(black, target, black) == metrics.relative_rms(black, target)


@pytest.mark.parametrize("name", SOURCES)
def test_a_retrace_with_few_rays_says_the_figure_of_many(name):
    """20 rays a pixel; without the correction the noise of the image would be most of the figure's error."""
    scene, field, heights, target = lens(SOURCES[name])
    truth = retrace(scene, field, heights, target, rays=2_000_000, seed=99)[1]
    found = [retrace(scene, field, heights, target, rays=30_000, seed=s) for s in range(12)]
    figures = [f for _, f in found]
    rms, said = np.array([f["relative_rms"] for f in figures]), np.array([f["noise"] for f in figures])
    z = (rms - truth["relative_rms"]) / np.hypot(said, truth["noise"])
    assert np.abs(z).max() < 4.0
    assert 0.4 < np.sqrt(np.mean(z**2)) < 1.7
    dark, dark_said = np.array([(f["in_black"], f["in_black_noise"]) for f in figures]).T
    z = (dark - truth["in_black"]) / np.hypot(dark_said, truth["in_black_noise"])
    assert truth["in_black"] > 0.05 and np.abs(z).max() < 4.0 and 0.4 < np.sqrt(np.mean(z**2)) < 1.7
    assert metrics.relative_rms(found[0][0].image, target) > truth["relative_rms"] + 3.0 * said[0]
    exact = retrace(scene, field, heights, target, rays=2_000_000, seed=98)[0].image.numpy()
    apart = [metrics.relative_rms(e.image, exact) for e, _ in found]
    assert np.mean([f["error_estimate"] for f in figures]) == pytest.approx(np.mean(apart), rel=0.1)
    assert figures[0]["on_screen"] + sum(figures[0]["lost"].values()) == pytest.approx(1.0, abs=1e-12)
    assert figures[0]["loss"] * math.prod(PIXELS) == pytest.approx(rms[0])


def test_sobol_rays_leave_less_noise_than_strata():
    """Of a disc, whose rays fill four dimensions; see the README."""
    scene, field, heights, _ = lens(SOURCES["disc"])

    def scatter(kind):
        images = torch.stack([expose(scene, field, heights, rays_of(scene, kind, 1 << 17, seed)).image for seed in range(4)])
        return math.sqrt(float(images.var(0).mean()))

    assert scatter("sobol") < 0.85 * scatter("stratified")


def test_figures_of_a_plane_wave_are_of_its_image_as_it_is():
    scene, field, heights, target = lens(PlaneWave())
    exposure, figures = retrace(scene, field, heights, target, rays=30_000, seed=4)
    image = expose(scene, field, heights, rays_of(scene, "stratified", 30_000, stream(4, "render"))).image
    assert torch.equal(exposure.image, image) and figures["rays"] == exposure.rays
    assert {k: figures[k] for k in metrics.figures_of_merit(exposure, target)} == metrics.figures_of_merit(exposure, target)
    truth, more = retrace(scene, field, heights, target, rays=3_000_000, seed=5)
    assert figures["error_estimate"] == pytest.approx(metrics.relative_rms(image, truth.image.numpy()), rel=0.15)
    found = [retrace(scene, field, heights, target, rays=30_000, seed=s)[1] for s in range(10)]
    z = [(f["relative_rms"] - more["relative_rms"]) / f["noise"] for f in found]
    assert 0.5 < np.sqrt(np.mean(np.square(z))) < 1.5
    z = [(f["in_black"] - more["in_black"]) / f["in_black_noise"] for f in found]
    assert 0.2 < np.sqrt(np.mean(np.square(z))) < 1.5
    silent = retrace(scene, field, heights, target, rays=30_000, seed=4, noise=False)[1]
    assert silent["noise"] is None and silent["in_black_noise"] is None and silent["in_black"] == figures["in_black"]
    none = retrace(scene, field, heights, None, rays=30_000)[1]
    assert none["noise"] is None and none["in_black"] is None and none["in_black_noise"] is None
    grey = retrace(scene, field, heights, target + 1.0, rays=30_000)[1]
    assert grey["noise"] > 0 and grey["in_black"] is None and grey["in_black_noise"] is None


@pytest.mark.parametrize(
    ("source", "pixels", "rays"),
    [
        (PlaneWave(), (250, 250), 4_000_000),
        (PlaneWave(), (1000, 500), 32_000_000),
        (PlaneWave(), (4000, 2000), 64_000_000),
        (Disc((0.0, 0.0, -100.0), (6.0, 6.0)), (1000, 500), 4_000_000),
    ],
)
def test_as_many_rays_a_pixel_judge_a_large_picture_of_a_plane_wave(source, pixels, rays):
    """Its figures hold their noise; those of other light do not, and more rays are taken there by the noise itself."""
    assert evaluation_rays(Scene(source, Lens(), Screen((30.0, 30.0), 100.0, pixels))) == rays


def test_rays_are_added_until_the_noise_is_low():
    scene, field, heights, target = lens(SOURCES["disc"])
    _, first = retrace(scene, field, heights, target, rays=2000, seed=1)
    _, same = retrace(scene, field, heights, target, rays=2000, seed=1, quiet=2.0 * first["noise"] / first["relative_rms"])
    assert same == first
    _, more = retrace(scene, field, heights, target, rays=2000, seed=1, quiet=1e-9)
    assert more["rays"] == MOST_TIMES * first["rays"]
    assert more["noise"] < 0.7 * first["noise"]
    assert more["on_screen"] + sum(more["lost"].values()) == pytest.approx(1.0, abs=1e-12)


def test_sobol_points_do_not_depend_on_where_a_draw_begins():
    for dimensions in (2, 4):
        engine = torch.quasirandom.SobolEngine(dimensions, scramble=True, seed=7)
        for start in (0, 1, 2, 3, 1023, 1024, 1025, (1 << 20) + 5):
            engine.reset()
            own = (engine.fast_forward(start) if start else engine).draw(9, dtype=torch.float64)
            drawn = torch.stack(numbers("sobol", (1, 1), 7, dimensions, start, start + 9), 1)
            assert torch.equal(drawn, own), start


def test_design_and_render_of_a_disc_say_their_noise(tmp_path, monkeypatch, capfd):
    monkeypatch.chdir(tmp_path)
    write_blob()
    common = ["--threads", "1", "--json"]
    assert (
        cli.run(
            [
                "design",
                "blob.png",
                "--source",
                "disc",
                "--resolution",
                "24",
                "--control",
                "12",
                "--rays",
                "4000",
                "--waves",
                "off",
                "--iterations",
                "20",
                *common,
            ]
        )
        == 0
    )
    figures = json.loads(capfd.readouterr().out)
    assert 0 < figures["noise"] < 0.1 * figures["relative_rms"]
    rows = dict(figures_rows(figures))
    assert rows["relative RMS error"].endswith(f", noise {figures['noise']:.2g}") and "noise of the image" in rows
    assert cli.run(["render", "blob.caustic", "--rays", "2e6", "--seed", "3", *common]) == 0
    many = json.loads(capfd.readouterr().out)
    assert figures["relative_rms"] == pytest.approx(many["relative_rms"], abs=4.0 * math.hypot(figures["noise"], many["noise"]))
    assert cli.run(["render", "blob.caustic", "--tolerance", "0.05", "--rays", "4000", *common]) == 0
    enough = json.loads(capfd.readouterr().out)
    assert enough["error_estimate"] <= 0.05 and enough["rays_traced"] >= enough["rays"]
    assert enough["relative_rms"] == pytest.approx(many["relative_rms"], abs=4.0 * math.hypot(enough["noise"], many["noise"]))
