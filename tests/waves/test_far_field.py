"""The far field, in mrad: rays by their directions, waves by one Fourier transform, against closed forms and sums."""

from __future__ import annotations

import json
import math
import tomllib
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.interpolate import RectBivariateSpline
from test_beams import LAMBDA, NM, close, gaussian, image, scene_of
from test_lenses import spline_of

from caustic_cli import cli
from caustic_cli.errors import InputError
from caustic_cli.inverse.initial_surface import first_surface
from caustic_cli.optics.emission import rays_of
from caustic_cli.optics.misalignment import Misalignment
from caustic_cli.optics.reconstruction import Filter
from caustic_cli.optics.surfaces import HeightField
from caustic_cli.optics.trace import expose
from caustic_cli.optics.waves.image import wave_image
from caustic_cli.scene import Lens, Light, Offset, PlaneWave, Scene, Screen
from caustic_cli.scene.screen import FOCAL, tilted
from caustic_cli.scene.sources.gaussian import Gaussian
from caustic_cli.studies.manufacture import manufacture


def far(size: float, pixels: int, **more) -> Screen:
    return Screen((size, size), FOCAL, (pixels, pixels), far=True, **more)


@pytest.mark.parametrize("behind", [0.0, -900.0, 400.0])
def test_a_beam_has_its_divergence_wherever_its_waist_is(behind):
    source = Gaussian((0.5, 0.4), NM, behind)
    mrad = [1e3 * LAMBDA / (math.pi * w) for w in source.waist]
    screen = far(5.0, 50)
    close(image(scene_of(source, 6.0, screen), finer=2.0), gaussian(screen, mrad), 1e-4)


def test_behind_a_thin_lens_it_is_that_of_the_new_waist():
    focal, w = 600.0, 0.5
    screen = far(6.0, 50)
    scene = scene_of(Gaussian((w, w), NM), 5.0, screen, control=(12, 12), offset=Offset(0.1))
    field = HeightField.of(scene.lens)
    heights = spline_of(field, lambda x, y: 0.1 - (x * x + y * y) / focal + 0.0 * x)
    theta = 1e3 * LAMBDA / (math.pi * w) * math.hypot(1.0, math.pi * w * w / (LAMBDA * focal))
    close(image(scene, field, heights, finer=2.0), gaussian(screen, (theta, theta)), 1e-4)


def test_a_tilted_beam_is_aside_by_its_angle():
    tilt = 0.5
    aside = 1e3 * math.sin(math.radians(tilt))
    screen = far(5.0, 50, shift=(aside, 0.0))
    mrad = 1e3 * LAMBDA / (math.pi * 0.5)
    scene = scene_of(Gaussian((0.5, 0.5), NM, tilt=(0.0, tilt)), 6.0, screen)
    close(image(scene, finer=2.0), gaussian(screen, (mrad, mrad), (aside, 0.0)), 1e-3)


def by_rays(scene: Scene, field: HeightField, heights: torch.Tensor, count: int) -> np.ndarray:
    return expose(scene, field, heights, rays_of(scene, "stratified", count, 0), Filter()).image.double().numpy()


def bent(size: float = 6.0, screen: Screen | None = None) -> tuple[Scene, HeightField, torch.Tensor]:
    """A lens whose surface turns light by a few mrad, without folds."""
    lens = Lens((size, size), control=(20, 20), index=1.5, fresnel="none", offset=Offset(1.0), min_thickness=0.1)
    scene = Scene(Gaussian((1.5, 1.5), NM), lens, screen or far(24.0, 80), Light(wavelengths=(NM,)))
    field = HeightField.of(lens)
    return scene, field, spline_of(field, lambda x, y: 1.0 + (x * x + 0.7 * y * y) / 700.0 + 0.003 * (0.5 * x + 0.4 * y).cos())


def own_rays(field: HeightField, heights: torch.Tensor, n: int, size: float = 6.0):
    """Refraction of light along z by Snell's law in its vector form: points, heights and unit directions behind, (n, n) each."""
    x = np.linspace(-0.5 * size, 0.5 * size, n)
    a, b = np.meshgrid(x, x, indexing="ij")
    z, zx, zy = (
        c.numpy().reshape(n, n) for c in field.at(heights, *(torch.from_numpy(c.ravel()) for c in (a, b)), ((0, 0), (1, 0), (0, 1)))
    )
    length = np.sqrt(1.0 + zx**2 + zy**2)
    cos = 1.0 / length
    k = np.sqrt(1.0 - 1.5**2 * (1.0 - cos**2)) - 1.5 * cos
    return a, b, z, np.stack([-k * zx / length, -k * zy / length, 1.5 + k / length])


