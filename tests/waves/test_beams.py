"""Laser beams: without and through a thin lens, truncated, tilted and partly coherent, against closed forms and sums."""

from __future__ import annotations

import json
import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.special import erf
from test_lenses import flat, spline_of

from caustic_cli import cli
from caustic_cli.errors import InputError
from caustic_cli.inverse.incidence import incident
from caustic_cli.optics.emission import rays_of
from caustic_cli.optics.misalignment import Misalignment
from caustic_cli.optics.surfaces import HeightField
from caustic_cli.optics.waves.image import wave_image
from caustic_cli.project.project import Project
from caustic_cli.scene import CircularAperture, Lens, Light, Offset, Pupil, Scene, Screen
from caustic_cli.scene.aperture import Aperture
from caustic_cli.scene.sources.gaussian import Gaussian

NM = 1064.0
LAMBDA = 1.064e-3
#: Thickness of a window, mm, over which light is traced by its rays: of a Rayleigh range of hundreds of mm a small part.
THIN = 0.02
THROW = 1500.0


def scene_of(source: Gaussian, size: float, screen: Screen, **lens) -> Scene:
    given = {"control": (6, 6), "index": 1.5, "fresnel": "none", "offset": Offset(THIN), "min_thickness": 0.01} | lens
    return Scene(source, Lens((size, size), **given), screen, Light(wavelengths=(NM,)))


def image(scene: Scene, field: HeightField | None = None, heights=None, finer: float = 1.0) -> np.ndarray:
    field, heights = (field, heights) if field else flat(scene, THIN)
    return wave_image(scene, field, heights, dtype=torch.float64, finer=finer).image.numpy()


def gaussian(screen: Screen, radii, at=(0.0, 0.0)) -> np.ndarray:
    """Power on the pixels of a beam of power 1 with these 1/e^2 radii, centred on a point."""
    one = [
        0.5 * np.diff(erf(math.sqrt(2.0) * (c + np.linspace(-s, s, n + 1) - a) / w))
        for w, s, n, c, a in zip(radii, screen.half_size, screen.resolution, screen.shift, at, strict=True)
    ]
    return np.outer(*one)


def close(found: np.ndarray, exact: np.ndarray, to: float) -> None:
    assert np.abs(found - exact).max() < to * exact.max()


def radius(waist: float, distance: float, m2: float = 1.0) -> float:
    """w_0 sqrt(1 + (M^2 lambda D / pi w_0^2)^2)."""
    return waist * math.hypot(1.0, m2 * LAMBDA * distance / (math.pi * waist**2))


@pytest.mark.parametrize(("waist", "behind"), [((0.5, 0.5), 0.0), ((0.5, 0.4), -800.0), ((0.45, 0.5), 700.0)])
def test_a_beam_spreads_as_its_complex_parameter_says(waist, behind):
    screen = Screen((9.0, 9.0), THROW, (60, 60))
    found = image(scene_of(Gaussian(waist, NM, behind), 6.0, screen), finer=2.0)
    far = THROW - THIN + THIN / 1.5 - behind
    close(found, gaussian(screen, [radius(w, far) for w in waist]), 1e-4)


def test_a_beam_is_focused_to_the_waist_of_abcd():
    """Through a thin lens of focal length 600 mm: with q' = 1 / (1 / q - 1 / f), the waist behind it (Self, Appl. Opt. 22, 658)."""
    focal, w0, behind = 600.0, 0.8, -300.0
    z_r = math.pi * w0**2 / LAMBDA
    s = -behind
    at = focal + focal**2 * (s - focal) / ((s - focal) ** 2 + z_r**2)
    waist = w0 * focal / math.hypot(s - focal, z_r)
    for throw in (at, 0.5 * at, 2.0 * at):
        wide = radius(waist, throw - at)
        screen = Screen((6.0 * wide, 6.0 * wide), throw + 0.1, (50, 50))
        scene = scene_of(Gaussian((w0, w0), NM, behind), 5.0, screen, control=(12, 12), offset=Offset(0.1))
        field = HeightField.of(scene.lens)
        heights = spline_of(field, lambda x, y: 0.1 - (x * x + y * y) / (2.0 * 0.5 * focal) + 0.0 * x)
        # From the entrance to the lens, 0.1 mm of glass; the vertex is where the sag is 0.
        close(image(scene, field, heights, finer=2.0), gaussian(screen, (wide, wide)), 1e-4)


