"""Materials, presets and pictures by the names that a command line gives them, and what is said before a design begins."""

import io
import json
import math
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from helpers import write_blob
from PIL import Image, ImageDraw

from caustic_cli import cli, design
from caustic_cli.config import presets, settings
from caustic_cli.config.lamp import goal_of, lamp_of
from caustic_cli.errors import InputError
from caustic_cli.project.completion import complete
from caustic_cli.project.project import Project
from caustic_cli.scene.materials import MATERIALS
from caustic_cli.schema.table import Parameters

SMALL = ["--resolution", "32", "--control", "20", "--rays", "4000", "--iterations", "1", "--waves", "off", "--quiet"]


@pytest.fixture(autouse=True)
def _quick(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)


@pytest.mark.parametrize("name", presets.names())
def test_every_preset_is_a_whole_scene(name):
    said = settings.read(presets.path_of(name), parameters=True)
    full = complete(said, 1.0, Parameters(**said.pop("")))
    if full.lamp is not None:
        assert lamp_of(full).radius == 15.0
        assert goal_of(full).distance == (full.screen.z if full.lamp.angles is None else math.inf)
        return
    scene = settings.build_scene(full)
    assert scene.screen.z == full.screen.z and dict(presets.rows())[name].endswith(".")


def test_a_preset_gives_way_to_a_configuration_and_both_to_options(capfd):
    write_blob("blob.png", 16, (5, 6), 15.0)
    Path("more.toml").write_text("mag = 2.5\nthrow = 900.0\n[lens]\nindex = 1.6\n")
    given = ["--preset", "plate-100", "--config", "more.toml", "--throw", "80cm"]
    assert cli.run(["design", "blob.png", *given, *SMALL]) == 0
    s = Project.open("blob.caustic").settings
    assert s.lens.size == (100.0, 100.0) and s.source.angle == 0.533  # the preset's
    assert s.target.size[0] == 250.0 and s.lens.index == 1.6 and "glass" not in s.lens  # the configuration's
    assert s.screen.z == 800.0  # the option's
    assert cli.run(["design", "blob.png", "--preset", "window-floor", "--throw", "80cm", "--mag", "2", *SMALL, "-o", "w"]) == 0
    s = Project.open("w").settings
    assert s.screen.z == 800.0 and s.target.size[0] == 200.0 and s.room.faces == 180.0  # instead of its place and its size
    assert cli.run(["design", "--resume", "blob.caustic", "--preset", "thesis"]) == 2
    assert "--preset cannot be given" in capfd.readouterr().err
    assert cli.run(["design", "blob.png", "--preset", "plate100"]) == 2
    assert "did you mean plate-100?" in capfd.readouterr().err


def test_a_project_says_no_parameters():
    with pytest.raises(InputError, match=r"x.toml: \[mag\] is not a section"):
        settings.parse("mag = 3.0", "x.toml")
    with pytest.raises(InputError, match=r"x\.toml: mag must be a number"):
        settings.parse('mag = "three"', "x.toml", parameters=True)


@pytest.mark.parametrize(("option", "words"), [("--glass", ["PMMA", "acrylic", "0.90"]), ("--preset", ["plate-100", "sunlight"])])
def test_lists_are_results(capfd, option, words):
    assert cli.run(["design", option, "list"]) == 0
    out, err = capfd.readouterr()
    assert err == "" and all(word in out for word in words)
    assert len(out.splitlines()) == (1 + len(MATERIALS) if option == "--glass" else len(presets.names()))


@pytest.mark.parametrize("option", ["--glass list --json", "--json --glass list", "none.png --mag 0 --glass list --json"])
def test_the_list_of_materials_as_json(capfd, option):
    assert cli.run(["design", *option.split()]) == 0
    out, err = capfd.readouterr()
    found = {row["name"]: row for row in json.loads(out)["glasses"]}
    assert err == "" and out.count("\n") == 1 and set(found) == set(MATERIALS)
    bk7 = found["N-BK7"]
    assert bk7["n_d"] == pytest.approx(1.5168, abs=5e-5) and bk7["V_d"] == pytest.approx(64.17, abs=0.01) and "BK7" in bk7["also"]
    assert found["NOA61"]["density"] is None and found["PRINT-RESIN"]["spread"] == 0.01