def test_rays_land_by_their_direction():
    scene, field, heights = bent()
    a, b, _, d = own_rays(field, heights, 1501)
    power = np.exp(-2.0 * (a**2 + b**2) / 1.5**2)
    own = np.histogram2d(*(1e3 * c.ravel() for c in d[:2]), bins=80, range=[[-12.0, 12.0]] * 2, weights=power.ravel())[0]
    found = by_rays(scene, field, heights, 1 << 21)
    assert d[0].max() * 1e3 > 3.0
    assert np.abs(found / found.sum() - own / own.sum()).sum() < 0.02
    nearer = by_rays(replace(scene, screen=replace(scene.screen, far=False)), field, heights, 1 << 18)
    assert np.abs(nearer / nearer.sum() - own / own.sum()).sum() > 0.5


def test_waves_are_the_fourier_transform_of_the_field_behind_the_lens():
    """Own rays, carried to a plane, interpolated onto a lattice, and summed directly; on other points than the program's."""
    scene, field, heights = bent()
    a, b, z, d = own_rays(field, heights, 401)
    t = (1.01 - z) / d[2]
    x, y, path = a + t * d[0], b + t * d[1], 1.5 * z + t
    n, half = 700, 2.95
    line = (np.arange(n) + 0.5) * (2.0 * half / n) - half
    by = np.gradient(x, a[:, 0], axis=0) * np.gradient(y, b[0], axis=1) - np.gradient(x, b[0], axis=1) * np.gradient(
        y, a[:, 0], axis=0
    )
    amplitude = np.exp(-(a**2 + b**2) / 1.5**2) / np.sqrt(by)
    # rays move by less than 10 µm: from the lattice of the lens to that of the plane by Newton steps on splines
    p, q = np.meshgrid(line, line, indexing="ij")
    u, v = p.copy(), q.copy()
    sx, sy = (RectBivariateSpline(a[:, 0], b[0], c) for c in (x - a, y - b))
    for _ in range(6):
        u, v = p - sx.ev(u, v), q - sy.ev(u, v)
    waves = RectBivariateSpline(a[:, 0], b[0], amplitude).ev(u, v) * np.exp(
        2j * math.pi / LAMBDA * (RectBivariateSpline(a[:, 0], b[0], path).ev(u, v) - 1.51)
    )
    m, fine = 80, 4
    angles = ((np.arange(m * fine) + 0.5) * (24.0 / m / fine) - 12.0) * 1e-3
    kernel = np.exp(-2j * math.pi / LAMBDA * np.outer(angles, line))
    own = (np.abs(kernel @ waves @ kernel.T) ** 2).reshape(m, fine, m, fine).sum((1, 3))
    found = wave_image(scene, field, heights, dtype=torch.float64, finer=1.5).image.numpy()
    own, found = own / own.sum(), found / found.sum()
    assert np.abs(found - own).max() < 2e-3 * own.max()


def test_derivatives_are_those_of_differences():
    scene, field, heights = bent(screen=far(24.0, 24))
    weights = torch.from_numpy(np.random.default_rng(1).random((24, 24)))
    leaf = heights.clone().requires_grad_()
    (wave_image(scene, field, leaf, dtype=torch.float64).image * weights).sum().backward()
    step = torch.from_numpy(np.random.default_rng(2).standard_normal(tuple(heights.shape)))
    step[[0, -1]], step[:, [0, -1]] = 0.0, 0.0

    def value(by: float) -> float:
        return float((wave_image(scene, field, heights + by * step, dtype=torch.float64).image * weights).sum())

    h = 1e-8
    assert (value(h) - value(-h)) / (2.0 * h) == pytest.approx(float((leaf.grad * step).sum()), rel=2e-3)


def test_the_transport_starts_with_the_picture():
    x = np.abs(np.linspace(-1, 1, 65)[1:] - 1.0 / 64)
    edge = np.clip((0.7 - x) / 0.1, 0.0, 1.0)
    target = np.outer(edge, edge)
    lens = Lens((8.0, 8.0), control=(60, 60), index=1.5, fresnel="none", offset=Offset(1.0, (200.0, 200.0)), min_thickness=0.1)
    scene = Scene(PlaneWave(), lens, far(40.0, 64))
    field = HeightField.of(lens)
    found = first_surface(scene, target, field, 128)
    picture = by_rays(scene, field, torch.from_numpy(np.asarray(found.heights)), 1 << 21)
    error = picture / picture.sum() - target / target.sum()
    assert np.sqrt((error**2).mean()) / (1.0 / target.size) < 0.2 and picture.sum() > 0.99


