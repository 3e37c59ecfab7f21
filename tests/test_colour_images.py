"""Images in the colours of the CIE 1931 observer: what is traced, propagated, shown and written of light with a spectrum."""

from __future__ import annotations

import json
from dataclasses import replace
from functools import partial
from pathlib import Path

import matplotlib.figure
import numpy as np
import pytest
import torch
from PIL import Image

from caustic_cli import cli, load
from caustic_cli.io.archive import open_archive
from caustic_cli.io.picture import codes_of, to_srgb
from caustic_cli.optics.emission import of_member, rays_of
from caustic_cli.optics.image import Image as Traced
from caustic_cli.optics.surfaces import HeightField
from caustic_cli.optics.trace import expose
from caustic_cli.optics.waves.image import lines_of, wave_image
from caustic_cli.scene import Lens, Light, Points, Scene, Screen
from caustic_cli.scene.sources.several import light_of_all, together
from caustic_cli.scene.spectrum import BUILT_IN, measure_of, tristimulus, white_point
from caustic_cli.studies.design_report import write_report
from caustic_cli.studies.irradiance import irradiance
from caustic_cli.studies.viewing import as_viewed, in_colour, tristimulus_values
from caustic_cli.workflow import movie as movies
from caustic_cli.workflow.design import sphere

SMALL = ["--lens-size", "2", "--throw", "60", "--mag", "2", "--resolution", "32", "--control", "19", "--threads", "1"]


def lit_by(name: str, **more) -> Scene:
    """The default scene in the light of a spectrum."""
    return replace(sphere()[0], light=light_of_all({"type": "plane", "power": 1.0, "spectrum": name, **more}))


@pytest.fixture(scope="module")
def project(tmp_path_factory) -> Path:
    """A design for a white LED through a dispersive glass, with its film."""
    place = tmp_path_factory.mktemp("colour")
    x = np.linspace(-1.0, 1.0, 32)
    blob = np.exp(-8.0 * (x[:, None] ** 2 + (x[None, :] - 0.2) ** 2))
    Image.fromarray((255.0 * blob).astype(np.uint8)).save(place / "blob.png")
    options = ["--spectrum", "led-4000", "--glass", "N-SF11", "--waves", "on", "--quality", "draft", "--quiet"]
    shown = ["--movie", str(place / "film.gif"), "-o", str(place / "p")]
    assert cli.run(["design", str(place / "blob.png"), *SMALL, *options, *shown]) == 0
    return place / "p"


@pytest.mark.parametrize("name", BUILT_IN)
def test_the_colours_of_the_wavelengths_add_up_to_that_of_the_source(name):
    measure = measure_of(name)
    for count in (1, 5, 10):
        nodes, weights = measure.nodes(count)
        assert weights @ measure.colours_at(nodes) == pytest.approx(measure.white, abs=1e-12)
    assert measure.white == pytest.approx(white_point(measure.spectrum), rel=5e-3)  # of which 400 to 700 nm are nearly all
    narrow = measure.colours_at(np.arange(450.0, 650.0, 2.0))
    xyz = tristimulus(np.arange(450.0, 650.0, 2.0))
    np.testing.assert_allclose(narrow[1:-1], (xyz / xyz[:, 1:2])[1:-1], rtol=0.02, atol=0.02)


@pytest.mark.parametrize("name", ["daylight", "halogen", "led-3000", "sun"])
def test_a_screen_lit_by_the_source_is_white(name):
    """D65 above all: to 1 of 255 in each of sRGB's channels; and half of it is grey."""
    scene = lit_by(name)
    for part in (1.0, 0.5):
        lit = Traced(torch.full((4, 3), part, dtype=torch.float64), part, {})
        shown = codes_of(in_colour(scene, tristimulus_values(scene, lit), 1.0), 1.0, "srgb").astype(int)
        assert shown.shape == (3, 4, 3) and np.abs(shown - 255.0 * to_srgb(np.array(part))).max() <= 1


def test_light_has_a_colour_where_it_has_a_spectrum_and_an_eye_sees_it():
    assert lit_by("led-4000").white == pytest.approx(measure_of("led-4000").white)
    for light in (Light(), Light(None, (633.0,)), Light(None, (450.0, 550.0, 650.0)), lit_by("sun", detector="power").light):
        scene = replace(sphere()[0], light=light)
        assert scene.white is None and light.colours_of((500.0, 600.0)) == (None, None)
        lit = Traced(torch.ones(4, 3, dtype=torch.float64), 1.0, {})
        assert tristimulus_values(scene, lit) is None and as_viewed(scene, lit.image.numpy(), None)[0].shape == (4, 3)


