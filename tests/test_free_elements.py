"""Free surfaces of other elements together with whatever else may be free, or on: index, colour, networks, Adam, the wave image."""

import itertools
import json
import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from helpers import write_blob
from PIL import Image

from caustic_cli import cli, load
from caustic_cli.inverse.graded_lens import FirstValues, JointLoss
from caustic_cli.inverse.gradient_index import with_index
from caustic_cli.inverse.initial_surface import sphere_net
from caustic_cli.inverse.objective import Objective
from caustic_cli.inverse.schedule import LossImage
from caustic_cli.kinds import kind_of
from caustic_cli.kinds.gradient_index import GradedElements
from caustic_cli.kinds.robust import RobustGradedElements
from caustic_cli.optics.emission import rays_of
from caustic_cli.optics.surfaces.heightfield import HeightField
from caustic_cli.scene import Component, Lens, Light, Offset, PlaneWave, Scene, Screen

PIXELS = 24
LENS = Lens(control=(14, 14), offset=Offset(5.0))
FIELD = HeightField.of(LENS)
BEHIND = Component(60.0, (24.0, 24.0), 6.0, (120.0, -120.0), 1.5, free="both")
SCENE = Scene(PlaneWave(), LENS, Screen((38.4, 38.4), 300.0, (PIXELS, PIXELS)), elements=(BEHIND,))
RANGE = (LENS.index - 0.02, LENS.index + 0.02)
FREE = ("--element", "lens z=60 thickness=6 radius=120,-120 index=1.5 free=both")
TINY = ("--quality", "draft", "--resolution", "24", "--threads", "1", "--quiet", "--force", "-o", "p")


def light() -> torch.Tensor:
    x = torch.linspace(-1.0, 1.0, PIXELS, dtype=torch.float64)
    return torch.exp(-4.0 * ((x[:, None] + 0.2) ** 2 + (x[None, :] - 0.1) ** 2)) + 0.2 * (x.abs()[:, None] < 0.7)


def surfaces() -> torch.Tensor:
    spheres = [sphere_net(BEHIND, side, FIELD) for side in BEHIND.free_sides]
    x, y = FIELD.control_xy()
    return torch.stack([*spheres, 5.0 + 0.004 * x[:, None] ** 2 + 0.003 * y[None, :] ** 2 + 0.02 * torch.sin(x[:, None] + y)])


def test_index_and_all_surfaces_have_the_gradient_of_the_loss():
    """By the remainders of Taylor's formula, of order 2, along each surface, along the index, and along all."""
    nets, index = surfaces(), torch.full((9, 9, 1), LENS.index, dtype=torch.float64)
    rays = rays_of(SCENE, "grid", 4 * PIXELS * PIXELS, 0)
    objective = Objective(
        with_index(SCENE, index), FIELD, rays, light(), "rms-light", LossImage(apron=1, oversample=2), dtype=torch.float64
    )
    loss = JointLoss(objective, LENS, FirstValues(nets, index, (nets - 0.5, nets + 0.5), RANGE))
    assert loss.split == [nets.numel(), index.numel()]
    generator = torch.Generator().manual_seed(0)
    whole = torch.randn(sum(loss.split), generator=generator, dtype=torch.float64)
    at, each = 1e-4 * whole, nets[0].numel()
    value, gradient = loss(at)
    blocks = [torch.zeros_like(whole) for _ in range(4)]
    for k, block in enumerate(blocks):
        block[k * each : (k + 1) * each] = whole[k * each : (k + 1) * each]
    for direction in (*blocks, whole):
        slope = float(gradient @ direction)
        assert slope
        remainders = [abs(loss(at + h * direction)[0] - value - h * slope) for h in (8e-6, 4e-6, 2e-6)]
        orders = [math.log2(a / b) for a, b in itertools.pairwise(remainders)]
        assert min(orders) > 1.9, (remainders, orders)


def test_a_coloured_loss_has_the_gradient_of_all_surfaces():
    """By central differences, in three colours of which each has its own picture, through glass."""
    light_ = Light(wavelengths=(620.0, 540.0, 460.0), weights=(1.0, 1.0, 1.0), color=True)
    scene = replace(SCENE, light=light_, lens=replace(LENS, glass="N-BK7"), elements=(replace(BEHIND, glass="N-SF11"),))
    target = torch.stack([light(), light().flip(0), light().T])
    rays = rays_of(scene, "grid", 4 * PIXELS * PIXELS, 0)
    objective = Objective(scene, FIELD, rays, target, "rms-light", LossImage(apron=1, oversample=2), dtype=torch.float64)
    nets, generator = surfaces(), torch.Generator().manual_seed(1)
    found = objective(nets)
    for k in range(len(nets)):
        way = torch.zeros_like(nets)
        way[k] = torch.randn(nets[k].shape, generator=generator, dtype=torch.float64)
        ahead, behind = (objective(nets + s * 1e-6 * way).loss for s in (1, -1))
        assert float((found.gradient * way).sum()) == pytest.approx((ahead - behind) / 2e-6, rel=1e-3)


@pytest.fixture
def in_tmp(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return tmp_path


def made(capfd, *options: str, picture: str = "blob.png") -> dict:
    status = cli.run(["design", picture, *TINY, *FREE, "--json", *options])
    out, err = capfd.readouterr()
    assert status == 0, err
    return json.loads(out)


FEW = ("--control", "30", "--waves", "off")
CASES = {
    "adam": ((*FEW, "--optimizer", "adam", "--start", "offset", "--iterations", "30", "--lr", "0.01"), 0.7),
    "network": ((*FEW, "--network", "dense", "--network-width", "16", "--iterations", "30"), 0.7),
    "offset": ((*FEW, "--start", "offset"), 0.2),
    "waves": (("--control", "40", "--waves", "on", "--iterations", "4"), 1.0),
}


@pytest.mark.parametrize("case", CASES)
def test_designs_lower_the_error_of_their_start(in_tmp, capfd, case):
    write_blob()
    options, most = CASES[case]
    figures = made(capfd, *options)
    assert figures["error"] < most * figures["start_error"]
    (element,) = load("p").scene.elements
    assert all(surface is not None for surface in element.surfaces)


def test_an_index_is_designed_with_all_surfaces(in_tmp, capfd):
    """By rays of its own, about as well as with the exit alone; robust, too."""
    write_blob()
    few = ("--gradient", "free", "--control", "40", "--index-control", "30")
    figures = made(capfd, *few)
    settings = load("p").project.settings
    assert kind_of(settings) is GradedElements
    lens = load("p")
    assert lens.scene.lens.gradient.volume.std() > 1e-4
    surfaces = [surface for element in lens.scene.elements for surface in element.surfaces]
    assert len(surfaces) == 2
    assert cli.run(["render", "p", "--json", "--rays", "100000", "-o", "image.png"]) == 0
    seen = json.loads(capfd.readouterr().out)
    assert seen["relative_rms"] == pytest.approx(figures["relative_rms"], abs=0.02)
    (in_tmp / "t.toml").write_text("[index]\nsigma = 0.001\n")
    assert made(capfd, *few, "--robust", "t.toml")["error"] == pytest.approx(figures["error"], rel=0.2)
    assert kind_of(load("p").project.settings) is RobustGradedElements


def test_a_coloured_picture(in_tmp, capfd):
    """White light of three wavelengths, whose dispersion is that of the glass."""
    write_blob()
    grey = np.asarray(Image.open("blob.png").convert("L"))
    Image.fromarray(np.stack([grey] * 3, -1)).save("white.png")
    figures = made(capfd, *FEW, "--color", picture="white.png")
    assert figures["error"] < 0.6
