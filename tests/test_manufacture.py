"""Constraints that a finished design satisfies, and the manufacturing report, against closed forms."""

import json
import math
import shlex
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from scipy.optimize import brentq
from test_export import make

from caustic_cli import cli
from caustic_cli.errors import CausticError, InputError
from caustic_cli.inverse import constraints
from caustic_cli.inverse.constraints import within_limits
from caustic_cli.inverse.penalties import Penalty
from caustic_cli.optics import curvature
from caustic_cli.optics.surfaces.heightfield import HeightField
from caustic_cli.project.project import Project
from caustic_cli.scene import Disc, Lens, Offset, PlaneWave, Points, Scene, Screen
from caustic_cli.studies.manufacture import manufacture, preview, wall_and_stock

ORDERS = ((0, 0), (1, 0), (0, 1), (2, 0), (1, 1), (0, 2))


def surface(shape, control=(40, 34), size=(10.0, 8.0), source=None, fresnel="exact"):
    """A scene whose exit surface is the spline through shape(x, y)."""
    lens = Lens(size=size, control=control, index=1.5, fresnel=fresnel, offset=Offset(5.0))
    field = HeightField.of(lens)
    x, y = field.control_xy()
    values = shape(x[:, None], y[None, :]).expand(*control).double()
    at = [torch.linalg.inv(s.matrix(s.greville)) for s in field.spaces]
    return Scene(source or PlaneWave(), lens, Screen((30.0, 24.0), 300.0, (60, 48))), field, at[0] @ values @ at[1].T


def bowl(radius, centre=(0.0, 0.0)):
    """The inside of a sphere, concave towards the screen."""
    return lambda x, y: 3.0 + radius - torch.sqrt(radius**2 - (x - centre[0]) ** 2 - (y - centre[1]) ** 2)


# curvature


@pytest.mark.parametrize(("radius", "sign"), [(7.0, 1), (7.0, -1)])
def test_a_sphere_bends_alike_everywhere(radius, sign):
    x, y = torch.linspace(-4, 4, 41, dtype=torch.float64), torch.linspace(-3, 3, 31, dtype=torch.float64)
    x, y = torch.meshgrid(x, y, indexing="ij")
    root = torch.sqrt(radius**2 - x * x - y * y)
    zx, zy = x / root, y / root
    second = 1 / root + x * x / root**3, x * y / root**3, 1 / root + y * y / root**3
    k = curvature.largest(*(sign * t for t in (zx, zy, *second)))
    torch.testing.assert_close(k, torch.full_like(k, sign / radius), rtol=1e-5, atol=0)


def test_a_cylinder_and_a_saddle():
    one, none = torch.ones(1, dtype=torch.float64), torch.zeros(1, dtype=torch.float64)
    assert curvature.largest(none, none, -0.3 * one, none, none) == pytest.approx(0, abs=1e-6)  # a ridge: nowhere concave
    assert curvature.largest(none, none, 0.3 * one, none, none) == pytest.approx(0.3)
    assert curvature.largest(none, none, none, 0.2 * one, none) == pytest.approx(0.2)  # z = 0.2 x y
    assert curvature.largest(one, none, 0.3 * one, none, none) == pytest.approx(0.3 / 2**1.5)


# limits


def samples(field, heights, n=200_000):
    rng = np.random.default_rng(7)
    x, y = (torch.as_tensor(rng.uniform(-r, r, n)) for r in field.half_size)
    z, *derivatives = field.at(heights, x, y, ORDERS)
    return float(z.min()), float(torch.hypot(*derivatives[:2]).max()), float(curvature.largest(*derivatives).max())


@pytest.fixture(scope="module")
def rough():
    _, field, heights = make(control=(14, 12), size=(10.0, 8.0), relief=0.02)
    return field, heights, (heights - 0.5, heights + 0.5)


