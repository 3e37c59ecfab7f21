"""Lamps: surfaces around a source, light of a chip through them, and their design."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.optimize import brentq
from scipy.signal import fftconvolve
from scipy.spatial import cKDTree

from caustic_cli.effort import STANDARD
from caustic_cli.errors import InputError
from caustic_cli.inverse.lamp import (
    APRON,
    Folds,
    LampObjective,
    design_lamp,
    directions_of,
    field_of,
    final_field,
    judged_pixels,
    pixels_of,
    refined,
    stages_of,
    wanted,
)
from caustic_cli.inverse.lamp_limits import chip_limits, etendue_limit, least_error
from caustic_cli.inverse.mirrors import Mirrors
from caustic_cli.inverse.refractor_transport import envelope, source_directions
from caustic_cli.optics.lamp import (
    PointGrid,
    chip_grids,
    concentric,
    emissions,
    land,
    least_wall,
    through,
    through_point,
    uncoated_limit,
)
from caustic_cli.optics.surfaces.base import SECOND
from caustic_cli.optics.surfaces.polarfield import PolarField, direction_of, frame, stereographic
from caustic_cli.scene.lamp import Chip, Goal, Lamp
from caustic_cli.scene.sources.rayset import RaySet
from caustic_cli.studies.lamp import cut_off, lamp_figures

FIELD = PolarField.uniform((12, 9), (3, 4))
FAR = Goal((100.0, 60.0))
QUICK = replace(STANDARD, lamp_stages=((400, 10_000, 25, 0.1), (1000, 20_000, 25, 0.02)), lamp_spans=16, lamp_cells=20)


def bumpy(field=FIELD, radius=12.0, height=0.05, seed=0):
    """A sphere with bumps: control values of r."""
    noise = torch.randn(field.shape, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))
    return field.sphere(radius) * (height * noise).exp()


def random(*shape, seed=1):
    return torch.rand(*shape, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))


def emit(chip, count, seed):
    """The rays of a chip, fewer than are emitted at a time."""
    (rays,) = emissions(chip, count, seed)
    return rays


# Geometry


def test_the_frame_is_orthonormal_right_handed_and_along_the_coordinates():
    u, v = (2.0 * random(2, 50) - 1.0).requires_grad_()
    axes = torch.stack([torch.stack(a, 1) for a in frame(u, v)], 1)  # (N, 3, 3)
    torch.testing.assert_close(axes @ axes.mT, torch.eye(3, dtype=torch.float64).expand(50, 3, 3))
    torch.testing.assert_close(torch.linalg.det(axes), torch.ones(50, dtype=torch.float64))
    k = 2.0 / (1.0 + u * u + v * v)
    for j, along in enumerate(axes[:, :2].unbind(1)):
        by = torch.stack([torch.autograd.grad(c.sum(), (u, v)[j], retain_graph=True)[0] for c in direction_of(u, v)], 1)
        torch.testing.assert_close(by, k[:, None] * along)
    torch.testing.assert_close(torch.stack(stereographic(*(3.0 * c for c in direction_of(u, v)))), torch.stack([u, v]))


def test_normals_are_perpendicular_to_the_derivatives_of_the_points():
    values = bumpy()
    u, v = 1.6 * random(2, 40) - 0.8
    normal = torch.stack(FIELD.normals(values, u, v), 1)
    torch.testing.assert_close(normal.norm(dim=1), torch.ones(40, dtype=torch.float64))
    h = 1e-6
    for du, dv in ((h, 0.0), (0.0, h)):
        ahead, behind = (torch.stack(FIELD.points(values, u + s * du, v + s * dv), 1) for s in (1.0, -1.0))
        assert float(((ahead - behind) / (2.0 * h) * normal).sum(1).abs().max()) < 1e-7
    assert bool(((normal * torch.stack(FIELD.points(values, u, v), 1)).sum(1) > 0).all())


@pytest.mark.parametrize("degree", [(3, 4), (2, 5), (1, 3)])
def test_second_derivatives_are_those_of_the_basis(degree):
    field = PolarField.uniform((12, 9), degree)
    values, (u, v) = bumpy(field), 2.0 * random(2, 50) - 1.0
    for found, expected in zip(field.second(values, u, v), field.at(values, u, v, SECOND), strict=True):
        torch.testing.assert_close(found, expected, rtol=1e-10, atol=1e-10)


def test_a_sphere_has_its_radius_everywhere_and_refuses_none():
    u, v = 1.4 * random(2, 10) - 0.7
    points = torch.stack(FIELD.points(FIELD.sphere(7.5), u, v))
    torch.testing.assert_close(points.norm(dim=0), torch.full((10,), 7.5, dtype=torch.float64))
    with pytest.raises(InputError, match="greater than 0 mm"):
        FIELD.sphere(0.0)


@pytest.mark.parametrize("height", [0.0, 0.05, 0.15])
def test_intersections_are_the_first_crossing_found_by_brute_force(height):
    values, n = bumpy(height=height), 100
    origin = [6.0 * (random(n, seed=s) - 0.5) for s in (2, 3)] + [torch.zeros(n, dtype=torch.float64)]
    direction = emit(Chip(), n, 5).direction
    n = len(direction[0])
    origin = tuple(o[:n] if len(o) >= n else o.repeat(2)[:n] for o in origin)
    hit = FIELD.intersect(values, origin, direction)
    t = torch.linspace(0.0, 24.0, 2401, dtype=torch.float64)[:, None]
    x, y, z = (o + t * d for o, d in zip(origin, direction, strict=True))
    u, v = stereographic(x, y, torch.where(t == 0, torch.ones_like(z), z))
    outside = (x * x + y * y + z * z).sqrt() > FIELD.at(values, u.reshape(-1), v.reshape(-1), [(0, 0)])[0].view(u.shape)
    first, crossings = outside.double().argmax(0), (outside.diff(dim=0)).sum(0)
    found = torch.stack([p - o for p, o in zip(hit.point, origin, strict=True)]).norm(dim=0)
    once = crossings == 1
    assert int(once.sum()) > 0.9 * n
    assert bool(hit.valid[once].all())
    assert float((found - t[first, 0])[once].abs().max()) < 1.05e-2  # the spacing of the samples
    r = torch.stack(hit.point).norm(dim=0)
    torch.testing.assert_close(r[hit.valid], FIELD.at(values, hit.u, hit.v, [(0, 0)])[0][hit.valid], rtol=0, atol=1e-12)


def test_rays_that_start_outside_have_no_intersection():
    one = torch.ones(1, dtype=torch.float64)
    hit = FIELD.intersect(FIELD.sphere(5.0), (6.0 * one, 0.0 * one, 1.0 * one), (0.0 * one, 0.0 * one, one))
    assert not bool(hit.valid.any())
    lamp = Lamp(Chip("disc", (2.0, 2.0)), inner=6.0, radius=15.0)
    rays = emit(lamp.chip, 1000, 1)
    light = through(lamp, FIELD, rays, FIELD.sphere(5.0))  # within the hemisphere: every ray misses, and is booked as such
    assert float(light.power.sum()) == 0.0
    assert float(light.lost["missed"].sum() + light.lost["inner_fresnel"].sum()) == pytest.approx(1.0, abs=1e-12)


# Light


@pytest.mark.parametrize("chip", [Chip(), Chip("disc", (3.0, 3.0)), Chip("rectangle", (2.0, 1.0))])
def test_a_lambertian_chip_emits_by_the_cosine_from_its_whole_area(chip):
    rays = emit(chip, 40_000, 3)
    x, y, _ = rays.origin
    dx, _, dz = rays.direction
    assert float(rays.power.sum()) == pytest.approx(1.0, abs=1e-12)
    assert float(dz.mean()) == pytest.approx(2.0 / 3.0, abs=2e-3)  # of cos(theta) / pi
    assert float((dx * dx).mean()) == pytest.approx(0.25, abs=2e-3)
    squares = {"point": (0.0, 0.0), "disc": (9.0 / 16.0, 9.0 / 16.0), "rectangle": (4.0 / 12.0, 1.0 / 12.0)}[chip.shape]
    for c, square in zip((x, y), squares, strict=True):
        assert float((c * c).mean()) == pytest.approx(square, abs=2e-3)
    assert float((x * dx).mean()) == pytest.approx(0.0, abs=5e-3)


@pytest.mark.parametrize("chip", [Chip(), Chip("disc", (4.0, 4.0))])
def test_many_rays_are_emitted_some_at_a_time(chip):
    parts = list(emissions(chip, 300_000, 1))
    assert len(parts) == 3 and max(len(part.power) for part in parts) == 1 << 17
    assert sum(float(part.power.sum()) for part in parts) == pytest.approx(1.0, abs=1e-12)
    assert sum(float((part.power * part.direction[2]).sum()) for part in parts) == pytest.approx(2.0 / 3.0, abs=1e-4)


@pytest.mark.parametrize("chip", [Chip(), Chip("disc", (4.0, 4.0)), Chip("rectangle", (5.0, 3.0))])
def test_all_light_is_booked(chip):
    lamp, values = Lamp(chip, inner=5.0, radius=16.0), bumpy(height=0.2)
    rays = emit(chip, 20_000, 3)
    light = through(lamp, FIELD, rays, values)
    total = light.power + sum(light.lost.values())
    assert float((total - rays.power).abs().max()) < 1e-18
    assert float(total.sum()) == pytest.approx(1.0, abs=1e-12)
    assert min(float(light.lost[cause].sum()) for cause in ("inner_fresnel", "outer_fresnel", "total_internal_reflection")) > 0
    norm = torch.stack(light.direction).norm(dim=0)[light.power > 0]
    assert float((norm - 1.0).abs().max()) < 1e-12


@pytest.mark.parametrize("chip", [Chip("disc", (4.0, 2.0)), Chip("rectangle", (2.0, 1.0))])
def test_the_grids_of_a_chip_carry_the_light_of_independent_rays(chip):
    parts = list(chip_grids(chip, 4, 300_000))
    assert len(parts) > 1 and sum(float(part.power.sum()) for part in parts) == pytest.approx(1.0, abs=1e-12)
    moments = [lambda o, d: o[0] ** 2, lambda o, d: o[1] ** 2, lambda o, d: d[2], lambda o, d: d[0] ** 2, lambda o, d: o[0] * d[0]]
    other = emit(chip, 100_000, 2)
    for moment in moments:
        mean = sum(float((part.power * moment(part.origin, part.direction)).sum()) for part in parts)
        assert mean == pytest.approx(float((other.power * moment(other.origin, other.direction)).sum()), rel=0.01, abs=1e-3)
    assert sum(len(part.power) for part in parts) == pytest.approx(300_000, rel=0.02)


def test_the_interior_of_a_target_is_what_a_chip_does_not_blur():
    road = Goal((30_000.0, 10_000.0), 8000.0)
    assert Lamp().border(road) == 250.0  # of a point
    assert Lamp(Chip("rectangle", (0.5, 0.3))).border(road) == pytest.approx(2.0 * 0.5 / 15.0 * 8000.0)
    assert Lamp(Chip("disc", (3.0, 3.0))).border(road) == 1000.0
    assert Lamp(Chip("disc", (1.0, 1.0))).blur(Goal((90.0, 30.0))) == pytest.approx(math.degrees(1.0 / 15.0))


def test_a_sphere_about_a_point_loses_what_normal_incidence_reflects():
    lamp, rays = Lamp(), emit(Chip(), 1000, 0)
    light = through(lamp, FIELD, rays, FIELD.sphere(15.0))
    assert float(light.power.sum()) == pytest.approx(uncoated_limit(lamp), abs=1e-12)
    assert uncoated_limit(lamp) == pytest.approx(0.9240, abs=1e-4)
    torch.testing.assert_close(torch.stack(light.direction), torch.stack(rays.direction))


def test_a_point_is_a_small_chip_and_its_grid_carries_the_same_light():
    values = bumpy(height=0.02)
    rays = emit(Chip(), 100_000, 1)
    small = Chip("disc", (1e-9, 1e-9))
    one, other = through(Lamp(), FIELD, rays, values), through(Lamp(small), FIELD, rays, values)
    for a, b in zip((*one.direction, one.power), (*other.direction, other.power), strict=True):
        torch.testing.assert_close(a, b, rtol=1e-7, atol=1e-9)
    grids = PointGrid.of(FIELD, 100_000)
    assert sum(float(grid.power.sum()) for grid in grids) == pytest.approx(1.0, abs=1e-12)
    lights = [through_point(Lamp(), FIELD, grid, values) for grid in grids]
    assert sum(float(light.power.sum()) for light in lights) == pytest.approx(float(one.power.sum()), abs=1e-5)
    for k in (0, 1, 2):
        mean = sum(float((light.power * light.direction[k]).sum()) for light in lights)
        assert mean == pytest.approx(float((one.power * one.direction[k]).sum()), abs=2e-4)


def test_rays_are_those_of_a_textbook_tracer():
    """Roots by SciPy, normals by differences of points, Snell and Fresnel by angles."""
    lamp, values = Lamp(Chip("rectangle", (4.0, 3.0)), inner=4.5, radius=16.0), bumpy(height=0.25)
    rays = emit(lamp.chip, 100, 6)
    light = through(lamp, FIELD, rays, values)

    def height(points):
        """|P| - r(P) of points (.., 3)."""
        x, y, z = torch.from_numpy(np.atleast_2d(points)).T
        u, v = stereographic(x, y, z)
        return np.linalg.norm(points, axis=-1) - np.squeeze(FIELD.at(values, u, v, [(0, 0)])[0].numpy())

    def normal(point, h=1e-6):
        """The gradient of |P| - r(P), by differences."""
        found = np.array([height(point + h * e) - height(point - h * e) for e in np.eye(3)])
        return found / np.linalg.norm(found)

    def interface(d, n, eta):
        """Direction and transmittance beyond a surface; None in total reflection."""
        inside = math.acos(min(1.0, float(d @ n)))
        if eta * math.sin(inside) >= 1.0:
            return None
        beyond = math.asin(eta * math.sin(inside))
        out = eta * d + (math.cos(beyond) - eta * math.cos(inside)) * n
        if inside < 1e-9:
            return out, 1.0 - ((1.0 - eta) / (1.0 + eta)) ** 2
        s = math.sin(inside - beyond) / math.sin(inside + beyond)
        p = math.tan(inside - beyond) / math.tan(inside + beyond)
        return out, 1.0 - 0.5 * (s * s + p * p)

    checked = reflected = 0
    for k in range(len(rays.power)):
        o, d = (np.array([float(c[k]) for c in w]) for w in (rays.origin, rays.direction))
        t = brentq(lambda t: np.linalg.norm(o + t * d) - lamp.inner, 0.0, 20.0, xtol=1e-14)  # noqa: B023
        o = o + t * d
        d, power = interface(d, o / lamp.inner, 1.0 / lamp.index)
        if d[2] <= 0 or (np.diff(height(o + np.linspace(0.0, 25.0, 500)[:, None] * d) > 0) != 0).sum() != 1:
            continue  # more than one crossing
        t = brentq(lambda t: float(height(o + t * d)), 0.0, 25.0, xtol=1e-13)  # noqa: B023
        point = o + t * d
        np.testing.assert_allclose([float(c[k]) for c in light.point], point, atol=1e-9)
        found = interface(d, normal(point), lamp.index)
        if found is None:
            assert float(light.power[k]) == 0.0 and float(light.lost["total_internal_reflection"][k]) > 0.0
            reflected += 1
            continue
        np.testing.assert_allclose([float(c[k]) for c in light.direction], found[0], atol=1e-5)
        assert float(light.power[k] / rays.power[k]) == pytest.approx(power * found[1], abs=1e-4)
        checked += 1
    assert checked > 50 and reflected > 2


def test_an_ellipsoid_with_the_chip_at_its_focus_sends_all_light_into_one_direction():
    """r = b / (1 - x.y / n), the stigmatic surface on which the transport rests."""
    y = torch.tensor([0.1, -0.2, 0.9], dtype=torch.float64)
    y = y / y.norm()
    field, lamp = PolarField.uniform((80, 80), (5, 5)), Lamp()
    u, v = (c.reshape(-1) for c in torch.meshgrid(*field.net.control_xy(), indexing="ij"))
    g = torch.zeros(1, dtype=torch.float64)
    log_r = envelope(direction_of(u, v), y[None], torch.ones(1, dtype=torch.float64), g, 0.01, lamp.index)
    values = field.net.interpolated(10.0 * log_r.exp().view(field.shape))
    (grid,) = PointGrid.of(field, 5000)
    light = through_point(lamp, field, grid, values)
    x = torch.stack(direction_of(grid.u, grid.v), 1)
    seen = x @ y > 1.0 / lamp.index + 0.02  # beyond, the ellipsoid turns its back to y
    assert 0.15 < float(seen.double().mean()) < 0.8
    assert bool((light.power[seen] > 0).all())
    assert float((torch.stack(light.direction, 1)[seen] @ y).min()) > 1.0 - 1e-8


def test_coordinates_on_a_plane_and_in_the_far_field_are_those_of_directions():
    pixels = (7, 5)
    for goal in (FAR, Goal((4000.0, 3000.0), 2000.0), Goal((4000.0, 3000.0), 2000.0, (700.0, -2500.0))):
        d = directions_of(goal, pixels)
        light = through(Lamp(), FIELD, emit(Chip(), 4, 0), FIELD.sphere(10.0))
        zero = torch.zeros(len(d), dtype=torch.float64)
        x, y, ahead = land(goal, light._replace(point=(zero, zero, zero), direction=tuple(d.T), power=zero))
        assert bool(ahead.all())
        for c, n, s in zip((x.view(pixels)[:, 0], y.view(pixels)[0]), pixels, goal.size, strict=True):
            torch.testing.assert_close(c, ((torch.arange(n, dtype=torch.float64) + 0.5) / n - 0.5) * s)


def test_the_light_wanted_in_the_far_field_is_intensity_times_solid_angle():
    power = wanted(Goal((90.0, 120.0)), np.ones((3, 3)), (6, 8))
    edges = np.sin(np.radians(np.linspace(-60.0, 60.0, 9)))
    np.testing.assert_allclose(power[0].numpy() / float(power[0].sum()), np.diff(edges) / (edges[-1] - edges[0]), rtol=1e-12)
    assert pixels_of(Goal((30.0, 10.0), 8.0), 1200) == (60, 20)


def test_a_shifted_target_lies_where_it_was_shifted_to():
    goal = Goal((4000.0, 2000.0), 2000.0, (500.0, -800.0))
    d = directions_of(goal, (2, 2))
    x, y = 2000.0 * d[:, 0] / d[:, 2], 2000.0 * d[:, 1] / d[:, 2]
    np.testing.assert_allclose(torch.stack([x, y], 1), [[-500, -1300], [-500, -300], [1500, -1300], [1500, -300]])
    assert goal.nearest_edge == pytest.approx(math.degrees(math.atan(0.1)))
    assert replace(goal, shift=(0.0, 3000.0)).nearest_edge == pytest.approx(-45.0)
    assert Goal((4000.0, 2000.0), 2000.0).nearest_edge == pytest.approx(math.degrees(math.atan(0.5)))
    assert FAR.nearest_edge == 30.0


def test_the_light_of_the_transport_is_lambertian():
    x, a = source_directions(80)
    assert float(a.sum()) == pytest.approx(1.0, abs=1e-12)
    assert float((a * x[:, 2]).sum()) == pytest.approx(2.0 / 3.0, abs=1e-3)


# Two free-form surfaces


@pytest.mark.parametrize("chip", [Chip(), Chip("disc", (3.0, 2.0))])
def test_a_spherical_inner_surface_is_the_hemisphere(chip):
    outer, rays = bumpy(height=0.2), emit(chip, 5000, 2)
    one = through(Lamp(chip, inner=4.0), FIELD, rays, outer)
    two = through(Lamp(chip, inner=4.0, surfaces=2), FIELD, rays, torch.stack([FIELD.sphere(4.0), outer]))
    for a, b in zip((*one.point, *one.direction, one.power), (*two.point, *two.direction, two.power), strict=True):
        lit = one.power > 0
        torch.testing.assert_close(a[lit], b[lit], rtol=1e-9, atol=1e-9)
    for cause, lost in one.lost.items():
        torch.testing.assert_close(lost, two.lost[cause], rtol=1e-9, atol=1e-15)


def test_all_light_is_booked_between_two_surfaces_and_the_grid_carries_the_same():
    values = torch.stack([bumpy(radius=4.0, height=0.1, seed=3), bumpy(height=0.1)])
    lamp = Lamp(inner=3.0, surfaces=2)
    for chip in (Chip(), Chip("rectangle", (2.0, 2.0))):
        rays = emit(chip, 30_000, 3)
        light = through(replace(lamp, chip=chip), FIELD, rays, values)
        assert float((light.power + sum(light.lost.values()) - rays.power).abs().max()) < 1e-18
        assert float(light.lost["inner_fresnel"].sum()) > 0.0387
    light = through(lamp, FIELD, emit(Chip(), 100_000, 3), values)
    grids = [through_point(lamp, FIELD, grid, values) for grid in PointGrid.of(FIELD, 100_000)]
    assert sum(float(one.power.sum()) for one in grids) == pytest.approx(float(light.power.sum()), abs=2e-4)


def test_light_that_leaves_the_glass_on_its_way_is_booked_as_missed():
    rays = emit(Chip(), 1000, 1)
    light = through(Lamp(surfaces=2), FIELD, rays, torch.stack([FIELD.sphere(6.0), FIELD.sphere(5.0)]))  # crossed
    assert float(light.power.sum()) == 0.0 and float(light.lost["missed"].sum()) > 0.9
    dented = FIELD.sphere(4.0)
    dented[5:7, :] *= 2.46  # a wall across the inner surface, through which light of its flanks passes twice
    with torch.no_grad():
        light = through(Lamp(inner=3.0, surfaces=2), FIELD, emit(Chip(), 20_000, 1), torch.stack([dented, FIELD.sphere(15.0)]))
    assert 0.0 < float(light.lost["missed"].sum()) < 0.9
    assert float((light.power + sum(light.lost.values())).sum()) == pytest.approx(1.0, abs=1e-12)


def test_the_wall_between_two_surfaces_is_their_least_distance():
    lamp, inner = Lamp(surfaces=2), FIELD.sphere(4.0)
    assert least_wall(lamp, FIELD, torch.stack([inner, FIELD.sphere(3.0)])) < 0.0
    outer = bumpy(radius=7.0, height=0.1, seed=8)
    wall = least_wall(lamp, FIELD, torch.stack([inner, outer]))
    assert wall == pytest.approx(FIELD.extent(outer)[0] - 4.0, abs=2e-3)  # of a sphere it is along the radius
    assert least_wall(Lamp(inner=4.0), FIELD, outer) == pytest.approx(wall, abs=2e-3)


def test_two_surfaces_are_differentiable_to_second_order_remainders():
    values = torch.stack([bumpy(radius=4.0, height=0.02, seed=3), bumpy(height=0.02)])
    by = torch.randn(values.shape, dtype=torch.float64, generator=torch.Generator().manual_seed(9))
    for chip in (Chip(), Chip("disc", (2.0, 2.0))):
        lamp, rays = Lamp(chip, inner=3.0, surfaces=2), emit(chip, 400, 2)

        def f(values, lamp=lamp, rays=rays):
            light = through(lamp, FIELD, rays, values)
            x, y, _ = land(FAR, light)
            return (light.power * (0.01 * x + torch.sin(0.1 * y))).sum() + 0.1 * (rays.power * light.spare).sum()

        start = values.clone().requires_grad_()
        (g,) = torch.autograd.grad(f(start), start)
        steps = [4e-4 * 0.5**k for k in range(5)]
        remainders = [abs(float(f(values + h * by) - f(values) - h * (g * by).sum())) for h in steps]
        assert 1.8 < np.polyfit(np.log(steps), np.log(remainders), 1)[0] < 2.2


def test_two_surfaces_pass_more_light_than_one_and_keep_their_limits():
    goal, square = Goal((30_000.0, 10_000.0), 8000.0), np.ones((2, 2))
    effort = replace(QUICK, two_stages=((400, 10_000, 40, 0.1),), lamp_stages=((400, 10_000, 40, 0.1),))
    fine, coarse = (wanted(goal, square, pixels_of(goal, count)).numpy() for count in (1500, 400))
    found = {}
    for surfaces, inner, wall in ((1, 4.0, 1.0), (2, 2.0, 1.5)):
        lamp = Lamp(index=1.49, inner=inner, wall=wall, surfaces=surfaces)
        values = design_lamp(lamp, goal, square, effort=effort)
        _, found[surfaces] = lamp_figures(lamp, goal, field_of(effort), values, fine, coarse, rays=100_000)
        assert found[surfaces]["least_wall"] >= lamp.wall
    assert found[2]["of_source"] > found[1]["of_source"] + 0.02
    assert found[2]["greatest_radius"] < 15.1
    field = field_of(effort)
    assert field.extent(values[0])[0] > 0.9 * 2.0
    dx, dy = concentric(*random(2, 1_000_000))  # the gap at a million points
    at = stereographic(dx, dy, (1.0 - dx * dx - dy * dy).clamp_min(0.0).sqrt())
    inner, outer = (np.stack([c.numpy() for c in field.points(net, *at)], 1) for net in values)
    assert float(cKDTree(inner).query(outer, distance_upper_bound=2.0)[0].min()) >= 1.5


def test_folded_light_lacks_and_its_lack_is_differentiable():
    goal, lamp = Goal((100.0, 60.0)), Lamp(inner=3.0, surfaces=2)
    folds = Folds(lamp, goal, FIELD)
    even = torch.stack([FIELD.sphere(4.0), FIELD.sphere(12.0)])  # of light that goes straight on
    assert float(folds.lack(even)) < 1e-12
    values = even.clone()
    values[1] = bumpy(height=0.02)
    assert float(folds.lack(values)) > 1e-9
    light = folds.through(folds.rays, values)  # another sign of folds: neighbours along u land in the other order
    x, _, _ = land(goal, light)
    rows = torch.full(folds.rays.shape, math.nan, dtype=torch.float64)
    rows.view(-1)[folds.rays.lit] = x
    assert bool((rows.diff(dim=0) < 0).any())
    by = torch.randn(values.shape, dtype=torch.float64, generator=torch.Generator().manual_seed(9))
    start = values.clone().requires_grad_()
    (g,) = torch.autograd.grad(folds.lack(start), start)
    steps = [1e-4 * 0.5**k for k in range(5)]
    remainders = [abs(float((folds.lack(values + h * by) - folds.lack(values)).detach() - h * (g * by).sum())) for h in steps]
    assert 1.8 < np.polyfit(np.log(steps), np.log(remainders), 1)[0] < 2.2


# Gradients


@pytest.mark.parametrize("chip", [Chip(), Chip("rectangle", (3.0, 2.0))])
def test_the_light_is_differentiable_to_second_order_remainders(chip):
    lamp, values = Lamp(chip, inner=5.0, radius=16.0), bumpy(height=0.02)
    rays, by = emit(chip, 400, 2), torch.randn(FIELD.shape, dtype=torch.float64, generator=torch.Generator().manual_seed(9))

    def f(values):
        light = through(lamp, FIELD, rays, values)
        x, y, _ = land(FAR, light)
        return (light.power * (0.01 * x + torch.sin(0.1 * y))).sum() + 0.1 * (rays.power * light.spare).sum()

    start = values.clone().requires_grad_()
    (g,) = torch.autograd.grad(f(start), start)
    steps = [1e-3 * 0.5**k for k in range(5)]
    remainders = [abs(float(f(values + h * by) - f(values) - h * (g * by).sum())) for h in steps]
    order = np.polyfit(np.log(steps), np.log(remainders), 1)[0]
    assert 1.8 < order < 2.2


@pytest.mark.parametrize("chip", [Chip(), Chip("disc", (2.0, 2.0))])
def test_the_loss_is_differentiable_to_second_order_remainders(chip):
    lamp, field = Lamp(chip), PolarField.uniform((10, 10))
    goal = Goal((120.0, 120.0))
    objective = LampObjective(lamp, goal, field, wanted(goal, np.ones((2, 2)), (8, 8)), 3000)
    values, by = field.sphere(15.0), bumpy(field, seed=4) - field.sphere(12.0)
    start = values.clone().requires_grad_()
    (g,) = torch.autograd.grad(objective(start), start)
    steps = [2e-3 * 0.5**k for k in range(5)]
    remainders = [abs(float((objective(values + h * by) - objective(values)).detach()) - h * float((g * by).sum())) for h in steps]
    assert 1.7 < np.polyfit(np.log(steps), np.log(remainders), 1)[0] < 2.3


@pytest.mark.parametrize("chip", [Chip(), Chip("disc", (2.0, 2.0))])
def test_the_loss_is_the_same_in_any_number_of_threads(chip, monkeypatch):
    monkeypatch.setattr("caustic_cli.optics.lamp.CHUNK", 300)
    field, goal = PolarField.uniform((10, 10)), Goal((120.0, 120.0))
    found = []
    for threads in (1, 3):
        objective = LampObjective(Lamp(chip), goal, field, wanted(goal, np.ones((2, 2)), (8, 8)), 3000, threads=threads)
        assert len(objective.groups) > 2
        start = bumpy(field, seed=4).requires_grad_()
        loss = objective(start)
        found.append((float(loss.detach()), torch.autograd.grad(loss, start)[0]))
        with torch.no_grad():
            assert float(objective(start)) == found[-1][0]
    assert found[0][0] == found[1][0] and torch.equal(found[0][1], found[1][1])


@pytest.mark.parametrize(
    "goal, picture, planes",
    [
        (FAR, np.ones((4, 4)), (True, True)),
        (FAR, np.outer([1.0, 2.0, 3.0, 4.0], [1.0, 2.0, 2.0, 1.0]), (False, True)),
        (Goal((5e3, 4e3), 4e3, (0.0, 600.0)), np.ones((4, 4)), (True, False)),
    ],
)
def test_the_light_on_one_side_of_mirror_planes_stands_for_all_of_it(goal, picture, planes, monkeypatch):
    """Loss and gradient of symmetric surfaces are those by all rays, with a part of them."""
    lamp, target = Lamp(surfaces=2), wanted(goal, picture, (40, 24))
    assert Mirrors.of(lamp, goal, target) == planes
    values = torch.stack([FIELD.sphere(5.0), bumpy()])
    values, found, rays = Mirrors(*planes).whole(values), [], []
    for mirrored in (True, False):
        if not mirrored:
            monkeypatch.setattr(Mirrors, "of", lambda *_: Mirrors())
        objective = LampObjective(lamp, goal, FIELD, target, 20_000)
        start = values.clone().requires_grad_()
        loss = objective(start)
        found.append((loss.detach(), Mirrors(*planes).whole(torch.autograd.grad(loss, start)[0])))
        rays.append(sum(len(grid.power) for grids in objective.groups for grid in grids))
    torch.testing.assert_close(found[0], found[1], rtol=1e-9, atol=1e-14)
    assert rays[1] == 2 ** sum(planes) * rays[0]


@pytest.mark.parametrize("chip", [Chip("rectangle", (2.0, 1.0)), Chip("disc", (2.0, 2.0))])
def test_the_places_of_a_chip_on_one_side_carry_all_light(chip):
    parts = list(chip_grids(chip, 4, 300_000, (True, False)))
    assert sum(float(part.power.sum()) for part in parts) == pytest.approx(1.0)
    x, y, _ = (torch.cat([part.origin[k] for part in parts]) for k in range(3))
    assert float(x.min()) > 0 and abs(float(y.mean())) < 1e-3
    everywhere = sum(len(part.power) for part in chip_grids(chip, 4, 300_000))
    assert len(x) == pytest.approx(0.5 * everywhere, rel=1e-3)


def test_a_chip_of_a_file_has_no_mirror_planes():
    rays = RaySet(np.zeros((3, 3)), np.tile([0.0, 0.0, 1.0], (3, 1)), np.ones(3))
    assert Mirrors.of(Lamp(Chip.of_rays(rays)), FAR, torch.ones(4, 4, dtype=torch.float64)) == (False, False)


# Design


def test_a_symmetric_target_has_symmetric_surfaces():
    values = design_lamp(Lamp(), FAR, np.ones((4, 4)), effort=QUICK)
    for axis in (0, 1):
        torch.testing.assert_close(values, values.flip(axis), rtol=1e-14, atol=0)


def test_a_net_of_more_spans_is_the_same_surface():
    effort = replace(STANDARD, lamp_spans=16)
    assert [field_of(effort, pixels).shape[0] for pixels in (360, 350, 80)] == [19, 11, 7]
    coarse, fine = field_of(effort, 80), field_of(effort)
    values, (u, v) = torch.stack([bumpy(coarse), bumpy(coarse, seed=3)]), 1.8 * random(2, 50) - 0.9
    for one, other in zip(values, refined(coarse, values, fine), strict=True):
        torch.testing.assert_close(torch.stack(coarse.at(one, u, v)), torch.stack(fine.at(other, u, v)), rtol=0, atol=1e-12)


def test_a_lamp_is_judged_on_pixels_half_as_wide_as_those_refined():
    goal = Goal((30_000.0, 10_000.0), 8000.0)
    for lamp, (across, along) in ((Lamp(), (537, 179)), (Lamp(surfaces=2), (268, 90)), (Lamp(Chip("disc", (1.0, 1.0))), (96, 32))):
        assert judged_pixels(lamp, goal, STANDARD) == (2 * across, 2 * along)


def test_a_design_has_the_spans_that_the_pixels_of_its_last_stage_show():
    point, chip = Lamp(), Lamp(Chip("disc", (1.0, 1.0)))
    assert [final_field(lamp, STANDARD).shape[0] - 3 for lamp in (point, replace(point, surfaces=2), chip)] == [256, 128, 32]
    assert [stage[1] for _, stage in stages_of(chip, STANDARD)] == [20_000, 60_000, 300_000]  # rays: few for the point


def test_pixels_of_a_point_are_half_as_wide():
    """All are compared, and the loss is the squared relative error on them, on the apron as within."""
    goal = Goal((80.0, 40.0))
    one = LampObjective(Lamp(), goal, FIELD, wanted(goal, np.ones((2, 2)), (40, 20)), 3000)
    assert one.weights.shape == one.target.shape == (40 + 4 * APRON, 20 + 4 * APRON)
    assert bool((one.weights == 40 * 20).all())


def test_the_edges_that_a_chip_blurs_count_little():
    goal = Goal((80.0, 40.0))
    target = wanted(goal, np.ones((2, 2)), (40, 20))
    other = LampObjective(Lamp(Chip("disc", (0.5, 0.5))), goal, FIELD, target, 3000)
    counted = other.weights / other.weights.max()
    assert counted.shape == (20 + 2 * APRON, 10 + 2 * APRON) and 0 < float(counted.min()) < 0.02
    assert float((counted == 1.0).sum()) == (20 - 2) * (10 - 2)  # less 3.8 degrees, a pixel of 4, at every edge
    assert float((other.target * other.seen).sum()) == pytest.approx(1.0) and float(other.target.sum()) > 1.2


@pytest.mark.parametrize("goal", [Goal((2000.0, 2000.0), 1000.0), Goal((100.0, 60.0)), Goal((5e3, 4e3), 4e3, (8e2, -6e2))])
def test_a_small_design_lights_its_target(goal):
    losses = []
    lamp = Lamp(inner=4.0 if goal.shift == (0.0, 0.0) else 3.0)
    values = design_lamp(lamp, goal, np.ones((2, 2)), effort=QUICK, on_iteration=lambda *step: losses.append(step))
    assert losses[-1][2] < losses[0][2]
    assert {stage for stage, _, _ in losses} == {0, 1}
    fine, coarse = (wanted(goal, np.ones((2, 2)), pixels_of(goal, count)).numpy() for count in (2000, 400))
    found, figures = lamp_figures(lamp, goal, field_of(QUICK), values, fine, coarse, rays=200_000, seed=5)
    assert figures["of_source"] + sum(figures["lost"].values()) == pytest.approx(1.0, abs=1e-12)
    assert figures["of_source"] > (0.82 if goal.shift == (0.0, 0.0) else 0.72)  # light of one side has farther to go
    assert figures["interior_rms"] < 0.12
    assert figures["uniformity"] > 0.6
    assert found.image.sum() == pytest.approx(figures["of_source"], abs=1e-12)


def test_a_design_is_repeated_to_the_bit():
    stages = ((100, 2000, 3, 0.1),)
    effort = replace(STANDARD, lamp_stages=stages, chip_stages=stages, lamp_spans=6, lamp_cells=12)
    chip, goal = Lamp(Chip("disc", (0.5, 0.5))), Goal((80.0, 80.0))
    one, other = (design_lamp(chip, goal, np.ones((2, 2)), effort=effort) for _ in range(2))
    assert torch.equal(one, other)


def test_a_surface_too_near_to_the_hemisphere_is_refused_with_the_radius_needed():
    goal, effort = Goal((100.0, 100.0)), replace(STANDARD, lamp_stages=(), lamp_spans=6, lamp_cells=16)
    with pytest.raises(InputError, match=r"radius of [\d.]+ mm or more") as error:
        design_lamp(Lamp(inner=5.0, radius=6.5), goal, np.ones((2, 2)), effort=effort)
    radius = float(str(error.value).split("radius of ")[1].split()[0])
    design_lamp(Lamp(inner=5.0, radius=radius), goal, np.ones((2, 2)), effort=effort)


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: Chip("square"), "one of point, disc, rectangle"),
        (lambda: Chip("point", (1.0, 1.0)), "a point has no size"),
        (lambda: Chip("disc", (1.0, 0.0)), "two sizes above 0 mm"),
        (lambda: Chip("disc", (math.nan, 1.0)), "finite and not negative"),
        (lambda: Lamp(index=1.0), "greater than 1"),
        (lambda: Lamp(Chip("rectangle", (8.0, 8.0)), inner=5.0), "greater than the radius of the chip, 5.65685 mm"),
        (lambda: Lamp(radius=4.5), "5 mm"),
        (lambda: Lamp(wall=0.0), "wall"),
        (lambda: Goal((0.0, 1.0), 5.0), "greater than 0"),
        (lambda: Goal((1.0, 1.0), 0.0), "distance"),
        (lambda: Goal((180.0, 20.0)), "at most 178 degrees"),
        (lambda: Goal((80.0, 20.0), shift=(1.0, 0.0)), "centred on the axis"),
        (lambda: Goal((80.0, 20.0), 90.0, (math.nan, 0.0)), "shift of a target must be finite"),
        (lambda: wanted(Goal((10.0, 10.0)), np.zeros((3, 3)), (4, 4)), "black"),
    ],
)
def test_values_out_of_range_are_refused_in_one_line(make, words):
    with pytest.raises(InputError) as error:
        make()
    assert words in str(error.value)
    assert "\n" not in str(error.value)


# The upper edge


@pytest.mark.parametrize("wide", [0.4, 2.0])
def test_the_cut_off_is_the_angle_between_two_parts_of_the_intensity_beneath(wide):
    latitude = (np.arange(1800) + 0.5) * 0.1 - 90.0
    intensity = np.clip(0.5 - (latitude - 3.0) / wide, 0.0, 1.0) * (latitude > -20.0)  # a ramp
    rise = intensity * np.cos(np.radians(latitude))
    assert cut_off(rise) == pytest.approx(0.8 * wide, rel=0.08)
    assert cut_off(0.0 * rise) is None
    assert cut_off(np.where(np.arange(1800) == 900, 1.0, 0.0)) is None


# Limits by the chip


def test_a_narrow_target_takes_no_more_light_than_its_etendue():
    """Of a cone about the axis the etendue is known: pi R^2 (w + pi sin^2) / 2, w its solid angle."""
    chip = Chip("disc", (4.0, 4.0))
    wide = etendue_limit(Lamp(chip), Goal((30_000.0, 10_000.0), 8000.0))
    assert wide > 1.0 and etendue_limit(Lamp(), FAR) == math.inf
    for goal, solid in (
        (Goal((6.0, 6.0)), math.radians(6.0) * 2.0 * math.sin(math.radians(3.0))),
        (Goal((10.0, 10.0), 100.0), 0.01),
    ):
        expected = math.pi * 15.0**2 * solid / (math.pi * math.pi * 4.0)
        assert etendue_limit(Lamp(chip), goal) == pytest.approx(expected, rel=5e-3)
    half = etendue_limit(Lamp(chip, radius=1e3), Goal((178.0, 178.0)))
    assert half == pytest.approx(0.25e6 * 1.5, rel=0.02)  # the half ball in all directions: pi R^2 (2 pi + pi) / 2


def test_the_error_of_fine_shades_is_bounded_behind_the_blur_of_a_chip():
    stripes = np.repeat((np.arange(16) % 2 == 0) * 1.0 + 0.2, 6)[:, None] * np.ones((1, 60))
    goal = Goal((12_000.0, 6000.0), 8000.0)
    small, large = (least_error(Lamp(Chip("disc", (s, s))), goal, stripes, 400) for s in (0.3, 3.0))
    assert small < 0.01 and 0.2 < large < 0.72  # of two shades 1.2 and 0.2 the standard deviation is 0.71
    words = list(chip_limits(Lamp(Chip("rectangle", (2.0, 2.0))), goal, stripes, 200))
    assert len(words) == 3 and "blurs the picture by 1067 mm" in words[0] and "of less than 0." in words[1]
    assert "by etendue, at most 35%" in list(chip_limits(Lamp(Chip("disc", (4.0, 4.0))), Goal((8.0, 8.0)), np.ones((2, 2)), 9))[1]
    assert list(chip_limits(Lamp(), goal, stripes, 9)) == []


def test_sharp_edges_cost_light_behind_the_blur_of_a_chip():
    """The bound of a uniform picture: none if light may fall beside it, and less than the error of any blurred picture."""
    goal, lamp, square = Goal((30_000.0, 10_000.0), 8000.0), Lamp(Chip("rectangle", (3.0, 3.0)), inner=3.0), np.ones((2, 2))
    free, little, none = (least_error(lamp, goal, square, 300, beside) for beside in (math.inf, 0.01, 0.002))
    assert free < 1e-3 and 0.05 < little <= none
    pixels, blur = pixels_of(goal, 3000), 0.5 * lamp.blur(goal)
    x, y = ((np.arange(n) + 0.5) / n * s - s / 2 for n, s in zip(pixels, goal.size, strict=True))
    kernel = (np.hypot(x[:, None], y[None, :]) <= blur).astype(float)
    for shrunk in (0.0, 0.5, 1.0):  # an even picture without a border of so many radii of the blur, blurred
        inside = (abs(x) < goal.size[0] / 2 - shrunk * blur)[:, None] & (abs(y) < goal.size[1] / 2 - shrunk * blur)
        full = fftconvolve(inside.astype(float), kernel)
        low = [(f - n) // 2 for f, n in zip(full.shape, pixels, strict=True)]
        seen = full[low[0] : low[0] + pixels[0], low[1] : low[1] + pixels[1]]
        beside = max(0.0, full.sum() / seen.sum() - 1.0)
        assert float((seen / seen.mean()).std()) > least_error(lamp, goal, square, 300, beside + 1e-6)
