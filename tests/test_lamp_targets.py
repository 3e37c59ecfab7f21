"""Targets of lamps: maps of the far field, and the road of equal luminance."""

import json
import math
from pathlib import Path

import numpy as np
import pytest
import torch

from caustic_cli import cli
from caustic_cli.errors import InputError
from caustic_cli.inverse.lamp import pixels_of, wanted
from caustic_cli.io.photometry import Photometry
from caustic_cli.optics.lamp import LampLight, land
from caustic_cli.project.photometric_target import angles_of
from caustic_cli.project.road_target import luminance_coefficient, picture_of
from caustic_cli.scene import anglemap
from caustic_cli.scene.lamp import Goal

#: A target of each map, degrees of the map, wider than high.
GOALS = {name: Goal((100.0, 60.0), projection=name) for name in anglemap.MAPS}


@pytest.fixture(autouse=True)
def _here(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)


def landed(goal, directions):
    """Where light of these directions (N, 3) lands, and its sum as the gradient of the directions sees it."""
    d = torch.from_numpy(directions).requires_grad_()
    zero = torch.zeros(len(directions), dtype=torch.float64)
    x, y, ahead = land(goal, LampLight((zero, zero, zero), tuple(d.T), zero, {}, zero))
    (gradient,) = torch.autograd.grad((x + y).sum(), d)
    return x.detach().numpy(), y.detach().numpy(), ahead.numpy(), gradient.numpy()


@pytest.mark.parametrize("name", GOALS)
def test_light_lands_on_the_pixel_of_its_direction(name):
    goal, pixels = GOALS[name], (31, 17)  # with a pixel on the axis
    x, y, ahead, gradient = landed(goal, goal.directions(pixels))
    found = np.meshgrid(*(((np.arange(n) + 0.5) / n - 0.5) * s for n, s in zip(pixels, goal.size, strict=True)), indexing="ij")
    np.testing.assert_allclose(np.stack([x, y]), np.stack(found).reshape(2, -1), atol=1e-7)
    assert ahead.all() and np.isfinite(gradient).all()


@pytest.mark.parametrize("name", GOALS)
def test_solid_angles_are_those_of_the_directions(name):
    """Against the count of directions drawn evenly from the hemisphere."""
    goal, count = GOALS[name], 400_000
    rng = np.random.default_rng(5)
    z, turn = rng.uniform(size=count), 2.0 * math.pi * rng.uniform(size=count)
    sine = np.sqrt(1.0 - z * z)
    x, y, *_ = landed(goal, np.stack([sine * np.cos(turn), sine * np.sin(turn), z], 1))
    seen = np.histogram2d(x, y, (6, 4), [(-0.5 * s, 0.5 * s) for s in goal.size])[0]
    expected = goal.solid_angle * goal.shares((6, 4)) * count / (2.0 * math.pi)
    assert np.abs((seen - expected) / np.sqrt(expected)).max() < 4.5


def test_radial_maps_have_their_known_solid_angles():
    gnomonic = Goal(tuple(anglemap.extent_of("gnomonic", a) for a in (90.0, 90.0)), projection="gnomonic")
    assert gnomonic.solid_angle == pytest.approx(4.0 * math.pi / 6.0, rel=1e-5)  # a face of a cube
    assert gnomonic.angles == pytest.approx((90.0, 90.0)) and gnomonic.nearest_edge == pytest.approx(45.0)
    for name in ("stereographic", "polar"):
        goal = Goal((anglemap.extent_of(name, 100.0),) * 2, projection=name)
        x, y = np.meshgrid(np.linspace(-0.5, 0.5, 801), np.linspace(-0.5, 0.5, 801))
        inside = np.hypot(x, y) <= 0.5
        density = anglemap.solid_angles_at(name, goal.size[0] * x.ravel(), goal.size[0] * y.ravel()).reshape(x.shape)
        cap = (density * inside).sum() * (goal.size[0] / 800) ** 2
        assert cap == pytest.approx(2.0 * math.pi * (1.0 - math.cos(math.radians(50.0))), rel=2e-3)