def test_limits_are_satisfied_and_little_is_moved(rough):
    field, heights, bounds = rough
    _, steep, bent = samples(field, heights, 100_000)
    slope, radius = 0.8 * steep, 1.5 / bent
    found = within_limits(field, heights, bounds, slope, radius)
    _, steep_now, bent_now = samples(field, found, 200_000)
    assert steep_now <= slope and bent_now * radius <= 1
    assert steep_now > 0.9 * slope or bent_now * radius > 0.9
    assert 1e-4 < (found - heights).abs().max() < 0.02  # mm: the relief


@pytest.mark.parametrize("block", [1, 700, 10**9])
def test_the_gradient_of_the_violation(rough, block, monkeypatch):
    """By differences, however many points are looked at together."""
    field, heights, _ = rough
    _, steep, bent = samples(field, heights, 100_000)
    monkeypatch.setattr(constraints, "BLOCK", block)
    asked = constraints._Constraints(field, (heights - 0.01, heights), 0.8 * steep, 1.5 / bent, 4)
    g = asked.violation(heights)[1]
    d = torch.randn(heights.shape, dtype=torch.float64, generator=torch.Generator().manual_seed(2))
    step = 1e-8
    rise = (asked.violation(heights + step * d)[0] - asked.violation(heights - step * d)[0]) / (2 * step)
    assert rise != 0 and float((g * d).sum()) == pytest.approx(rise, rel=1e-5)


def test_a_lens_within_its_limits_is_left_alone(rough):
    field, heights, bounds = rough
    _, steep, bent = samples(field, heights, 100_000)
    assert within_limits(field, heights, bounds) is heights
    assert within_limits(field, heights, (heights - 1, heights + 1), 1.1 * steep, 0.9 / bent) is heights


def test_bounds_are_kept_meanwhile(rough):
    field, heights, _ = rough
    low = heights.min() + 0.001 + torch.zeros_like(heights)
    raised = heights.clamp_min(float(low.max()) + 2e-5)
    _, steep, bent = samples(field, raised, 100_000)
    found = within_limits(field, raised, (low, raised + 1), 0.8 * steep, 1.5 / bent)
    assert (found >= low).all()


def test_limits_that_contradict_say_so(rough, monkeypatch):
    monkeypatch.setattr("caustic_cli.inverse.constraints.STEPS", 20)
    field, heights, _ = rough
    with pytest.raises(CausticError, match="max_slope"):
        within_limits(field, heights, (heights - 1e-6, heights + 1e-6), 1e-3)


def test_creases_between_lenslets_are_beyond_a_slope():
    """Between the points at which it is enforced the slope there stays several times as large: that is said."""
    control = (22, 13)
    lens = Lens((9.0, 6.0), control=control, degree=(3, 2), array=(3, 2))
    heights = 5.0 + 0.02 * torch.from_numpy(np.random.default_rng(1).uniform(-1, 1, control))
    with pytest.raises(CausticError, match="no surface near the designed one obeys the limits"):
        within_limits(HeightField.of(lens), heights, (heights - 1, heights + 1), 0.005)


@pytest.mark.parametrize("radius", [0.0, 2.0, 200.0])
def test_the_penalty_of_a_radius(radius, rough):
    field, heights, _ = rough
    scene = make(control=(14, 12), size=(10.0, 8.0))[0]
    penalty = Penalty(scene, field, [], 0.0, "cpu", radius)
    assert bool(penalty) == (radius > 0)
    z = heights.clone().requires_grad_()
    value = penalty(z)
    assert (float(value.detach()) > 0) == (radius == 200)
    if radius == 200:
        (g,) = torch.autograd.grad(value, z)
        d = torch.randn(heights.shape, dtype=torch.float64, generator=torch.Generator().manual_seed(2))
        step = 1e-7
        slope = (penalty(heights + step * d) - penalty(heights - step * d)) / (2 * step)
        assert float((g * d).sum()) == pytest.approx(float(slope), rel=1e-5)