def test_dispersion_spreads_the_colours():
    """A diverging lens sends blue light farther from the axis than red, as much as its indices say; all light together is white."""
    _, field, z = sphere()
    scene = lit_by("daylight")
    scene = replace(scene, lens=replace(scene.lens, glass="N-SF11"), screen=replace(scene.screen, size=(50.0, 50.0)))
    rays = rays_of(scene, "stratified", 100_000, 1)
    found = expose(scene, field, z, rays)
    assert found.xyz is not None
    np.testing.assert_allclose(found.xyz[1], found.image, rtol=0, atol=1e-15)
    total = found.xyz.sum((1, 2)).numpy()
    assert total / total[1] == pytest.approx(scene.white, rel=0.01)  # short wavelengths lose a little more at the surfaces
    x = (np.arange(scene.screen.resolution[0]) + 0.5) * scene.screen.pixel[0] - scene.screen.half_size[0]

    def radius(plane: np.ndarray) -> float:
        return float(np.sqrt((plane * (x[:, None] ** 2 + x[None, :] ** 2)).sum() / plane.sum()))

    large, luminous, small = map(radius, found.xyz.numpy())
    blue, *_, red = (radius(expose(band.scene, field, z, rays).image.numpy()) for band in scene.bands)
    assert red < large < luminous < small < blue


def test_a_wave_image_has_the_colours_of_its_lines(project):
    lens = load(project)
    found = wave_image(lens.scene, lens.field, lens.heights)
    assert found.xyz is not None
    np.testing.assert_allclose(found.xyz[1], found.image, rtol=0, atol=1e-15)
    blue = wave_image(lens.scene, lens.field, lens.heights, wavelengths=found.wavelengths[:1])
    assert blue.xyz is not None  # the only wavelength stands for all the light
    assert (blue.xyz.sum((1, 2)) / blue.xyz[1].sum()).numpy() == pytest.approx(lens.scene.white)
    whole = found.xyz.sum((1, 2)) / found.xyz[1].sum()
    assert whole.numpy() == pytest.approx(lens.scene.white, rel=0.02)
    ratio = (found.xyz[2] / found.image)[found.image > 0.2 * found.image.max()]
    assert float(ratio.std()) > 0.01  # fringes


def test_sources_keep_their_own_spectra():
    """Two lamps beside each other: each throws an image of its own colour, by rays and by waves."""
    tables = [{"type": "plane", "power": p, "spectrum": name} for p, name in ((1.0, "halogen"), (3.0, "led-6500"))]
    lights, whole = [light_of_all(one) for one in tables], light_of_all(tables[0] | {"also": tables[1:]})
    members = (Points(((-1.0, 0.0, -40.0),), (1.0,)), Points(((1.0, 0.0, -40.0),), (3.0,)))
    source = together(members, lights)
    lens = Lens((2.0, 2.0), control=(9, 9))
    scene, field = Scene(source, lens, Screen((12.0, 12.0), 60.0, (24, 24)), whole), HeightField.of(lens)
    whites = np.array([one.white for one in lights])
    lumens = [p * one.efficacy for p, one in zip((1.0, 3.0), lights, strict=True)]
    parts = np.array(lumens) / sum(lumens)  # of what an eye sees
    assert scene.white == pytest.approx(parts @ whites) and source.fractions == pytest.approx(parts)
    assert sum(w for w in whole.weights[5:]) == pytest.approx(lumens[1])
    lines = lines_of(scene, field)
    assert [line.wavelength for line in lines] == [w for one in lights for w in one.lines()[0]]
    assert [line.colour for line in lines] == [c for one in lights for c in one.colours_of(one.lines()[0])]
    z = torch.from_numpy(lens.offset.heights(*(c.numpy() for c in field.control_xy())))
    rays = rays_of(scene, "sobol", 20_000)
    found = expose(scene, field, z, rays)
    assert found.xyz is not None
    alone = [expose(one, field, z, of_member(rays, k)).image for k, one in enumerate(scene.by_source)]
    wanted = sum(f * torch.tensor(w)[:, None, None] * image for f, w, image in zip(parts, whites, alone, strict=True))
    torch.testing.assert_close(found.xyz, wanted, rtol=0, atol=1e-15)


