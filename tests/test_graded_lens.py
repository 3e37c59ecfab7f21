"""A gradient-index lens whose index and exit surface are designed together."""

from __future__ import annotations

import itertools
import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from helpers import between_planes, write_blob
from PIL import Image

from caustic_cli import cli, load
from caustic_cli.inverse.constraints import Limits
from caustic_cli.inverse.graded_lens import INDEX, INDEX_ALONE, FirstValues, JointLoss, design_graded_lens
from caustic_cli.inverse.gradient_index import shared_index, with_index
from caustic_cli.inverse.initial_surface import first_surface
from caustic_cli.inverse.lbfgs import LBFGS
from caustic_cli.inverse.objective import Objective
from caustic_cli.inverse.optimisers import QuasiNewton
from caustic_cli.inverse.parametrisation import FreeHeights
from caustic_cli.inverse.schedule import LossImage
from caustic_cli.kinds import kind_of
from caustic_cli.kinds.gradient_index import GradedLens
from caustic_cli.optics.emission import rays_of
from caustic_cli.optics.surfaces.heightfield import HeightField
from caustic_cli.optics.system import EXIT
from caustic_cli.optics.trace import Tracer
from caustic_cli.scene import Lens, Offset, PlaneWave, Scene, Screen
from caustic_cli.scene.gradient import Gradient
from caustic_cli.studies.retrace import retrace

TINY = ("--resolution", "24", "--threads", "1", "--quiet", "--control", "30", "--index-control", "27")
BOTH = ("--gradient", "free", "--with-surface")
PIXELS, RAYS = 24, 4 * 24 * 24
SCENE = Scene(PlaneWave(), Lens(control=(28, 28), offset=Offset(5.0)), Screen((38.4, 38.4), 300.0, (PIXELS, PIXELS)))
FIELD = HeightField.of(SCENE.lens)
RANGE = (SCENE.lens.index - 0.02, SCENE.lens.index + 0.02)


def target() -> np.ndarray:
    """(24, 24) irradiance: a bright spot beside the centre."""
    x = np.linspace(-1.0, 1.0, PIXELS)
    return np.exp(-4.0 * ((x[:, None] + 0.2) ** 2 + (x[None, :] - 0.1) ** 2)) + 0.2 * (np.abs(x[:, None]) < 0.7)


def bounds() -> tuple[torch.Tensor, torch.Tensor]:
    low, high = SCENE.lens.height_bounds(*(c.numpy() for c in FIELD.control_xy()))
    return torch.from_numpy(low), torch.from_numpy(high)


def surface(gradient: Gradient | None = None) -> torch.Tensor:
    """Heights by transport of the light that a gradient bends."""
    return first_surface(replace(SCENE, lens=replace(SCENE.lens, gradient=gradient)), target(), FIELD, 64).heights


def even(layers: int = 1) -> torch.Tensor:
    return torch.full((23, 25, layers), SCENE.lens.index, dtype=torch.float64)


def objective(index: torch.Tensor, limits: Limits | None = None, kind: type[Objective] = Objective) -> Objective:
    scene, how = with_index(SCENE, index), LossImage(apron=1, oversample=2)
    rays = rays_of(scene, "grid", RAYS, 0)
    return kind(scene, FIELD, rays, torch.from_numpy(target()), "rms-light", how, limits, dtype=torch.float64)


class BetweenPlanes(Objective):
    """The loss of the index of a plate whose sides are planes."""

    def _tracers(self):
        for sample in self.samplers[0].chunks(self.chunk):
            yield 0, Tracer(between_planes(SCENE, torch.from_numpy(self.scene.lens.gradient.volume)), sample, torch.float64)


def half() -> FirstValues:
    index = shared_index(SCENE, target(), (23, 25), RANGE, 64)
    return FirstValues(surface(Gradient("volume", volume=index.numpy())), index, bounds(), RANGE)


