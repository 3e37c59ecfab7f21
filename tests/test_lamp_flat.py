"""Lamps with a flat inner side: light through the plane in closed form, energy, derivatives, designs and files."""

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from test_lamp import FAR, FIELD, QUICK, bumpy, emit

from caustic_cli import cli
from caustic_cli.errors import InputError
from caustic_cli.inverse.lamp import design_lamp, field_of, initial_lamp, pixels_of, wanted
from caustic_cli.optics.lamp import PointGrid, from_centre, land, least_wall, surfaces_of, through, through_point, uncoated_limit
from caustic_cli.optics.lamp_side import Roof
from caustic_cli.scene.lamp import Chip, Goal, Lamp
from caustic_cli.scene.sources.distribution import Distribution
from caustic_cli.scene.sources.rayset import RaySet
from caustic_cli.studies.lamp import lamp_figures

LAMP = Lamp(inner=4.0, flat=0.5)
EFFORT = replace(QUICK, two_stages=((400, 10_000, 30, 0.2), (800, 10_000, 15, 0.05)))
CHIPS = [Chip(), Chip("disc", (2.0, 1.0)), Chip("rectangle", (1.0, 2.0))]


def fresnel(inside, beyond):
    """Reflectance of unpolarised light, by the angles on both sides (N,)."""
    s = np.sin(inside - beyond) / np.sin(inside + beyond)
    p = np.tan(inside - beyond) / np.tan(inside + beyond)
    return 0.5 * (s * s + p * p)


def test_light_of_a_point_through_a_plane_and_a_sphere_is_that_of_closed_forms():
    """sin t' = sin t / n at the plane z = h, at h tan t from the axis; the sphere about the origin by the quadratic formula, its
    normal being the point itself, all in the plane of incidence."""
    lamp, radius, rays = LAMP, 10.0, emit(Chip(), 5000, 3)
    light = through(lamp, FIELD, rays, FIELD.sphere(radius))
    dx, dy, dz = (d.numpy() for d in rays.direction)
    sine, turn = np.hypot(dx, dy), np.arctan2(dy, dx)
    theta = np.arctan2(sine, dz)
    meets = lamp.flat * np.tan(theta) <= lamp.inner
    assert 0.9 < meets.mean() < 1.0
    within = np.arcsin(sine / lamp.index)
    at = np.stack([np.where(meets, lamp.flat * np.tan(theta), 0.0), np.full_like(theta, lamp.flat)])
    way = np.stack([np.sin(within), np.cos(within)])
    along = (at * way).sum(0)
    point = at + (np.sqrt(along**2 + radius**2 - (at * at).sum(0)) - along) * way
    inside = np.arccos((point * way).sum(0) / radius)
    passes = meets & (lamp.index * np.sin(inside) < 0.999)
    assert passes.sum() > 4000
    beyond = np.arcsin((lamp.index * np.sin(inside)).clip(0.0, 1.0))
    # The way turns within the plane of incidence, away from the normal on the side on which it already lies.
    side = np.sign(way[0] * point[1] - way[1] * point[0])
    leaves = np.arctan2(point[0], point[1]) + side * beyond
    expected = np.stack([np.sin(leaves) * np.cos(turn), np.sin(leaves) * np.sin(turn), np.cos(leaves)])
    seen = torch.stack(light.direction).numpy()
    assert np.abs(seen - expected)[:, passes].max() < 1e-9
    power = rays.power.numpy() * (1.0 - fresnel(theta, within)) * (1.0 - fresnel(inside, beyond))
    normal = inside > 1e-4  # the formula is 0 / 0 at normal incidence
    np.testing.assert_allclose(light.power.numpy()[passes & normal], power[passes & normal], rtol=1e-8)
    np.testing.assert_allclose(light.lost["missed"].numpy(), np.where(meets, 0.0, rays.power.numpy()), atol=1e-18)