def test_what_lies_behind_the_lamp_is_dark():
    goal = Goal((178.0, 178.0), projection="polar")
    found = wanted(goal, np.ones((2, 2)), pixels_of(goal, 900)).numpy()
    dark = (goal.directions(found.shape)[:, 2] <= 0).reshape(found.shape)
    assert dark[0, 0] and not dark[15, 15] and (found[dark] == 0).all() and (found[~dark] > 0).all()


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--angles", "170", "--projection", "gnomonic"], "at most 160 degrees"),
        (["--angles", "60", "--projection", "mercator"], "--projection must be"),
        (["--picture-size", "3m", "--throw", "2m", "--projection", "polar"], "--projection belongs to the far field"),
    ],
)
def test_a_map_that_is_none_is_refused_in_one_line(options, words, capfd):
    assert cli.run(["design", "uniform", "--lamp", "15", *options]) == 2
    (line,) = capfd.readouterr().err.splitlines()
    assert words in line and not list(Path().iterdir())
    with pytest.raises(InputError, match="of a plane there is none"):
        Goal((100.0, 100.0), 1000.0, projection="polar")


def test_a_disc_of_a_polar_map_is_a_cone(capfd):
    found = {}
    for name in ("polar", "latitude"):
        given = ["--lamp", "15", "--angles", "100x100", "--projection", name]
        assert cli.run(["design", "disc", *given, "-o", name, "--json", "--quiet"]) == 0
        found[name] = json.loads(capfd.readouterr().out)
        assert found[name]["of_source"] + math.fsum(found[name]["lost"].values()) == pytest.approx(1.0, abs=1e-12)
    assert found["polar"]["beam_angles"] == pytest.approx([100.0, 100.0], abs=6.0) and "cut_off" not in found["polar"]
    assert "cut_off" in found["latitude"] and found["polar"]["border_unit"] == "degrees"
    assert 'projection = "polar"' in Path("polar/project.toml").read_text()


def test_the_angles_of_a_file_are_those_of_the_map():
    plane, gamma = 5.0 * np.arange(72), np.arange(181.0)
    cone = Photometry(plane, gamma, np.broadcast_to(1.0 * (gamma <= 40.0), (72, 181)))
    for name in anglemap.MAPS:
        assert angles_of(cone, name) == pytest.approx((82.0, 82.0), abs=0.5)  # up to a step beyond the last lit angle


# A road


def test_the_model_of_a_road_has_the_published_figures_of_its_class():
    """Q0, the mean over the solid angle of a rectangle of lamps, and S1 (CIE 144:2001); light from ahead shines."""
    x, y = np.meshgrid(np.arange(-4.0, 12.0, 0.01) + 0.005, np.arange(-3.0, 3.0, 0.01) + 0.005, indexing="ij")
    solid = (1.0 + x * x + y * y) ** -1.5
    assert (luminance_coefficient(x, y) * solid).sum() / solid.sum() == pytest.approx(0.07, rel=1e-3)
    r = [luminance_coefficient(np.array(t), np.array(0.0)) * (1.0 + t * t) ** -1.5 for t in (2.0, 0.0)]
    assert r[0] / r[1] == pytest.approx(1.11, rel=1e-3)
    ahead, behind, beside = (float(luminance_coefficient(*map(np.array, at))) for at in ((2.0, 0.0), (-2.0, 0.0), (0.0, 2.0)))
    assert ahead > 5.0 * behind and behind == pytest.approx(beside, rel=0.05)


def test_a_road_of_this_illuminance_has_one_luminance():
    goal = Goal((30_000.0, 10_000.0), 8000.0, (2000.0, 1000.0))
    light = picture_of(goal)
    x, y = np.meshgrid(
        2000.0 + 30_000.0 * ((np.arange(light.shape[0]) + 0.5) / light.shape[0] - 0.5),
        1000.0 + 10_000.0 * ((np.arange(light.shape[1]) + 0.5) / light.shape[1] - 0.5),
        indexing="ij",
    )
    luminance = light * luminance_coefficient(-x / 8000.0, -y / 8000.0)
    np.testing.assert_allclose(luminance / luminance.mean(), 1.0, rtol=1e-9)
    assert light[0].min() < 0.3 * light[-1].min()  # a driver looks along +x: what lies before the lamp shines


def test_a_road_is_designed_for_by_name(capfd):
    given = ["--lamp", "15", "--lamp-inner", "2", "--throw", "8m", "--picture-size", "30mx10m"]
    assert cli.run(["design", "road", *given, "--json", "--quiet"]) == 0
    figures = json.loads(capfd.readouterr().out)
    assert figures["of_source"] > 0.75 and figures["uniformity"] is None and figures["project"] == "road.caustic"
    assert np.load("road.caustic/target.npy").ndim == 2
    for more, words in ((["--lamp", "15", "--angles", "60"], "no meaning in the far field"), ([], "--lamp is needed")):
        assert cli.run(["design", "road", *more, "--quiet"]) == 2
        assert words in capfd.readouterr().err