def test_the_list_of_presets_as_json(capfd, monkeypatch):
    assert cli.run(["design", "--preset", "list", "--json"]) == 0
    out = capfd.readouterr().out
    found = json.loads(out)["presets"]
    assert [(row["name"], row["purpose"]) for row in found] == presets.rows()
    monkeypatch.setenv("CAUSTIC_DESIGN_JSON", "1")
    assert cli.run(["design", "--preset", "list"]) == 0
    assert capfd.readouterr().out == out


def logo(path: str | io.BytesIO) -> None:
    """A black ring on nothing."""
    image = Image.new("RGBA", (32, 32))
    ImageDraw.Draw(image).ellipse((6, 6, 26, 26), outline=(0, 0, 0, 255), width=5)
    image.save(path, "PNG")


def test_a_logo_through_a_pipe(tmp_path):
    stream = io.BytesIO()
    logo(stream)
    run = [sys.executable, "-m", "caustic_cli", "design", "-", *SMALL, "--json", "--start", "offset"]
    env = {"PYTHONPATH": str(Path(cli.__file__).parents[1]), "PATH": "/usr/bin:/bin", "HOME": str(tmp_path)}
    refused = subprocess.run(run, input=stream.getvalue(), capture_output=True, check=False, env=env)
    assert refused.returncode == 2
    assert (
        refused.stderr
        == b"caustic: standard input: is black on nothing, so that none of it is bright; --invert takes dark as bright\n"
    )
    with pytest.MonkeyPatch.context() as patch:  # in this process, whose kernels are compiled
        patch.setattr("sys.stdin", io.TextIOWrapper(io.BytesIO(stream.getvalue())))
        assert cli.run([*run[3:], "--invert"]) == 0
    kept = Project.open("picture.caustic").picture.irradiance()
    assert kept[16, 16] == 0.0 and kept[8, 16] == 1.0 and kept[0, 0] == 0.0


@pytest.mark.parametrize("data", [None, b""])
def test_nothing_through_a_pipe(monkeypatch, capfd, data):
    monkeypatch.setattr("sys.stdin", None if data is None else io.TextIOWrapper(io.BytesIO(data)))
    assert cli.run(["design", "-"]) == 2
    assert "standard input" in capfd.readouterr().err


def test_what_is_said_before_a_design_begins(monkeypatch):
    lines: list[str] = []
    image = Image.new("L", (32, 32), 255)
    ImageDraw.Draw(image).ellipse((6, 6, 26, 26), outline=0, width=3)
    image.save("drawing.png")
    white = f"{(np.asarray(image) == 255).mean():.0%} of the picture"
    lens = design(
        "drawing.png",
        preset="plate-100",
        quality="draft",
        settings={"screen": {"resolution": [32, 32]}, "lens": {"control": [36, 36]}, "design": {"iterations": 1}},
        rays=4000,
        on_message=lines.append,
    )
    assert any(line.startswith(white) and line.endswith("for a drawing on white, invert makes the lines bright") for line in lines)
    (first,) = [line for line in lines if line.startswith("first surface: wall 2.")]
    assert "totally reflected from 0.90" in first and "project about 21 kB" in first
    assert any("source 4.6 mm or" in line and "pixels" in line for line in lines)
    low, high = float(lens.heights.min()), float(lens.heights.max())
    assert 1.9 < low < 3.0 and high < 8.0  # a plate: a wall of 2 mm, as the preset says, and its relief


def test_figures_are_json(capfd):
    write_blob("blob.png", 16, (5, 6), 15.0)
    assert cli.run(["design", "blob.png", "--glass", "Plexiglass", *SMALL]) == 0
    capfd.readouterr()
    assert cli.run(["render", "blob.caustic", "--report", "--json", "--quiet", "--rays", "1e4"]) == 0
    report = json.loads(capfd.readouterr().out)["report"]
    assert report["mass_g"] == pytest.approx(1.19 * report["volume_cm3"])
    assert report["volume_cm3"] == pytest.approx(0.1 * (report["stock_height_mm"] + report["minimum_wall_mm"]) / 2, rel=0.2)


def test_a_long_picture_is_told_of_a_lens_of_its_own_shape(capfd):
    Image.linear_gradient("L").resize((8, 80)).save("tall.png")
    loud = [option for option in SMALL if option != "--quiet"]
    assert cli.run(["design", "tall.png", *loud, "--start", "offset"]) == 0
    assert "magnified 3 times along x and 30 times along y" in (err := capfd.readouterr().err) and "--lens-size 3.16x31.6" in err
    assert cli.run(["design", "tall.png", *loud, "--start", "offset", "--lens-size", "3.16x31.6", "-o", "o.caustic"]) == 0
    assert "magnified" not in capfd.readouterr().err
