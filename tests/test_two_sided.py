"""Lenses with two free-form sides: initial surfaces, loss, design, a second picture or ray directions, files."""

import json
import re
import tomllib
from dataclasses import replace
from pathlib import Path

import misaligned
import numpy as np
import pytest
import torch
from helpers import begun
from PIL import Image

from caustic_cli import cli, load
from caustic_cli.config.tolerances import read
from caustic_cli.export.mesh import closed_mesh
from caustic_cli.inverse.constraints import Limits
from caustic_cli.inverse.initial_two_sided import first_sides
from caustic_cli.inverse.schedule import LossImage
from caustic_cli.inverse.source_limits import source_spread
from caustic_cli.inverse.two_sided_objective import TwoSidedObjective
from caustic_cli.io.archive import open_archive
from caustic_cli.io.colorimetry import XYZ_OF_RGB
from caustic_cli.kinds import problem_of
from caustic_cli.kinds.robust import RobustTwoSides
from caustic_cli.optics.effects import NO_REQUESTS, Requests
from caustic_cli.optics.emission import rays_of
from caustic_cli.optics.misalignment import Misalignment, landing_points
from caustic_cli.optics.reconstruction import Filter
from caustic_cli.optics.surfaces import HeightField
from caustic_cli.optics.system import ENTRANCE, EXIT, System, fixed_surface, split_heights
from caustic_cli.optics.trace import Tracer, expose, render
from caustic_cli.project.project import Project
from caustic_cli.scene import Lens, Light, Offset, PlaneWave, Points, Scene, Screen, SecondTarget
from caustic_cli.studies.retrace import retrace
from caustic_cli.studies.second_target import second_figures
from caustic_cli.studies.tolerances import Trials
from caustic_cli.workflow import design as workflow

HALF, PIXELS = 6.0, 40
NEAR = Screen((2 * HALF, 2 * HALF), 50.0, (PIXELS, PIXELS))
FAR = Screen((26.0, 26.0), 400.0, (PIXELS, PIXELS))
LENS = Lens((10.0, 10.0), control=(51, 51), offset=Offset(15.0), height_range=(-6.0, 6.0))


def spots(*places, width=0.16) -> np.ndarray:
    """Gaussian spots at places in parts of the screen, over a dim ground within a circle."""
    u = (np.arange(PIXELS) + 0.5) / PIXELS * 2 - 1
    x, y = np.meshgrid(u, u, indexing="ij")
    light = 0.25 * (np.hypot(x, y) < 0.75) + sum(np.exp(-((x - a) ** 2 + (y - b) ** 2) / (2 * width**2)) for a, b in places)
    return light * (np.hypot(x, y) < 0.75)


ONE, TWO = spots((-0.3, 0.1), (0.35, -0.2)), spots((0.0, 0.3), width=0.3)


def judged(scene, field, nets, second):
    behind, exit = split_heights(scene, field, nets)
    _, figures = retrace(behind, field, exit, ONE, rays=400_000)
    return figures | second_figures(behind, field, exit, second, rays=400_000, seed=1)[1]


@pytest.mark.parametrize("focus", [None, (0.5, -0.5, 800.0)])
@pytest.mark.parametrize("source", [PlaneWave(), Points(((0.0, 0.0, -80.0),))])
def test_first_sides_send_light_to_the_picture_and_on(focus, source):
    scene = Scene(source, LENS, NEAR, second_target=SecondTarget(focus=focus))
    field = HeightField.of(LENS)
    found = judged(scene, field, first_sides(scene, ONE, None, field, 128), None)
    assert found["relative_rms"] < 0.25 and found["angle_rms_mrad"] < 2.0
    assert found["on_screen"] > 0.88 * (1.0 - found["lost"]["missed_lens"])


def test_first_sides_of_two_pictures():
    scene = Scene(PlaneWave(), LENS, NEAR, second_target=SecondTarget(FAR))
    field = HeightField.of(LENS)
    found = judged(scene, field, first_sides(scene, ONE, TWO, field, 128), TWO)
    assert found["relative_rms"] < 0.35 and found["second_relative_rms"] < 0.7