def test_a_designed_lens_obeys_its_limits(tmp_path, monkeypatch, capfd):
    """At 2e5 points, where the same design without limits does not."""
    monkeypatch.chdir(tmp_path)
    y, x = np.mgrid[0:24, 0:24]
    Image.fromarray(np.where((x - 9) ** 2 + (y - 13) ** 2 < 34, 255, 60).astype(np.uint8)).save("dot.png")
    base = "design dot.png --resolution 24 --quality draft --control 35 --rays 20000 --iterations 3 --quiet "
    assert cli.run(shlex.split(base + "-o free")) == 0
    within = "--min-thickness 5 --min-radius 12 --max-slope 0.05"
    assert cli.run(shlex.split(f"{base} -o bound {within}")) == 0, capfd.readouterr().err
    found = {}
    for name in ("free", "bound"):
        project = Project.open(Path(name))
        _, field, _, checkpoint = project.lens(project.scene())
        found[name] = samples(field, checkpoint.state.heights)
    low, steep, bent = found["free"]
    assert steep > 0.05 and bent > 1 / 12
    low, steep, bent = found["bound"]
    with capfd.disabled():
        print(f"\n  at 2e5 points: least height {low:.5f} mm, slope {steep:.5f}, concave radius {1 / bent:.4f} mm", end="")
    assert low >= 5 and steep <= 0.05 and 1 / bent >= 12


# the report


def test_report_of_a_bowl():
    radius = 20.0
    scene, field, heights = surface(bowl(radius))
    scene = replace(scene, lens=replace(scene.lens, z_in=0.5))
    f = manufacture(scene, field, heights, tool_radius=19.0)
    corner = math.hypot(5, 4)
    top = 3 + radius - math.sqrt(radius**2 - corner**2)
    assert f["minimum_wall_mm"] == pytest.approx(2.5, abs=1e-5)
    assert f["minimum_wall_bound_mm"] <= f["minimum_wall_mm"]
    assert f["stock_height_mm"] == pytest.approx(top - 0.5, abs=1e-5)
    steep = corner / math.sqrt(radius**2 - corner**2)
    assert f["maximum_slope"] == pytest.approx(steep, rel=1e-3) and f["maximum_slope_bound"] >= f["maximum_slope"]
    assert f["smallest_concave_radius_mm"] == pytest.approx(radius, rel=1e-2) and f["tool_fits"]
    assert not manufacture(scene, field, heights, tool_radius=21.0)["tool_fits"]
    assert f["critical_angle_deg"] == pytest.approx(math.degrees(math.asin(1 / 1.5)))
    assert f["steepest_incidence_deg"] == pytest.approx(math.degrees(math.atan(steep)), abs=0.3)
    assert f["sharpness_limit_mm"] == 0
    json.dumps(f, allow_nan=False)


@pytest.mark.parametrize("wall", [3.0, 50.0])
def test_a_thick_plate_says_what_would_make_it_thin(wall):
    """The relief goes as 1 / throw: with 10 mm of it and 5 mm of room beside the wall, twice the throw."""
    scene, field, heights = surface(lambda x, y: wall + 10.0 * (x / 50.0) ** 2 + 0.0 * y, size=(100.0, 80.0))
    words = preview(scene, field, heights, 2e4)
    if wall == 3.0:
        assert "; a ⟨+throw⟩ of about 600 mm or a smaller ⟨+mag⟩ would make it 8 mm thick" in words
        near = replace(scene, source=Points(((0.0, 0.0, -20.0),)))  # whose light the relief gathers, whatever the throw
        assert "throw" not in preview(near, field, heights, 2e4)
        words = preview(scene, field, 3.0 + 0.45 * (heights - 3.0), 2e4)
    assert "throw" not in words and "stock" in words  # a thin plate, and a lens that is none


def test_report_of_a_dome_has_no_concave_place():
    scene, field, heights = surface(lambda x, y: 5 + torch.sqrt(30.0**2 - x * x - y * y) - 30)
    f = manufacture(scene, field, heights, tool_radius=1.0)
    assert f["smallest_concave_radius_mm"] is None and f["tool_fits"]