@pytest.mark.parametrize("m2", [1.3, 2.0])
@pytest.mark.parametrize("behind", [0.0, -600.0])
def test_a_partly_coherent_beam_is_a_sum_of_hermite_gaussian_modes(m2, behind):
    """Of the modes of waist w_0 / M with weights in a geometric series (Starikov and Wolf 1982), on each axis."""
    w0, screen = 0.6, Screen((6.0, 6.0), THROW, (180, 180))
    far = THROW - THIN + THIN / 1.5 - behind
    mode = radius(w0 / math.sqrt(m2), far)
    edges = np.linspace(-3.0, 3.0, 180 * 5 + 1)
    x = math.sqrt(2.0) * 0.5 * (edges[1:] + edges[:-1]) / mode
    ratio = (m2 - 1.0) / (m2 + 1.0)
    before, now, line, weight = np.zeros_like(x), np.exp(-0.5 * x * x) / math.pi**0.25, 0.0, 1.0 - ratio
    for n in range(60):
        line = line + weight * now**2
        before, now = now, math.sqrt(2.0 / (n + 1)) * x * now - math.sqrt(n / (n + 1)) * before
        weight *= ratio
    line = line.reshape(180, 5).mean(1) * (6.0 / 180) * math.sqrt(2.0) / mode
    scene = scene_of(Gaussian((w0, w0), NM, behind, m2), 8.0, screen)
    close(image(scene), np.outer(line, line), 1e-3)


def test_a_truncated_beam_is_the_sum_of_its_points():
    """Fresnel's integral over a square of half width 0.7 w, by Gauss' rule; the rest of the beam is booked."""
    w, half, behind = 1.0, 0.7, -400.0
    source, screen = Gaussian((w, w), NM, behind), Screen((3.0, 3.0), THROW, (30, 30))
    scene = scene_of(source, 2.0 * half, screen)
    t, by = np.polynomial.legendre.leggauss(300)
    far, k = THROW - THIN + THIN / 1.5, 2.0 * math.pi / LAMBDA
    z_r, here = math.pi * w * w / LAMBDA, radius(w, behind)
    field = np.exp(-((half * t / here) ** 2) + 0.5j * k * (half * t) ** 2 * (-behind / (behind**2 + z_r**2) + 1.0 / far))
    at = 0.5 * 3.0 * ((2.0 * np.arange(30 * 8) + 1.0) / 240 - 1.0)
    line = np.abs(np.exp(-1j * k * np.outer(at, half * t) / far) @ (by * half * field)) ** 2 / (LAMBDA * far)
    line = line.reshape(30, 8).mean(1) * 0.1 / np.sum(by * half * np.abs(field) ** 2)
    found = image(scene)
    close(found, np.outer(line, line), 5e-4)
    part, words = source.emitted(scene.lens.pupil)
    assert part == pytest.approx(erf(math.sqrt(2.0) * half / here) ** 2, rel=1e-9) and "whole beam" in words


def test_a_tilted_beam_lands_where_its_axis_does():
    source = Gaussian((0.5, 0.5), NM, tilt=(0.0, 1.0))
    aside = THROW * math.tan(math.radians(1.0))
    screen = Screen((6.0, 6.0), THROW, (40, 40), shift=(aside, 0.0))
    far = (THROW - THIN + THIN / 1.5) / math.cos(math.radians(1.0))
    wide = radius(0.5, far)
    exact = gaussian(screen, (wide / math.cos(math.radians(1.0)), wide), (aside, 0.0))
    close(image(scene_of(source, 4.0, screen), finer=2.0), exact, 1e-3)


