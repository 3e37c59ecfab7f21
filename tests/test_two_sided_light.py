"""Two free-form sides in light at an angle, on screens at an angle, from several sources and from files of rays: by a tracer that
shares nothing with the package."""

import math
from dataclasses import replace

import numpy as np
import pytest
import sequential
import torch
from scipy.interpolate import BivariateSpline

from caustic_cli.inverse.initial_two_sided import first_sides
from caustic_cli.optics.surfaces import HeightField
from caustic_cli.optics.system import split_heights
from caustic_cli.scene import Lens, Offset, PlaneWave, Scene, Screen, SecondTarget
from caustic_cli.studies.retrace import retrace
from caustic_cli.studies.second_target import second_figures

PIXELS, HALF = 24, 6.0
LENS = Lens((10.0, 10.0), control=(43, 43), offset=Offset(15.0), height_range=(-6.0, 6.0))
UPRIGHT = Screen((2 * HALF, 2 * HALF), 50.0, (PIXELS, PIXELS))
#: Square to light at 10 degrees about y, on its line through the middle of the exit.
SLOPE = math.tan(math.radians(10.0))
SQUARE = replace(UPRIGHT, tilt=(0.0, 10.0), shift=(35.0 * SLOPE, 0.0))


def picture() -> np.ndarray:
    u = (np.arange(PIXELS) + 0.5) / PIXELS * 2 - 1
    x, y = np.meshgrid(u, u, indexing="ij")
    light = 0.25 + np.exp(-((x + 0.3) ** 2 + (y - 0.1) ** 2) / 0.08) + np.exp(-((x - 0.35) ** 2 + (y + 0.2) ** 2) / 0.08)
    return light * (np.hypot(x, y) < 0.75)


def spline(field: HeightField, net: torch.Tensor):
    """The height of a surface at points, by SciPy's splines."""
    (u, v), (rx, ry) = field.spaces, field.half_size
    made = BivariateSpline._from_tck((u.knots.numpy(), v.knots.numpy(), net.numpy().ravel(), u.degree, v.degree))
    return lambda x, y: made.ev(*(np.clip(0.5 * (c / r + 1.0), 0.0, 1.0) for c, r in ((x, rx), (y, ry))))


def traced(scene: Scene, field: HeightField, nets: torch.Tensor, count: int):
    """Landing points in the screen's own coordinates, mm, and directions (N, 3), of light on a lattice of the entrance's plane."""
    line = (np.arange(count) + 0.5) / count * 2 - 1
    x, y = (5.0 * c.ravel() for c in np.meshgrid(line, line, indexing="ij"))
    d = np.broadcast_to(scene.source.axis, (x.size, 3))
    o = np.stack([x, y, 0.0 * x], 1) - 8.0 * d / d[:, 2:]
    for net, n_in, n_out in ((nets[0], 1.0, LENS.index), (nets[1], LENS.index, 1.0)):
        o, normal, _ = sequential.meet(o, d, spline(field, net), np.zeros(3), (0.0, 0.0), 40.0)
        kept = (np.abs(o[:, :2]) <= 5.0).all(1)
        o, d = o[kept], sequential.refract(d[kept], normal[kept], n_in, n_out)
    s = scene.screen
    return sequential.onto(o, d, np.array([*s.shift, s.z]), s.tilt), d


@pytest.mark.parametrize(
    ("tilt", "screen", "second"),
    [
        ((0.0, 15.0), UPRIGHT, SecondTarget()),
        ((0.0, 10.0), SQUARE, SecondTarget(focus=(3.0 + 785.0 * SLOPE, -2.0, 800.0))),
        ((-6.0, 8.0), SQUARE, SecondTarget()),
    ],
)
def test_another_tracer_finds_the_picture_of_light_at_an_angle(tilt, screen, second):
    """Of the initial surfaces, at sight: 8 x 8 fields of the picture have their light, and it goes on as it should."""
    scene, target = Scene(PlaneWave(tilt=tilt), LENS, screen, second_target=second), picture()
    field = HeightField.of(LENS)
    nets = first_sides(scene, target, None, field, 64)
    places, d = traced(scene, field, nets, 60)
    x, y = places.T
    fields = np.histogram2d(x, y, [np.linspace(-HALF, HALF, 9)] * 2)[0]
    wanted = target.reshape(8, 3, 8, 3).sum((1, 3))
    fields, wanted = fields / fields.sum(), wanted / wanted.sum()
    assert np.abs(fields - wanted).max() < 0.08 * wanted.max()
    turn = sequential.rotation(screen.tilt)
    place = np.stack([x, y, 0.0 * x], 1) @ turn.T + np.array([*screen.shift, screen.z])
    ahead = np.broadcast_to(turn[:, 2], d.shape) if second.focus is None else np.array(second.focus) - place
    ahead = ahead / np.linalg.norm(ahead, axis=1, keepdims=True)
    angle = np.sqrt((np.linalg.norm(np.cross(d, ahead), axis=1) ** 2).mean())
    assert angle < 2e-3
    behind, exit = split_heights(scene, field, nets)
    figures = second_figures(behind, field, exit, None, rays=40_000, seed=1)[1]
    assert figures["angle_rms_mrad"] == pytest.approx(1e3 * angle, rel=0.2)  # of few rays, at creases
    seen = retrace(behind, field, exit, target, rays=40_000)[0].image.numpy().reshape(8, 3, 8, 3).sum((1, 3))
    assert np.abs(seen / seen.sum() - fields).max() < 0.06 * fields.max()