def test_on_the_command_line(tmp_path, monkeypatch, capfd):
    """Designed, rendered and said in mrad; with a throw it is refused."""
    monkeypatch.chdir(tmp_path)
    x = np.abs(np.linspace(-1, 1, 48))
    edge = np.clip((0.7 - x) / 0.1, 0.0, 1.0)
    np.save("square.npy", np.outer(edge, edge))
    beam = ["square.npy", "--linear", "--source", "gaussian", "--waist", "3", "--wavelengths", "1064", "--lens-size", "8"]
    small = ["--margin", "0", "--resolution", "48", "--control", "60", "--threads", "1", "--loss", "log-rms"]
    assert cli.run(["design", *beam, *small, "--picture-size", "16mrad", "--throw", "inf", "-o", "a.caustic"]) == 0
    table = capfd.readouterr().out
    assert "mrad, from 1/e²" in table and "W/mrad^2" in table and "W/mm^2" not in table
    screen = tomllib.loads((tmp_path / "a.caustic" / "project.toml").read_text())["screen"]
    assert (screen["far"], screen["z"], screen["size"]) == (True, FOCAL, [16.0, 16.0])
    assert cli.run(["render", "a.caustic", "--quiet", "--json", "--rays", "50000"]) == 0
    found = json.loads(capfd.readouterr().out)
    assert found["screen_unit"] == "mrad" and found["beam"]["error"] < 0.05 and found["beam"]["in_mask"] > 0.9
    assert cli.run(["render", "a.caustic", "--quiet", "--json", "--rays", "50000", "--screen-at", "800", "-o", "near.png"]) == 0
    assert json.loads(capfd.readouterr().out)["screen_unit"] == "mm"
    for far_field in (["--picture-size", "1degx1deg"], ["--screen", "far", "--picture-size", "17.4533"]):
        quick = ["--waves", "off", "--iterations", "1", "--quiet", "--rays", "2000", "--resolution", "24", "--margin", "0"]
        assert cli.run(["design", *beam, *far_field, *quick, "-o", "b.caustic", "--force"]) == 0
        screen = tomllib.loads((tmp_path / "b.caustic" / "project.toml").read_text())["screen"]
        assert screen["far"] and screen["size"] == pytest.approx([17.4533] * 2, rel=1e-5)
    capfd.readouterr()
    for wrong, words in (
        (["--throw", "300", "--picture-size", "16mrad"], "is one in the far field, --throw inf, got 300 mm"),
        (["--picture-size", "2000mrad"], "at most are supported"),
        (["--throw", "inf", "--screen-radius", "60"], "leave out --screen-radius"),
    ):
        assert cli.run(["design", *beam, *wrong, "--quiet", "-o", "c.caustic"]) == 2
        assert words in capfd.readouterr().err


def test_a_mirror_sends_its_picture_there_too():
    """By transport and by rays, 100 mrad off the light that falls on it."""
    x = np.abs(np.linspace(-1, 1, 65)[1:] - 1.0 / 64)
    edge = np.clip((0.7 - x) / 0.1, 0.0, 1.0)
    target = np.outer(edge, edge)
    lens = Lens((8.0, 8.0), control=(60, 60), mirror=True, offset=Offset(0.0, (-400.0, -400.0)))
    screen = Screen((40.0, 40.0), -FOCAL, (64, 64), shift=(100.0, 0.0), far=True)
    scene = Scene(PlaneWave(), lens, screen)
    field = HeightField.of(lens)
    found = first_surface(scene, target, field, 128)
    picture = by_rays(scene, field, torch.from_numpy(np.asarray(found.heights)), 1 << 20)
    error = picture / picture.sum() - target / target.sum()
    assert np.sqrt((error**2).mean()) * target.size < 0.25 and picture.sum() > 0.9


@pytest.mark.parametrize("tilt", [(0.0, 45.0), (30.0, -40.0)])
def test_a_mirror_at_an_angle_starts_with_the_picture(tilt):
    """Over 300 mrad: direction cosines along the mirror are not linear in those along the screen; 0.17 if they were."""
    x, y, z = (FOCAL * c for c in tilted(tilt)[2])
    screen = Screen((300.0, 300.0), -FOCAL, (64, 64), tilt=(-tilt[0], -tilt[1]), shift=(FOCAL * x / z, FOCAL * y / z), far=True)
    edge = np.clip((0.8 - np.abs(np.linspace(-1, 1, 65)[1:] - 1.0 / 64)) / 0.2, 0.0, 1.0)
    target = np.outer(edge, edge)
    lens = Lens((8.0, 8.0), control=(60, 60), mirror=True, offset=Offset(0.0, (-60.0, -60.0)))
    scene = Scene(PlaneWave(tilt=tilt), lens, screen)
    field = HeightField.of(lens)
    found = first_surface(scene, target, field, 128)
    picture = by_rays(scene, field, torch.from_numpy(np.asarray(found.heights)), 1 << 20)
    error = picture / picture.sum() - target / target.sum()
    assert np.sqrt((error**2).mean()) * target.size < 0.08 and picture.sum() > 0.98


def test_an_error_of_the_throw_changes_nothing():
    scene, field, heights = bent()
    found = manufacture(scene, field, heights)
    assert found["landing_mm_per_mm_throw"] == 0.0 and found["screen_unit"] == "mrad"
    errors = Misalignment(throw=5.0, screen_tilt=(0.0, 0.1))
    assert errors.away(scene) == (0.0, 0.0, 0.0)


def test_it_has_no_shape():
    with pytest.raises(InputError, match="far field"):
        far(10.0, 8, radius=(60.0, 60.0))