def test_a_loss_of_zero_has_no_gradient():
    """Collimated light through a plate has its own image as picture, and stays collimated: the gradient is zero, not NaN."""
    scene, field = Scene(PlaneWave(), LENS, NEAR, second_target=SecondTarget()), HeightField.of(LENS)
    plate = torch.stack([torch.zeros(field.shape, dtype=torch.float64), torch.full(field.shape, LENS.offset.thickness).double()])

    def evaluation(target: torch.Tensor):
        rays = rays_of(scene, "grid", 10_000)
        return TwoSidedObjective(scene, field, rays, (target,), "rms", LossImage(Filter("cosine", (3, 3)), filter_target=False))(
            plate
        )

    found = evaluation(evaluation(torch.from_numpy(ONE)).image)
    assert found.loss == 0.0 and bool((found.gradient == 0.0).all())


@pytest.mark.parametrize("loss", ["rms", "uniformity"])
def test_losses_of_the_images_alone_have_gradients_of_both_sides(loss):
    """They do not depend on what leaves the lens."""
    scene = Scene(PlaneWave(), LENS, NEAR, second_target=SecondTarget(FAR))
    field, targets = HeightField.of(LENS), (torch.from_numpy(ONE), torch.from_numpy(TWO))
    objective = TwoSidedObjective(
        scene, field, rays_of(scene, "grid", 10_000), targets, loss, LossImage(Filter("cosine", (5, 5)), apron=6)
    )
    nets = torch.stack([torch.zeros(field.shape, dtype=torch.float64), torch.full(field.shape, 15.0, dtype=torch.float64)])
    assert bool(torch.isfinite(objective(nets).gradient).all())


def test_two_pictures_are_balanced_by_the_fourth_power_of_their_errors():
    """With t_1 and t_2 of an objective that sees one of them alone, the loss is sqrt((t_1^6 + t_2^6) / (t_1^4 + t_2^4))."""
    scene, field = Scene(PlaneWave(), LENS, NEAR, second_target=SecondTarget(FAR)), HeightField.of(LENS)
    nets = torch.stack([torch.zeros(field.shape, dtype=torch.float64), torch.full(field.shape, 15.0, dtype=torch.float64)])
    rays, targets = rays_of(scene, "grid", 10_000), (torch.from_numpy(ONE), torch.from_numpy(TWO))

    def objective():
        return TwoSidedObjective(scene, field, rays, targets, "rms-light", LossImage(Filter("cosine", (5, 5))))

    found = []
    for weights in ((1.0, 0.0), (0.0, 1.0)):
        one = objective()
        one.weights = weights
        found.append(one(nets).loss)
    a, b = found
    assert a != pytest.approx(b, rel=0.1)
    assert objective()(nets).loss == pytest.approx(((a**2 + b**2) / 2.0) ** 0.5, rel=1e-6)
    assert objective().balanced(nets)(nets).loss == pytest.approx(((a**6 + b**6) / (a**4 + b**4)) ** 0.5, rel=1e-6)


@pytest.mark.parametrize("second", [SecondTarget(), SecondTarget(FAR), SecondTarget(focus=(1.0, 2.0, 200.0))])
def test_the_loss_has_the_gradients_of_both_sides(second):
    """Against central differences along random directions, each side's own and both."""
    scene, generator = Scene(PlaneWave(), LENS, NEAR, second_target=second), torch.Generator().manual_seed(1)
    field = HeightField.of(LENS)
    x, y = (c / 5.0 for c in field.control_xy())
    nets = torch.stack(
        [
            0.1 * torch.cos(2.0 * x)[:, None] * y[None, :] + 0.8 * (x[:, None] ** 2 + y[None, :] ** 2),
            15.0 - 0.9 * (x[:, None] ** 2 + y[None, :] ** 2),
        ]
    )
    targets = [torch.from_numpy(ONE), torch.from_numpy(TWO)][: 2 if second.screen else 1]
    objective = TwoSidedObjective(
        scene,
        field,
        rays_of(scene, "grid", 40_000),
        tuple(targets),
        "rms-light + 0.01 laplacian",
        LossImage(Filter("cosine", (5, 5)), apron=6),
        limits=Limits(max_slope=0.3),
        dtype=torch.float64,
    )
    gradient = objective(nets).gradient
    assert gradient.shape == nets.shape and (gradient.abs().amax((1, 2)) > 0).all()
    for side in ((1.0, 0.0), (0.0, 1.0), (0.6, 0.8)):
        way = torch.randn(nets.shape, generator=generator, dtype=torch.float64) * torch.tensor(side)[:, None, None]
        step = 2e-6
        ahead, behind = (objective(nets + s * step * way).loss for s in (1, -1))
        assert (gradient * way).sum() == pytest.approx((ahead - behind) / (2 * step), rel=2e-3, abs=1e-9)


