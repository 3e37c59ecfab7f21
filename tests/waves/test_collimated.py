"""A Gaussian beam made flat and kept collimated by two free-form sides, of Frieden and Kreuzer: rays, and waves through both."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.special import j0
from test_lenses import spline_of

from caustic_cli.optics.emission import rays_of
from caustic_cli.optics.surfaces import HeightField
from caustic_cli.optics.trace import expose
from caustic_cli.optics.waves.image import wave_image
from caustic_cli.scene import FreeForm, Lens, Light, Offset, Scene, Screen, SecondTarget
from caustic_cli.scene.sources.gaussian import Gaussian
from caustic_cli.studies.second_target import second_figures

NM, LAMBDA, INDEX = 1064.0, 1.064e-3, 1.5
WAIST, TOP, EDGE, HALF, THICK = 1.5, 1.8, 0.2, 3.6, 40.0


def flat_top(r: np.ndarray) -> np.ndarray:
    """The irradiance behind: a Fermi-Dirac profile (Hoffnagle and Jefferson, Appl. Opt. 39, 5488, 2000)."""
    return 1.0 / (1.0 + np.exp(np.minimum((r - TOP) / EDGE, 50.0)))


class Kreuzer:
    """The two surfaces on a line of radii r, by equal energies, Snell's law, and parallel normals (Kreuzer, US 3476463, 1969).

    rho: where the ray of r leaves; first, last: heights of the entrance at r and of the exit at rho, mm.
    """

    def __init__(self):
        self.r = np.linspace(0.0, 5.5, 40001)
        fine = np.linspace(0.0, 6.0, 200001)
        within = _integral(fine * flat_top(fine), fine)
        part = -np.expm1(-2.0 * (self.r / WAIST) ** 2)
        self.rho = np.interp(part, within / within[-1], fine)
        self.rho[0] = 0.0
        first, last = np.zeros_like(self.r), np.full_like(self.r, THICK)
        for _ in range(30):
            inside = np.hypot(self.rho - self.r, last - first)
            sine, cosine = (self.rho - self.r) / inside, (last - first) / inside
            slope = -INDEX * sine / (INDEX * cosine - 1.0)  # of both surfaces: the light is parallel before and behind
            first = _integral(slope, self.r)
            last = THICK + _integral(slope, self.rho)
        self.first, self.last = first, last


def _integral(values: np.ndarray, at: np.ndarray) -> np.ndarray:
    return np.concatenate([[0.0], np.cumsum(0.5 * np.diff(at) * (values[1:] + values[:-1]))])


@pytest.fixture(scope="module")
def shaper():
    """The scene, its spline spaces, and the exit; the entrance is part of the lens."""
    exact = Kreuzer()
    lens = Lens(
        (2.0 * HALF, 2.0 * HALF),
        control=(121, 121),
        index=INDEX,
        z_in=0.0,
        fresnel="none",
        offset=Offset(THICK),
        height_range=(-5.0, 5.0),
    )
    field = HeightField.of(lens)

    def round_surface(at: np.ndarray, heights: np.ndarray) -> torch.Tensor:
        return spline_of(
            field, lambda x, y: torch.from_numpy(np.interp(torch.hypot(*torch.broadcast_tensors(x, y)).numpy(), at, heights))
        )

    u, v = field.spaces
    front = FreeForm(round_surface(exact.r, exact.first).numpy(), (u.degree, v.degree), (u.knots.tolist(), v.knots.tolist()))
    screen = Screen((6.0, 6.0), THICK + 50.0, (120, 120))
    scene = Scene(Gaussian((WAIST, WAIST), NM), replace(lens, entrance=front), screen, Light(wavelengths=(NM,)), SecondTarget())
    return scene, field, round_surface(exact.rho, exact.last)


def on_pixels(screen: Screen, radial, fine: int = 5) -> np.ndarray:
    n = screen.resolution[0] * fine
    x = ((2.0 * np.arange(n) + 1.0) / n - 1.0) * screen.half_size[0]
    whole = radial(np.hypot(x[:, None], x[None, :]))
    found = whole.reshape(screen.resolution[0], fine, screen.resolution[1], fine).mean((1, 3))
    return found / found.sum()


def test_rays_are_flat_and_parallel(shaper):
    scene, field, exit = shaper
    for away in (50.0, 500.0):  # parallel: it is the same farther on
        there = replace(scene, screen=replace(scene.screen, z=THICK + away))
        found = expose(there, field, exit, rays_of(there, "sobol", 1 << 21, 0)).image.double().numpy()
        exact = on_pixels(scene.screen, flat_top)
        bright = exact > 0.1 * exact.max()
        assert found.sum() > 0.9995
        assert np.sqrt(np.mean((found[bright] / found.sum() / exact[bright] - 1.0) ** 2)) < 0.03
    assert second_figures(scene, field, exit, None, rays=200_000, seed=1)[1]["angle_rms_mrad"] < 0.03


@pytest.mark.parametrize("away", [60.0, 1000.0])
def test_waves_pass_both_sides(shaper, away):
    """Behind, the field is the root of the profile in phase; Fresnel's integral of it is a Hankel transform."""
    scene, field, exit = shaper
    screen = replace(scene.screen, z=THICK + away)
    found = wave_image(scene, field, exit, screen=screen, dtype=torch.float64).image.numpy()
    s, by = np.polynomial.legendre.leggauss(3000)
    s, by = 2.1 * (s + 1.0), 2.1 * by
    k = 2.0 * math.pi / LAMBDA
    r = np.linspace(0.0, 4.3, 1500)
    source = by * s * np.sqrt(flat_top(s)) * np.exp(0.5j * k * s * s / away)
    amplitude = np.abs(j0(k * r[:, None] * s[None, :] / away) @ source) ** 2
    exact = on_pixels(screen, lambda at: np.interp(at, r, amplitude))
    assert np.abs(found / found.sum() - exact).max() < 0.005 * exact.max()
    wrong = on_pixels(screen, lambda at: np.exp(-2.0 * (at / WAIST) ** 2))
    assert np.abs(found / found.sum() - wrong).max() > 0.3 * exact.max()
