"""Many rays in one pixel: a running sum in float32 stops at 2^24 of them."""

import numpy as np
import pytest
import torch
from exact import SCREEN, splatted

from caustic_cli.optics.reconstruction import Filter, splat
from caustic_cli.optics.sampling import Sampler
from caustic_cli.optics.surfaces.heightfield import HeightField
from caustic_cli.optics.system import EXIT, System
from caustic_cli.optics.trace import Tracer, expose
from caustic_cli.scene import Lens, PlaneWave, Scene, Screen

MORE = 1_000_000


def test_1e8_unit_weights_into_one_pixel(kernels, compare):
    """A pixel that holds 99 million already, and a million rays of weight 1 in float32 that come after."""
    weights = torch.ones(1, MORE + 1, dtype=torch.float32)
    weights[0, 0] = 99.0 * MORE
    naive = float(np.add.accumulate(weights.numpy()[0], dtype=np.float32)[-1])
    at = torch.full_like(weights, 0.1)
    if kernels == "torch":
        image, off = splat(at, at, weights, SCREEN, Filter())
    else:
        at, weights = at.double(), weights.double()
        image, _, lost = splatted([torch.zeros_like(at)] * 3, at, at, None, weights, "none", Lens().index, Filter())
        off = lost["off_screen"]
    assert float(off) == 0.0 and int((image > 0).sum()) == 1
    compare(
        "1e8 unit weights into one pixel",
        "the pixel, relative",
        1.0 - naive / 100.0 / MORE,
        abs(float(image.sum()) / 100.0 / MORE - 1.0),
        1e-12,
    )


def test_chunks_are_added_in_double(kernels):
    """9e4 rays in float32, in chunks: every one is there."""
    lens = Lens(size=(1.0, 1.0), control=(4, 4), fresnel="none")
    scene = Scene(PlaneWave(), lens, Screen((10.0, 10.0), 20.0, (3, 3)))
    e = expose(
        scene,
        HeightField.of(lens),
        torch.full((4, 4), 5.0, dtype=torch.float64),
        Sampler("grid", (300, 300)),
        Filter(),
        torch.float32,
        chunk=1 << 13,
    )
    assert e.rays == 90_000
    assert float(e.image[1, 1]) == pytest.approx(1.0, abs=1e-7)


@pytest.mark.parametrize("count", [1, 2, 7])
def test_few_rays(count, kernels, dtype):
    """One ray and its neighbours in number: all of the power, in their pixels."""
    lens = Lens(size=(1.0, 1.0), control=(4, 4), fresnel="none")
    scene = Scene(PlaneWave(), lens, Screen((2.0, 2.0), 20.0, (5, 5)))
    for kind in ("grid", "lines", "stratified", "uniform", "sobol"):
        e = expose(
            scene,
            HeightField.of(lens),
            torch.full((4, 4), 5.0, dtype=torch.float64),
            Sampler(kind, (count, 1)),
            Filter("cosine", (3, 3)),
            dtype,
        )
        assert float(e.image.sum()) + sum(e.lost.values()) == pytest.approx(1.0, abs=1e-6 if dtype == torch.float32 else 1e-14)


def test_derivatives_add_up_too(kernels, dtype):
    """Derivative of one pixel's light over 360,000 rays by a tilt of the lens, against the closed form for an edge of light.

    A prism moves the patch of light sideways: what a whole pixel gains is the irradiance times its height times the shift.
    """
    lens = Lens(size=(4.0, 4.0), control=(2, 2), degree=(1, 1), fresnel="none", index=1.5)
    field, screen = HeightField.of(lens), Screen((8.0, 8.0), 10.0, (8, 8))
    scene = Scene(PlaneWave(), lens, screen)
    (sample,) = Sampler("grid", (600, 600)).chunks()
    leaf = torch.zeros(2, 2, dtype=torch.float64, requires_grad=True)
    tilted = leaf + torch.tensor([[-1e-9], [1e-9]], dtype=torch.float64)
    image = Tracer(System.of(scene, field), sample, dtype).expose({EXIT: tilted}, screen, Filter("cosine", (3, 3))).image
    (by,) = torch.autograd.grad(image[5:, :].sum().double(), leaf)  # beyond x = 1 mm, in the middle of the light
    moved = float(by[1].sum() - by[0].sum())  # by a slope of 2 / 4
    closed = 0.25 * (1.5 - 1.0) * 10.0 * 2.0 / 4.0  # irradiance 1/4 per mm of x, (n - 1) T times the slope
    assert moved == pytest.approx(closed, rel=1e-3)
