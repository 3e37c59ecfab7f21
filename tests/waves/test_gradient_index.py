"""Light through a gradient index against an independent wave: split steps through the medium, then the angular spectrum."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from angular import binned, propagated
from test_lenses import GREEN, LAMBDA

from caustic_cli.optics.surfaces import HeightField
from caustic_cli.optics.waves.image import wave_image
from caustic_cli.scene import Lens, Light, Offset, Scene, Screen
from caustic_cli.scene.gradient import Gradient
from caustic_cli.scene.sources.gaussian import Gaussian

INDEX, DEEP, SIZE, WAIST = 1.6, 4.0, 1.0, 0.2


def behind(squared, wavelength: float, steps: int, at: np.ndarray) -> np.ndarray:
    """The field of a beam at the flat exit of a medium of squared index `squared(x, y)`, of unit power, by symmetric split steps:
    half a step of diffraction in INDEX, the phase of the index, and the other half."""
    x, y = np.meshgrid(at, at, indexing="ij")
    step, d = DEEP / steps, at[1] - at[0]
    field = np.exp(-(x * x + y * y) / WAIST**2) * math.sqrt(2.0 / math.pi) / WAIST
    delay = np.exp(1j * (2.0 * math.pi / wavelength) * step * (np.sqrt(squared(x, y)) - INDEX))
    within = wavelength / INDEX
    for _ in range(steps):
        field = propagated(propagated(field, (d, d), within, 0.5 * step) * delay, (d, d), within, 0.5 * step)
    return field


@pytest.mark.parametrize(
    ("gradient", "throw"),
    [(Gradient("selfoc", (0.06,)), 20.0), (Gradient("selfoc", (0.06,)), 45.0), (Gradient("radial", (-2e-3, 1e-3)), 30.0)],
)
def test_against_split_steps(gradient, throw):
    """Images in front of the focus, near it and behind a surface of higher order; light within the medium is that of rays here."""
    wide, count = 0.5, (50, 50)
    lens = Lens((SIZE, SIZE), control=(24, 24), index=INDEX, fresnel="none", offset=Offset(DEEP), gradient=gradient)
    scene = Scene(Gaussian((WAIST, WAIST), GREEN), lens, Screen((wide, wide), DEEP + throw, count), Light(wavelengths=(GREEN,)))
    field = HeightField.of(lens)
    found = wave_image(scene, field, torch.full(field.shape, DEEP, dtype=torch.float64)).image.numpy()

    n, d = 1200, 2.5e-3
    at = d * (np.arange(n) - 0.5 * (n - 1))

    def squared(x, y):
        r = np.minimum(np.hypot(x, y), SIZE)
        if gradient.kind == "selfoc":
            return INDEX**2 * (1.0 - (gradient.terms[0] * r) ** 2)
        return (INDEX + sum(t * r ** (2 * k + 2) for k, t in enumerate(gradient.terms))) ** 2

    power = np.abs(propagated(behind(squared, LAMBDA, 24, at), (d, d), LAMBDA, throw)) ** 2 * d * d
    exact = binned(power, (at, at), (0.5 * wide,) * 2, count)
    assert exact.sum() > 0.9
    assert np.linalg.norm(found - exact) < 5e-3 * np.linalg.norm(exact)
