"""Effects on the command line and in project.toml: --explain, --effects, --study effects, mirrors, colours."""

import json
import math
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from caustic_cli import cli
from caustic_cli.config import settings
from caustic_cli.errors import InputError
from caustic_cli.inverse.losses import Loss
from caustic_cli.inverse.objective import Objective
from caustic_cli.inverse.schedule import LossImage
from caustic_cli.io.archive import open_archive
from caustic_cli.io.colorimetry import XYZ_OF_RGB
from caustic_cli.io.files import MARK, refuse_foreign
from caustic_cli.io.picture import read_picture
from caustic_cli.optics.effects import EFFECTS
from caustic_cli.optics.effects.mirror import Mirror
from caustic_cli.optics.emission import rays_of
from caustic_cli.optics.reconstruction import Filter
from caustic_cli.optics.surfaces.heightfield import HeightField
from caustic_cli.project.colours import powers
from caustic_cli.project.completion import complete
from caustic_cli.project.project import Project
from caustic_cli.scene import Lens, Light, Offset, PlaneWave, Scene, Screen
from caustic_cli.scene.gradient import Gradient
from caustic_cli.scene.light import RGB
from caustic_cli.scene.spectrum import primaries
from caustic_cli.studies import effects as study
from caustic_cli.workflow.outputs.base import Request

NAMES = tuple(effect.name for effect in EFFECTS)
# A lens of 3 mm: a wave image takes a tenth of the time of one of 10 mm.
TINY = ["--resolution", "24", "--control", "12", "--rays", "4000", "--quiet", "--threads", "1", "--iterations", "6"]
TINY += ["--lens-size", "3", "--throw", "90"]


