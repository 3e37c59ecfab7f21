"""The whole chain against an independent wave: refraction and the angular spectrum of `angular`."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from angular import Relief, behind, binned, propagated
from test_lenses import GREEN, LAMBDA, spline_of

from caustic_cli.optics.surfaces import HeightField
from caustic_cli.optics.waves.image import wave_image
from caustic_cli.scene import Lens, Light, Offset, PlaneWave, Scene, Screen

INDEX = 1.5

#: Lens, screen, throw, pixels, steps of the grid, all mm, and the relief.
CASES = {
    "structured": (
        (1.0, 1.0),
        (2.6, 2.6),
        20.0,
        (52, 52),
        (3.4e-3, 3.4e-3),
        lambda x, y: (x * x + y * y) / 20.0 + 6e-4 * torch.cos(14.0 * x + 3.0 * y) * torch.sin(11.0 * y - 4.0 * x),
    ),
    "steep": (
        (0.6, 0.6),
        (3.6, 2.0),
        8.0,
        (30, 20),
        (1.1e-3, 2.5e-3),
        lambda x, y: 0.2 * x * x + 0.1 * y * y + 5e-3 * torch.cos(14.0 * x + 2.0 * y) + 2e-3 * torch.sin(9.0 * y + 3.0 * x),
    ),
}


@pytest.mark.parametrize("name", CASES)
def test_against_the_angular_spectrum(name):
    """Relative RMS at most 0.01 over all pixels, sampled as an image is."""
    size, wide, throw, count, steps, shape = CASES[name]
    screen = Screen(wide, 0.3 + throw, count)
    scene = Scene(
        PlaneWave(),
        Lens(size, control=(24, 16), index=INDEX, fresnel="none", offset=Offset(0.3)),
        screen,
        Light(wavelengths=(GREEN,)),
    )
    field = HeightField.of(scene.lens)
    heights = 0.3 + spline_of(field, shape)
    found = wave_image(scene, field, heights).image.numpy()

    half = tuple(0.5 * s for s in size)
    relief = Relief(heights.numpy(), [s.knots.numpy() for s in field.spaces], [s.degree for s in field.spaces], half)
    plane = float(heights.max()) + 1e-3
    counts = [2 * math.ceil(0.5 * 1.25 * w / d) for w, d in zip(wide, steps, strict=True)]
    inner = [2 * math.ceil(0.5 * s * 1.1 / d) for s, d in zip(size, steps, strict=True)]
    x, y = (d * (np.arange(n) - 0.5 * (n - 1)) for n, d in zip(inner, steps, strict=True))
    path, amplitude = behind(relief, INDEX, plane, x, y, half)
    whole = np.zeros(counts, dtype=complex)
    at = tuple(slice((n - i) // 2, (n + i) // 2) for n, i in zip(counts, inner, strict=True))
    whole[at] = amplitude * np.exp(2j * math.pi / LAMBDA * path)
    power = np.abs(propagated(whole, steps, LAMBDA, screen.z - plane)) ** 2 * steps[0] * steps[1] / (size[0] * size[1])
    grid = tuple(d * (np.arange(n) - 0.5 * (n - 1)) for n, d in zip(counts, steps, strict=True))
    exact = binned(power, grid, screen.half_size, count)
    assert exact.sum() > 0.9
    contrast = exact.std() / exact.mean()
    assert contrast > 0.3  # there is something to agree on
    slopes = list(relief.at(*np.meshgrid(x, y, indexing="ij")))[1]  # by half of these light turns
    assert np.abs(slopes).max() * (INDEX - 1.0) > (0.09 if name == "steep" else 0.02)
    rms = math.sqrt(((found - exact) ** 2).mean()) / exact.mean()
    assert rms < 0.01, rms