@pytest.mark.parametrize("second", [SecondTarget(), SecondTarget(focus=(1.0, 2.0, 200.0)), SecondTarget(FAR)])
def test_colours_of_one_index_have_the_loss_of_their_sum(second):
    field, heights = HeightField.of(LENS), torch.stack([torch.zeros(51, 51), torch.full((51, 51), 15.0)]).double()
    bumps = (
        0.02 * torch.randn(heights.shape, generator=torch.Generator().manual_seed(1), dtype=torch.float64).cumsum(1).cumsum(2) / 51
    )
    lights, found = [torch.from_numpy(light) for light in (ONE, TWO)], []
    for colours in ((), (611.0, 549.0, 464.0)):
        targets = tuple(torch.stack([light] * 3) if colours else light for light in lights)
        scene = Scene(PlaneWave(), LENS, NEAR, Light(wavelengths=colours, color=bool(colours)), second_target=second)
        rays = rays_of(scene, "grid", 10_000)
        loss = TwoSidedObjective(
            scene, field, rays, targets, "rms", LossImage(filter=Filter("cosine", (3, 3))), dtype=torch.float64
        )
        one = loss(heights + bumps)
        found.append((one.loss, one.gradient))
    assert found[0][0] == pytest.approx(found[1][0], rel=1e-9)
    assert torch.allclose(found[0][1], found[1][1], rtol=1e-6, atol=1e-9 * float(found[0][1].abs().max()))


def test_a_designed_entrance_traces_as_the_free_one():
    scene = Scene(PlaneWave(), LENS, NEAR, second_target=SecondTarget())
    field = HeightField.of(LENS)
    nets = first_sides(scene, ONE, None, field, 64)
    (free,) = render(System.of(scene, field), {ENTRANCE: nets[0], EXIT: nets[1]}, 40_000, kind="grid")
    behind, exit = split_heights(scene, field, nets)
    fixed = expose(behind, field, exit, rays_of(behind, "grid", 40_000))
    assert torch.allclose(free.image, fixed.image, atol=1e-12) and free.lost == pytest.approx(fixed.lost, abs=1e-12)


@pytest.fixture
def _here(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("CAUSTIC_EFFORT", "test final_rays=100000")
    for name, light in (("one", ONE), ("two", TWO)):
        Image.fromarray((255 * light / light.max()).astype(np.uint8).T[::-1]).save(f"{name}.png")


SMALL = (
    "--linear",
    "--throw",
    "50",
    "--mag",
    "1.0",
    "--margin",
    "0.2",
    "--resolution",
    "40",
    "--control",
    "35",
    "--quiet",
    "--json",
)


def run(capfd, *arguments, code=0):
    assert cli.run(list(map(str, arguments))) == code
    out, err = capfd.readouterr()
    return json.loads(out) if code == 0 else err.strip()


def test_a_radius_of_both_sides_says_its_cost_and_again_when_resumed(_here, capfd):
    made = run(capfd, "design", "one.png", *SMALL, "--collimate", "--iterations", "1", "-o", "p", "--min-radius", "8")
    cost = made["min_radius"]
    assert cost["in_black_per_mm"] == pytest.approx((cost["start_in_black"] - cost["start_in_black_without"]) / 8.0)
    assert cost["noise"] is None  # of fewer rays, which say none
    longer = run(capfd, "design", "--resume", "p", "--iterations", "2", "--quiet", "--json")
    assert longer["iterations"] == 2 and longer["min_radius"] == cost


def test_design_render_resume_and_files(_here, capfd):
    made = run(capfd, "design", "one.png", *SMALL, "--collimate", "--iterations", "4", "-o", "p")
    assert made["relative_rms"] < made["start_relative_rms"] < 0.5 and made["angle_rms_mrad"] < 5
    settings = tomllib.loads(Path("p/project.toml").read_text())
    assert settings["second"] == {"collimate": True} and settings["lens"]["thickness"] == 20.0
    longer = run(capfd, "design", "--resume", "p", "--iterations", "6", "--quiet", "--json")
    assert longer["iterations"] == 6 and longer["relative_rms"] < made["relative_rms"]
    again = run(capfd, "render", "p", "--rays", "100000", "--quiet", "--json")
    assert again["angle_rms_mrad"] == pytest.approx(longer["angle_rms_mrad"], rel=0.05)
    lens = load("p")
    lens.export("lens.npz")
    scene, field, heights = open_archive("lens.npz")
    assert np.array_equal(scene.lens.entrance.heights, lens.scene.lens.entrance.heights + 0.0)
    a, b = (
        expose(s, f, h, rays_of(s, "grid", 10_000)).image
        for s, f, h in ((scene, field, heights), (lens.scene, lens.field, lens.heights))
    )
    assert torch.allclose(a, b, atol=1e-12)
    lens.export("lens.step")
    assert Path("lens.step").read_text().count("B_SPLINE_SURFACE_WITH_KNOTS") == 2
    vertices, faces = closed_mesh(lens.scene, lens.field, lens.heights, (41, 41))
    corners = vertices[faces]
    volume = np.einsum("ij,ij->i", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])).sum() / 6.0
    line = np.linspace(-5, 5, 41)
    top, low = (lens.surface(line[:, None], line[None, :], side)[0] for side in ("exit", "entrance"))
    assert volume == pytest.approx(np.trapezoid(np.trapezoid(top - low, line), line), rel=1e-3)
    edges = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1)
    assert (np.unique(edges, axis=0, return_counts=True)[1] == 2).all()
    run(capfd, "render", "p", "--html", "page.html", "--rays", "20000", "--effects", "entrance", "--quiet", "--json", "--force")
    page = Path("page.html").read_text()
    assert "free-form on both sides" in page
    wall = float(re.search(r">Wall<.*?>([0-9.]+) mm", page)[1])
    assert wall == pytest.approx((top - low).min(), abs=1e-3)
    files = run(capfd, "export", "p", "--format", "zemax", "--max-size", "1MB", "--quiet", "--json")
    assert files["beside"] == ["p-entrance.dat"] and files["keeps_picture"]