def test_files_of_light_with_a_colour(project, tmp_path, capfd):
    """PNGs in colour, equal in brightness to those of the power alone; arrays of X, Y, Z; by power, grey and as ever."""
    capfd.readouterr()
    command = ["render", str(project), "--rays", "20000", "--effects", "dispersion,diffraction", "--json", "--quiet"]
    files = ["--npy", str(tmp_path / "seen.npy"), "-o", str(tmp_path / "seen.png")]
    assert cli.run([*command, *files]) == 0
    json.loads(capfd.readouterr().out)
    scene, target = load(project).scene, load(project).target
    for name in ("seen", "seen-wave"):
        xyz = np.load(tmp_path / f"{name}.npy")
        assert xyz.shape == (3, 32, 32) and xyz.dtype == np.float64
        with Image.open(tmp_path / f"{name}.png") as image:
            assert image.mode == "RGB" and image.size == (32, 32)
            shown = np.asarray(image)
        level = float(target.max() / target.sum() * xyz[1].sum())
        np.testing.assert_array_equal(shown, codes_of(in_colour(scene, xyz, level), level, "srgb"))
        assert np.ptp(shown.astype(int), axis=2).max() > 3  # there are colours
    other = ["--npy", str(tmp_path / "power.npy"), "-o", str(tmp_path / "power.png"), "--detector", "power"]
    assert cli.run([*command, *other]) == 0
    assert np.load(tmp_path / "power.npy").shape == (32, 32)
    with Image.open(tmp_path / "power-wave.png") as image:
        assert image.mode == "L"
    seen = load(project).render(2e4, effects="dispersion")
    image, _ = seen
    np.testing.assert_allclose(seen.xyz[1], image, rtol=0, atol=1e-15)


def test_an_archive_has_the_colours_of_its_project(project, tmp_path):
    assert cli.run(["export", str(project), "--format", "lighttools", "-o", str(tmp_path / "lens.npz"), "--quiet"]) == 0
    assert open_archive(tmp_path / "lens.npz")[0].white == pytest.approx(load(project).scene.white)


def test_a_film_is_in_colour_from_its_first_frame(project, monkeypatch):
    with Image.open(project.parent / "film.gif") as film, Image.open(project / "wave.png") as last:
        film.seek(film.n_frames - 1)
        end = np.asarray(film.convert("RGB").crop((0, 0, 480, 480)).resize((32, 32), Image.Resampling.BOX)).astype(int)
        final = np.asarray(last.resize((480, 480), Image.Resampling.BILINEAR).resize((32, 32), Image.Resampling.BOX)).astype(int)
    assert last.mode == "RGB" and np.abs(end - final).mean() < 4  # a palette of 256 colours
    scene, target = load(project).scene, load(project).target
    film = movies.Movie(project.parent / "other.gif")
    film.begin(scene)
    film._target = target
    film._add(target, "grey", "light")
    film._add(np.stack([2.0 * target, target, 0.1 * target]), "red", "light")
    grey, red = (frame.codes.astype(int) for frame in film.frames)
    assert np.ptp(grey, axis=2).max() <= 1 and (red[..., 0] - red[..., 2])[(grey[..., 0] > 60) & (grey[..., 0] < 160)].min() > 40


def test_a_report_is_in_colour(project, tmp_path, monkeypatch):
    """The images by rays and by waves are drawn in colour over their grey ones, whose scale stays; the target is white."""
    drawn = []
    monkeypatch.setattr(matplotlib.figure.Figure, "savefig", lambda figure, *_, **__: drawn.append(figure))
    lens = load(project)
    traced = lens.render(2e4, effects="dispersion")
    shown = irradiance(traced.xyz, lens.scene.screen)
    figures = {**traced.figures, "lost": {}}
    write_report(
        tmp_path / "r.png",
        lens.target,
        traced.image,
        np.zeros((9, 9)),
        np.zeros((0, 5)),
        lens.scene.lens,
        lens.scene.screen,
        figures,
        "srgb",
        colours=[partial(in_colour, lens.scene, shown), None],
    )
    (figure,) = drawn
    panels = {axis.get_title().splitlines()[0]: axis for axis in figure.axes}
    assert len(panels["target"].get_images()) == 1
    grey, rgb = panels["caustic"].get_images()
    assert rgb.get_array().shape == (32, 32, 3) and grey.get_array().shape == (32, 32)
    luminance = np.asarray(rgb.get_array())[::-1].mean(2)
    assert (
        np.corrcoef(luminance.ravel(), to_srgb(np.clip(np.asarray(grey.get_array()) / grey.norm.vmax, 0, 1)).ravel())[0, 1] > 0.98
    )