def test_power_through_a_circle():
    """1 - exp(-2 a^2 / w^2)."""
    source = Gaussian((2.0, 2.0), NM)
    assert source.emitted(Pupil(CircularAperture((1.5, 1.5)), 0.0))[0] == pytest.approx(1.0 - math.exp(-1.125), rel=1e-9)


@pytest.mark.parametrize("m2", [1.0, 3.0])
@pytest.mark.parametrize(("behind", "tilt"), [(0.0, (0.0, 0.0)), (900.0, (0.0, 0.0)), (-900.0, (3.0, 0.0))])
def test_rays_follow_the_normals_of_the_wavefronts(m2, behind, tilt):
    source = Gaussian((1.0, 0.7), NM, behind, m2, tilt)
    scene = scene_of(source, 8.0, Screen((9.0, 9.0), THROW, (8, 8)))
    rays = list(rays_of(scene, "sobol", 1 << 16, 0).chunks())
    if source.collimated:
        return  # a plane wave with a profile
    (x, y, _), d, power = rays[0].origin, rays[0].direction, rays[0].power
    assert float(power.sum()) == pytest.approx(1.0, abs=1e-12)
    z_r = [math.pi * w * w / (LAMBDA * m2) for w in source.waist]
    mean = float((power * d[1]).sum())
    assert mean == pytest.approx(-math.sin(math.radians(tilt[0])), abs=1e-4)
    for at, along, w, z, lean in zip((x, y), d, source.waist, z_r, (0.0, mean), strict=False):
        here = w * math.hypot(1.0, behind / z)
        if not any(tilt):
            assert 2.0 * math.sqrt(float((power * at**2).sum())) == pytest.approx(here, rel=2e-3)
        curve = float((power * at * along).sum() / (power * at**2).sum())
        assert curve == pytest.approx(-behind / (behind**2 + z**2), rel=3e-2, abs=2e-5)
        spread = math.sqrt(max(float((power * (along - lean - curve * at) ** 2).sum()), 0.0))
        assert spread == pytest.approx(0.5 * math.sqrt(m2**2 - 1.0) * LAMBDA / (math.pi * here), rel=3e-2, abs=1e-6)


def test_transport_starts_from_the_rays_that_are_traced():
    """Directions in the glass are the normals of the wavefront; light and map keep the power."""
    source = Gaussian((1.0, 1.0), NM, -900.0)
    lens = Lens((5.0, 5.0), control=(6, 6), index=1.5, fresnel="none")
    scene = Scene(source, lens, Screen((9.0, 9.0), THROW, (8, 8)), Light(wavelengths=(NM,)))
    x = np.linspace(-2.5, 2.5, 201)
    light, (dx, _, _) = incident(scene, x, x, np.full((201, 201), 2.0))
    z_r = math.pi / LAMBDA
    curve = 900.0 / (900.0**2 + z_r**2)
    assert dx[-1, 100] * 1.5 == pytest.approx(curve * 2.5 / (1.0 + 2.0 * curve / 1.5), rel=1e-4)
    row = light[:, 100] / light[:, 100].max()
    wide = radius(1.0, 900.0) * (1.0 + 2.0 * curve / 1.5)
    assert np.abs(row - np.exp(-2.0 * ((x[1:] + x[:-1]) / 2.0 / wide) ** 2)).max() < 1e-3


def test_errors_of_alignment_move_and_widen_it():
    source = Gaussian((1.0, 1.0), NM)
    scene = scene_of(source, 5.0, Screen((9.0, 9.0), THROW, (8, 8)))
    errors = Misalignment(source_shift=(0.3, -0.2), source_size=0.1)
    changed = errors.scene(scene).source
    assert changed.aside == pytest.approx((0.3, -0.2)) and changed.waist == pytest.approx((1.1, 1.1))
    assert changed.irradiance(np.array([0.3]), np.array([-0.2]), scene.pupil) == pytest.approx(1.0)