def run(capfd, *arguments: str, code: int = 0):
    """The JSON of a command, or the message of one that fails."""
    status = cli.run([*arguments, "--json"])
    out, err = capfd.readouterr()
    assert status == code, err
    return json.loads(out) if code == 0 else err.strip().splitlines()[-1]


@pytest.mark.parametrize("layers", [1, 2])
def test_the_gradient_of_both_is_that_of_the_loss(layers):
    """By the remainders of Taylor's formula, of order 2, along each block and along both."""
    begun = half()
    begun = replace(begun, index=begun.index.expand(-1, -1, layers).contiguous())
    loss = JointLoss(objective(begun.index), SCENE.lens, begun)
    torch.manual_seed(0)
    blocks = [torch.randn(n, dtype=torch.float64) for n in loss.split]
    nothing = [torch.zeros_like(b) for b in blocks]
    at = 1e-4 * torch.cat(blocks)
    value, gradient = loss(at)
    for direction in (torch.cat([blocks[0], nothing[1]]), torch.cat([nothing[0], blocks[1]]), torch.cat(blocks)):
        slope = float(gradient @ direction)
        assert abs(slope) > 1e-3 * value
        remainders = [abs(loss(at + h * direction)[0] - value - h * slope) for h in (4e-6, 2e-6, 1e-6)]
        orders = [math.log2(a / b) for a, b in itertools.pairwise(remainders)]
        assert min(orders) > 1.9, (remainders, orders)


def test_equal_steps_of_the_blocks_change_the_image_alike():
    """The same relief by surface or by index: gradients of equal length within a quarter, whatever the nets and the range."""
    for limits in (RANGE, (SCENE.lens.index - 0.004, SCENE.lens.index + 0.004)):
        begun = replace(half(), index=even(), heights=surface(), limits=limits)
        loss = JointLoss(objective(begun.index), SCENE.lens, begun)
        of_surface, of_index = loss(torch.zeros(sum(loss.split), dtype=torch.float64))[1].split(loss.split)
        assert float(of_index.norm() / of_surface.norm()) == pytest.approx(1.0, abs=0.25)


def test_with_the_index_frozen_it_is_the_design_of_a_surface():
    """In a lens of one index, traced by other code: the same surface after five iterations to 1e-8 mm."""
    begun = FirstValues(surface(), even(), bounds(), RANGE)
    both = objective(begun.index)
    loss = JointLoss(both, SCENE.lens, begun, (1.0, 0.0))
    search = LBFGS(loss, torch.zeros(sum(loss.split), dtype=torch.float64))
    heights = FreeHeights(*begun.bounds, begun.heights)
    how = LossImage(apron=1, oversample=2)
    alone = Objective(SCENE, FIELD, both.samplers[0], torch.from_numpy(target()), "rms-light", how, dtype=torch.float64)
    method = QuasiNewton(alone, heights, 0.0)
    for _ in range(5):
        assert search.step() and method.step()
        assert search.f == pytest.approx(method.method.f, rel=1e-7)
    with torch.no_grad():
        found, index = loss.lens(search.x)
        expected = heights()
    assert float((found - expected).abs().max()) < 1e-8
    assert float((found - begun.heights).abs().max()) > 1e-5
    assert float((index - begun.index).abs().max()) < 1e-12


