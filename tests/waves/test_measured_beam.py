"""A beam by its measured irradiance and phase, against the closed forms of the beam that it was sampled from."""

from __future__ import annotations

import json
import math
import tomllib

import numpy as np
import pytest
import torch
from test_beams import LAMBDA, NM, THIN, THROW, close, gaussian, image, radius, scene_of

from caustic_cli import cli
from caustic_cli.errors import InputError
from caustic_cli.optics.emission import rays_of
from caustic_cli.scene import CircularAperture, Pupil, Screen
from caustic_cli.scene.aperture import Aperture
from caustic_cli.scene.sources.gaussian import Gaussian
from caustic_cli.scene.sources.measured_beam import MeasuredBeam

SIZE = 6.0


def sampled(waist=(0.5, 0.4), behind: float = -800.0, n: int = 300, tilt: float = 0.0, profile: bool = True) -> MeasuredBeam:
    """A Gaussian beam on n x n cells over the aperture, by its closed form (`radius` and the curvature D / (D^2 + z_R^2))."""
    x = ((2.0 * np.arange(n) + 1.0) / n - 1.0) * 0.5 * SIZE
    light, phase = [], []
    for w in waist:
        z_r = math.pi * w * w / LAMBDA
        light.append(np.exp(-2.0 * (x / radius(w, behind)) ** 2))
        phase.append(math.pi / LAMBDA * x**2 * -behind / (behind**2 + z_r**2))
    phase[0] = phase[0] + 2.0 * math.pi / LAMBDA * tilt * x
    return MeasuredBeam(np.add.outer(*phase), NM, np.outer(*light) if profile else None)


def test_its_image_is_that_of_the_beam_it_was_sampled_from():
    screen, waist, behind = Screen((9.0, 9.0), THROW, (60, 60)), (0.5, 0.4), -800.0
    far = THROW - THIN + THIN / 1.5 - behind
    close(image(scene_of(sampled(waist, behind), SIZE, screen), finer=2.0), gaussian(screen, [radius(w, far) for w in waist]), 1e-3)


def test_a_tilt_of_its_phase_moves_it():
    screen, sine = Screen((9.0, 9.0), THROW, (60, 60)), 1e-3
    far = THROW - THIN + THIN / 1.5 + 800.0
    wide = [radius(w, far) for w in (0.5, 0.4)]
    aside = (THROW - THIN + THIN / 1.5) * sine
    close(image(scene_of(sampled(tilt=sine), SIZE, screen), finer=2.0), gaussian(screen, wide, (aside, 0.0)), 1e-3)


def test_its_rays_are_those_of_the_beam():
    pupil = Pupil(Aperture((0.5 * SIZE, 0.5 * SIZE)), 0.0)
    x, y = np.meshgrid(np.linspace(-2.9, 2.9, 20), np.linspace(-2.9, 2.9, 20), indexing="ij")
    found, exact = sampled().beam(x, y, pupil), Gaussian((0.5, 0.4), NM, -800.0).beam(x, y, pupil)
    for a, b in zip(found.directions[:2], exact.directions[:2], strict=True):
        assert np.abs(a - b).max() < 1e-6
    assert np.abs(found.path - found.path[10, 10] - exact.path + exact.path[10, 10]).max() < 1e-7
    of_tensors = sampled().beam(torch.from_numpy(x), torch.from_numpy(y), pupil)
    assert np.array_equal(of_tensors.directions[0].numpy(), found.directions[0])
    scene = scene_of(sampled(), SIZE, Screen((9.0, 9.0), THROW, (8, 8)))
    (rays,) = rays_of(scene, "sobol", 1 << 15, 0).chunks()
    assert float(rays.power.sum()) == pytest.approx(1.0, abs=1e-12)
    assert 2.0 * math.sqrt(float((rays.power * rays.origin[0] ** 2).sum())) == pytest.approx(radius(0.5, 800.0), rel=2e-3)


def test_light_through_the_aperture():
    flat, round_pupil = sampled(profile=False), Pupil(CircularAperture((3.0, 3.0)), 0.0)
    assert flat.passed(round_pupil) == 1.0
    assert sampled((1.0, 1.0), 0.0).passed(Pupil(Aperture((3.0, 3.0)), 0.0)) == pytest.approx(0.5 * math.pi / 36.0, rel=1e-3)
    aside = sampled((1.0, 1.0), 0.0).displaced(lambda p: (p[0] + 0.5, p[1], p[2]), 1.0)
    at = aside.irradiance(np.array([0.5, 0.0]), np.array([0.0, 0.0]), Pupil(Aperture((3.0, 3.0)), 0.0))
    assert at == pytest.approx([1.0, math.exp(-0.5)], abs=2e-3)


def test_what_is_no_phase_is_refused():
    for phase, words in (
        (np.zeros((3, 8)), "4 values or more"),
        (np.full((8, 8), np.nan), "finite"),
        (np.angle(np.exp(1j * sampled(tilt=0.02).phase)), "wrapped"),
    ):
        with pytest.raises(InputError, match=words):
            MeasuredBeam(phase, NM)


def test_on_the_command_line(tmp_path, monkeypatch, capfd):
    """Designed for its own curvature, by rays; the project keeps the files, and a plane wave makes another picture."""
    monkeypatch.chdir(tmp_path)
    np.save("square.npy", np.pad(np.ones((6, 6)), 1))
    beam = sampled((2.0, 2.0), -4000.0, 80)
    np.save("phase.npy", beam.phase)
    np.save("light.npy", beam.profile)
    of = ["--source", "measured", "--source-phase", "phase.npy", "--source-file", "light.npy", "--wavelengths", "1064"]
    small = [
        "--linear",
        "--resolution",
        "24",
        "--lens-size",
        "6",
        "--control",
        "40",
        "--rays",
        "40000",
        "--throw",
        "400",
        "--mag",
        "1",
    ]
    quick = ["--quiet", "--waves", "off", "--threads", "1"]
    assert cli.run(["design", "square.npy", *of, *small, *quick, "--json"]) == 0
    found = json.loads(capfd.readouterr().out)
    assert found["relative_rms"] < 0.3 and found["on_target"] > 0.85
    settings = tomllib.loads((tmp_path / "square.caustic" / "project.toml").read_text())["source"]
    assert settings["type"] == "measured" and np.array_equal(
        np.load(tmp_path / "square.caustic" / settings["phase_file"]), beam.phase
    )
    assert (
        cli.run(["render", "square.caustic", "--source", "plane", "--source-file", "light.npy", "--quiet", "--json", "-o", "p.png"])
        == 0
    )
    assert json.loads(capfd.readouterr().out)["relative_rms"] > 1.5 * found["relative_rms"]
    for wrong, words in (
        (["--source", "measured", "--wavelengths", "1064"], "needs --source-phase"),
        ([*of[:-2]], "needs one of --wavelengths"),
        (["--source", "plane", "--source-phase", "phase.npy"], "--source-phase belongs to --source measured, got plane"),
        (["--source", "measured", "--source-phase", "square.txt", "--wavelengths", "1064"], "square.txt"),
        (["--source", "donut"], "--source plane with --source-file, a picture of its irradiance"),
    ):
        assert cli.run(["design", "square.npy", *wrong, *small, *quick, "-o", "x.caustic"]) == 2
        said = capfd.readouterr().err
        assert words in said and said.count("\n") == 1
    assert cli.run(["export", "square.caustic", "--format", "mitsuba", "-o", "lens.xml", "--quiet"]) == 2
    assert "its emitters have no wavefront, so the beam of a laser cannot be written" in capfd.readouterr().err
