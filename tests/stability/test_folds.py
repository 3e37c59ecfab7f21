"""Folded caustics: where the map from lens to screen folds, the irradiance 1 / |det| is infinite, but no pixel's power is."""

import numpy as np
import pytest
import torch

from caustic_cli.optics.reconstruction import Filter
from caustic_cli.optics.sampling import Sampler
from caustic_cli.optics.surfaces.heightfield import HeightField
from caustic_cli.optics.system import EXIT, System
from caustic_cli.optics.trace import Tracer, expose
from caustic_cli.scene import Lens, PlaneWave, Scene, Screen
from caustic_cli.studies.stability import images

LENS, SCREEN, heights = images.FOLDED, images.FAR, images.fold_heights
FIELD = HeightField.of(LENS)


def test_pixels_at_a_fold_hold_finite_power(kernels, dtype):
    count = 20_000
    e = expose(Scene(PlaneWave(), LENS, SCREEN), FIELD, heights(), Sampler("grid", (count, 2)), Filter(), dtype)
    found, expected = e.image.sum(1).numpy(), images.fold_powers()
    assert expected.sum() > 0.5 and expected.max() > 3.0 * np.median(expected)  # it does fold
    assert np.abs(found - expected).max() < (5.0 / count if dtype == torch.float64 else 2e-3)


def test_derivatives_at_a_fold(kernels, dtype):
    """Against differences, in double precision, over the same rays: smooth filters see no fold."""
    (sample,) = Sampler("grid", (3000, 2)).chunks()
    filter = Filter("cosine", (3, 3))
    weights = torch.rand(24, 2, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    leaf = heights().requires_grad_()
    scene = Scene(PlaneWave(), LENS, SCREEN)
    image = Tracer(System.of(scene, FIELD), sample, dtype).expose({EXIT: leaf}, SCREEN, filter).image
    (by,) = torch.autograd.grad((image.double() * weights).sum(), leaf)
    exactly = Tracer(System.of(scene, FIELD), sample, torch.float64)
    for i, j in ((0, 0), (2, 1), (3, 0)):
        step = torch.zeros(5, 2, dtype=torch.float64)
        step[i, j] = 1e-6
        moved = (exactly.expose({EXIT: heights() + s * step}, SCREEN, filter).image for s in (1, -1))
        up, down = (float((image.double() * weights).sum()) for image in moved)
        size = float(by.abs().max())
        assert abs((up - down) / 2e-6 - float(by[i, j])) < (2e-3 if dtype == torch.float32 else 1e-5) * size


@pytest.mark.parametrize("focus", [-1.0, -1.0 - 1e-12, -1.0 + 1e-9])
def test_all_rays_into_one_point(focus, kernels, dtype):
    """A focus on the screen: infinite irradiance, one pixel, all of the light, finite derivatives."""
    lens = Lens(size=(1e-3, 1e-3), control=(4, 4), index=1.5, fresnel="none")
    field, screen = HeightField.of(lens), Screen((1.0, 1.0), 50.0, (5, 5))
    x, y = field.control_xy()
    leaf = (focus / (2.0 * 0.5 * 50.0) * (x[:, None] ** 2 + y**2)).requires_grad_()
    (sample,) = Sampler("grid", (20, 20)).chunks()
    system = System.of(Scene(PlaneWave(), lens, screen), field)
    part = Tracer(system, sample, dtype).expose({EXIT: leaf}, screen, Filter("cosine", (3, 3)))
    (by,) = torch.autograd.grad((part.image * torch.linspace(0, 1, 25).view(5, 5)).sum(), leaf)
    assert float(part.image.detach().sum()) == pytest.approx(1.0, abs=1e-6)
    assert float(part.image.detach()[1:4, 1:4].sum()) == pytest.approx(1.0, abs=1e-6)
    assert bool(torch.isfinite(by).all()) and float(by.abs().max()) > 0