def test_with_the_surface_frozen_it_is_the_design_of_an_index():
    """Between planes: loss and gradient are theirs to rounding, and so is the index after five iterations in the coordinates of the
    inverse Laplacian; the exit stays flat exactly."""
    flat = torch.full(FIELD.shape, SCENE.lens.offset.thickness, dtype=torch.float64)
    index = shared_index(SCENE, target(), (23, 25), RANGE, 64, share=1.0)
    both, plate = objective(index), objective(index, kind=BetweenPlanes)
    one, other = both.evaluate({EXIT: flat, INDEX: index}), plate.evaluate({INDEX: index})
    assert one.loss == pytest.approx(other.loss, rel=1e-12)
    assert torch.allclose(one.gradients[INDEX], other.gradients[INDEX], rtol=1e-9, atol=1e-9 * one.loss)
    loss = JointLoss(both, SCENE.lens, FirstValues(flat, index, (flat - 1.0, flat + 1.0), RANGE), INDEX_ALONE)
    low, high = (torch.full((23, 25), limit, dtype=torch.float64) for limit in RANGE)
    net, pixels = FreeHeights(low, high, index[:, :, 0].contiguous(), laplacian=True), plate.loss.target.numel()

    def squared(x: torch.Tensor) -> tuple[float, torch.Tensor]:
        net.y.data = x.view(net.y.shape).clone()
        values = net()[:, :, None]
        found = plate.evaluate({INDEX: values.detach()})
        (by,) = torch.autograd.grad(values, net.y, found.gradients[INDEX])
        return 0.5 * (found.loss * pixels) ** 2, pixels**2 * found.loss * by.reshape(-1)

    searches = [LBFGS(loss, torch.zeros(sum(loss.split), dtype=torch.float64)), LBFGS(squared, torch.zeros(index.numel()).double())]
    for _ in range(5):
        assert all(search.step() for search in searches)
    with torch.no_grad():
        (heights, values), net.y.data = loss.lens(searches[0].x), searches[1].x.view(net.y.shape)
        expected = net()[:, :, None]
    assert torch.equal(heights, flat)
    assert float((values - expected).abs().max()) < 1e-9
    assert float((values - index).abs().max()) > 1e-5


def test_neither_block_stalls_and_the_picture_is_thrown():
    """By rays that the search has not seen: from a start at which both have moved towards it, each by half."""
    begun = half()
    losses = []
    found = design_graded_lens(
        objective(begun.index, Limits(max_slope=0.5)),
        SCENE.lens,
        begun,
        iterations=8,
        on_iteration=lambda k, loss, on_screen, image: losses.append(loss),
    )
    assert losses == sorted(losses, reverse=True) and losses[-1] < 0.7 * losses[0]
    dn = (found.index - begun.index).abs()
    path = float(dn.max()) * 5.0, float((found.heights - begun.heights).abs().max()) * (SCENE.lens.index - 1.0)
    assert 0.1 < path[0] / path[1] < 10.0

    def error(heights, index) -> float:
        lens = replace(SCENE.lens, gradient=Gradient("volume", volume=index.numpy()))
        return retrace(replace(SCENE, lens=lens), FIELD, heights, target(), rays=200_000, seed=9)[1]["relative_rms"]

    assert error(found.heights, found.index) < error(begun.heights, begun.index) < 0.2


def test_the_index_takes_half_or_what_its_range_allows():
    whole = shared_index(SCENE, target(), (23, 25), RANGE, 64, share=1.0)
    half_of_it = shared_index(SCENE, target(), (23, 25), RANGE, 64)
    assert float(np.ptp(half_of_it.numpy())) == pytest.approx(0.5 * float(np.ptp(whole.numpy())), rel=1e-9)
    narrow = (1.54, 1.5402)
    least = shared_index(SCENE, target(), (23, 25), narrow, 64)
    assert narrow[0] < float(least.min()) < float(least.max()) < narrow[1]
    assert float(np.ptp(least.numpy())) == pytest.approx(0.98 * 2e-4, rel=1e-6)


# on the command line


