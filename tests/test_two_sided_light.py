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
from caustic_cli.inverse.lens_space import lines_behind
from caustic_cli.inverse.schedule import LossImage
from caustic_cli.inverse.two_sided_objective import TwoSidedObjective
from caustic_cli.optics.emission import rays_of
from caustic_cli.optics.reconstruction import Filter
from caustic_cli.optics.surfaces import HeightField
from caustic_cli.optics.system import split_heights
from caustic_cli.scene import Component, Lens, Light, Offset, PlaneWave, Points, Scene, Screen, SecondTarget
from caustic_cli.scene.elements import FoldMirror
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
FARTHER = replace(UPRIGHT, z=300.0)
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


def sphere(radius: float):
    """Sag of a sphere through the origin."""
    return lambda x, y: (x * x + y * y) / radius / (1.0 + np.sqrt(1.0 - (x * x + y * y) / radius**2))


BICONVEX = Component(z=32.0, thickness=3.0, size=(20.0, 20.0), radius=(60.0, -90.0), index=1.6)
MIRROR = FoldMirror(z=46.0, size=(30.0, 30.0), tilt=(0.0, 50.0))


@pytest.mark.parametrize("mirror", [False, True])
def test_another_tracer_goes_along_lines_behind_the_lens_to_the_points(mirror):
    """Through a lens, and onto a mirror behind it: lines of `lines_behind` arrive at their points, with their slopes."""
    elements = (BICONVEX, MIRROR) if mirror else (BICONVEX,)
    scene = Scene(PlaneWave(), LENS, replace(UPRIGHT, z=70.0, tilt=(5.0, 0.0)), elements=elements)
    rng = np.random.default_rng(4)
    points = np.stack([*rng.uniform(-5.0, 5.0, (2, 300)), rng.uniform(69.0, 71.0, 300)])
    slopes = rng.uniform(-0.08, 0.08, (2, 300))
    at, leaving = lines_behind(scene, points, slopes)
    d = np.stack([*leaving, np.ones(300)], 1)
    o, d = (at - (at[2] - 16.0) * d.T).T, d / np.linalg.norm(d, axis=1, keepdims=True)
    glass = [(sphere(r), (0.0, 0.0, z), (0.0, 0.0), *n) for r, z, *n in ((60.0, 32.0, 1.0, 1.6), (-90.0, 35.0, 1.6, 1.0))]
    fold = [(lambda x, y: 0.0 * x, (0.0, 0.0, 46.0), (0.0, 50.0), "reflect")] if mirror else []
    o, d, _ = sequential.walk(o, d, glass + fold)
    if mirror:  # back to the straight axis: reflected once more, in the plane of the mirror
        turn = sequential.rotation((0.0, 50.0))[:, 2]
        middle = np.array([0.0, 0.0, 46.0])
        o, d = o - 2.0 * ((o - middle) @ turn)[:, None] * turn, d - 2.0 * (d @ turn)[:, None] * turn
        o, d = o * [-1.0, 1.0, 1.0], d * [-1.0, 1.0, 1.0]  # the axis in the plane of the fold is reversed
    landed = o + ((points[2] - o[:, 2]) / d[:, 2])[:, None] * d
    assert np.abs(landed.T - points).max() < 1e-5
    assert np.abs(d[:, :2].T / d[:, 2] - slopes).max() < 1e-7


@pytest.mark.parametrize("second", [SecondTarget(), SecondTarget(focus=(2.0, -1.0, 400.0)), SecondTarget(FARTHER)])
def test_a_fold_mirror_changes_neither_picture_nor_directions(second):
    """What is asked of the light along the folded axis is what was along the straight one, reversed in the plane of the fold."""
    scene, field, found = Scene(PlaneWave(), LENS, UPRIGHT, second_target=second), HeightField.of(LENS), []
    other = SecondTarget(second.screen, None if second.focus is None else (-second.focus[0], *second.focus[1:]))
    for folded, way in ((replace(scene, second_target=other), -1), (replace(scene, elements=(replace(MIRROR, z=35.0),)), 1)):
        goals = [np.ascontiguousarray(a[::way]) for a in (picture(), picture().T)][: 2 if second.screen else 1]
        light, far = goals[0], goals[1] if second.screen else None
        own = first_sides(folded, light, far, field, 64)
        nets = found[0][1] if found else own  # both traced through the same lens
        behind, exit = split_heights(folded, field, nets)
        figures = retrace(behind, field, exit, light, rays=40_000)[1]
        figures |= second_figures(behind, field, exit, far, rays=40_000, seed=1)[1]
        targets, rays = tuple(map(torch.from_numpy, goals)), rays_of(folded, "grid", 10_000)
        loss = TwoSidedObjective(folded, field, rays, targets, "rms", LossImage(Filter("cosine", (3, 3))), dtype=torch.float64)(
            nets
        )
        found.append((figures, own, loss.loss, loss.gradient))
    assert folded.unfolded.second_target.focus == other.focus
    (straight, one, loss, gradient), (turned, two, other, its) = found
    assert (one - two).abs().max() < 5e-3 and straight["relative_rms"] < 0.25  # light on the edge of a cell counts in either
    for key in {"relative_rms", "on_screen", "angle_rms_mrad", "second_relative_rms"} & straight.keys():
        assert turned[key] == pytest.approx(straight[key], rel=1e-5)
    assert other == pytest.approx(loss, rel=1e-9) and (gradient - its).norm() < 1e-6 * gradient.norm()


@pytest.mark.parametrize("z", [-20.0, 25.0])
@pytest.mark.parametrize("second", [SecondTarget(), SecondTarget(focus=(1.0, -2.0, 300.0))])
def test_light_is_collimated_and_focused_beside_another_lens(second, z):
    """In front of it or behind it, a lens of 100 mm focal length: the picture and the directions are as without it."""
    lens = replace(BICONVEX, z=z, size=(12.0, 12.0), radius=(100.0, -150.0))
    scene = Scene(PlaneWave(), LENS, UPRIGHT, second_target=second, elements=(lens,))
    found = figures_of(scene)
    assert found["relative_rms"] < 0.25 and found["angle_rms_mrad"] < 3.0 and found["on_screen"] > 0.8


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
