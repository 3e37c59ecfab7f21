"""Coloured pictures: powers of three wavelengths that look like them, images written back, and the colour error that is said."""

import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from oracle import colour_science
from PIL import Image

from caustic_cli import cli, load
from caustic_cli.errors import InputError
from caustic_cli.inverse.designer import State
from caustic_cli.io.colorimetry import D65, XYZ_OF_RGB, mean_color_difference, mixture
from caustic_cli.io.picture import codes_of, read_picture, write_image
from caustic_cli.project import colours
from caustic_cli.project.project import Project
from caustic_cli.scene import Lens, Light, Offset, PlaneWave, Scene, Screen
from caustic_cli.scene.light import RGB
from caustic_cli.scene.spectrum import primaries
from caustic_cli.studies.color_error import color_figures, shown
from caustic_cli.studies.viewing import as_viewed
from caustic_cli.workflow.movie import Movie

LASERS = (638.0, 520.0, 450.0)
#: Three wavelengths that mix no white.
REDDISH = (700.0, 600.0, 500.0)
TINY = ["--resolution", "24", "--control", "12", "--rays", "4000", "--quiet", "--threads", "1"]
TINY += ["--lens-size", "3", "--throw", "90"]


@pytest.fixture(scope="module")
def codes() -> np.ndarray:
    """(24, 20, 3) uint8: the corners of the cube of sRGB, greys, and colours between."""
    rng = np.random.default_rng(3)
    found = rng.integers(0, 256, (24, 20, 3), dtype=np.uint8)
    found[0, :8] = [[255 * (k >> c & 1) for c in range(3)] for k in range(8)]
    found[1] = np.linspace(0, 255, 20, dtype=np.uint8)[:, None]
    return found