def test_the_image_changes_with_a_height_of_the_exit_as_differences_say(_here, capfd):
    run(capfd, "design", "one.png", *SMALL, "--collimate", "--iterations", "1", "-o", "p")
    (found,) = run(capfd, "gradmap", "p", "--check", "--rays", "10000", "--quiet", "--json")["maps"]
    assert found["largest"] > 0 and found["check"]["relative_error"] < 1e-3


def test_the_report_measures_between_both_sides(_here, capfd):
    made = run(capfd, "design", "one.png", *SMALL, "--collimate", "--iterations", "1", "-o", "p")
    found, lens = run(capfd, "render", "p", "--report", "--tool-radius", "1", "--quiet", "--json")["report"], load("p")
    line = np.linspace(-5.0, 5.0, 201)
    top, low = (lens.surface(line[:, None], line[None, :], side) for side in ("exit", "entrance"))
    assert found["minimum_wall_mm"] == made["minimum_wall_mm"] == pytest.approx((top[0] - low[0]).min(), rel=1e-3)
    assert found["stock_height_mm"] == pytest.approx(top[0].max() - low[0].min(), rel=1e-3)
    mean = np.trapezoid(np.trapezoid(top[0] - low[0], line), line)
    assert found["volume_cm3"] == pytest.approx(1e-3 * mean, rel=1e-3)
    for one, (_, across, along) in ((found, top), (found["entrance"], low)):
        assert one["maximum_slope"] == pytest.approx(np.hypot(across, along).max(), rel=0.02)
    # seen from outside the entrance is hollow where its height has a maximum
    bends = np.gradient(low[1], line, axis=0)[100, 100], np.gradient(low[2], line, axis=1)[100, 100]
    assert found["entrance"]["smallest_concave_radius_mm"] < 1.0 / max(1e-9, -min(bends))
    both = [found["smallest_concave_radius_mm"], found["entrance"]["smallest_concave_radius_mm"]]
    assert found["tool_fits"] == all(r is None or r >= 1.0 for r in both)


