"""A GPU computes in plain torch what the CPU's kernels compute; without one, what is chosen and said."""

from __future__ import annotations

import importlib
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
from torch.autograd import forward_ad

from caustic_cli.errors import InputError
from caustic_cli.inverse.objective import Objective
from caustic_cli.inverse.schedule import LossImage
from caustic_cli.optics import backends
from caustic_cli.optics.reconstruction import Filter
from caustic_cli.optics.sampling import Sampler
from caustic_cli.optics.surfaces.heightfield import HeightField
from caustic_cli.optics.trace import expose
from caustic_cli.optics.waves import propagation
from caustic_cli.scene import FreeForm, Lens, Offset, PlaneWave, Scene, Screen
from caustic_cli.workflow.compilation import choose_device

HERE = Path(__file__).parent
needs_device = pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")


def lens():
    scene = Scene(PlaneWave(), Lens(control=(20, 24), degree=(3, 4)), Screen((36.0, 36.0), resolution=(50, 40)))
    field = HeightField.of(scene.lens)
    x, y = field.control_xy()
    offset = Offset.for_magnification((3, 3), scene.lens.index, scene.screen.z, 5.0)
    heights = offset.thickness + torch.from_numpy(offset.sag(x[:, None].numpy(), y[None, :].numpy()))
    noise = torch.randn(20, 24, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    return scene, field, heights + 1e-3 * noise


@needs_device
@pytest.mark.parametrize("sampler", ["lines", "stratified"])
@pytest.mark.parametrize("dtype, close", [(torch.float64, 1e-11), (torch.float32, 1e-4)])
def test_cuda_equals_cpu(sampler, dtype, close):
    scene, field, heights = lens()
    filter, target = Filter("cosine", (3, 3)), torch.rand(50, 40, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    images, gradients = [], []
    for device in ("cpu", "cuda"):
        rays = Sampler(sampler, (200, 150), seed=3, device=device)
        images.append(expose(scene, field, heights, rays, filter, dtype).image.cpu())
        gradients.append(Objective(scene, field, rays, target, "rms-light", LossImage(filter), dtype=dtype)(heights).gradient.cpu())
    for cpu, cuda in (images, gradients):
        assert float((cpu - cuda).norm() / cpu.norm()) < close


@needs_device
def test_rays_on_a_curved_entrance_are_those_of_the_cpu():
    scene, field, heights = lens()
    x, y = (torch.linspace(-1.0, 1.0, n, dtype=torch.float64) for n in (8, 9))
    entrance = FreeForm((0.2 * x[:, None] ** 2 - 0.1 * y[None, :] ** 2).numpy(), (3, 3))
    scene = replace(scene, lens=replace(scene.lens, entrance=entrance))
    cpu, cuda = (
        expose(scene, field, heights, Sampler("lines", (200, 150), seed=3, device=device), Filter("cosine", (3, 3))).image.cpu()
        for device in ("cpu", "cuda")
    )
    assert float((cpu - cuda).norm() / cpu.norm()) < 1e-9


@pytest.mark.parametrize("asked", ["auto", "cpu", "cuda"])
@pytest.mark.parametrize("device", [True, False])
def test_the_device_chosen(asked, device, monkeypatch):
    lines: list[str] = []
    monkeypatch.setattr(torch.cuda, "is_available", lambda: device)
    monkeypatch.setattr(torch.cuda, "get_device_name", lambda: "a device")
    chosen = choose_device(asked, SimpleNamespace(say=lines.append))
    assert chosen == ("cuda" if asked == "cuda" else "cpu")
    assert lines == (["tracing on a device, in plain torch"] if asked == "cuda" else [])


def test_the_backend_of_a_device(monkeypatch):
    monkeypatch.delenv("CAUSTIC_KERNELS", raising=False)
    assert backends.backend_for("cuda:0").name == "torch"
    assert backends.backend_for("cpu").name == "numba"
    with forward_ad.dual_level():  # the kernels have no tangents
        assert backends.backend_for("cpu").name == backends.usable(backends.backend_for("cpu")).name == "torch"
    assert backends.usable(backends.backend_for("cpu")).name == "numba"
    monkeypatch.setenv("CAUSTIC_KERNELS", "torch")
    assert backends.backend_for("cpu").name == "torch"
    monkeypatch.setenv("CAUSTIC_KERNELS", "cuda")
    with pytest.raises(InputError, match="must be torch"):
        backends.backend_for("cpu")


def test_waves_stay_on_the_device_of_their_field():
    """Propagation is torch's FFT: on torch's device without numbers, which refuses whatever was made on another, all of it runs."""
    phase, amplitude = (torch.zeros(8, 8, dtype=torch.float64, device="meta", requires_grad=True) for _ in range(2))
    rows, columns = (propagation.cells(propagation.pixel_edges(-1.0, 0.5, 4, -1.2, 0.2, 16).to(phase.device), 16) for _ in range(2))
    image = propagation.power_on_pixels(phase, amplitude, (16, 16), rows, columns)
    image.sum().backward()
    assert image.device.type == phase.grad.device.type == "meta" and image.shape == (4, 4)


def test_the_benchmark_without_a_device():
    if torch.cuda.is_available():
        pytest.skip("there is a CUDA device")
    there = os.environ | {"PYTHONPATH": os.pathsep.join([str(HERE.parent), os.environ.get("PYTHONPATH", "")])}
    done = subprocess.run([sys.executable, "benchmarks/gpu.py"], cwd=HERE, env=there, capture_output=True, text=True, check=False)
    assert done.returncode == 2 and not done.stdout
    assert done.stderr.splitlines() == ["gpu.py: there is no CUDA device here, and no figure without one"]


@pytest.mark.slow
def test_the_benchmark_measures_iterations(monkeypatch, capsys):
    """What it would do on a device, with few rays by the CPU's kernels: the table is complete, and both sides agree."""
    monkeypatch.syspath_prepend(str(HERE / "benchmarks"))
    gpu = importlib.import_module("gpu")
    few = {name: {**s, "rays": 100, "control": 8} for name, s in gpu.settings(1000).items() if name.startswith(("1,000", "point"))}
    monkeypatch.setattr(gpu, "settings", lambda rays: few)
    gpu.rows("cpu", 1000, 1)
    table = [line.strip("| ").split(" | ") for line in capsys.readouterr().out.splitlines()[2:]]
    assert [row[0] for row in table] == list(few)
    assert all(float(row[4]) == 0.0 for row in table)