def test_bad_beams_are_refused_in_a_sentence(tmp_path, monkeypatch, capfd):
    with pytest.raises(InputError, match="diverges by"):
        Gaussian((1e-3, 1e-3), NM)
    with pytest.raises(InputError, match="m2"):
        Gaussian((1.0, 1.0), NM, m2=0.5)
    monkeypatch.chdir(tmp_path)
    np.save("square.npy", np.ones((8, 8)))
    for options, words in (
        (["--wavelengths", "1064"], "--source gaussian needs --waist"),
        (["--waist", "2"], "needs one of --wavelengths"),
        (["--waist", "2", "--wavelengths", "500,600"], "got 2"),
    ):
        assert cli.run(["design", "square.npy", "--source", "gaussian", *options]) == 2
        assert words in capfd.readouterr().err
    assert cli.run(["design", "square.npy", "--source", "plane", "--waist", "2"]) == 2
    assert "--waist belongs to --source gaussian, got plane" in capfd.readouterr().err


def test_a_beam_on_the_command_line(tmp_path, monkeypatch, capfd):
    monkeypatch.chdir(tmp_path)
    np.save("square.npy", np.ones((8, 8)))
    small = ["--linear", "--resolution", "24", "--control", "12", "--rays", "4000", "--quiet", "--threads", "1", "--throw", "400"]
    beam = ["--source", "gaussian", "--waist", "2x1.8", "--wavelengths", "1064", "--waist-at", "50", "--m2", "1.2"]
    assert (
        cli.run(["design", "square.npy", *beam, *small, "--lens-size", "6", "--waves", "off", "--iterations", "5", "--json"]) == 0
    )
    found = json.loads(capfd.readouterr().out)
    here = [radius(w, 50.0, 1.2) for w in (2.0, 1.8)]
    whole = math.prod(erf(math.sqrt(2.0) * 3.0 / w) for w in here)
    assert found["of_source"] <= whole and found["of_source"] == pytest.approx(whole * found["on_target"], rel=1e-3)
    text = (tmp_path / "square.caustic" / "project.toml").read_text()
    assert "waist_at = 50.0" in text and "m2 = 1.2" in text


def test_a_measured_beam_is_a_picture(tmp_path, monkeypatch, capfd):
    monkeypatch.chdir(tmp_path)
    np.save("square.npy", np.ones((8, 8)))
    light = np.exp(-2.0 * np.add.outer(np.linspace(-1, 1, 40) ** 2, np.linspace(-1, 1, 30) ** 2))
    np.save("beam.npy", light)
    small = ["--resolution", "24", "--control", "12", "--rays", "4000", "--quiet", "--waves", "off", "--iterations", "1"]
    assert cli.run(["design", "square.npy", "--linear", "--source-file", "beam.npy", *small]) == 0
    assert np.array_equal(Project.open("square.caustic").scene().source.profile, light)
    capfd.readouterr()
    (tmp_path / "beam.dat").write_bytes(b"1 2 3")
    assert cli.run(["design", "square.npy", "--source", "plane", "--source-file", "beam.dat", *small]) == 2
    assert capfd.readouterr().err.count("\n") == 1


def test_the_field_on_a_pupil_is_that_of_its_rays():
    """The derivative of the path along the pupil is the ray's direction, at any tilt."""
    source = replace(Gaussian((0.8, 0.6), NM, -500.0, tilt=(2.0, -3.0)), aside=(0.1, 0.2))
    pupil, h = Pupil(Aperture((3.0, 3.0)), 0.0), 1e-3
    x, y = np.meshgrid(np.linspace(-1.0, 1.0, 9), np.linspace(-1.0, 1.0, 9), indexing="ij")
    for k, (a, b) in enumerate(((h, 0.0), (0.0, h))):
        slope = (source.beam(x + a, y + b, pupil).path - source.beam(x - a, y - b, pupil).path) / (2.0 * h)
        assert np.abs(slope - source.beam(x, y, pupil).directions[k]).max() < 2e-7
