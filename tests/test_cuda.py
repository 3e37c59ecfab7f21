"""A GPU computes what the CPU computes.

Where there is none: its kernels in numba's simulator (`simulated_cuda.py`), through the device's compiler (`compiled_cuda.py`), and
what is said and chosen.
"""

from __future__ import annotations

import importlib
import os
import subprocess
import sys
from glob import glob
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
from caustic_cli.scene import Lens, Offset, PlaneWave, Scene, Screen
from caustic_cli.workflow.compilation import choose_device

HERE = Path(__file__).parent
needs_device = pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")


def process(*arguments: str, **environment: str) -> subprocess.CompletedProcess:
    """A run of Python in a process of its own, since numba reads its settings as it is loaded."""
    path = os.pathsep.join([str(HERE.parent), os.environ.get("PYTHONPATH", "")])
    there = {**os.environ, "PYTHONPATH": path, "OMP_NUM_THREADS": "1", **environment}
    return subprocess.run([sys.executable, *arguments], env=there, cwd=HERE, capture_output=True, text=True, check=False)


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
@pytest.mark.parametrize("sampler", ["lines", "stratified"])
def test_cuda_repeats_bitwise(sampler):
    """Kernels, where numba has them; plain torch adds in no fixed order."""
    if not backends.cuda_kernels():
        pytest.skip("numba has no kernels for the device")
    scene, field, heights = lens()
    rays, target = Sampler(sampler, (2000, 1500), seed=3, device="cuda"), torch.ones(50, 40, dtype=torch.float64)
    filter = Filter("cosine", (3, 3))
    images = [expose(scene, field, heights, rays, filter).image for _ in range(3)]
    gradients = [Objective(scene, field, rays, target, "rms-light", LossImage(filter))(heights).gradient for _ in range(3)]
    for first, *others in (images, gradients):
        assert all(torch.equal(first, other) for other in others)


@pytest.mark.slow
@pytest.mark.parametrize("part", ["sums or splat or stages or surface", "image"])
def test_kernels_in_the_simulator(part):
    done = process(*("-m", "pytest", "-q", "-p", "no:cacheprovider", "simulated_cuda.py", "-k", part), NUMBA_ENABLE_CUDASIM="1")
    assert done.returncode == 0, done.stdout + done.stderr
    assert " passed" in done.stdout


@pytest.mark.slow
def test_kernels_through_the_compiler():
    toolkits = [*filter(None, [os.environ.get("CUDA_HOME")]), *(str(Path(p).parent) for p in glob("/usr/local/cuda*/nvvm"))]
    done = process("compiled_cuda.py", **({"CUDA_HOME": toolkits[0]} if toolkits else {}))
    if done.returncode == 77:
        pytest.skip("there is no compiler for CUDA's kernels")
    assert done.returncode == 0, done.stdout + done.stderr
    sources = (HERE.parent / "caustic_cli" / "optics" / "kernels" / "cuda").glob("*.py")
    lines = done.stdout.split()
    assert len(set(lines)) == sum(p.read_text("utf-8").count("@cuda.jit\n") for p in sources)
    assert len(lines) > 15


@pytest.mark.parametrize("asked", ["auto", "cpu", "cuda"])
@pytest.mark.parametrize("kernels", [True, False])
@pytest.mark.parametrize("device", [True, False])
def test_the_device_chosen(asked, kernels, device, monkeypatch):
    lines: list[str] = []
    monkeypatch.setattr(torch.cuda, "is_available", lambda: device)
    monkeypatch.setattr(torch.cuda, "get_device_name", lambda: "a device")
    monkeypatch.setattr("caustic_cli.workflow.compilation.cuda_kernels", lambda: kernels)
    chosen = choose_device(asked, SimpleNamespace(say=lines.append))
    assert chosen == ("cuda" if device and (asked == "cuda" or (asked == "auto" and kernels)) else "cpu")
    assert len(lines) == (device and asked != "cpu")
    if lines:
        assert ("plain torch" in lines[0]) == (chosen == "cuda" and not kernels)
        assert ("[cuda]" in lines[0]) == (not kernels)


@pytest.mark.parametrize("kernels, name", [(True, "cuda"), (False, "torch")])
def test_the_backend_of_a_device(kernels, name, monkeypatch):
    monkeypatch.delenv("CAUSTIC_KERNELS", raising=False)
    monkeypatch.setattr(backends, "cuda_kernels", lambda: kernels)
    monkeypatch.setattr(backends, "_made", lambda name: name)
    assert backends.backend_for("cuda:0") == name
    assert backends.backend_for("cpu") == "numba"
    monkeypatch.setenv("CAUSTIC_KERNELS", "cuda")  # without the simulator only of a device
    monkeypatch.delenv("NUMBA_ENABLE_CUDASIM", raising=False)
    assert (backends.backend_for("cpu"), backends.backend_for("cuda:0")) == ("numba", name)
    monkeypatch.setenv("CAUSTIC_KERNELS", "torch")
    assert backends.backend_for("cuda:0") == "torch"
    monkeypatch.delenv("CAUSTIC_KERNELS")
    with forward_ad.dual_level():  # the kernels have no tangents
        assert backends.backend_for("cpu") == backends.backend_for("cuda:0") == backends.usable("numba") == "torch"
    assert backends.usable("numba") == "numba"
    monkeypatch.setenv("CAUSTIC_KERNELS", "numpy")
    with pytest.raises(InputError, match="torch or cuda"):
        backends.backend_for("cpu")


def test_cuda_is_not_loaded_for_a_cpu():
    code = "import sys, caustic_cli.optics.backends as b; b.backend_for('cpu'); sys.exit('numba.cuda.api' in sys.modules)"
    done = process("-c", code)
    assert done.returncode == 0, done.stderr


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
    done = process("benchmarks/gpu.py")
    assert done.returncode == 2 and not done.stdout
    assert done.stderr.splitlines() == ["gpu.py: there is no CUDA device here, and no figure without one"]


@pytest.mark.slow
def test_the_benchmark_measures_iterations(monkeypatch, capsys):
    """What it would do on a device, on the CPU's kernels and a few rays: the table is complete, and both sides agree."""
    monkeypatch.syspath_prepend(str(HERE / "benchmarks"))
    gpu = importlib.import_module("gpu")
    few = {name: {**s, "rays": 100, "control": 8} for name, s in gpu.settings(1000).items() if name.startswith(("1,000", "point"))}
    monkeypatch.setattr(gpu, "settings", lambda rays: few)
    gpu.rows("cpu", 1000, 1)
    table = [line.strip("| ").split(" | ") for line in capsys.readouterr().out.splitlines()[2:]]
    assert [row[0] for row in table] == list(few)
    assert all(float(row[4]) == 0.0 and row[5] == "True" for row in table)
