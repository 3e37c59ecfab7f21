"""The wave image behind the opaque mask between round lenslets, against Fresnel diffraction by circular apertures."""

import math

import numpy as np
import pytest
import torch
from scipy.special import j0

from caustic_cli.optics.surfaces.heightfield import HeightField
from caustic_cli.optics.waves.image import wave_image
from caustic_cli.scene import Lens, Light, Offset, PlaneWave, Scene, Screen

SIZE, THICK, THROW, WAVELENGTH = 2.0, 5.0, 505.0, 600.0


def flat(array=(2, 2), packing="square", **screen) -> tuple[Scene, HeightField, torch.Tensor]:
    """A plane-parallel plate behind a mask with round holes."""
    lens = Lens(
        (SIZE, SIZE), control=(13, 13), array=array, packing=packing, lenslets="round", fresnel="none", offset=Offset(THICK)
    )
    shape = Screen((3.0, 3.0), THROW, (30, 30), **screen)
    scene = Scene(PlaneWave(), lens, shape, light=Light(wavelengths=(WAVELENGTH,)))
    return scene, HeightField.of(lens), torch.full(lens.control, THICK, dtype=torch.float64)


def of_a_hole(radius: float, distance: float, reach: float):
    """Field (over that of the plane wave) behind a circular hole at distances from its axis, mm, as a function: the Fresnel
    integral in polar coordinates, by Gauss-Legendre quadrature.

        U(p) = (k / i z) exp(i k p^2 / 2 z)  int_0^R  J0(k p s / z) exp(i k s^2 / 2 z) s ds
    """
    k = 2.0 * math.pi / (1e-6 * WAVELENGTH)
    nodes, weights = np.polynomial.legendre.leggauss(400)
    s, w = 0.5 * radius * (nodes + 1.0), 0.5 * radius * weights
    p = np.linspace(0.0, reach, 3000)
    found = (j0(k / distance * p[:, None] * s) * (np.exp(0.5j * k / distance * s * s) * s * w)).sum(1) * k / (1j * distance)

    def field(at: np.ndarray) -> np.ndarray:
        smooth = np.interp(at, p, found.real) + 1j * np.interp(at, p, found.imag)
        return smooth * np.exp(0.5j * k / distance * at * at)

    return field


@pytest.mark.parametrize(("array", "packing"), [((2, 2), "square"), ((2, 1), "square"), ((2, 2), "hexagonal")])
def test_round_holes_diffract_and_interfere(array, packing):
    scene, field, heights = flat(array, packing)
    found = wave_image(scene, field, heights).image.numpy()
    fine = 16  # points along a pixel
    x = (np.arange(30 * fine) + 0.5) * 3.0 / (30 * fine) - 1.5
    hole, cells = of_a_hole(scene.lens.cells.radius, THROW - THICK, 5.0), scene.lens.cells
    light = np.abs(sum(hole(np.hypot(x[:, None] - a, x[None, :] - b)) for a, b in cells.centres)) ** 2
    wanted = light.reshape(30, fine, 30, fine).mean((1, 3)) * (3.0 / 30) ** 2 / SIZE**2
    off = np.sqrt(np.mean((found - wanted) ** 2)) / wanted.mean()
    assert off < 0.01
    separate = sum(np.abs(hole(np.hypot(x[:, None] - a, x[None, :] - b))) ** 2 for a, b in cells.centres)
    separate = separate.reshape(30, fine, 30, fine).mean((1, 3)) * (3.0 / 30) ** 2 / SIZE**2
    assert np.sqrt(np.mean((separate - wanted) ** 2)) / wanted.mean() > 0.1  # which interference makes much of


def test_the_light_behind_the_mask():
    """What leaves the lens is that of the holes, by waves and by rays."""
    scene, field, heights = flat()
    found = wave_image(scene, field, heights)
    assert found.leaving == pytest.approx(math.pi / 4.0, rel=2e-3)
    assert float(found.image.sum()) + found.off_screen == pytest.approx(found.leaving, rel=0.02)