def test_errors_of_a_lens_with_two_sides_are_traced(_here, capfd):
    """As for one surface in test_tolerances, in the room's own frame with rays of another generator."""
    run(capfd, "design", "one.png", *SMALL, "--collimate", "--iterations", "1", "-o", "p")
    errors = Misalignment(index=2e-3, thickness=0.05, throw=1.0, lens_shift=(0.2, -0.1), lens_tilt=(0.5, -0.8))
    lens = load("p")
    scene, count = lens.scene, 4_000_000
    (seen,) = landing_points(scene, lens.field, lens.heights, rays_of(scene, "stratified", 500_000, 1), errors)
    edges = [np.linspace(-h, h, 9) for h in scene.screen.half_size]
    mine = np.histogram2d(seen.x.numpy(), seen.y.numpy(), edges, weights=seen.power.numpy())[0]
    coarse = replace(scene, screen=replace(scene.screen, resolution=(8, 8)))
    other = misaligned.image(coarse, lens.field, lens.heights, errors, count, np.random.default_rng(1))
    mine, other = mine / mine.sum(), other / other.sum()
    (still,) = landing_points(scene, lens.field, lens.heights, rays_of(scene, "stratified", 500_000, 1), Misalignment())
    before = np.histogram2d(still.x.numpy(), still.y.numpy(), edges, weights=still.power.numpy())[0]
    assert np.abs(mine - other).max() < 0.01 * other.max() < 0.1 * np.abs(before / before.sum() - other).max()


def test_both_sides_have_form_errors_of_their_own(_here, capfd):
    run(capfd, "design", "one.png", *SMALL, "--collimate", "--iterations", "1", "-o", "p")
    Path("t.toml").write_text("draws = 10\n[form_error]\nrms = 0.0002\nshortest = 2.0\n[thickness]\nsigma = 0.01\n")
    found = run(capfd, "render", "p", "--tolerances", "t.toml", "--rays", "20000", "--quiet", "--json")["tolerances"]
    assert {"form_error", "thickness"} == {one["name"] for one in found["sensitivities"]}
    assert found["error"]["mean_square_root"] > found["nominal"]["relative_rms"]
    lens = load("p")
    trials = Trials(lens.scene, lens.field, lens.heights, lens.target, read(Path("t.toml")), rays=1000)
    scene, heights = trials.shaped(0, ("form_error",))
    front = fixed_surface(scene.lens.entrance, scene.lens.half_size)
    plain = fixed_surface(lens.scene.lens.entrance, scene.lens.half_size)
    at = torch.linspace(-4.9, 4.9, 40, dtype=torch.float64)
    x, y = (c.reshape(-1) for c in torch.meshgrid(at, at, indexing="ij"))
    bumps = front.at(None, x, y, ((0, 0),))[0] - plain.at(None, x, y, ((0, 0),))[0]
    exits = trials.field.at(heights - trials.heights, x, y, ((0, 0),))[0]
    assert 5e-5 < bumps.std() < 5e-4 and 5e-5 < exits.std() < 5e-4
    assert abs(torch.corrcoef(torch.stack([bumps, exits]))[0, 1]) < 0.5


