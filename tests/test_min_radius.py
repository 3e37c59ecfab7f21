"""Cost of a least concave radius: light in black regions of the picture, for the initial surface of a design."""

import json
import shlex
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from caustic_cli import cli
from caustic_cli.commands.figures import figures_rows
from caustic_cli.inverse.designer import Designer
from caustic_cli.inverse.penalties import Penalty
from caustic_cli.kinds import problem_of
from caustic_cli.kinds.evaluation import radius_figures
from caustic_cli.optics import curvature
from caustic_cli.optics.surfaces.heightfield import HeightField
from caustic_cli.project.project import Project
from caustic_cli.scene import Lens, PlaneWave, Scene, Screen
from caustic_cli.studies.retrace import retrace

BASE = "--resolution 24 --quality draft --control 35 --rays 20000 --iterations 3 --waves off --margin 0 --linear --quiet --json"


@pytest.fixture
def here(tmp_path, monkeypatch):
    """Two islands of light: between them, the surface has a crease."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("CAUSTIC_EFFORT", "test final_rays=60000")
    y, x = np.mgrid[:48, :48]
    islands = (np.hypot(x - 12, y - 20) < 9) | (np.hypot(x - 36, y - 28) < 9)
    Image.fromarray(np.where(islands, 255, 0).astype(np.uint8)).save("islands.png")
    Image.fromarray(np.where(islands, 255, 60).astype(np.uint8)).save("grey.png")
    return tmp_path


def run(capfd, text):
    code = cli.run(shlex.split(text))
    out, err = capfd.readouterr()
    assert code == 0, err
    return json.loads(out)


def saved(name):
    project = Project.open(Path(name))
    return project, project.load().state


def bent(field, heights, side):
    """Largest curvature at 2e5 points, as seen from +z, side 1, or -z, side -1."""
    rng = np.random.default_rng(7)
    x, y = (torch.as_tensor(rng.uniform(-r, r, 200_000)) for r in field.half_size)
    return float(curvature.largest(*(side * d for d in field.at(heights, x, y, curvature.ORDERS))).max())


def test_a_design_says_what_its_radius_costs(here, capfd):
    radius = 20.0
    figures = run(capfd, f"design islands.png {BASE} -o p --min-radius {radius}")
    said = figures["min_radius"]
    project, state = saved("p")
    designer = Designer(problem_of(project))
    target = designer.problem.target.numpy()
    assert bent(designer.field(0), state.unrounded, 1) > 2.0 / radius  # it bites
    assert bent(designer.field(0), state.start, 1) <= 1.0 / radius
    assert bent(designer.field(state.stage), state.heights, 1) <= 1.0 / radius
    for name, heights in (("start_in_black", state.start), ("start_in_black_without", state.unrounded)):
        again = retrace(designer.scene, designer.field(0), heights, target, rays=400_000, seed=7)[1]
        assert said[name] == pytest.approx(again["in_black"], abs=6 * radius * said["noise"]), name
    assert said["radius_mm"] == radius
    assert said["start_in_black"] > said["start_in_black_without"] + 0.01
    assert said["in_black_per_mm"] == pytest.approx((said["start_in_black"] - said["start_in_black_without"]) / radius)
    assert 0 < said["noise"] < 0.1 * said["in_black_per_mm"]
    rows = dict(figures_rows(figures))
    assert f"{said['in_black_per_mm']:.2%} a mm" in rows["a radius of 20 mm"]
    assert rows["light in black"].startswith(f"{figures['in_black']:.2%}")


def test_a_resumed_design_says_the_same_of_its_radius(here, capfd):
    first = run(capfd, f"design islands.png {BASE} -o p --min-radius 20")
    longer = run(capfd, "design --resume p --iterations 5 --quiet --json")
    assert longer["iterations"] == 5 and longer["min_radius"] == first["min_radius"]
    project, state = saved("p")
    (project.path / "checkpoints.h5").unlink()  # as if killed before its first checkpoint
    run(capfd, "design --resume p --iterations 3 --quiet --json")
    again = saved("p")[1]
    torch.testing.assert_close(again.unrounded, state.unrounded, rtol=0, atol=1e-12)
    torch.testing.assert_close(again.start, state.start, rtol=0, atol=1e-12)


def test_without_a_radius_nothing_is_said_of_it(here, capfd):
    figures = run(capfd, f"design islands.png {BASE} -o p")
    assert "min_radius" not in figures and saved("p")[1].unrounded is None
    assert not any(name.startswith("a radius") for name, _ in figures_rows(figures))
    assert 0 < figures["in_black"] < 1 and figures["in_black_noise"] > 0
    assert run(capfd, "render p --rays 60000 --quiet --json")["in_black"] == figures["in_black"]


def test_a_picture_without_black(here, capfd):
    figures = run(capfd, f"design grey.png {BASE} -o p --min-radius 20")
    assert figures["in_black"] is None and figures["in_black_noise"] is None
    assert figures["min_radius"] == {
        "radius_mm": 20.0,
        "start_in_black": None,
        "start_in_black_without": None,
        "in_black_per_mm": None,
        "noise": None,
    }
    assert not {"light in black", "a radius of 20 mm"} & {name for name, _ in figures_rows(figures)}


def test_a_surface_that_the_radius_does_not_touch_pays_nothing(here, capfd):
    said = run(capfd, f"design islands.png {BASE} -o p --min-radius 0.001")["min_radius"]
    assert said["in_black_per_mm"] == 0.0 and said["start_in_black"] == said["start_in_black_without"] > 0
    said = run(capfd, f"design islands.png {BASE} -o q --min-radius 20 --start offset")
    assert "min_radius" not in said  # a sphere shows no picture


def test_the_tool_of_a_mirror_comes_from_the_light(here, capfd):
    """A mirror that spreads its light has ridges where a lens has hollows: they cost nothing, and its hollows have the radius."""
    radius = 40.0
    figures = run(capfd, f"design islands.png {BASE} -o p --mirror --min-radius {radius}")
    project, state = saved("p")
    field = problem_of(project).field(state.stage)
    assert bent(field, state.heights, -1) <= 1.0 / radius
    assert bent(field, state.heights, 1) > 1.0 / radius  # ridges are as sharp as they like
    assert figures["min_radius"]["in_black_per_mm"] is not None


def test_a_mirror_is_penalised_for_hollows_as_the_light_sees_them():
    lens = Lens(control=(12, 10))
    heights = 5.0 + 0.05 * torch.linspace(-1, 1, 12, dtype=torch.float64)[:, None] ** 2 + torch.zeros(12, 10, dtype=torch.float64)
    scene, mirror = (
        Scene(PlaneWave(), replaced, Screen((9.0, 9.0), z, (12, 12)))
        for replaced, z in ((lens, 100.0), (Lens(control=(12, 10), mirror=True), -100.0))
    )
    for one, sign in ((scene, 1), (mirror, -1)):
        penalty = Penalty(one, HeightField.of(one.lens), [], 0.0, "cpu", 1000.0)
        assert (float(penalty(heights)) > 0, float(penalty(-heights)) > 0) == (sign > 0, sign < 0)


def test_a_project_of_before_knows_no_such_figures(here, capfd):
    figures = run(capfd, f"design islands.png {BASE} -o p --min-radius 20")
    old = {key: value for key, value in figures.items() if key not in ("in_black", "in_black_noise", "min_radius")}
    assert {name for name, _ in figures_rows(figures)} - {name for name, _ in figures_rows(old)} == {
        "light in black",
        "a radius of 20 mm",
    }


def test_the_cost_of_a_radius():
    one, other = {"in_black": 0.05, "in_black_noise": 0.003}, {"in_black": 0.01, "in_black_noise": 0.004}
    found = radius_figures(2.0, one, other)
    assert found["in_black_per_mm"] == pytest.approx(0.02) and found["noise"] == pytest.approx(0.0025)
    assert radius_figures(2.0, one | {"in_black_noise": None}, other)["noise"] is None