def test_report_of_a_prism():
    """A plane of slope g sends all light to x + tan(a) path, with n sin(b) = sin(b + a), tan(b) = g."""
    g, n = 0.3, 1.5
    scene, field, heights = surface(lambda x, y: 5 - g * x + 0 * y)
    f = manufacture(scene, field, heights)
    b = math.atan(g)
    turn = math.asin(n * math.sin(b)) - b
    assert f["landing_mm_per_mm_throw"] == pytest.approx(math.tan(turn), rel=1e-6)
    assert f["throw_error_of_a_pixel_mm"] == pytest.approx(0.5 / math.tan(turn), rel=1e-6)
    by_index = math.sin(b) / math.cos(turn + b) / math.cos(turn) ** 2 * (300 - 5)  # d tan(turn) / dn times the path
    assert f["landing_mm_per_thousandth_index"] == pytest.approx(1e-3 * by_index, rel=1e-3)
    assert f["steepest_incidence_deg"] == pytest.approx(math.degrees(b), rel=1e-6)
    steeper = surface(lambda x, y: 5 - 1.0 * x + 0 * y)
    assert manufacture(*steeper)["internal_reflection_margin_deg"] == pytest.approx(math.degrees(math.asin(1 / 1.5)) - 45, abs=1e-6)


def test_report_of_other_light():
    scene, field, heights = surface(lambda x, y: 5 + 0 * x * y, source=Points(((0.0, 0.0, -20.0),)))
    f = manufacture(scene, field, heights)
    # the ray that just reaches the exit surface's corner: 20 tan(a) + 5 tan(b) = its radius, sin(a) = n sin(b)
    b = brentq(lambda b: 20 * math.tan(math.asin(1.5 * math.sin(b))) + 5 * math.tan(b) - math.hypot(5, 4), 0, 0.5)
    assert 0.98 * math.degrees(b) < f["steepest_incidence_deg"] <= math.degrees(b)
    f = manufacture(Scene(Disc(angle=0.5), scene.lens, scene.screen), field, heights)
    assert f["sharpness_limit_mm"] == pytest.approx(300 * math.radians(0.5))
    assert f["sharpness_limit_pixels"] == pytest.approx(300 * math.radians(0.5) / 0.5)


def test_report_refuses_a_tool_without_radius():
    with pytest.raises(InputError, match="tool_radius"):
        manufacture(*surface(bowl(20.0)), tool_radius=0.0)


def test_the_command_writes_what_it_prints(tmp_path, monkeypatch, capfd):
    from caustic_cli.export.lighttools import write_lighttools  # noqa: PLC0415

    monkeypatch.chdir(tmp_path)
    write_lighttools("lens.npz", *surface(bowl(20.0)))
    for _ in range(2):  # and replaces its own
        assert cli.run(shlex.split("render lens.npz --rays 1000 --effects fresnel --report --tool-radius 3 --json --quiet")) == 0
        out, err = capfd.readouterr()
        assert err == ""
        told = json.loads(Path("report.json").read_text())
        assert told.pop("created_by") == "caustic" and told == json.loads(out)["report"]
    assert cli.run(shlex.split("render lens.npz --rays 1000 --effects fresnel --report")) == 0
    assert "concave radius" in capfd.readouterr().out
    assert cli.run(shlex.split("render lens.npz --rays 1000 --tool-radius 3")) == 2


@pytest.mark.parametrize("aperture", ["rectangle", "circle"])
def test_wall_and_stock_are_those_of_the_glass(aperture):
    """Of a bowl the rim is highest, of a circle's the lower one; the report says the same."""
    scene, field, heights = surface(bowl(40.0), size=(10.0, 10.0))
    scene = replace(scene, lens=replace(scene.lens, aperture=aperture))
    said, f = wall_and_stock(scene, field, heights), manufacture(scene, field, heights)
    assert said == {key: f[key] for key in ("minimum_wall_mm", "stock_height_mm")}
    rim = 5.0 * (math.sqrt(2.0) if aperture == "rectangle" else 1.0)
    assert said["minimum_wall_mm"] == pytest.approx(3.0 - scene.lens.z_in, abs=1e-4)
    assert said["stock_height_mm"] == pytest.approx(43.0 - math.sqrt(40.0**2 - rim**2) - scene.lens.z_in, abs=2e-3)
    assert wall_and_stock(replace(scene, lens=replace(scene.lens, mirror=True)), field, heights) == {}