def test_light_below_a_plane_is_lambertian_over_the_cone_of_total_reflection():
    """Etendue: n^2 cos t' dw' = cos t dw, so that sin^2 t' is as evenly spread as sin^2 t, up to 1 / n^2."""
    rays, wide = emit(Chip(), 40_000, 1), replace(LAMP, inner=1e3 * LAMP.flat, radius=2e3)
    within, _ = from_centre(wide, FIELD, torch.stack(rays.direction, 1), rays.power)
    reflected = float(through(wide, FIELD, rays, FIELD.sphere(1500.0)).lost["inner_fresnel"].sum())
    square = (LAMP.index**2 * (within[:, 0] ** 2 + within[:, 1] ** 2)).numpy()
    assert square.max() < 1.0
    counted, _ = np.histogram(square, 10, (0.0, 1.0))
    np.testing.assert_allclose(counted / len(square), 0.1, atol=2e-3)
    n = LAMP.index
    walsh = (  # reflectance of diffuse light (J. W. T. Walsh, 1926)
        0.5
        + (n - 1.0) * (3.0 * n + 1.0) / (6.0 * (n + 1.0) ** 2)
        + n**2 * (n**2 - 1.0) ** 2 / (n**2 + 1.0) ** 3 * math.log((n - 1.0) / (n + 1.0))
        - 2.0 * n**3 * (n**2 + 2.0 * n - 1.0) / ((n**2 + 1.0) * (n**4 - 1.0))
        + 8.0 * n**4 * (n**4 + 1.0) / ((n**2 + 1.0) * (n**4 - 1.0) ** 2) * math.log(n)
    )
    assert reflected == pytest.approx(walsh, abs=2e-4)


@pytest.mark.parametrize("table", [None, Distribution((0.0, 40.0, 90.0), (1.0, 0.6, 0.3))])
def test_the_limit_of_uncoated_surfaces_is_that_of_the_light_that_passes_the_plane(table):
    lamp = replace(LAMP, chip=Chip(intensity=table))
    n, angle = lamp.index, 0.5 * math.pi * (np.arange(20_000) + 0.5) / 20_000
    outside, inside = np.cos(angle), np.sqrt(1.0 - (np.sin(angle) / n) ** 2)
    light = np.sin(angle) * (outside if table is None else table.relative(angle))
    meets = lamp.flat * np.tan(angle) <= lamp.inner
    s, p = (outside - n * inside) / (outside + n * inside), (n * outside - inside) / (n * outside + inside)
    passed = float((light * meets * (1.0 - 0.5 * (s**2 + p**2))).sum() / light.sum())
    normal = 1.0 - ((LAMP.index - 1.0) / (LAMP.index + 1.0)) ** 2
    assert uncoated_limit(lamp) == pytest.approx(normal * passed, abs=3e-4)
    assert uncoated_limit(lamp) < uncoated_limit(Lamp()) - 0.02


@pytest.mark.parametrize("chip", CHIPS)
def test_all_light_is_booked(chip):
    rays = emit(chip, 20_000, 3)
    light = through(replace(LAMP, chip=chip), FIELD, rays, bumpy(height=0.2))
    total = light.power + sum(light.lost.values())
    assert float((total - rays.power).abs().max()) < 1e-18
    assert float(total.sum()) == pytest.approx(1.0, abs=1e-12)
    assert min(float(light.lost[cause].sum()) for cause in ("inner_fresnel", "missed", "outer_fresnel")) > 0


def test_a_point_is_a_small_chip_and_its_grid_carries_the_same_light():
    values, rays = bumpy(height=0.02), emit(Chip(), 100_000, 1)
    one, other = (through(replace(LAMP, chip=c), FIELD, rays, values) for c in (Chip(), Chip("disc", (1e-9, 1e-9))))
    lit = one.power > 0
    for a, b in zip((*one.direction, one.power), (*other.direction, other.power), strict=True):
        torch.testing.assert_close(a[lit], b[lit], rtol=1e-6, atol=1e-8)
    grids = [through_point(LAMP, FIELD, grid, values) for grid in PointGrid.of(FIELD, 100_000)]
    assert sum(float(light.power.sum()) for light in grids) == pytest.approx(float(one.power.sum()), abs=3e-4)


@pytest.mark.parametrize("chip", CHIPS)
def test_derivatives_have_second_order_remainders(chip):
    values = bumpy(height=0.02)
    by = torch.randn(values.shape, dtype=torch.float64, generator=torch.Generator().manual_seed(9))
    lamp, rays = replace(LAMP, chip=chip), emit(chip, 400, 2)

    def f(values):
        light = through(lamp, FIELD, rays, values)
        x, y, _ = land(FAR, light)
        return (light.power * (0.01 * x + torch.sin(0.1 * y))).sum() + 0.1 * (rays.power * light.spare).sum()

    start = values.clone().requires_grad_()
    (g,) = torch.autograd.grad(f(start), start)
    steps = [4e-3 * 0.5**k for k in range(5)]
    remainders = [abs(float(f(values + h * by) - f(values) - h * (g * by).sum())) for h in steps]
    assert 1.8 < np.polyfit(np.log(steps), np.log(remainders), 1)[0] < 2.2


