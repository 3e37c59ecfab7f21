"""Initial surfaces on cells finer than those on which their transport is solved, in every kind of scene."""

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from caustic_cli.inverse import initial_surface
from caustic_cli.optics.surfaces import HeightField
from caustic_cli.scene import Component, Lens, Offset, PlaneWave, Points, Scene, Screen
from caustic_cli.scene.gradient import Gradient
from caustic_cli.studies.retrace import retrace

PIXELS, SPANS = 48, 192
LENS = Lens((10.0, 10.0), control=(SPANS + 3, SPANS + 3), offset=Offset.for_magnification((3.0, 3.0), 1.5, 60.0, 5.0))
PLANE = Scene(PlaneWave(), LENS, Screen((30.0, 30.0), 60.0, (PIXELS, PIXELS)))
SCENES = {
    "plane wave": PLANE,
    "near point": replace(PLANE, source=Points(((0.5, -0.5, -60.0),))),
    "tilted screen": replace(PLANE, screen=replace(PLANE.screen, tilt=(10.0, 20.0))),
    "curved screen": replace(PLANE, screen=replace(PLANE.screen, radius=(45.0, math.inf))),
    "lens before it": replace(PLANE, elements=(Component(-30.0, (14.0, 14.0), 3.0, (120.0, math.inf), 1.5),)),
    "lens behind it": replace(PLANE, elements=(Component(20.0, (30.0, 30.0), 6.0, (150.0, -150.0), 1.5),)),
    "gradient": replace(PLANE, lens=replace(LENS, gradient=Gradient("radial", (-5e-4,)))),
}


def picture() -> np.ndarray:
    """Two discs with sharp edges in the dark."""
    u = (np.arange(PIXELS) + 0.5) / PIXELS * 2 - 1
    x, y = np.meshgrid(u, u, indexing="ij")
    discs = (np.hypot(x + 0.2, y + 0.1) < 0.4).astype(float) + 0.6 * (np.hypot(x - 0.45, y - 0.4) < 0.25)
    return gaussian_filter(discs, 0.7)


def error(scene: Scene, cells: int) -> float:
    """With a transport solved on a third of SPANS cells, where more than these are wanted."""
    field = HeightField.of(scene.lens)
    heights = initial_surface.first_surface(scene, picture(), field, cells, coarse=SPANS // 3).heights
    return retrace(scene, field, heights, picture(), rays=300_000, noise=False)[1]["relative_rms"]


@pytest.mark.parametrize("name", SCENES)
def test_creases_are_sharpened_on_finer_cells(name):
    assert error(SCENES[name], SPANS) < 0.75 * error(SCENES[name], SPANS // 3)