@pytest.fixture
def picture(codes, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Image.fromarray(codes).save("rgb.png")
    return read_picture("rgb.png", color=True)


def scene_of(light: Light, pixels: tuple[int, int] = (20, 24)) -> Scene:
    return Scene(PlaneWave(), Lens((10.0, 10.0), offset=Offset(3.0), glass="N-BK7"), Screen((20.0, 24.0), 200.0, pixels), light)


def xyz_of(powers: np.ndarray, light: Light) -> np.ndarray:
    return np.tensordot(light.primaries, powers, 1)


def run(capfd, *arguments, code=0):
    assert cli.run([*map(str, arguments), "--json"]) == code
    out, err = capfd.readouterr()
    return json.loads(out) if code == 0 else err.strip()


def test_the_matrix_is_that_of_the_observer():
    theirs = colour_science().MSDS_CMFS["CIE 1931 2 Degree Standard Observer"]
    np.testing.assert_allclose(primaries((610.0, 549.0, 464.0)), np.stack([theirs[w] for w in (610, 549, 464)], 1), rtol=1e-12)
    np.testing.assert_allclose(primaries((611.5, 549.0, 464.0))[:, 0], 0.5 * (theirs[611] + theirs[612]), rtol=1e-12)


def test_powers_have_the_tristimulus_values_of_the_picture(codes, picture):
    """By the oracle's conversion of sRGB, and by its observer."""
    colour = colour_science()
    theirs = np.moveaxis(colour.sRGB_to_XYZ(codes / 255.0)[::-1], (0, 1), (2, 1))
    light = Light(wavelengths=RGB, color=True)
    powers = colours.powers(picture.irradiance(), light)
    observer = np.array([colour.wavelength_to_XYZ(w) for w in RGB]).T
    assert powers.shape == (3, 20, 24) and powers.min() >= 0.0
    np.testing.assert_allclose(np.tensordot(observer, powers, 1), theirs, atol=2e-3)  # its matrix of sRGB is rounded
    np.testing.assert_allclose(xyz_of(powers, light), np.tensordot(XYZ_OF_RGB, picture.irradiance(), 1), atol=1e-12)


@pytest.mark.parametrize("wavelengths", [LASERS, REDDISH, (600.0, 550.0, 500.0), (620.0, 540.0, 460.0)])
def test_colours_beyond_the_wavelengths_keep_their_luminance(picture, wavelengths):
    light = Light(wavelengths=wavelengths, color=True)
    rgb = picture.irradiance()
    powers, moved = mixture(rgb, light.primaries)
    exact = np.linalg.solve(light.primaries, np.tensordot(XYZ_OF_RGB, rgb, 1).reshape(3, -1)).reshape(powers.shape)
    assert powers.min() >= 0.0 and np.array_equal(moved, (exact < -1e-9).any(0))
    np.testing.assert_allclose(
        np.tensordot(light.primaries[1], powers, 1), np.tensordot(XYZ_OF_RGB[1], rgb, 1), rtol=1e-9, atol=1e-12
    )
    np.testing.assert_allclose(powers[:, ~moved], exact[:, ~moved], rtol=1e-6, atol=1e-12)
    if moved.any():  # no further than necessary: one light is out
        assert (powers[:, moved].min(0) <= 1e-9 * powers[:, moved].max(0)).all()
        assert f"cannot mix the colours of {moved.mean():.2%} of the picture" in colours.beyond_words(picture, light)
    assert moved.any() == (wavelengths != (620.0, 540.0, 460.0))


def test_the_default_wavelengths_mix_every_colour_of_srgb(picture):
    assert colours.beyond_words(picture, Light(wavelengths=RGB, color=True)) == ""


@pytest.mark.parametrize("wavelengths", [(550.0,) * 3, (550.0, 550.0, 460.0), (620.0, 600.0, 580.0), (900.0, 550.0, 460.0)])
def test_wavelengths_that_mix_no_picture_are_refused(picture, capfd, wavelengths):
    with pytest.raises(InputError, match="mix too few colours"):
        Light(wavelengths=wavelengths, color=True)
    said = run(capfd, "design", "rgb.png", "--color", "--wavelengths", ",".join(map(str, wavelengths)), *TINY, code=2)
    assert "--wavelengths" in said and "mix too few colours" in said and len(said.splitlines()) == 1


def test_pictures_without_colours_are_refused(tmp_path, capfd, monkeypatch):
    monkeypatch.chdir(tmp_path)
    said = run(capfd, "design", "disc", "--color", *TINY, code=2)
    assert "disc: has no colours" in said and len(said.splitlines()) == 1


@pytest.mark.parametrize("wavelengths", [RGB, LASERS, REDDISH])
@pytest.mark.parametrize("encoding", ["srgb", "linear"])
def test_a_perfect_image_is_the_picture(codes, picture, tmp_path, wavelengths, encoding):
    """On a screen whose pixels are the picture's, at any power: no colour error, and the same codes to 1 of 255."""
    picture = replace(picture, encoding=encoding)
    light = Light(wavelengths=wavelengths, color=True)
    target = colours.powers(picture.irradiance(), light)
    image = 0.37 / target.sum() * target
    assert color_figures(scene_of(light), image, target)["ciede2000"] < 1e-6
    write_image(tmp_path / "out.png", *as_viewed(scene_of(light), image, target), encoding)
    with Image.open(tmp_path / "out.png") as file:
        back = np.asarray(file).astype(int)
    moved = mixture(picture.irradiance(), light.primaries)[1].T[::-1]
    assert np.abs(back - codes)[~moved].max() <= 1
    assert np.array_equal(
        codes_of(shown(light, image, None), 1.0, encoding), codes_of(shown(light, 2 * image, None), 1.0, encoding)
    )


def test_a_movie_shows_the_colours(codes, picture, tmp_path):
    light = Light(wavelengths=RGB, color=True)
    target = colours.powers(picture.irradiance(), light)
    movie = Movie(tmp_path / "a.gif")
    movie.begin(scene_of(light))
    state = State(stage=0, heights=torch.zeros(2, 2), history=[(1, 0, 0.0, 1.0, 0.0)], image=torch.from_numpy(0.2 * target))
    movie.record(state, target, "srgb", False)
    assert np.abs(movie.frames[0].codes.astype(int) - codes).max() <= 1


def test_the_colour_error_is_over_the_picture_at_its_luminance(picture):
    """A dark margin does not count, brightness does not, an unlit channel does; by the oracle's formula."""
    colour, light = colour_science(), Light(wavelengths=RGB, color=True)
    target = colours.powers(picture.irradiance(), light)
    image = target[:, ::-1] + 0.1 * target.mean()
    found = color_figures(scene_of(light), image, target)["ciede2000"]
    own, goal = (np.moveaxis(xyz_of(a, light), 0, -1) for a in (image, target))
    own = own * (goal[..., 1].sum() / own[..., 1].sum())
    lab = [colour.XYZ_to_Lab(xyz, colour.XYZ_to_xy(D65)) for xyz in (own, goal)]
    assert found == pytest.approx(colour.difference.delta_E_CIE2000(*lab).mean(), rel=1e-6)
    wide = [np.pad(a, ((0, 0), (5, 5), (4, 4))) for a in (image, target)]
    assert color_figures(scene_of(light, (30, 32)), *wide)["ciede2000"] == pytest.approx(found, rel=1e-9)
    assert color_figures(scene_of(light), 9.0 * image, target)["ciede2000"] == pytest.approx(found, rel=1e-9)
    assert color_figures(scene_of(light), target * [[[1]], [[1]], [[0]]], target)["ciede2000"] > 5.0
    assert color_figures(scene_of(light), 0.0 * image, target) == color_figures(scene_of(light), image, None) == {"ciede2000": None}
    assert color_figures(scene_of(Light()), image[0], target[0]) == {}


def test_weights_follow_from_the_picture(picture, capfd):
    """With them light that is spread like the picture's luminance has its mean colour; given ones are kept, at a cost."""
    own = colours.filled({}, picture)
    assert own["wavelengths"] == list(RGB) and sum(own["weights"]) == pytest.approx(1.0)
    mean = np.tensordot(XYZ_OF_RGB, picture.irradiance().mean((1, 2)), 1)
    mixed = primaries(RGB) @ own["weights"]
    np.testing.assert_allclose(mixed / mixed.sum(), mean / mean.sum(), rtol=1e-9)
    assert colours.filled({"weights": [1.0, 2.0, 3.0]}, picture)["weights"] == [1.0, 2.0, 3.0]
    assert colours.filled({"wavelengths": list(LASERS), "weights": []}, picture)["weights"] != own["weights"]


@pytest.mark.slow
def test_a_design_in_colour(picture, capfd):
    """Figures by rays and by waves; interrupted and resumed gives the same; a render goes by its own wavelengths and weights."""
    figures = run(capfd, "design", "rgb.png", "--color", *TINY, "--iterations", "4", "-o", "whole.caustic")
    assert 0.0 < figures["ciede2000"] < 60.0
    run(capfd, "design", "rgb.png", "--color", *TINY, "--iterations", "2", "-o", "parts.caustic")
    resumed = run(capfd, "design", "--resume", "parts.caustic", "--iterations", "4", "--quiet", "--threads", "1")
    assert resumed["ciede2000"] == figures["ciede2000"]
    whole, parts = (Path(f"{name}.caustic") for name in ("whole", "parts"))
    for name in ("project.toml", "render.png"):
        assert (whole / name).read_bytes() == (parts / name).read_bytes()
    assert Project.open(whole).settings.source.weights == tuple(colours.filled({}, picture)["weights"])

    def render(*light: str) -> dict:
        return run(capfd, "render", whole, "--rays", "20000", *light, "-o", "out.png", "--force", "--quiet")

    assert cli.run(["render", str(whole), "--rays", "20000", "-o", "out.png", "--quiet"]) == 0
    assert "mean CIEDE2000" in capfd.readouterr().out
    own = render()
    assert 0.0 < own["wave_ciede2000"] < 60.0
    with Image.open("out.png") as rays, Image.open("out-wave.png") as waves:
        assert rays.mode == waves.mode == "RGB"
    lasers = render("--wavelengths", "638,520,450")
    assert lasers["ciede2000"] == pytest.approx(own["ciede2000"], rel=0.1)  # their weights follow from the picture, too
    assert render("--wavelengths", "611.4:1,549.1:1,464.3:4")["ciede2000"] > own["ciede2000"] + 5.0


def test_a_project_without_weights_opens(picture, capfd):
    """As written by hand: they follow from the picture, as for other wavelengths from the library."""
    run(capfd, "design", "rgb.png", "--color", *TINY, "--iterations", "1")
    path = Path("rgb.caustic/project.toml")
    before = Project.open("rgb.caustic").scene().light
    other = load("rgb.caustic", wavelengths=list(LASERS)).scene.light
    assert list(other.weights) == colours.filled({"wavelengths": list(LASERS)}, picture)["weights"]
    path.write_text(re.sub(r"(?ms)^weights = \[.*?\][^\n]*\n", "", path.read_text()))
    assert "weights" not in path.read_text()
    assert Project.open("rgb.caustic").scene().light == before


def test_floating_point_colours_have_their_brightest_as_white(picture, tmp_path):
    rgb = picture.irradiance()
    np.save("rgb.npy", 7.0 * rgb)
    np.testing.assert_allclose(read_picture("rgb.npy", color=True).irradiance(), rgb, rtol=1e-12)
    assert mean_color_difference(*(np.tensordot(XYZ_OF_RGB, a, 1) for a in (rgb, rgb)), D65) == 0.0