@pytest.fixture(autouse=True)
def _here(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    y, x = np.mgrid[0:24, 0:24]
    blob = (40 + 200 * np.exp(-((x - 8) ** 2 + (y - 9) ** 2) / 30.0)).astype(np.uint8)
    Image.fromarray(blob).save("blob.png")
    Image.fromarray(np.stack([blob, blob // 2, blob[::-1]], -1)).save("rgb.png")


def run(capfd, *arguments, code=0):
    assert cli.run([*map(str, arguments), "--json"]) == code
    out, err = capfd.readouterr()
    return json.loads(out) if code == 0 else err.strip()


def test_explain_and_effects(capfd, tmp_path):
    run(capfd, "design", "blob.png", *TINY)
    plain = run(capfd, "render", "blob.caustic", "--rays", "4000", "--npy", "plain.npy", "--quiet")
    assert "effects" not in plain and plain["wave_relative_rms"] > 0 and plain["wave_wavelengths"]
    told = run(capfd, "render", "blob.caustic", "--rays", "4000", "--explain", "--quiet", "--npy", "told.npy")
    assert np.array_equal(np.load("plain.npy"), np.load("told.npy"))
    rows = {row["name"]: row for row in told["effects"]}
    assert tuple(rows) == NAMES
    assert {k for k, row in rows.items() if row["on"]} == {"fresnel", "diffraction"}
    for row in rows.values():
        assert set(row) == {"name", "on", "why", "bound", "limit", "cost_ms", "cost_ms_range", "error", "power"} and row["why"]
    least, most = rows["diffraction"]["cost_ms_range"]
    assert 0 < least == rows["diffraction"]["cost_ms"] < most
    assert rows["fresnel"]["power"] == pytest.approx(plain["lost"]["fresnel"], rel=0.02)
    for name in ("entrance", "intersection", "polarisation", "secondary-intersection", "total-reflection"):
        assert rows[name]["error"] < 1e-12, name
    assert 0 < rows["ghosts"]["bound"] < 0.01 and rows["ghosts"]["power"] < 0

    run(capfd, "render", "blob.caustic", "--rays", "4000", "--effects", "fresnel", "--npy", "same.npy", "--quiet")
    assert np.array_equal(np.load("plain.npy"), np.load("same.npy"))
    bare = run(capfd, "render", "blob.caustic", "--rays", "4000", "--effects", "none", "--quiet")
    assert bare["lost"]["fresnel"] == 0 and bare["on_screen"] > plain["on_screen"] + 0.05
    both = run(capfd, "render", "blob.caustic", "--rays", "4000", "--effects", "fresnel,ghosts", "--quiet")
    assert both["on_screen"] - plain["on_screen"] == pytest.approx(-rows["ghosts"]["power"], rel=0.2)
    message = run(capfd, "render", "blob.caustic", "--effects", "fresnell", code=2)
    assert message.startswith("caustic: --effects must be auto, none, or some of") and message.endswith("did you mean fresnel?")

    assert cli.run(["render", "blob.caustic", "--rays", "4000", "--explain", "--quiet"]) == 0
    out, err = capfd.readouterr()
    assert not err and "effect" in out and "normal incidence on a flat entrance bends nothing" in out


OPTIONS = {
    "absorption": (["--absorption", "0.05"], "absorbed"),
    "roughness": (["--roughness", "0.002"], None),
    "polarisation": (["--polarisation", "30"], None),
    "screen-tilt": (["--screen-tilt", "0,20"], None),
    "screen-shift": (["--screen-shift", "1,-2"], None),
    "source-size": (["--source-angle", "0.5"], None),
}


@pytest.mark.parametrize("name", OPTIONS)
def test_every_option_is_an_effect(capfd, name):
    """Given to render, and in a design: the effect is on, and project.toml keeps it."""
    options, loss = OPTIONS[name]
    run(capfd, "design", "blob.png", *TINY, "-o", "plain.caustic")
    found = run(capfd, "render", "plain.caustic", "--rays", "4000", *options, "--explain", "--quiet")
    row = next(r for r in found["effects"] if r["name"] == name)
    assert row["on"] and row["error"] + abs(row["power"]) > 1e-5
    assert loss is None or found["lost"][loss] > 0.05
    figures = run(capfd, "design", "blob.png", *TINY, *options, "-o", "own.caustic")
    again = run(capfd, "render", "own.caustic", "--rays", "4000", "--quiet")
    assert again["on_screen"] == pytest.approx(figures["on_screen"], abs=0.03)
    assert figures["on_screen"] + sum(figures["lost"].values()) == pytest.approx(1.0, abs=1e-9)
    assert loss is None or again["lost"][loss] > 0.05


def test_gradients_of_a_render_know_the_effects(capfd):
    """Forward mode through the steps: as central differences say."""
    run(capfd, "design", "blob.png", *TINY, "--absorption", "0.02", "--screen-tilt", "5,10", "--polarisation", "20")
    found = run(capfd, "gradmap", "blob.caustic", "--control", "2,3", "--rays", "4000", "--check", "--quiet")
    assert 0 < found["maps"][0]["check"]["relative_error"] < 1e-5


def test_a_design_for_a_shifted_screen_hits_it(capfd):
    figures = run(capfd, "design", "blob.png", *TINY, "--screen-shift", "1.8,-1.2")
    assert figures["on_target"] > 0.85 * (1 - figures["lost"]["fresnel"])


def test_a_mirror_is_designed_and_exported_as_one(capfd):
    figures = run(capfd, "design", "blob.png", "--mirror", *TINY)
    assert figures["on_screen"] > 0.98 and figures["lost"]["fresnel"] == 0
    toml = settings.read(Path("blob.caustic/project.toml"))
    assert toml["lens"]["mirror"] and toml["screen"]["z"] == -90.0
    lens = run(capfd, "design", "blob.png", *TINY, "-o", "lens.caustic")
    assert figures["relative_rms"] < 1.2 * lens["relative_rms"]
    run(capfd, "export", "blob.caustic", "-o", "mirror.npz")
    again = run(capfd, "render", "mirror.npz", "--rays", "20000", "--effects", "screen-shift")
    assert again["on_screen"] > 0.98 and again["lost"]["off_screen"] < 0.02
    for name in ("mirror.tif", "mirror-map.png"):
        said = run(capfd, "export", "blob.caustic", "--format", "heightmap", "-o", name)["heightmap"]
        begun = run(capfd, "design", "blob.png", "--mirror", *TINY, "--start", name, "--iterations", "1", "-o", f"{name}.caustic")
        assert said["turned"] and begun["start_relative_rms"] < 1.05 * figures["relative_rms"]
    assert "must lie before the mirror" in run(capfd, "render", "blob.caustic", "--screen-at", "20", code=2)
    check = run(capfd, "gradmap", "blob.caustic", "--control", "5,5", "--rays", "4000", "--check")["maps"][0]["check"]
    assert 0 < check["relative_error"] < 1e-4
    report = run(capfd, "render", "blob.caustic", "--rays", "4000", "--effects", "none", "--report", "--force")["report"]
    assert report["throw_error_of_a_pixel_mm"] > 0 and report["minimum_wall_mm"] is report["critical_angle_deg"] is None


def test_an_archive_keeps_glass_and_light(capfd):
    """What of them the scene has beyond clear glass and light of one wavelength: the image is the project's own, bit for bit."""
    glass = ("--glass", "N-BK7", "--absorption", "0.02", "--roughness", "0.01")
    run(capfd, "design", "blob.png", *TINY, *glass, "--wavelengths", "450:2,650", "--polarisation", "30")
    run(capfd, "export", "blob.caustic", "-o", "lens.npz")
    for source, image in (("blob.caustic", "a.npy"), ("lens.npz", "b.npy")):
        run(capfd, "render", source, "--rays", "4000", "--npy", image)
    assert (np.load("a.npy") == np.load("b.npy")).all()
    scene, light = open_archive("lens.npz")[0], Project.open("blob.caustic").scene().light
    assert scene.light.fractions == light.fractions and scene.light.wavelengths == light.wavelengths


def test_dispersion_of_a_glass_and_its_range(capfd):
    run(capfd, "design", "blob.png", "--glass", "N-SF11", *TINY)
    found = run(capfd, "render", "blob.caustic", "--rays", "4000", "--wavelengths", "450:2,550,650", "--explain", "--quiet")
    row = next(r for r in found["effects"] if r["name"] == "dispersion")
    assert row["on"] and row["error"] > 0.01 and "3 wavelengths in N-SF11" in row["why"]
    assert "370 to 2500 nm" in run(capfd, "render", "blob.caustic", "--wavelengths", "300,550", code=2)
    assert "--wavelengths must be" in run(capfd, "render", "blob.caustic", "--wavelengths", "red", code=2)


def test_a_coloured_target(capfd):
    figures = run(capfd, "design", "rgb.png", "--color", *TINY)
    project = Project.open("rgb.caustic")
    assert project.settings.source.wavelengths == tuple(RGB) and project.settings.lens.glass == "N-BK7"
    light = powers(project.picture.irradiance(), project.scene().light).sum((1, 2))  # not R, G, B: what looks like them
    assert project.settings.source.weights == pytest.approx(list(light / light.sum()))
    assert figures["on_screen"] + sum(figures["lost"].values()) == pytest.approx(1.0, abs=1e-9)
    run(capfd, "render", "rgb.caustic", "--rays", "4000", "--npy", "out.npy", "-o", "out.png", "--quiet")
    image = np.load("out.npy")
    assert image.shape == (3, 24, 24) and shown_as("out.png").shape == (24, 24, 3)
    np.testing.assert_allclose(image.sum((1, 2)), light / light.sum() * image.sum(), rtol=0.02)
    assert not np.allclose(image[0] / image[0].sum(), image[2] / image[2].sum(), rtol=1e-3, atol=0)
    shown = np.asarray(shown_as("out.png"), float)
    likeness = [np.corrcoef(shown[..., k][::-1].T.ravel(), image[0].ravel())[0, 1] for k in (0, 2)]
    assert likeness[0] > 0.8 and likeness[0] > likeness[1]
    assert "an array (3, n_x, n_y)" in run(capfd, "design", _flat(), "--color", *TINY, code=2)


def shown_as(path: str) -> np.ndarray:
    with Image.open(path) as image:
        return np.asarray(image)


def _flat() -> str:
    np.save("flat.npy", np.ones((8, 8)))
    return "flat.npy"


def test_colours_over_black(tmp_path):
    """Alpha weighs the light, not the code; colours stay in place; an opaque picture is kept code by code."""
    codes = np.zeros((2, 3, 4), np.uint8)
    codes[0, 0], codes[1, 2] = (255, 0, 0, 255), (0, 0, 200, 128)
    Image.fromarray(codes).save("a.png")
    light = read_picture("a.png", color=True).irradiance()
    assert light.shape == (3, 3, 2) and light[0, 0, 1] == 1.0
    assert light[2, 2, 0] == pytest.approx(((200 / 255 + 0.055) / 1.055) ** 2.4 * 128 / 255, rel=0.02)
    picture = read_picture("rgb.png", color=True)
    assert np.array_equal(picture.values, shown_as("rgb.png")) and picture.aspect == 1.0


def test_the_loss_of_colours_is_their_root_mean_square():
    """Value by the three losses apart, gradient by differences; a colour without light counts for nothing."""
    lens = Lens((10.0, 10.0), 0.0, 1.5168, (7, 7), (3, 3), offset=Offset(3.0), glass="N-SF11")
    light = Light(wavelengths=RGB, weights=(1.0, 2.0, 0.0), color=True)
    scene = Scene(PlaneWave(), lens, Screen((14.0, 14.0), 200.0, (10, 10)), light)
    field, g = HeightField.of(lens), torch.Generator().manual_seed(0)
    heights = 3.0 + 0.02 * torch.randn(7, 7, generator=g, dtype=torch.float64)
    target = torch.rand(3, 10, 10, generator=g, dtype=torch.float64)
    target[2] = 0.0
    how = LossImage(Filter("cosine", (3, 3)), apron=2, oversample=2, filter_target=False)
    made = Objective(scene, field, rays_of(scene, "lines", 900), target, "rms-light", how, dtype=torch.float64)
    apart = []
    for k, band in enumerate(scene.bands[:2]):
        one = Objective(band.scene, field, rays_of(band.scene, "lines", 900), target[k], "rms-light", how, dtype=torch.float64)
        assert isinstance(one.loss, Loss)
        apart.append(one(heights).loss)
    found = made(heights)
    assert found.loss == pytest.approx((sum(x * x for x in apart) / 2) ** 0.5, rel=1e-12)
    along = torch.randn(7, 7, generator=g, dtype=torch.float64)
    difference = (made(heights + 1e-6 * along).loss - made(heights - 1e-6 * along).loss) / 2e-6
    assert float((found.gradient * along).sum()) == pytest.approx(difference, rel=1e-5)


def test_the_study_of_effects(capfd, tmp_path):
    found = run(capfd, "convergence", "--study", "effects", "--rays", "1000", "--repeats", "1", "--quiet", "-o", "out")
    rows = {row["series"]: row for row in found["rows"]}
    assert set(NAMES) == set(rows)
    assert {name for name, row in rows.items() if row["on"]} == {"fresnel", "diffraction"}
    for name in ("absorption", "roughness", "dispersion", "screen-tilt", "screen-shift", "source-size", "mirror"):
        assert rows[name]["amount"] != "the scene's own" and rows[name]["error"] + abs(rows[name]["power"]) > 1e-7, name
    assert rows["entrance"]["error"] < 1e-12
    assert {p.suffix for p in (tmp_path / "out").iterdir()} == {".csv", ".json", ".png"}


def test_a_lens_of_many_indices_makes_no_mirror():
    """The study leaves out what the scene cannot have."""
    lens = Lens(control=(6, 6), gradient=Gradient("selfoc", (0.1,)))
    assert Mirror().probe(Scene(PlaneWave(), lens, Screen((20.0, 20.0))), torch.ones(6, 6)) is None


def test_a_lens_in_tilted_light_makes_a_mirror_whose_screen_faces_it():
    """The light of a flat one arrives at the middle of its screen, which stands square to it."""
    screen = Screen((20.0, 20.0), 100.0, tilt=(0.0, 45.0, 10.0), shift=(95.0, 0.0))
    made = Mirror().probe(Scene(PlaneWave(tilt=(0.0, 45.0)), Lens(control=(6, 6)), screen), torch.full((6, 6), 5.0))
    (x, _, z), normal = made.scene.screen.centre, made.scene.screen.axes[2]
    assert (x, z) == (95.0, -90.0) and normal == pytest.approx((-math.sqrt(0.5), 0.0, math.sqrt(0.5)))


def test_rounds_of_a_wave_image(monkeypatch):
    """As many as are asked for, and their least and most."""
    times = iter([0.0, 3.0, 10.0, 12.0, 20.0, 27.0])
    monkeypatch.setattr(study.time, "process_time", lambda: next(times))
    scene = Scene(
        PlaneWave(),
        Lens((1.0, 1.0), control=(6, 6), offset=Offset(1.0)),
        Screen((2.0, 2.0), 30.0, (8, 8)),
        Light(wavelengths=(550.0,)),
    )
    field = HeightField.of(scene.lens)
    heights = torch.full(field.shape, 1.0, dtype=torch.float64)
    found = study.measure_waves(study.compile_plan(scene, field, heights), field, heights, rays=1000, repeats=3)
    assert [found[k] for k in ("seconds", "seconds_min", "seconds_max", "whole")] == [2.0, 2.0, 7.0, 2.0] and found["error"] > 0


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"lens_absorption": -1.0}, "[lens] absorption must be 0 to 1e+06, got -1"),
        ({"lens_roughness": 2.0}, "[lens] roughness must be 0 to 1, got 2"),
        ({"source_weights": [1.0]}, "[source] weights must be one for each of the 0 wavelengths, got 1"),
        ({"source_polarisation": 1e9}, "[source] polarisation must be -360 to 360"),
        ({"screen_tilt": [190.0, 0.0]}, "[screen] tilt must be -180 to 180, got 190"),
        ({"target_color": True, "source_wavelengths": [500.0]}, "[source] wavelengths of a coloured picture are three"),
    ],
)
def test_bad_values_are_named(changes, message):
    full = complete({}, 1.0)
    for name, value in changes.items():
        section, _, key = name.partition("_")
        full = full.changed(**{section: getattr(full, section).changed(**{key: value})})
    with pytest.raises(InputError) as error:
        settings.build_scene(full)
    assert message in str(error.value)


