"""A GPU computes what the CPU computes.  Runs where there is one."""

from __future__ import annotations

import pytest
import torch

from caustic_cli.inverse.objective import Objective
from caustic_cli.optics.reconstruction import Filter
from caustic_cli.optics.sampling import Sampler
from caustic_cli.optics.surfaces.heightfield import HeightField
from caustic_cli.optics.trace import expose
from caustic_cli.scene import Lens, Offset, PlaneWave, Scene, Screen

pytestmark = pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")


def lens():
    scene = Scene(PlaneWave(), Lens(control=(20, 24), degree=(3, 4)), Screen((36.0, 36.0), resolution=(50, 40)))
    field = HeightField.of(scene.lens)
    x, y = field.control_xy()
    offset = Offset.for_magnification((3, 3), scene.lens.index, scene.screen.z, 5.0)
    heights = offset.thickness + torch.from_numpy(offset.sag(x[:, None].numpy(), y[None, :].numpy()))
    noise = torch.randn(20, 24, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    return scene, field, heights + 1e-3 * noise


@pytest.mark.parametrize("sampler", ["lines", "stratified"])
@pytest.mark.parametrize("dtype, close", [(torch.float64, 1e-11), (torch.float32, 1e-4)])
def test_cuda_equals_cpu(sampler, dtype, close):
    scene, field, heights = lens()
    filter, target = Filter("cosine", (3, 3)), torch.rand(50, 40, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    images, gradients = [], []
    for device in ("cpu", "cuda"):
        rays = Sampler(sampler, (200, 150), seed=3, device=device)
        images.append(expose(scene, field, heights, rays, filter, dtype).image.cpu())
        gradients.append(Objective(scene, field, rays, filter, target, "rms-light", dtype=dtype)(heights).gradient.cpu())
    for cpu, cuda in (images, gradients):
        assert float((cpu - cuda).norm() / cpu.norm()) < close
