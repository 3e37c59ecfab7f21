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
from caustic_cli.inverse.schedule import LossImage
from caustic_cli.inverse.two_sided_objective import TwoSidedObjective
from caustic_cli.optics.emission import rays_of
from caustic_cli.optics.reconstruction import Filter
from caustic_cli.optics.surfaces import HeightField
from caustic_cli.optics.system import split_heights
from caustic_cli.scene import Lens, Light, Offset, PlaneWave, Points, Scene, Screen, SecondTarget
from caustic_cli.scene.sources.rays import Measured
from caustic_cli.scene.sources.rayset import RaySet
from caustic_cli.scene.sources.several import together
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


def figures_of(scene: Scene, rays: int = 100_000) -> dict:
    """Of the initial surfaces, by the program's own rays."""
    field, target = HeightField.of(LENS), picture()
    nets = first_sides(scene, target, None, field, 64)
    behind, exit = split_heights(scene, field, nets)
    found = retrace(behind, field, exit, target, rays=rays)[1]
    return found | second_figures(behind, field, exit, None, rays=rays, seed=1)[1]


def test_rays_of_a_file_are_collimated_as_those_of_the_source_they_are_of():
    """A cone of a file's rays that come from a point, as intense as the point: the rays of either are drawn by another."""
    rng, place = np.random.default_rng(3), np.array([0.4, -0.3, -60.0])
    along = 1.0 - rng.uniform(0.0, 1.0 - np.cos(np.radians(8.0)), 200_000)
    around, across = rng.uniform(0.0, 2.0 * np.pi, along.size), np.sqrt(1.0 - along**2)
    directions = np.stack([across * np.cos(around), across * np.sin(around), along], 1)
    rays = RaySet(np.zeros((along.size, 3)), directions, np.ones(along.size))
    scenes = [
        Scene(source, LENS, UPRIGHT, second_target=SecondTarget())
        for source in (Measured(rays, tuple(place)), Points((tuple(place),), cone=8.0))
    ]
    file, point = (figures_of(scene) for scene in scenes)
    assert file["angle_rms_mrad"] == pytest.approx(point["angle_rms_mrad"], rel=0.15)
    assert file["relative_rms"] < 0.25 and file["on_screen"] == pytest.approx(point["on_screen"], rel=0.02)


def test_several_sources_are_their_sum_and_their_directions_remain():
    """Equal ones are one; light of two directions is as far apart behind the lens as etendue asks for."""
    one, pair = (
        Scene(s, LENS, UPRIGHT, second_target=SecondTarget())
        for s in (PlaneWave(), together([PlaneWave(), PlaneWave(2.0)], [Light()] * 2))
    )
    field, target = HeightField.of(LENS), torch.from_numpy(picture())
    nets = [first_sides(scene, target.numpy(), None, field, 64) for scene in (one, pair)]
    assert (nets[0] - nets[1]).abs().median() < 5e-3  # the exit is fitted to half as many rays of each
    filter = Filter("cosine", (3, 3))
    found = [
        TwoSidedObjective(s, field, rays_of(s, "grid", n), (target,), "rms", LossImage(filter))(nets[0])
        for s, n in ((one, 10_000), (pair, 20_000))
    ]
    assert found[0].loss == pytest.approx(found[1].loss, rel=5e-3)  # of other numbers of rays
    assert (found[0].gradient - found[1].gradient).norm() < 0.1 * found[0].gradient.norm()
    apart = replace(pair, source=together([PlaneWave(tilt=(0.0, a)) for a in (-0.5, 0.5)], [Light()] * 2))
    share = target / target.sum()
    denser = float((share * share).sum()) * 100.0 / 0.25  # mean irradiance over that on the lens: the angle's square
    assert figures_of(apart)["angle_rms_mrad"] == pytest.approx(1e3 * math.radians(0.5) * math.sqrt(denser), rel=0.1)