@pytest.fixture
def here(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    write_blob()


def test_index_and_surface_are_designed_saved_rendered_and_exported(here, capfd):
    figures = run(capfd, "design", "blob.png", *BOTH, *TINY, "--iterations", "4", "-o", "both", "--movie", "m.gif")
    assert figures["relative_rms"] < 0.15 and figures["iterations"] == 4 and figures["minimum_wall_mm"] > 1.0
    assert figures["on_screen"] + sum(figures["lost"].values()) == pytest.approx(1.0, abs=1e-9)
    values, lens = np.load("both/index.npy"), load("both")
    assert values.shape == (27, 27, 1) and figures["index_least"] == values.min() < values.max() == figures["index_most"]
    assert isinstance(lens.heights, torch.Tensor) and lens.heights.shape == (30, 30)
    assert float(np.ptp(lens.heights.numpy())) > 0.01 and np.ptp(values) > 1e-3
    with Image.open("m.gif") as movie:
        assert movie.n_frames > 2
    again = run(capfd, "render", "both", "--rays", "40000", "--quiet", "--threads", "1")
    assert again["relative_rms"] == pytest.approx(figures["relative_rms"], abs=0.03)
    assert run(capfd, "export", "both", "--format", "stl", "-o", "lens.stl")["bytes"] > 84 + 50 * 14
    assert "varies" in run(capfd, "export", "both", "--format", "mitsuba", code=2)
    run(capfd, "export", "both", "--format", "lighttools", "--samples", "33", "-o", "both.npz")
    images = [load(name).render(40_000).image for name in ("both", "both.npz")]
    np.testing.assert_allclose(*images, atol=1e-6 * float(np.max(images[0])))


def test_six_iterations_are_three_and_three_bitwise(here, capfd):
    run(capfd, "design", "blob.png", *BOTH, *TINY, "--iterations", "6", "-o", "whole")
    run(capfd, "design", "blob.png", *BOTH, *TINY, "--iterations", "3", "-o", "parts")
    more = run(capfd, "design", "--resume", "parts", "--iterations", "6", "--quiet", "--threads", "1")
    assert more["iterations"] == 6 == len(load("parts").state.history)
    assert Path("whole/index.npy").read_bytes() == Path("parts/index.npy").read_bytes()
    assert torch.equal(load("whole").heights, load("parts").heights)
    assert run(capfd, "design", "--resume", "parts", "--quiet", "--threads", "1")["iterations"] == 6


def test_limits_of_both_hold(here, capfd):
    """A range that is too narrow for the index alone, and a slope that is too small for the surface alone."""
    narrow = ("--index-range", "1.543,1.5456")
    assert "requires an index that varies by" in run(
        capfd, "design", "blob.png", "--gradient", "free", *narrow, "--resolution", "24", "--quiet", "-o", "x", code=2
    )
    figures = run(capfd, "design", "blob.png", *BOTH, *TINY, *narrow, "--max-slope", "0.06", "--iterations", "2", "-o", "limited")
    assert 1.543 <= figures["index_least"] < figures["index_most"] <= 1.5456
    lens = load("limited")
    x = np.linspace(-4.9, 4.9, 40)
    slopes = np.hypot(*lens.surface(*np.meshgrid(x, x))[1:3])
    assert float(np.max(slopes)) < 0.0601


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (("--with-surface",), "--with-surface belongs to --gradient free"),
        (("--gradient", "radial", "--gradient-terms", "0.1", "--with-surface"), "--with-surface belongs to --gradient free"),
        ((*BOTH, "--start", "offset"), "--start of a free gradient must be transport, got offset"),
        ((*BOTH, "--waves", "on"), "designs the index, by rays"),
        ((*BOTH, "--network", "dense"), "--network of a free gradient must be none"),
        ((*BOTH, "--array", "2"), "--array cannot be combined with a free gradient"),
        ((*BOTH, "--mirror"), "mirror"),
        ((*BOTH, "--index-range", "1.6,1.5"), "ascend"),
    ],
)
def test_what_cannot_be_is_refused_in_a_line(here, capfd, options, words):
    message = run(capfd, "design", "blob.png", "--resolution", "24", "--quiet", *options, "-o", "x", code=2)
    assert words in message and not Path("x").exists()


def test_the_kind_is_that_of_the_setting(here, capfd):
    run(capfd, "design", "blob.png", *BOTH, *TINY, "--iterations", "1", "-o", "both")
    assert kind_of(load("both").project.settings) is GradedLens
    assert "with_surface = true" in Path("both/project.toml").read_text()
