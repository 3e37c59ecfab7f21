"""Gradient-index lenses on the command line: given by a formula or a file, or designed in place of the surface."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from helpers import between_planes, write_blob
from PIL import Image

from caustic_cli import cli, load
from caustic_cli.inverse.graded_lens import INDEX_ALONE, FirstValues, design_graded_lens
from caustic_cli.inverse.gradient_index import index_of_plate, with_index
from caustic_cli.inverse.initial_surface import first_surface
from caustic_cli.inverse.objective import Objective
from caustic_cli.inverse.schedule import LossImage
from caustic_cli.optics.effects import EFFECTS
from caustic_cli.optics.emission import rays_of
from caustic_cli.optics.gradient import index_field_of
from caustic_cli.optics.gradient.fields import SplineIndex
from caustic_cli.optics.misalignment import Misalignment, landing_points
from caustic_cli.optics.plan import compile_plan
from caustic_cli.optics.surfaces.heightfield import HeightField
from caustic_cli.optics.system import System
from caustic_cli.optics.trace import Tracer, expose, render
from caustic_cli.project import directory
from caustic_cli.scene import Lens, Offset, PlaneWave, Points, Scene, Screen
from caustic_cli.scene.gradient import Gradient
from caustic_cli.studies.manufacture import manufacture
from caustic_cli.studies.metrics import relative_rms
from caustic_cli.workflow import design as workflow

TINY = ("--resolution", "24", "--iterations", "3", "--threads", "1", "--quiet")


@pytest.fixture(autouse=True)
def here(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    write_blob()


def run(capfd, *arguments: str, code: int = 0):
    """The JSON of a command, or the message of one that fails."""
    status = cli.run([*arguments, "--json"])
    out, err = capfd.readouterr()
    assert status == code, err
    return json.loads(out) if code == 0 else err.strip().splitlines()[-1]


def scene_of(gradient=None, pixels: int = 24, radius=(np.inf, np.inf), **options) -> Scene:
    lens = Lens(control=(4, 4), offset=Offset(5.0, radius), gradient=gradient, **options)
    return Scene(PlaneWave(), lens, Screen((38.4, 38.4), 300.0, (pixels, pixels)))


def flat(scene: Scene) -> torch.Tensor:
    return torch.full(scene.lens.control, scene.lens.offset.thickness, dtype=torch.float64)


def test_a_gradient_index_plate_is_designed_saved_and_rendered(capfd):
    """By transport nearly at once; the project opens again with the same image; the same design again is the same index."""
    figures = run(capfd, "design", "blob.png", "--gradient", "free", *TINY, "-o", "free.caustic")
    assert figures["relative_rms"] < 0.3 and figures["on_screen"] > 0.85 and figures["iterations"] == 3
    assert figures["on_screen"] + sum(figures["lost"].values()) == pytest.approx(1.0, abs=1e-9)
    values = np.load("free.caustic/index.npy")
    assert values.shape == (51, 51, 1) and figures["index_least"] == values.min() < values.max() == figures["index_most"]
    again = run(capfd, "render", "free.caustic", "--rays", "40000", "--quiet", "--threads", "1")
    assert again["relative_rms"] == pytest.approx(figures["relative_rms"], abs=0.02)
    anew = run(capfd, "design", "blob.png", "--gradient", "free", *TINY, "-o", "free.caustic")
    assert anew["index_least"] == figures["index_least"]
    more = run(capfd, "design", "--resume", "free.caustic", "--iterations", "5", "--movie", "m.gif")
    assert more["iterations"] == 5 and more["relative_rms"] < figures["relative_rms"] + 3 * figures["noise"]
    losses = [row[2] for row in load("free.caustic").state.history]
    assert len(losses) == 5 and losses == sorted(losses, reverse=True)
    with Image.open("m.gif") as movie:
        assert movie.n_frames == 3
    assert (
        run(capfd, "export", "free.caustic", "--format", "stl", "-o", "blank.stl")["bytes"] == 84 + 50 * 14
    )  # a box, of which two triangles are a side
    assert "varies" in run(capfd, "export", "free.caustic", "--format", "mitsuba", code=2)
    (found,) = run(capfd, "gradmap", "free.caustic", "--rays", "20000", "--check", "--threads", "1", "--quiet")["maps"]
    assert found["largest"] > 0.0 and found["check"]["relative_error"] < 1e-4
    far = ("--source", "point", "--source-position", "0,0,-1e6")  # nearly a plane wave
    seen = run(capfd, "render", "free.caustic", "--rays", "40000", "--quiet", "--threads", "1", "-o", "far.png", *far)
    assert seen["relative_rms"] == pytest.approx(again["relative_rms"], abs=0.02)
    lens = load("free.caustic")
    assert (
        index_field_of(lens.scene.lens).shape == (51, 51, 1) and float(np.ptp(lens.surface(np.linspace(-4, 4, 9), 0.0)[0])) < 1e-12
    )


def test_a_design_of_an_index_that_is_run_again_locks_its_project(capfd, monkeypatch):
    again = ("design", "blob.png", "--gradient", "free", *TINY, "-o", "again.caustic")
    run(capfd, *again)
    Path("again.caustic/render.png").unlink()

    def run_index(project, *_):
        with directory.locked(project.path):
            raise AssertionError("another design could run there")

    monkeypatch.setattr(workflow, "_run_index", run_index)
    assert "another caustic design is running there" in run(capfd, *again, code=2)


def test_a_file_of_indices_is_kept(capfd):
    """As given: in the project under its own name, and what `volume` traces."""
    rows = 1.5 + 1e-3 * np.add.outer(np.arange(6.0), np.arange(5.0))
    np.save("mine.npy", rows)
    options = ("--gradient", "volume", "--index-file", "mine.npy", "--control", "6", "--quality", "draft")
    run(capfd, "design", "blob.png", *options, *TINY, "-o", "volume.caustic")
    Path("mine.npy").unlink()
    assert np.array_equal(np.load("volume.caustic/index.npy"), rows)
    held = index_field_of(load("volume.caustic").scene.lens)
    assert isinstance(held, SplineIndex) and np.array_equal(held.coefficients[:, :, 0].numpy(), rows)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (("--gradient", "free", "--index-range", "1.54,1.542"), "thickness"),
        (("--gradient", "free", "--index-range", "1.6,1.5"), "ascend"),
        (("--gradient", "free", "--waves", "on"), "designs the index, by rays"),
        (("--gradient", "free", "--mirror"), "mirror"),
        (("--gradient", "free", "--start", "old.npz"), "--start of a free gradient must be transport"),
        (("--index-control", "12"), "--index-control belongs to --gradient free"),
        (("--gradient", "lens"), "must be one of"),
        (("--gradient", "selfoc"), "gradient_terms"),
        (("--gradient", "selfoc", "--gradient-terms", "0.1,x"), "separated by commas"),
        (("--gradient-terms", "0.1"), "--gradient"),
        (("--gradient", "volume"), "index_file"),
        (("--gradient", "volume", "--index-file", "blob.png"), "npy"),
        (("--gradient", "volume", "--index-file", "none.npy"), "none.npy"),
        (("--gradient", "volume", "--index-file", "text.npy"), "text.npy: has text, not real numbers; a .npy array of (n, m)"),
        (("--gradient", "volume", "--index-file", "complex.npy"), "complex.npy: has complex numbers, not real numbers"),
    ],
)
def test_what_cannot_be_is_refused_in_a_line(capfd, options, words):
    np.save("text.npy", np.full((4, 4), "1.5"))
    np.save("complex.npy", np.full((4, 4), 1.5j))
    Path("old.npz").write_bytes(b"any")
    message = run(capfd, "design", "blob.png", *TINY, *options, "-o", "x.caustic", code=2)
    assert words in message and not (Path("x.caustic") / "index.npy").exists()


def test_a_design_comes_nearer_to_the_picture():
    """By rays that it has not seen; the flat exit of a plane and of a height field are one; layers along z share the work."""
    scene, (x, y) = scene_of(), np.meshgrid(*(np.linspace(-1.0, 1.0, 24),) * 2, indexing="ij")
    target = np.where((np.abs(x) < 0.6) & (np.abs(y) < 0.5), 1.0 + 0.6 * np.sin(5.0 * x) * np.cos(4.0 * y), 0.0)

    def error(index) -> float:
        (image,) = render(between_planes(scene, index), {}, 200_000, seed=9)
        j = image.image.numpy()
        return float(np.sqrt(np.mean((j / j.mean() - target / target.mean()) ** 2)))

    limits, losses, net = (1.49, 1.59), [], flat(scene)
    start = index_of_plate(scene, target, (28, 28), limits, 20, layers=2)
    graded = with_index(scene, start)
    rays, how = rays_of(graded, "grid", 9216), LossImage(apron=1, oversample=2)
    objective = Objective(graded, HeightField.of(graded.lens), rays, torch.from_numpy(target), "rms-light", how)
    begun = FirstValues(net, start, (net - 1.0, net + 1.0), limits)
    found = design_graded_lens(
        objective, scene.lens, begun, INDEX_ALONE, iterations=10, on_iteration=lambda k, loss, on_screen, image: losses.append(loss)
    )
    assert error(found.index) < 0.9 * error(start) < 0.35 and found.index.shape == (28, 28, 2)
    assert losses == sorted(losses, reverse=True)
    (image,) = render(between_planes(scene, found.index), {}, 4000)
    held = with_index(scene, found.index)
    by_net = expose(held, HeightField.of(held.lens), flat(held), rays_of(held, "stratified", 4000))
    assert torch.allclose(by_net.image, image.image, atol=1e-9)


def test_the_effect_knows_whether_bending_matters():
    """By a bound on how far light moves: that of no ray is larger; below the limit leaving it out changes next to nothing."""
    weak, strong = scene_of(Gradient("radial", (-1e-8,))), scene_of(Gradient("radial", (-1e-3,)))
    for scene, on in ((weak, False), (strong, True), (scene_of(), False)):
        plan = compile_plan(scene, HeightField.of(scene.lens), flat(scene))
        decision = plan["gradient-index"]
        assert decision.on == on and (plan.scene.lens.gradient is not None) == on
        assert "index" in decision.why
        if scene.lens.gradient is None:
            assert not decision.present
            continue
        (effect,) = (e for e in EFFECTS if e.name == "gradient-index")
        landed = []
        for one in (scene, effect.without(scene)):
            field = HeightField.of(one.lens)
            (sample,) = rays_of(one, "stratified", 400).chunks()
            from_system = Tracer(System.of(one, field), sample)
            landed.append(torch.stack(from_system.land({"exit": flat(one)}, one.screen)[0].origin[:2]))
        moved = float(torch.hypot(*(landed[0] - landed[1])).max()) / min(scene.screen.pixel)
        assert moved <= decision.bound <= 30.0 * moved
    assert compile_plan(strong, HeightField.of(strong.lens), flat(strong), {"diffraction"})["diffraction"].on


def test_bounds_hold_where_rays_bend():
    """No ray leans more inside, and none is totally reflected, where the plan proves it."""
    scene = replace(scene_of(Gradient("radial", (4e-3,))), source=Points(((0.0, 0.0, -60.0),)))
    field = HeightField.of(scene.lens)
    plan = compile_plan(scene, field, flat(scene))
    assert plan["gradient-index"].on and not plan["total-reflection"].on
    image = expose(plan.scene, field, flat(scene), rays_of(scene, "stratified", 4000))
    assert image.lost["total_internal_reflection"] == 0.0 and image.lost["missed_surface"] > 0.0 and plan["missed-surface"].on


@pytest.mark.parametrize("kind, terms", [("radial", (-1e-3,)), ("selfoc", (0.03,)), ("axial", (5e-3,))])
def test_the_initial_surface_knows_the_gradient(kind, terms):
    """Light that the gradient bends, and the index where it leaves: the start is as good as that of a homogeneous lens."""
    x = np.linspace(-1.0, 1.0, 32)
    target = np.exp(-4.0 * (x[:, None] ** 2 + (x[None, :] - 0.3) ** 2)) + 0.1
    lens = Lens((10.0, 10.0), 0.0, 1.5, (67, 67), offset=Offset(5.0))
    screen, errors = Screen((30.0, 30.0), 300.0, (32, 32)), []
    for gradient in (None, Gradient(kind, terms)):
        scene = Scene(PlaneWave(), replace(lens, gradient=gradient), screen)
        field = HeightField.of(scene.lens)
        heights = first_surface(scene, target, field, cells=96).heights
        image = expose(scene, field, heights, rays_of(scene, "stratified", 400_000, 0)).image.numpy()
        errors.append(relative_rms(image, target))
    assert errors[1] < 2.0 * errors[0] < 0.1  # 3 and 10 for two of them as of a homogeneous lens


@pytest.mark.parametrize("gradient", [Gradient("volume", volume=np.full((4, 4, 2), 1.5)), Gradient("radial", (1e-13,))])
def test_an_even_gradient_is_made_like_a_lens_of_one_index(gradient):
    """Figures for the workshop, and where light lands with errors, among them of the index."""
    torch.manual_seed(0)
    scenes = [scene_of(one, index=1.5) for one in (None, gradient)]
    heights = flat(scenes[0]) + 1e-2 * torch.rand(scenes[0].lens.control, dtype=torch.float64)
    made = [manufacture(scene, HeightField.of(scene.lens), heights) for scene in scenes]
    assert made[0]["landing_mm_per_thousandth_index"] > 1e-4
    numbers = [{key: value for key, value in one.items() if isinstance(value, float)} for one in made]
    assert len(numbers[0]) > 12 and numbers[1] == pytest.approx(numbers[0], rel=1e-5, abs=1e-9)
    errors, rays = Misalignment(index=1e-3, lens_tilt=(0.2, 0.1), thickness=0.05), rays_of(scenes[0], "stratified", 400)
    plans = [compile_plan(scene, HeightField.of(scene.lens), heights).requests for scene in scenes]
    one, other = (
        next(iter(landing_points(scene, HeightField.of(scene.lens), heights, rays, errors, requests)))
        for scene, requests in zip(scenes, plans, strict=True)
    )
    assert float((one.x - other.x).abs().max()) < 1e-6
