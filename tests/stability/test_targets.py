"""Targets with zeros, with one bright pixel, with a 16-bit range; heights at the limits of their range."""

import json
import math
import shlex

import numpy as np
import pytest
import torch
from PIL import Image

from caustic_cli import cli
from caustic_cli.inverse.initial_surface import first_surface
from caustic_cli.inverse.objective import Objective
from caustic_cli.inverse.parametrisation import FreeHeights
from caustic_cli.inverse.schedule import LossImage
from caustic_cli.optics.emission import rays_of
from caustic_cli.optics.reconstruction import Filter
from caustic_cli.optics.sampling import Sampler
from caustic_cli.optics.surfaces.heightfield import HeightField
from caustic_cli.optics.trace import expose
from caustic_cli.project.checkpoint import load
from caustic_cli.scene import Lens, PlaneWave, Points, Scene, Screen

N = 16


def pictures() -> dict[str, np.ndarray]:
    one, corner, ramp = np.zeros((N, N)), np.zeros((N, N)), np.linspace(0.0, 65535.0, N * N).reshape(N, N)
    one[9, 6] = corner[0, -1] = 1.0
    far = np.ones((N, N))
    far[3, 3] = 1e12
    islands = (np.indices((N, N)).sum(0) % 5 == 0) * 1.0
    return {
        "one pixel": one,
        "a corner": corner,
        "16 bits": ramp,
        "1e12 in one pixel": far,
        "islands": islands,
        "denormal": islands * 1e-310,
        "huge": ramp * 1e290,
    }