def test_the_wall_is_the_distance_from_the_cylinder():
    assert least_wall(LAMP, FIELD, FIELD.sphere(10.0)) == pytest.approx(10.0 - math.hypot(4.0, 0.5), abs=1e-3)
    wide = replace(LAMP, inner=9.0, wall=0.5)
    assert least_wall(wide, FIELD, FIELD.sphere(10.0)) == pytest.approx(10.0 - math.hypot(9.0, 0.5), abs=1e-3)
    assert least_wall(LAMP, FIELD, FIELD.sphere(3.0)) < 0.0
    roof = surfaces_of(LAMP, FIELD, FIELD.sphere(10.0))[1]
    assert isinstance(roof, Roof) and roof.rim == 0.5


@pytest.mark.parametrize(
    "given, words",
    [
        ({"flat": 0.0}, "height of the chip, 0 mm"),
        ({"flat": 14.5}, "less than 14 mm"),
        ({"surfaces": 2}, "one free-form surface"),
        ({"chip": Chip.of_rays(RaySet(np.array([[0.0, 0.0, 0.6]]), np.array([[0.0, 0.0, 1.0]]), np.ones(1)))}, "0.6 mm"),
    ],
)
def test_a_plane_that_does_not_fit_is_refused(given, words):
    with pytest.raises(InputError, match=words):
        replace(LAMP, **given)


def test_its_blur_is_wider_by_the_index():
    assert replace(LAMP, chip=CHIPS[1]).blur(FAR) == pytest.approx(LAMP.index * Lamp(CHIPS[1]).blur(FAR))


def test_a_design_throws_most_light_onto_its_target():
    goal, square = Goal((30_000.0, 10_000.0), 8000.0), np.ones((2, 2))
    fine, coarse = (wanted(goal, square, pixels_of(goal, count)).numpy() for count in (1500, 400))
    start = initial_lamp(LAMP, goal, field_of(EFFORT), square, EFFORT.lamp_cells)
    values = design_lamp(LAMP, goal, square, effort=EFFORT)
    _, before = lamp_figures(LAMP, goal, field_of(EFFORT), start, fine, coarse, rays=100_000)
    _, found = lamp_figures(LAMP, goal, field_of(EFFORT), values, fine, coarse, rays=100_000)
    assert found["of_source"] > 0.78 and found["interior_rms"] < 0.4 * before["interior_rms"]
    assert found["least_wall"] >= LAMP.wall and found["greatest_radius"] < 15.1
    assert sum(found["lost"].values()) + found["of_source"] == pytest.approx(1.0, abs=1e-12)


def test_by_the_command_line(tmp_path, monkeypatch, capfd):
    monkeypatch.chdir(tmp_path)
    given = ["--lamp", "15", "--lamp-flat", "0.5", "--angles", "100x60", "--quiet"]
    assert cli.run(["design", "uniform", *given, "--json", "-o", "flat.caustic"]) == 0
    figures = json.loads(capfd.readouterr().out)
    assert figures["of_source"] > 0.7 and 0.01 < figures["lost"]["missed"] < 0.02
    assert cli.run(["render", "flat.caustic", "--rays", "1e4", "--report", "--effects", "ghosts", "-o", "a.png", "--quiet"]) == 0
    formats = "step,lighttools,stl,ply,obj,3mf,zemax,mitsuba,ies,ldt"
    assert cli.run(["export", "flat.caustic", "--format", formats, "--samples", "20x40", "--quiet"]) == 2  # not all have samples
    assert cli.run(["export", "flat.caustic", "--format", "step,zemax,mitsuba,ldt,3mf", "--quiet"]) == 0
    assert "PLANE" in Path("flat.step").read_text()
    capfd.readouterr()
    assert cli.run(["design", "uniform", *given, "--lamp-surfaces", "2", "-o", "two.caustic"]) == 2
    assert "--lamp-flat" in capfd.readouterr().err
