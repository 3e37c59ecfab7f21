"""The benchmark of a network from picture to lens: it learns, and its potential becomes the lens that it means."""

from __future__ import annotations

import importlib
from pathlib import Path

import numpy as np
import pytest
import torch
from torch.nn import functional

from caustic_cli.io.picture import Picture
from caustic_cli.studies.retrace import retrace
from caustic_cli.workflow.preparation import prepare
from caustic_cli.workflow.reporter import Listener

N = 16


@pytest.fixture
def benchmark(monkeypatch):
    monkeypatch.syspath_prepend(str(Path(__file__).parent / "benchmarks"))
    return importlib.import_module("picture_network")


def spot(x: float, y: float) -> np.ndarray:
    """A picture (N, N) with a bright spot at this place in its widths."""
    at = (np.arange(N) + 0.5) / N
    return 0.3 + 3.0 * np.exp(-((at[:, None] - x) ** 2 + (at - y) ** 2) / 0.04)


def traced(benchmark, psi: torch.Tensor, picture: np.ndarray) -> np.ndarray:
    """The caustic (N, N), of mean 1, that the tracer finds of the lens of a potential."""
    said = {"mag": 2.0, "margin": 0.0, "screen.resolution": [N, N], "lens.control": [2 * N + 3] * 2, "design.waves": "off"}
    problem = prepare(Picture(picture, "linear"), said | {"design.start": "offset"}, say=Listener()).problem
    net = benchmark.heights_of(benchmark.basis_of(N, "cpu"), psi, problem)
    image = retrace(problem.scene, problem.field(0), net, picture, rays=40_000, noise=False)[0].image
    return (image / image.sum() * N * N).numpy()


def test_the_network_learns_and_its_lens_throws_its_caustic(benchmark, monkeypatch):
    """After some seconds of training the loss has fallen, and the light of a lens without symmetry lands where its splat says."""
    monkeypatch.setattr(benchmark, "POOL", 2)
    torch.manual_seed(0)
    network = benchmark.PictureNetwork((8, N), 1, (16, 32))
    losses = benchmark.train(network, None, 0.0, 8, 3e-3, "cpu", iterations=80)
    assert np.mean(losses[-20:]) < 0.7 * np.mean(losses[:5])

    picture = spot(0.3, 0.6)
    goal = torch.from_numpy(picture / picture.mean()).float()
    with torch.inference_mode():
        *_, (basis, framed, found) = network.eval()(goal[None])
        splat = basis.caustic(found[-1], basis.regular, basis.regular)[0]
    inner = slice(basis.pad, basis.pad + N)
    predicted = splat[0, inner, inner].numpy()
    assert np.sqrt(np.mean((predicted - framed[0, inner, inner].numpy()) ** 2)) < 0.7 * (picture / picture.mean()).std()

    seen = torch.from_numpy(traced(benchmark, found[-1][0], picture)).float()
    seen = basis.framed(seen[None])[0, inner, inner].numpy()  # as a splat blurs it
    apart = np.sqrt(np.mean((seen - predicted) ** 2))
    assert apart < 0.06 < 0.5 * np.sqrt(np.mean((seen - predicted.T) ** 2))


def test_a_checkpoint_holds_the_network(benchmark, tmp_path):
    network = benchmark.PictureNetwork((8,), 1, (8, 16))
    for p in network.parameters():
        torch.nn.init.normal_(p, std=0.1)
    benchmark.save(network, tmp_path / "n.pt")
    pictures = benchmark.made_pictures(3, 8, "cpu")
    assert (pictures >= 0).all() and functional.avg_pool2d(pictures[:, None], 8).flatten().tolist() == pytest.approx([1.0] * 3)
    with torch.inference_mode():
        one, other = (list(n(pictures))[-1][2][-1] for n in (network, benchmark.load(tmp_path / "n.pt")))
    assert one.abs().max() > 0 and torch.equal(one, other)