@pytest.mark.parametrize("name", pictures())
@pytest.mark.parametrize("loss", ["rms", "rms-light", "rms-light + throughput + 0.1 diffusion", "uniformity"])
def test_loss_and_derivative(name, loss, kernels, dtype, compare):
    """Against float64 by the reference; naive: squares of relative errors, which divide by the target's zeros."""
    picture = torch.from_numpy(pictures()[name])
    lens = Lens(size=(10.0, 10.0), control=(8, 8), index=1.5)
    s, field = Scene(PlaneWave(), lens, Screen((14.0, 14.0), 60.0, (N, N))), HeightField.of(lens)
    heights = 5.0 + 0.3 * torch.rand(8, 8, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    sampler, filter = Sampler("grid", (60, 60)), Filter("cosine", (3, 3))
    found = Objective(s, field, sampler, picture, loss, LossImage(filter, apron=2), dtype=dtype)(heights)
    assert math.isfinite(found.loss) and bool(torch.isfinite(found.gradient).all())
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("CAUSTIC_KERNELS", "torch")
        exact = Objective(s, field, sampler, picture, loss, LossImage(filter, apron=2), dtype=torch.float64)(heights)
    if exact.loss == 0.0:  # the evenness of a single pixel
        assert loss == "uniformity" and found.loss == 0.0 and not found.gradient.any()
        return
    error = max(abs(found.loss / exact.loss - 1.0), float((found.gradient - exact.gradient).norm() / exact.gradient.norm()))
    image = torch.full((N, N), 1.0 / N**2, dtype=dtype, requires_grad=True)
    t = (picture / picture.sum()).to(dtype)
    naive = torch.sqrt((((image - t) / t) ** 2).mean())
    bound = 1e-3 if dtype == torch.float32 else 1e-9
    if bool((t == 0).any()) and loss == "rms":
        compare("targets with zeros or one bright pixel", "loss and derivatives, relative", float(naive.detach()), error, bound)
    assert error < bound


@pytest.mark.parametrize("name", pictures())
@pytest.mark.parametrize(
    "source", [PlaneWave(), Points(((0.0, 0.0, -50.0),)), Points(((0.0, 0.0, -1e6),))], ids=["plane", "point", "far point"]
)
def test_transport_start(name, source):
    """The first surface of a design is finite, and throws more light where the picture is bright than a flat lens would."""
    picture = pictures()[name]
    if name in ("denormal", "huge"):
        picture = picture / picture.max()  # as the pictures' reader and `target_on_screen` hand them on
    lens = Lens(size=(10.0, 10.0), control=(19, 19), index=1.5)
    s = Scene(source, lens, Screen((20.0, 20.0), 200.0, (N, N)))
    heights = first_surface(s, picture, HeightField.of(lens), 48).heights
    assert bool(torch.isfinite(heights).all())
    rays = rays_of(s, "stratified", 4000, 1)
    image = expose(s, HeightField.of(lens), heights, rays).image.numpy()
    flat = expose(s, HeightField.of(lens), torch.full_like(heights, 5.0), rays).image.numpy()
    fit = [np.abs(i / i.sum() - picture / picture.sum()).sum() for i in (image, flat)]
    assert fit[0] < 0.6 * fit[1], fit


def test_designs_of_extreme_pictures_write_finite_files(tmp_path, monkeypatch, capfd):
    """The whole command: zeros and one bright pixel as 8-bit and 16-bit images and as .npy."""
    monkeypatch.chdir(tmp_path)
    spot = np.zeros((N, N))
    spot[4, 11] = 1.0
    Image.fromarray((255 * spot).astype(np.uint8)).save("spot8.png")
    Image.fromarray((65535 * (np.eye(N) + spot) / 2).astype(np.uint16)).save("range16.png")
    np.save("tiny.npy", 1e-300 * (spot + 1e-12))
    done = 0
    for name in ("spot8.png", "range16.png", "tiny.npy"):
        for more in ("", "--optimizer adam --lr 0.1"):
            code = cli.run(
                shlex.split(
                    f"design {name} --resolution 16 --control 10 --rays 900 --iterations 4 --threads 1 --quiet"
                    f" --json --force {more}"
                )
            )
            out, err = capfd.readouterr()
            assert code == 0, err
            figures = json.loads(out)
            assert 0.0 < figures["on_screen"] <= 1.0
            assert bool(torch.isfinite(load(tmp_path / f"{name.split('.')[0]}.caustic" / "checkpoints.h5").state.heights).all())
            done += 1
    assert done == 6


@pytest.mark.parametrize("laplacian", [False, True])
@pytest.mark.parametrize("where", [0.0, 1.0, -3.0, 7.0])
def test_heights_at_the_limits_of_their_range(where, laplacian, compare):
    """tanh saturates: atanh of the limit is infinite and its slope there 0, so that such a height would never move again."""
    low, high = torch.zeros(6, 6, dtype=torch.float64), torch.ones(6, 6, dtype=torch.float64)
    start = 0.3 + 0.2 * torch.rand(6, 6, dtype=torch.float64)
    start[2, 3] = where
    module = FreeHeights(low, high, start, laplacian)
    heights = module()
    (by,) = torch.autograd.grad(heights[2, 3], module.y)
    assert bool(torch.isfinite(heights).all() and torch.isfinite(by).all()) and float(by.abs().max()) > 1e-9
    assert float((heights >= low).all()) and float((heights <= high).all())
    naive = torch.atanh(2.0 * start - 1.0)[2, 3]
    if where in (0.0, 1.0):
        ours = abs(float(heights[2, 3].detach()) - where)
        compare("heights at the limits of their range", "the height, mm", float(naive.abs()), ours, 1e-6)


def test_saturated_heights_come_back():
    """Raw values of +-1e6, where float32 and float64 both give a slope of exactly 0, stay finite and in range."""
    low, high = torch.zeros(4, 4, dtype=torch.float64), torch.full((4, 4), 2.0, dtype=torch.float64)
    module = FreeHeights(low, high)
    module.y.data = torch.linspace(-1e6, 1e6, 16, dtype=torch.float64).view(4, 4)
    heights = module()
    (by,) = torch.autograd.grad(heights.sum(), module.y)
    assert bool(torch.isfinite(heights).all() and torch.isfinite(by).all())
    again = FreeHeights(low, high, heights.detach())
    (by,) = torch.autograd.grad(again().sum(), again.y)
    assert float(by.min()) > 0  # a new stage begins with a slope everywhere


@pytest.mark.parametrize("degree", [1, 3, 15])
def test_transport_start_on_repeated_knots(degree):
    """Interpolated through the Greville points such a net overshoots the surface many times; the start's does not."""
    t = [0.0] * (degree + 1) + [0.1] * min(degree, 10) + [0.25] * degree + [0.5, 0.5 + 1e-11] + [1.0] * (degree + 1)
    n = len(t) - degree - 1
    lens = Lens(size=(10.0, 10.0), control=(n, n), degree=(degree, degree), knots=(t, t), index=1.5)
    field = HeightField.of(lens)
    s = Scene(PlaneWave(), lens, Screen((20.0, 20.0), 200.0, (N, N)))
    heights = first_surface(s, pictures()["16 bits"], field, 48).heights
    assert bool(torch.isfinite(heights).all())
    assert float(heights.max() - heights.min()) < 2.0  # of a surface that is 0.2 mm high
