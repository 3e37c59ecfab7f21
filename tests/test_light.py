"""The spectrum of a scene's light: wavelengths and weights of rays and waves, watts and lumens, and what commands say of them."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from caustic_cli import cli, load
from caustic_cli.commands.figures import figures_rows
from caustic_cli.effort import EFFORTS
from caustic_cli.errors import InputError
from caustic_cli.io.archive import open_archive
from caustic_cli.optics.waves.image import wave_image
from caustic_cli.project.project import Project
from caustic_cli.scene import Light
from caustic_cli.scene.light import RAY_NODES, WAVE_NODES
from caustic_cli.scene.materials import refractive_index
from caustic_cli.scene.sources.several import light_of_all
from caustic_cli.scene.spectrum import BUILT_IN, built_in, luminous_efficacy, luminous_efficiency, measure_of
from caustic_cli.studies.metrics import relative_rms

SMALL = ["--lens-size", "2", "--throw", "60", "--mag", "2", "--resolution", "32", "--control", "19", "--threads", "1"]


@pytest.fixture
def _here(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    x = np.linspace(-1.0, 1.0, 32)
    blob = np.exp(-8.0 * (x[:, None] ** 2 + (x[None, :] - 0.2) ** 2))
    Image.fromarray((255.0 * blob).astype(np.uint8)).save("blob.png")


def designed(*options: str) -> None:
    assert cli.run(["design", "blob.png", *SMALL, "--waves", "off", "--iterations", "1", "--quiet", *options]) == 0


def table(**given) -> dict:
    return {"type": "plane", "power": 1.0, **given}


def test_white_light_is_what_an_eye_sees():
    for light in (Light(), light_of_all(table()), light_of_all(table(spectrum="equal")), light_of_all(table(detector="eye"))):
        wavelengths, parts = light.lines()
        assert len(wavelengths) == WAVE_NODES and sum(parts) == pytest.approx(1.0)
        fine = np.linspace(400.0, 700.0, 300_001)
        seen = luminous_efficiency(fine)
        assert np.dot(wavelengths, parts) == pytest.approx((fine * seen).sum() / seen.sum(), abs=1.0)
        assert light.mean == pytest.approx((fine * seen).sum() / seen.sum(), abs=1e-3)


@pytest.mark.parametrize("name", BUILT_IN)
def test_a_verdict_is_at_other_wavelengths_than_a_design(name):
    """More than 2 nm away from those of every quality."""
    judged = measure_of(name).nodes(WAVE_NODES)[0]
    for quality in ("draft", "standard", "fine"):
        for count, _ in EFFORTS[quality].waves:
            designed = measure_of(name).nodes(count)[0]
            assert np.abs(judged[:, None] - designed).min() >= 2.0


def test_wavelengths_of_a_stage_have_their_share_of_the_spectrum():
    nodes, weights = measure_of("led-4000").rule(5)
    assert light_of_all(table(spectrum="led-4000")).lines(nodes)[1] == pytest.approx(weights, abs=1e-9)
    assert light_of_all(table(spectrum="led-4000")).lines(nodes[::-1])[1] == pytest.approx(weights[::-1], abs=1e-9)
    assert Light(None, (500.0, 600.0), (1.0, 3.0)).lines((450.0, 550.0)) == ((450.0, 550.0), (0.5, 0.5))


def test_equal_power_is_that_of_earlier_versions():
    """450 to 650 nm, uniform: midpoints of six equal parts have the same mean and nearly the same spread."""
    measure = light_of_all(table(spectrum="equal", detector="power")).continuum
    assert measure.range == (450.0, 650.0) and measure.mean == pytest.approx(550.0)
    assert measure.spread == pytest.approx(200.0 / 12.0**0.5)


def test_lines_are_measured_by_power_unless_the_eye_is_asked_for():
    green, blue = luminous_efficiency(np.array([550.0, 450.0]))
    lines = {"wavelengths": [550.0, 450.0], "weights": [1.0, 2.0]}
    assert light_of_all(table(**lines)).fractions == pytest.approx((1 / 3, 2 / 3))
    eye = pytest.approx((green / (green + 2 * blue), 2 * blue / (green + 2 * blue)))
    assert light_of_all(table(**lines, detector="eye")).fractions == eye
    assert light_of_all(table(**lines, power_unit="lm")).fractions == eye
    assert light_of_all(table(**lines, power_unit="lm", detector="power")).fractions == pytest.approx((1 / 3, 2 / 3))
    assert light_of_all(table(**lines)).efficacy == pytest.approx(683.0 * (green + 2 * blue) / 3)
    assert light_of_all(table(**lines)).continuum is None


def test_lumens_of_several_sources():
    one, other = ({"spectrum": "led-3000"}, {"spectrum": "sun"})
    e, f = (luminous_efficacy(built_in(x["spectrum"])) for x in (one, other))
    both = table(**one, also=[table(**other) | {"power": 3.0}])
    assert light_of_all(both).efficacy == pytest.approx((e + 3 * f) / 4)
    assert light_of_all(both | {"power_unit": "lm"}).efficacy == pytest.approx(4 / (1 / e + 3 / f))
    assert light_of_all(table(**one, also=[table()])).efficacy is None


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--spectrum", "led"], "'led' is no spectrum"),
        (["--spectrum", "none.csv"], "none.csv: no such file"),
        (["--spectrum", "negative.csv"], "negative.csv: line 2 is '500,-1'; finite numbers are needed"),
        (["--spectrum", "long.csv"], "long.csv: has more than 10,000 wavelengths"),
        (["--spectrum", "infrared.csv"], "has no power that the eye sees, 400 to 700 nm"),
        (["--spectrum", "led-4000", "--wavelengths", "500:2,600"], "--wavelengths follow from --spectrum: give one of them"),
        (["--spectrum", "sun", "--color"], "--spectrum is not for a coloured picture"),
        (["--detector", "ear"], "--detector must be one of eye, power, got 'ear'"),
        (["--wavelengths", "1200", "--detector", "eye"], "the eye sees none of them; --detector power"),
    ],
)
def test_refused_in_a_line(_here, capfd, options, message):
    Path("negative.csv").write_text("400,1\n500,-1\n")
    Path("long.csv").write_text("".join(f"{400 + k / 1e4},1\n" for k in range(200_000)))
    Path("infrared.csv").write_text("800,1\n900,1\n")
    assert cli.run(["design", "blob.png", *SMALL, *options, "-o", "x"]) == 2
    said = capfd.readouterr().err.strip().splitlines()
    assert len(said) == 1 and message in said[0] and not Path("x").exists()


def test_watts_and_lumens_side_by_side(_here, capfd):
    options = ["--power", "5W", "--spectrum", "led-4000", "--waves", "off", "--iterations", "2", "--json", "--quiet"]
    assert cli.run(["design", "blob.png", *SMALL, *options, "-o", "lamp"]) == 0
    found = json.loads(capfd.readouterr().out)
    each = luminous_efficacy(built_in("led-4000"))
    assert (found["radiant_flux"], found["luminous_flux"]) == pytest.approx((5.0, 5.0 * each))
    rows = dict(figures_rows(found))
    assert rows["power of the source"].startswith("5 W, 1584 lm (316.9 lm/W)")
    assert (
        rows["illuminance"].startswith(f"peak {1e6 * each * found['peak_irradiance']:.4g} lux") and "W/mm^2" in rows["irradiance"]
    )
    assert cli.run(["render", "lamp", "--power", "1000lm", "--rays", "4000", "--json", "--quiet"]) == 0
    bright = json.loads(capfd.readouterr().out)
    assert (bright["radiant_flux"], bright["luminous_flux"]) == pytest.approx((1000.0 / each, 1000.0))
    assert bright["mean_irradiance"] == pytest.approx(1e6 * each * found["mean_irradiance"] * 1000.0 / (5.0 * each), rel=0.02)


def test_a_spectrum_stays_with_its_project_and_archive(_here, capfd):
    Path("lamp.csv").write_text("nm,power\n450,0\n500,1\n600,3\n650,0\n")
    designed("--spectrum", "lamp.csv", "--glass", "N-BK7", "-o", "lamp")
    Path("lamp.csv").unlink()
    assert 'spectrum = "spectrum.csv"' in Path("lamp/project.toml").read_text()
    assert cli.run(["export", "lamp", "--format", "lighttools", "-o", "lamp.npz", "--quiet"]) == 0
    scene = open_archive("lamp.npz")[0]
    whole = scene.light.continuum
    assert whole.spectrum.wavelengths.tolist() == [450.0, 500.0, 600.0, 650.0] and whole.detector == "eye"
    assert len(scene.light.wavelengths) == RAY_NODES and scene.dispersive
    assert scene.light.efficacy == pytest.approx(luminous_efficacy(whole.spectrum))
    capfd.readouterr()
    assert cli.run(["render", "lamp", "--spectrum", "sun", "--rays", "4000", "--effects", "diffraction", "--json", "--quiet"]) == 0
    found = json.loads(capfd.readouterr().out)
    assert (found["wave_spectrum"], found["wave_detector"]) == ("sun", "eye")
    assert found["wave_wavelengths"] == pytest.approx(measure_of("sun").rule(WAVE_NODES)[0])


def test_a_glass_known_in_part_of_the_spectrum(_here):
    """Beyond its range the index is that at its end; spectral lines there are refused."""
    designed("--spectrum", "sun", "--detector", "power", "--glass", "NOA61", "-o", "p")
    scene = Project.open("p").scene()
    shortest = min(scene.light.wavelengths)
    assert shortest < 450.0 and scene.at(shortest).lens.index == refractive_index("NOA61", 450.0)
    with pytest.raises(InputError, match="must be 450 to"):
        replace(scene, light=Light(None, (shortest,)))


def test_a_verdict_says_the_error_of_its_wavelengths(_here, capfd):
    """A third of the mean excess of either half of them; spectral lines have none."""
    designed("--spectrum", "daylight", "-o", "p")
    lens = load("p")
    found = wave_image(lens.scene, lens.field, lens.heights)
    first, second = found.halves
    torch.testing.assert_close(first + second, found.image, rtol=0, atol=1e-15)
    alone = wave_image(lens.scene, lens.field, lens.heights, wavelengths=found.wavelengths[::2])
    assert alone.image.sum() > 0 and first.sum() / found.image.sum() == pytest.approx(0.5, abs=0.1)
    error = relative_rms(found.image.numpy(), lens.target)
    halves = [relative_rms(half.numpy(), lens.target) for half in found.halves]
    figures = lens.render_waves().figures
    assert figures["wave_spectral_error"] == pytest.approx(abs(sum(halves) / 2.0 - error) / 3.0, rel=1e-6)
    assert 0 < figures["wave_spectral_error"] < 0.05 * error
    capfd.readouterr()
    assert cli.run(["render", "p", "--rays", "4000", "--effects", "diffraction", "--json", "--quiet"]) == 0
    said = dict(figures_rows(json.loads(capfd.readouterr().out)))["relative RMS error"]
    assert said.endswith(f"± {figures['wave_spectral_error']:.1g} by their number")
    lines = replace(lens, scene=replace(lens.scene, light=Light(None, (500.0, 600.0)))).render_waves().figures
    assert lines["wave_spectral_error"] is None and lines["wave_spectrum"] is None


def test_a_verdict_at_the_lines_of_the_design_says_so(_here, capfd):
    options = ["--wavelengths", "450,500,550,600,650", "--waves", "on", "--json", "--quiet"]
    assert cli.run(["design", "blob.png", *SMALL, *options, "-o", "lines"]) == 0
    found = json.loads(capfd.readouterr().out)
    assert found["wave_spectrum"] is None and len(found["wave_unseen_wavelengths"]) == 10
    first = figures_rows(found)[0][1]
    assert "those of the design" in first and f"{found['wave_unseen_relative_rms']:.4f} at wavelengths 1 % beside" in first
