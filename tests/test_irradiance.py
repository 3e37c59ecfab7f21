"""Absolute light: power and its unit on the command line, in project.toml and in exports; W/mm^2 and lux of images."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from helpers import write_blob

from caustic_cli import cli
from caustic_cli.commands.figures import figures_rows
from caustic_cli.commands.options import power
from caustic_cli.config import settings
from caustic_cli.errors import InputError
from caustic_cli.io.archive import open_archive
from caustic_cli.project.completion import complete
from caustic_cli.project.project import Project
from caustic_cli.scene import Disc, Lens, Light, PlaneWave, Points, Scene, Screen
from caustic_cli.studies.design_report import write_report
from caustic_cli.studies.irradiance import irradiance_figures, per_part, unit_figures

TINY = ["--resolution", "24", "--control", "12", "--rays", "4000", "--waves", "off", "--quiet", "--threads", "1", "--json"]
RENDER = ["render", "blob.caustic", "--rays", "20000", "--quiet", "--threads", "1", "--json"]
BAD = [
    "100 lumens?",
    "-1W",
    "nanW",
    "1e400lm",
    "",
    "0",
    "0lm",
    "infW",
    "W",
    "lm",
    "1.2.3",
    "1,5W",
    "2mW",
    "100LM",
    "1_000W",
    "+2W",
    "1e31",
    "\u0662W",
]


@pytest.fixture(autouse=True)
def _here(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    write_blob()


def run(capfd, *arguments, code=0):
    assert cli.run(list(map(str, arguments))) == code
    out, err = capfd.readouterr()
    return json.loads(out) if code == 0 else err.strip()


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("2", (2.0, "W")),
        ("2W", (2.0, "W")),
        ("100lm", (100.0, "lm")),
        (" 1.5e3 lm ", (1500.0, "lm")),
        (".5W", (0.5, "W")),
        ("1e-3W", (1e-3, "W")),
        ("1e30", (1e30, "W")),
    ],
)
def test_a_power_with_and_without_a_unit(text, value):
    assert power("--power", text) == value


@pytest.mark.parametrize("text", BAD)
def test_what_is_no_power_is_refused_in_one_line(text, capfd):
    said = run(capfd, "design", "blob.png", f"--power={text}", code=2)
    assert "--power must be a number greater than 0 and at most 1e+30, of W or lm" in said and "\n" not in said
    with pytest.raises(InputError, match="--power"):
        power("--power", text)


def test_irradiance_is_power_over_area():
    """100 lm on a quarter of 4 x 2 mm: 1 lux is 1 lm on a square metre."""
    scene = Scene(PlaneWave(100.0), Lens(), Screen((4.0, 2.0), 100.0, (8, 4)), Light(unit="lm"))
    image = np.zeros((8, 4))
    image[:4, :2] = 1.0 / 8.0
    assert irradiance_figures(scene, image) == pytest.approx({"peak_irradiance": 100.0 / 2e-6, "mean_irradiance": 100.0 / 8e-6})
    words = unit_figures(scene)
    assert words == {
        "power": 100.0,
        "power_unit": "lm",
        "screen_unit": "mm",
        "irradiance_unit": "lux",
        "fractions_of": "the power through the aperture",
    }
    far = replace(scene, screen=replace(scene.screen, z=1000.0, far=True))
    assert unit_figures(far)["irradiance_unit"] == "cd" and unit_figures(far)["screen_unit"] == "mrad"
    assert irradiance_figures(far, image)["peak_irradiance"] == pytest.approx(100.0 / 2e-6)  # 2 mrad^2 are 2e-6 sr
    near = replace(scene, source=Points(((0.0, 0.0, -20.0),), cone=30.0))
    assert unit_figures(near)["fractions_of"] == "the power within the cone of 30 degrees"
    in_watts = Scene(Disc(power=3.0), Lens(), scene.screen)
    assert irradiance_figures(in_watts, image)["peak_irradiance"] == pytest.approx(3.0 / 2.0)
    assert unit_figures(in_watts)["irradiance_unit"] == "W/mm^2"
    assert per_part(in_watts.onto(Screen((8.0, 4.0), 50.0, (8, 4)))) == pytest.approx(3.0)
    colours = np.stack([image, 0.0 * image, image])
    assert irradiance_figures(in_watts, colours)["mean_irradiance"] == pytest.approx(3.0 * 2.0 / 8.0)


def test_a_unit_of_power_is_watts_or_lumens():
    with pytest.raises(InputError, match=r"\[source\] power_unit must be one of W, lm, got 'cd'"):
        Light(unit="cd")
    old = complete({"source": {"power": 3.0}}, 1.0)
    assert "power_unit" not in old.source and settings.build_light(old).unit == "W"
    said = settings.dump(complete({"source": {"power": 3.0, "power_unit": "lm"}}, 1.0))
    assert settings.build_light(complete(settings.parse(said, "here"), 1.0)).unit == "lm"
    with pytest.raises(InputError, match="power_unit must be text"):
        settings.parse("[source]\npower_unit = 3", "here")


def test_the_fraction_of_all_that_an_led_emits(capfd):
    """A Lambertian one before a small lens: its own table's base is the cone over the lens; the same lens in its whole hemisphere,
    whose cone is given, is the independent answer."""
    led = ["--source", "disc", "--source-position", "0,0,-30", "--source-size", "1", "--intensity", "lambertian"]
    assert cli.run(["design", "blob.png", *led, "--iterations", "3", *(a for a in TINY if a != "--quiet")]) == 0
    figures = json.loads(capfd.readouterr().out)
    said = dict(figures_rows(figures))["of all the source emits"]
    assert said == f"{100.0 * figures['of_source']:.3g}%: in all directions, Lambertian"
    assert figures["of_source"] < 0.1 < figures["on_target"] and figures["source_emits"] == "in all directions, Lambertian"
    narrow = run(capfd, *RENDER)
    whole = run(capfd, *RENDER, "--cone", "90", "--force")
    assert whole["on_target"] == pytest.approx(narrow["of_source"], rel=0.02)
    assert whole["of_source"] == pytest.approx(whole["on_target"], rel=1e-12)
    assert run(capfd, *RENDER, "--intensity", "uniform", "--cone", "40", "--force")["source_emits"] == "in its cone"


@pytest.mark.parametrize("source", ["plane", "disc"])
def test_design_and_render_say_lux_and_watts(source, capfd):
    figures = run(capfd, "design", "blob.png", "--source", source, "--power", "100lm", "--iterations", "3", *TINY)
    assert (figures["power"], figures["power_unit"], figures["irradiance_unit"]) == (100.0, "lm", "lux")
    assert (figures["of_source"] == figures["on_target"]) == (source == "plane")
    wide, tall = Project.open("blob.caustic").scene().screen.half_size
    area = 4.0 * wide * tall
    assert figures["mean_irradiance"] == pytest.approx(1e8 * figures["on_screen"] / area, rel=1e-12)
    assert figures["peak_irradiance"] > figures["mean_irradiance"]
    same = run(capfd, *RENDER, "--npy", "a.npy")
    image = np.load("a.npy")
    assert same["peak_irradiance"] == pytest.approx(1e8 * image.max() * image.size / area, rel=1e-12)
    watts = run(capfd, *RENDER, "--power", "2", "--npy", "b.npy", "--force")
    assert (watts["power"], watts["power_unit"], watts["irradiance_unit"]) == (2.0, "W", "W/mm^2")
    assert np.array_equal(np.load("b.npy"), image) and watts["relative_rms"] == same["relative_rms"]
    assert watts["peak_irradiance"] == pytest.approx(2e-8 * same["peak_irradiance"], rel=1e-12)
    assert 'power_unit = "lm"' in (Project.open("blob.caustic").path / "project.toml").read_text()
    assert cli.run(["export", "blob.caustic", "--format", "lighttools", "-o", "a.npz", "--quiet"]) == 0
    assert open_archive("a.npz")[0].light.unit == "lm"
    capfd.readouterr()
    of_archive = run(capfd, "render", "a.npz", *RENDER[2:])
    assert of_archive["irradiance_unit"] == "lux"
    assert of_archive["mean_irradiance"] == pytest.approx(same["mean_irradiance"], rel=1e-3)


def test_the_table_and_the_report_say_it_too(capfd, monkeypatch):
    from matplotlib.figure import Figure  # noqa: PLC0415

    bars, plain = [], Figure.colorbar
    monkeypatch.setenv("CAUSTIC_EFFORT", "test report=True")

    def colorbar(figure, drawn, **options):
        norm = drawn.norm
        bars.append((options["label"], norm.vmin, norm.vmax, float(drawn.get_array().max()), norm(norm.vmax)))
        return plain(figure, drawn, **options)

    monkeypatch.setattr(Figure, "colorbar", colorbar)
    assert cli.run(["design", "blob.png", "--power", "2W", "--iterations", "3", *(a for a in TINY if a != "--quiet")]) == 0
    figures = json.loads(capfd.readouterr().out)
    peak, mean = (figures[f"{k}_irradiance"] for k in ("peak", "mean"))
    assert f"peak {peak:.4g} W/mm^2, mean {mean:.4g} W/mm^2" in dict(figures_rows(figures))["irradiance"]
    label, low, high, most, full = bars[0]
    assert label == f"irradiance (W/mm²)\npeak {peak:.3g}, mean {mean:.3g}"
    assert low == 0 < high and most == pytest.approx(peak) and full == pytest.approx(1.0)
    target = Project.open("blob.caustic").target(Project.open("blob.caustic").scene())
    assert high == pytest.approx(max(peak, mean * target.max() / target.mean()))  # of the image and of its target


@pytest.mark.parametrize(
    "mean, encoding", [(0.0, "srgb"), (0.0, "linear"), (5e-324, "linear"), (1e-200, "srgb"), (1e-36, "linear"), (1e36, "srgb")]
)
def test_a_report_of_any_brightness(tmp_path, mean, encoding):
    target = np.random.default_rng(0).random((12, 9))
    figures = {"relative_rms": 0.1, "mean_irradiance": mean, "peak_irradiance": 2.0 * mean, "irradiance_unit": "lux"}
    figures |= {"on_screen": 0.9, "on_target": 0.8, "lost": {"fresnel": 0.1}}
    history = np.array([[1, 0, 0.1, 0.9, 0.1], [2, 0, 0.05, 0.9, 0.2]])
    write_report(
        tmp_path / "r.png",
        target,
        target * mean,
        np.zeros((9, 9)),
        history,
        Lens(),
        Screen((12.0, 9.0), 300.0, (12, 9)),
        figures,
        encoding,
    )
    assert (tmp_path / "r.png").stat().st_size > 10_000


def test_blurred_stages_have_a_panel_of_their_own(tmp_path, monkeypatch):
    """Their loss, which grows as the blur falls, is not drawn on the axis of the error; nor is it lost."""
    from matplotlib.figure import Figure  # noqa: PLC0415

    drawn = []
    monkeypatch.setattr(Figure, "savefig", lambda figure, *_, **__: drawn.append(figure))
    target = np.random.default_rng(0).random((12, 9))
    figures = {"relative_rms": 0.3, "start_relative_rms": 1.2, "mean_irradiance": 1.0, "peak_irradiance": 2.0}
    figures |= {"irradiance_unit": "lux", "on_screen": 0.9, "on_target": 0.8, "lost": {"fresnel": 0.1}}
    losses = {0: [0.2, 0.02], 1: [0.3, 0.1], 2: [0.4, 0.35]}
    history = np.array([[1, k, loss / target.size, 0.9, k + 0.1 * i] for k, row in losses.items() for i, loss in enumerate(row)])
    for blurs in ((4.0, 1.0, 0.0), (0.0, 0.0, 0.0)):
        write_report(
            tmp_path / "r.png",
            target,
            target,
            np.zeros((9, 9)),
            history,
            Lens(),
            Screen((12.0, 9.0), 300.0, (12, 9)),
            figures,
            "linear",
            stages=[(blur, False) for blur in blurs],
        )
        panels = {axis.get_title(): axis for axis in drawn.pop().axes if axis.get_ylabel() == "relative RMS"}
        found = {
            title: [line.get_ydata().tolist() for line in axis.get_lines() if len(line.get_ydata()) > 1]
            for title, axis in panels.items()
        }
        own = [found[title] for title in found if title.startswith("error")]
        wanted = [pytest.approx(row) for row in losses.values()]
        assert own == [[row for row, blur in zip(wanted, blurs, strict=True) if blur == 0]]
        assert [row for rows in found.values() for row in rows] == wanted