def test_files_of_one_index_have_that_of_the_one_wavelength(capfd):
    """N-BK7 at 450 nm, not at the d line."""
    run(capfd, "design", "blob.png", *TINY, "--glass", "N-BK7", "--wavelengths", "450")
    for name in ("lens.npz", "lens.dat", "lens.xml"):
        run(capfd, "export", "blob.caustic", "-o", name)
    assert float(np.load("lens.npz")["refractive_index"]) == pytest.approx(1.52532, abs=1e-5)
    for name in ("lens.dat", "lens.xml"):
        text = Path(name).read_text()
        assert "1.5253" in text and "1.5168" not in text


def test_wavelengths_leave_a_coloured_picture_its_balance(capfd):
    run(capfd, "design", "rgb.png", "--color", "--wavelengths", "620,540,460", *TINY, "-o", "own.caustic")
    run(capfd, "design", "rgb.png", "--color", "--wavelengths", "620:1,540:1,460:1", *TINY, "-o", "even.caustic")
    own, even = (Project.open(f"{name}.caustic").scene().light for name in ("own", "even"))
    red, green, blue = own.fractions
    # R, G, B are 2 : 1 : 2, and these what looks like them; the sums of R, G, B themselves would not
    mean = XYZ_OF_RGB @ Project.open("own.caustic").picture.irradiance().mean((1, 2))
    mixed = primaries((620.0, 540.0, 460.0)) @ (red, green, blue)
    assert mixed / mixed.sum() == pytest.approx(mean / mean.sum(), rel=1e-9) and even.fractions == (1 / 3,) * 3


