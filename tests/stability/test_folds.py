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

LENS = Lens(size=(2.0, 2.0), control=(5, 2), degree=(4, 1), index=1.5, fresnel="none")
FIELD = HeightField.of(LENS)
SCREEN = Screen((1.2, 4.0), 40.0, (24, 2))


def heights() -> torch.Tensor:
    """z = a x^2 - b x^4, which lands at x = 0 in a cusp; the spline of degree 4 holds it exactly."""
    x = FIELD.spaces[0].greville
    basis = FIELD.spaces[0].matrix(x)
    at = 2.0 * x - 1.0
    return torch.linalg.solve(basis, -0.03 * at**2 + 0.02 * at**4)[:, None].expand(5, 2).contiguous()


def landing(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Where a ray at x lands, and dX/dx, in double precision by the closed form of the plane wave."""
    z, g, gg = -0.03 * x**2 + 0.02 * x**4, -0.06 * x + 0.08 * x**3, -0.06 + 0.24 * x**2
    n, reach = LENS.index, SCREEN.z
    s = np.sqrt(1.0 - (n * n - 1.0) * g * g)
    m = (n * n - 1.0) / (1.0 + n * s)
    dm = n * (n * n - 1.0) * g / s * m / (1.0 + n * s)
    return x + (reach - z) * m * g, 1.0 + (reach - z) * (m + dm * g) * gg - m * g * g


def exact() -> np.ndarray:
    """Power of every column of pixels: the lengths of x that land there, from all crossings of its edges."""
    edges = np.linspace(-0.6, 0.6, 25)
    x = np.linspace(-1.0, 1.0, 4000)  # an even number: no point lies on an edge
    at = landing(x)[0]
    cuts = [x[0], x[-1]]
    for e in edges:
        for k in np.nonzero((at[:-1] - e) * (at[1:] - e) < 0)[0]:
            low, high = x[k], x[k + 1]
            for _ in range(60):
                middle = 0.5 * (low + high)
                low, high = (middle, high) if (landing(middle)[0] - e) * (at[k] - e) > 0 else (low, middle)
            cuts.append(0.5 * (low + high))
    cuts = np.sort(cuts)
    column = np.searchsorted(edges, landing(0.5 * (cuts[1:] + cuts[:-1]))[0]) - 1
    inside = (column >= 0) & (column < 24)
    return np.bincount(column[inside], np.diff(cuts)[inside] / 2.0, 24)


def test_pixels_at_a_fold_hold_finite_power(kernels, dtype, compare):
    count = 20_000
    e = expose(Scene(PlaneWave(), LENS, SCREEN), FIELD, heights(), Sampler("grid", (count, 2)), Filter(), dtype)
    found, expected = e.image.sum(1).numpy(), exact()
    x = np.linspace(-1.0, 1.0, 200_001)
    stretch = landing(x)[1]
    folds = np.nonzero(stretch[:-1] * stretch[1:] < 0)[0]
    assert len(folds) == 2  # it does fold
    assert expected.sum() > 0.5 and expected.max() > 3.0 * np.median(expected)
    naive = 1.0 / np.abs(stretch[folds]).min() * SCREEN.pixel[0] / 2.0 - expected.max()  # the irradiance there times the pixel
    compare("folds", "power of a pixel", naive, np.abs(found - expected).max(), 5.0 / count if dtype == torch.float64 else 2e-3)


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