def test_a_robust_loss_of_both_sides_has_their_gradients(_here, capfd):
    Path("t.toml").write_text("[thickness]\nsigma = 0.05\n[lens_shift]\nsigma = [0.1, 0.1]\n[index]\nsigma = 0.001\n")
    options = ("--second", "two.png", "--second-at", "400", "--second-size", "26", "--robust", "t.toml")
    made = run(capfd, "design", "one.png", *SMALL, *options, "--iterations", "1", "-o", "p")
    assert made["relative_rms"] < made["start_relative_rms"]
    project = Project.open("p")
    problem = problem_of(project)
    assert isinstance(problem, RobustTwoSides)
    start = load("p")
    both = torch.stack([torch.from_numpy(start.scene.lens.entrance.heights.copy()), start.heights])
    loss = problem.objective(len(problem.stages) - 1, both)
    assert len(loss.members) == 5
    draws = [m.objective.scene for m in loss.members[1:]]
    for a, b in (draws[:2], draws[2:]):  # antithetic
        assert a.screen.shift[0] == pytest.approx(-b.screen.shift[0], abs=1e-9) and a.screen.shift[0] != 0
        assert a.second_target.screen.shift[0] == pytest.approx(a.screen.shift[0])  # the whole lens is shifted
    assert all(float(m.added[0].abs().max()) == 0 < float(m.added[1].abs().max()) for m in loss.members[1:])
    found, way = loss(both), torch.randn(both.shape, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    step = 1e-5 * way
    change = (loss(both + step).loss - loss(both - step).loss) / 2.0
    assert change == pytest.approx(float((found.gradient * step).sum()), rel=0.02)


def test_rays_behind_a_fixed_entrance_are_traced_by_the_fused_kernel(_here, capfd):
    """To the image, losses and derivatives of the stages; on the way back to one plane some lines of rays leave the aperture."""
    run(capfd, "design", "one.png", *SMALL, "--collimate", "--mag", "0.8", "--iterations", "1", "-o", "p")
    lens = load("p")
    system, rays = System.of(lens.scene, lens.field), next(iter(rays_of(lens.scene, "grid", 40_000).chunks()))
    found = []
    for requests in (NO_REQUESTS, Requests.to(stages=True)):
        traced, heights = Tracer(system, rays, torch.float64, requests), lens.heights.clone().requires_grad_()
        assert (traced.fused is None) == requests.stages
        seen = traced.expose({EXIT: heights}, lens.scene.screen, Filter("cosine", (3, 3)))
        weight = torch.linspace(0.0, 1.0, PIXELS, dtype=torch.float64)
        (seen.image * weight[:, None]).sum().backward()
        found.append((seen.image.detach(), heights.grad, seen.lost["missed_surface"]))
    state = Tracer(system, rays, torch.float64, Requests.to(stages=True)).start.expanded()
    (x, y, z), (dx, dy, dz) = state.full(state.origin), state.full(state.direction)
    outside = ((x - z / dz * dx).abs() > 5.0) | ((y - z / dz * dy).abs() > 5.0)
    assert outside.sum() > 10
    for one, other in zip(*found, strict=True):
        assert torch.allclose(torch.as_tensor(one), torch.as_tensor(other), rtol=1e-9, atol=1e-12)


def test_default_stages_need_few_iterations(_here, capfd):
    """Of both sides on nets finer than pixels, judged by rays that the design did not use."""
    small = [a for a in SMALL if a not in ("--control", "35", "--rays", "40000")]
    made = run(capfd, "design", "one.png", *small, "--collimate", "--iterations", "10", "--quiet", "--json", "-o", "p")
    stages = Project.open("p").settings.design.stages
    assert [(s.control, s.oversample) for s in stages] == [((123, 123), 8)]
    assert made["relative_rms"] < 0.05 and made["relative_rms"] < 0.5 * made["start_error"] and made["angle_rms_mrad"] < 1.0


def test_mitsuba_traces_both_sides(_here, capfd):
    pytest.importorskip("mitsuba")
    run(capfd, "design", "one.png", *SMALL, "--collimate", "--iterations", "2", "-o", "p")
    found = run(capfd, "render", "p", "--verify", "mitsuba", "--rays", "200000", "--quiet", "--json")["verify"]
    assert found["agree"] and 0.9 < found["z_mean_square"] < 1.1


@pytest.mark.slow
def test_two_pictures_by_the_command_line(_here, capfd, monkeypatch):
    monkeypatch.setenv("CAUSTIC_EFFORT", "test report=True final_rays=100000")  # drawn of both
    options = ("--second", "two.png", "--second-at", "400", "--second-size", "26")
    made = run(capfd, "design", "one.png", *SMALL, *options, "--iterations", "3", "-o", "p")
    assert (
        made["second_relative_rms"] < made["start_second_relative_rms"]
        and Path("p/render-second.png").exists()
        and Path("p/second.png").exists()
    )
    assert run(capfd, "design", "one.png", *SMALL, *options, "--iterations", "3", "-o", "p") == made  # nothing was done
    render = ("render", "p", "--rays", "5000", "--effects", "fresnel", "--json", "--quiet")
    seen = run(capfd, *render)
    image = Image.open("p/second.png")
    image.rotate(90).save("p/second.png")
    again = run(capfd, *render)
    assert again["second_relative_rms"] != seen["second_relative_rms"] and again["relative_rms"] == seen["relative_rms"]


@pytest.mark.parametrize(
    "how", [("--network", "sparse"), ("--network", "dense", "--network-width", "16"), ("--optimizer", "adam", "--lr", "1e-4")]
)
def test_networks_and_adam_design_both_sides(_here, capfd, how):
    """Each step is along the gradient of both nets, and a resumed design goes on with the same network."""
    arguments = ("design", "one.png", *SMALL, *how, "--collimate")
    whole = run(capfd, *arguments, "--iterations", "8", "-o", "whole")
    assert whole["relative_rms"] < 0.95 * whole["start_relative_rms"] and whole["iterations"] == 8
    run(capfd, *arguments, "--iterations", "5", "-o", "parts")
    run(capfd, "design", "--resume", "parts", "--iterations", "8", "--quiet", "--json")
    one, two = load("whole"), load("parts")
    assert torch.allclose(one.heights, two.heights, atol=1e-7)
    assert np.allclose(one.scene.lens.entrance.heights, two.scene.lens.entrance.heights, atol=1e-7)


def test_two_pictures_in_colour(_here, capfd):
    """The second target has the tristimulus values of its picture, and each channel of its image is that of a lens of its index."""
    codes = np.random.default_rng(5).integers(120, 256, (40, 40, 3), dtype=np.uint8)
    Image.fromarray(codes).save("rgb.png")
    small = [a if a != "0.2" else "0" for a in SMALL if a != "--linear"]
    options = ("--second", "rgb.png", "--second-at", "400", "--second-size", "26", "--color", "--glass", "N-SF11")
    made = run(capfd, "design", "one.png", *small, *options, "--iterations", "2", "-o", "p")
    assert made["second_relative_rms"] < made["start_second_relative_rms"] and made["second_ciede2000"] > 0
    project, lens = Project.open("p"), load("p")
    scene = project.scene()
    rgb = np.where(codes / 255 <= 0.04045, codes / 255 / 12.92, ((codes / 255 + 0.055) / 1.055) ** 2.4)  # IEC 61966-2-1
    goal = np.tensordot(XYZ_OF_RGB, rgb[::-1].transpose(2, 1, 0), 1)
    np.testing.assert_allclose(np.tensordot(scene.light.primaries, project.second_target(scene), 1), goal, rtol=1e-9)
    shown = np.asarray(Image.open("p/render-second.png"))
    assert shown.ndim == 3 and np.ptp(shown, axis=2).max() > 20
    coloured, part = lens.scene.onto(lens.scene.second_target.screen), []
    for wavelength in scene.light.wavelengths:
        alone = replace(coloured, light=Light()).at(wavelength)
        part.append(expose(alone, lens.field, lens.heights, rays_of(alone, "grid", 40_000)).image)
    seen = expose(coloured, lens.field, lens.heights, rays_of(coloured, "grid", 40_000)).image
    weights = torch.tensor(scene.light.fractions)[:, None, None]
    assert torch.allclose(seen, weights * torch.stack(part), atol=1e-9 * float(seen.max()))


@pytest.mark.parametrize("sun", [(), ("--source-angle", "0.533")])
def test_a_disc_s_light_is_collimated(_here, capfd, monkeypatch, sun):
    """Of an extended source: no limit is stated by the blur of a surface that is not designed yet."""
    monkeypatch.setattr(workflow, "_run", begun)
    run(capfd, "design", "one.png", *SMALL, "--source", "disc", *sun, "--collimate", "-o", "p")
    assert source_spread(Project.open("p").scene()) is None


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (("--second", "two.png"), "--second needs --second-at"),
        (("--second-at", "400"), "--second-at belongs to --second"),
        (("--collimate", "--focus", "0,0,300"), "--collimate and --focus both define"),
        (("--collimate", "--mirror"), "--mirror cannot be combined with --collimate: a mirror has one side"),
        (("--focus", "0,0,300", "--network", "dense", "--over", "throw=40:60"), "is given for one scene"),
        (
            ("--second", "two.png", "--second-at", "400", "--color", "--wavelengths", "611:1,549:1,464:0"),
            "--second needs light of 464 nm",
        ),
        (("--focus", "0,0,20"), "must lie behind the picture's screen at 50 mm"),
        (("--collimate", "--source", "point", "--start", "offset"), "must be transport"),
        (("--second", "missing.png", "--second-at", "400"), "missing.png"),
        (("--collimate", "--config", "waves.toml"), "without spread"),
        (("--collimate", "--mag", "6"), "would have to come from outside the lens"),
    ],
)
def test_bad_input_is_refused(_here, capfd, options, words):
    Path("waves.toml").write_text("[[design.stages]]\nspread = true\n")
    small = [a for a in SMALL if "waves.toml" not in options or a not in ("--rays", "40000")]
    said = run(capfd, "design", "one.png", *small, *options, "-o", "p", code=2)
    assert words in said and said.count("\n") == 0 and not Path("p").exists()