def test_a_configuration_says_how_the_picture_is_read(capfd):
    np.save("rgb.npy", np.random.default_rng(0).random((3, 24, 24)))
    Path("c.toml").write_text("[target]\ncolor = true\n")
    assert len(run(capfd, "design", "rgb.npy", "--config", "c.toml", *TINY)["lost"]) > 0


MIRROR = "mirror z=50 tilt=45,0"


@pytest.mark.parametrize(
    "options",
    [("--focus", "0,0,0"), ("--second", "rgb.png", "--second-at", "500", "--throw", "0"), ("--element", MIRROR, "--throw", "0")],
    ids=["focus", "second", "element"],
)
def test_no_distance_at_all_is_one_line(options, capfd):
    err = run(capfd, "design", "blob.png", *TINY, *options, code=2)
    assert "must lie behind" in err and "internal" not in err


def test_an_image_for_another_value_is_another(tmp_path):
    request = Request(tmp_path, at="throw=350")
    assert request.shows == {"at": "throw=350"} and Request(tmp_path).shows == {}


def test_what_a_project_is_made_of_is_no_output():
    Path("project.toml").touch()
    for name in ("second.png", "screen.npy", "index.npy", "tolerances.toml"):
        Path(name).write_bytes(MARK)
        with pytest.raises(InputError):
            refuse_foreign(Path(name))


def test_a_first_surface_that_changes_is_another_design(capfd):
    run(capfd, "design", "blob.png", *TINY, "-o", "first.caustic")
    heights = Project.open("first.caustic").load().state.heights.numpy()
    np.save("start.npy", heights)
    own = ("design", "blob.png", *TINY, "--start", "start.npy", "-o", "own.caustic")
    assert run(capfd, *own)["relative_rms"] == run(capfd, *own)["relative_rms"]  # the same design is welcome
    np.save("start.npy", heights + 1e-4)
    assert "holds a design already" in run(capfd, *own, code=2)
