"""Lenses on a curved base: the parallel inner side, light through it, the relief between its limits, and what is made of them.

Rays are compared with a tracer of a few lines in NumPy: Snell's law at the closed form of the inner side and at SciPy's spline.
"""

import json
import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from helpers import write_blob
from scipy.interpolate import BSpline, NdBSpline
from scipy.spatial import cKDTree

from caustic_cli import cli, load
from caustic_cli.config.settings import build_lens
from caustic_cli.errors import InputError
from caustic_cli.export.milling import Milling
from caustic_cli.export.milling.gcode import write_gcode
from caustic_cli.export.part import part_of
from caustic_cli.export.step import write_step
from caustic_cli.inverse import relief
from caustic_cli.inverse.incidence import incident
from caustic_cli.inverse.initial_surface import first_surface
from caustic_cli.io.faces import read_face
from caustic_cli.optics.bounds import check_exit_above_entrance
from caustic_cli.optics.effects.base import Requests
from caustic_cli.optics.emission import rays_of
from caustic_cli.optics.parallel import beyond_aperture, parallel_side
from caustic_cli.optics.rays import RayState
from caustic_cli.optics.reconstruction import Filter
from caustic_cli.optics.surfaces import HeightField
from caustic_cli.optics.system import EXIT, System, entrance_of
from caustic_cli.optics.trace import Tracer, expose, is_lowered
from caustic_cli.scene import FreeForm, Lens, Offset, PlaneWave, Points, Scene, Screen
from caustic_cli.schema.table import LensSettings
from caustic_cli.studies.retrace import retrace
from caustic_cli.workflow import preparation
from caustic_cli.workflow.machining import cut_surface

INF, WALL, INDEX = math.inf, 3.0, 1.49
SIZE, HALF = (16.0, 12.0), (8.0, 6.0)
TUBE, DOME, BOWL, TORIC = (-30.0, INF), (-25.0, -25.0), (40.0, 40.0), (-30.0, 50.0)


def scene_of(radius=DOME, source=None, *, control=(14, 12), throw=150.0, size=SIZE, pixels=(24, 24), width=30.0, **lens) -> Scene:
    """A wall of 3 mm with its inner vertex at z = 0."""
    base = Offset(WALL, radius)
    entrance = parallel_side(base, WALL, (0.5 * size[0], 0.5 * size[1]))
    made = Lens(size, 0.0, INDEX, control, offset=base, entrance=entrance, min_thickness=1.0, height_range=(-1.5, 1.5), **lens)
    return Scene(source or PlaneWave(), made, Screen((width, width), throw, pixels))


def on_base(scene: Scene, bumps: float = 0.0) -> tuple[HeightField, torch.Tensor]:
    """The base surface interpolated on the control net, with a random relief."""
    field = HeightField.of(scene.lens)
    base = field.interpolated(torch.from_numpy(scene.lens.offset.heights(*(c.numpy() for c in field.control_xy()))))
    return field, base + bumps * torch.randn(field.shape, generator=torch.Generator().manual_seed(2), dtype=torch.float64)


@pytest.mark.parametrize(("radius", "inner"), [(TUBE, (-27.0, INF)), (DOME, (-22.0, -22.0)), (BOWL, (43.0, 43.0))])
def test_inner_side_of_a_sphere_or_cylinder_is_concentric(radius, inner):
    side = parallel_side(Offset(WALL, radius), WALL, HALF)
    u, v = np.linspace(-1.0, 1.0, 31), np.linspace(-1.0, 1.0, 17)
    assert side.at(u, v) == pytest.approx(Offset(0.0, inner).sag(8.0 * u[:, None], 6.0 * v[None, :]), abs=2e-8)


def test_inner_side_of_any_base_is_a_wall_away():
    base = Offset(WALL, TORIC)
    side = entrance_of(scene_of(TORIC).lens)
    x, y = (torch.from_numpy(c.ravel()) for c in np.meshgrid(np.linspace(-7.0, 7.0, 9), np.linspace(-5.0, 5.0, 9), indexing="ij"))
    z, zx, zy = (c.numpy() for c in side.at(None, x, y))
    along = np.stack([-zx, -zy, np.ones_like(zx)]) / np.sqrt(1.0 + zx**2 + zy**2)
    there = np.stack([x.numpy(), y.numpy(), z]) + WALL * along
    assert there[2] == pytest.approx(WALL + base.sag(there[0], there[1]), abs=1e-7)
    gx, gy = base.slopes(there[0], there[1])
    assert (gx, gy) == (pytest.approx(zx, abs=1e-6), pytest.approx(zy, abs=1e-6))  # with the same normal


@pytest.mark.parametrize(("degree", "shape"), [((3, 3), (9, 8)), ((2, 1), (5, 6))])
def test_free_form_is_its_spline_and_continues_beyond(degree, shape):
    heights = np.random.default_rng(1).normal(size=shape)
    side, u, v = FreeForm(heights, degree), np.linspace(-1.1, 1.1, 23), np.linspace(-1.05, 1.0, 11)

    def basis(at, n, p):
        knots = np.r_[np.zeros(p), np.linspace(0.0, 1.0, n - p + 1), np.ones(p)]
        return BSpline.design_matrix(0.5 * (at + 1.0), knots, p, extrapolate=True).toarray()

    assert side.at(u, v) == pytest.approx(basis(u, shape[0], degree[0]) @ heights @ basis(v, shape[1], degree[1]).T, abs=1e-12)


def test_continued_entrance_is_that_of_the_base():
    lens = scene_of(DOME).lens
    x, y = torch.tensor([8.6, 0.0, -8.5]), torch.tensor([0.0, 6.5, -6.4])
    wanted = Offset(0.0, (-22.0, -22.0)).sag(x.numpy(), y.numpy())
    assert beyond_aperture(lens).at(None, x.double(), y.double())[0].numpy() == pytest.approx(wanted, abs=1e-5)


def test_wall_has_to_be_thinner_than_the_radius():
    with pytest.raises(InputError, match="thinner"):
        parallel_side(Offset(6.0, (6.5, 6.5)), -1.0 + 7.5, (5.0, 2.0))
    with pytest.raises(InputError, match="thickness of the wall"):
        parallel_side(Offset(0.0, DOME), 0.0, HALF)
    # the circle of radius 30 - 16 does not reach 15 mm, that of 30 - 14.9 does
    with pytest.raises(InputError, match="wall of 16 mm ends within the aperture; a narrower lens or a thinner wall"):
        parallel_side(Offset(0.0, (-30.0, math.inf)), 16.0, (15.0, 15.0))
    edge = parallel_side(Offset(0.0, (-30.0, math.inf)), 14.9, (15.0, 15.0)).at(np.array([-1.0, 0.0, 1.0]), np.zeros(1))
    assert edge[1, 0] - edge[0, 0] == pytest.approx(15.1 - math.sqrt(15.1**2 - 15.0**2), rel=0.05)


@pytest.mark.parametrize("limits", [None, (-0.6, 0.0)])
def test_a_wall_that_a_deep_relief_makes_thicker(limits):
    """By one and a half times what the surface lies too deep, but not by what limits cut off."""
    own = {"lens": {"height_range": list(limits)}} if limits else {}
    given = {"size": [20.0, 20.0], "thickness": 5.0, "radius": [-60.0, INF], "entrance": "parallel", "control": [9, 9]}
    lens = LensSettings.of(given | {"height_range": list(limits or (-20.0, 20.0))})
    made = build_lens(lens)
    base = made.offset.heights(*(c.numpy() for c in HeightField.of(made).control_xy()))
    first = torch.from_numpy(base - np.linspace(0.0, 7.0, 9)[:, None])
    found = preparation._room(lens, own, first)
    assert found.get("thickness", 5.0) == (
        5.0 if limits else pytest.approx(5.0 + 1.5 * (7.0 - 5.0 + lens.min_thickness) + 0.4, abs=0.3)
    )


# Light


def refracted(d, normal, eta):
    """Unit directions (3, N) behind a surface by Snell's law, eta = n_in / n_out; normals (3, N) along the light."""
    cosine = (d * normal).sum(0)
    return eta * d + (np.sqrt(1.0 - eta**2 * (1.0 - cosine**2)) - eta * cosine) * normal


def independently(scene: Scene, heights: torch.Tensor, o: np.ndarray, d: np.ndarray) -> np.ndarray:
    """Landing points (2, N), mm, of rays through a concentric inner side of a tube or dome, and a spline of SciPy."""
    lens = scene.lens
    radius = lens.offset.radius[0] + WALL
    along = np.array([1.0, 0.0 if math.isinf(lens.offset.radius[1]) else 1.0, 1.0])[:, None]  # a cylinder has no curvature along y
    centre = np.array([0.0, 0.0, radius])[:, None]
    p, q = (o - centre) * along, d * along
    a, b, c = (q * q).sum(0), (p * q).sum(0), (p * p).sum(0) - radius**2
    t = (-b + math.copysign(1.0, -radius) * np.sqrt(b * b - a * c)) / a
    o = o + t * d
    d = refracted(d, -(o - centre) * along / radius, 1.0 / INDEX)
    knots = tuple(np.r_[np.zeros(3), np.linspace(0.0, 1.0, n - 2), np.ones(3)] for n in lens.control)
    spline = NdBSpline(knots, heights.numpy(), 3)
    half = np.array(lens.half_size)[:, None]

    def at(x, nu=(0, 0)):
        return spline((0.5 * (x / half + 1.0)).T, nu=nu) / np.prod((2.0 * half[:, 0]) ** np.array(nu))

    t = np.full(o.shape[1], WALL)
    for _ in range(30):
        x = o[:2] + t * d[:2]
        f = o[2] + t * d[2] - at(x)
        t = t - f / (d[2] - at(x, (1, 0)) * d[0] - at(x, (0, 1)) * d[1])
    o = o + t * d
    normal = np.stack([-at(o[:2], (1, 0)), -at(o[:2], (0, 1)), np.ones_like(t)])
    d = refracted(d, normal / np.linalg.norm(normal, axis=0), INDEX)
    return o[:2] + (scene.screen.z - o[2]) / d[2] * d[:2]


@pytest.mark.parametrize("radius", [TUBE, DOME, BOWL])
@pytest.mark.parametrize("source", [None, Points(((0.4, -0.3, -22.0),))])
def test_rays_are_those_of_an_independent_tracer(radius, source):
    scene = scene_of(radius, source)
    field, heights = on_base(scene, 0.02)
    rng = np.random.default_rng(3)
    o = np.stack([*(rng.uniform(-0.8, 0.8, (2, 300)) * np.array(HALF)[:, None]), np.full(300, -6.0)])
    d = np.stack([np.zeros(300), np.zeros(300), np.ones(300)])
    if source is not None:
        d = o * [[1.0], [1.0], [0.0]] - np.array([0.4, -0.3, -22.0])[:, None]
        d, o = d / np.linalg.norm(d, axis=0), np.repeat(np.array([[0.4], [-0.3], [-22.0]]), 300, 1)
    state = RayState(tuple(map(torch.from_numpy, o)), tuple(map(torch.from_numpy, d)), torch.full((300,), 1 / 300).double())
    (landed,) = Tracer(System.of(scene, field), state).land({EXIT: heights}, scene.screen)
    assert (landed.power > 0).all()
    found = np.stack([c.numpy() for c in landed.origin[:2]])
    assert found == pytest.approx(independently(scene, heights, o, d), abs=2e-6)


def test_light_of_the_centre_passes_a_wall_undeviated():
    centre = (0.0, 0.0, DOME[0] + WALL)
    scene = scene_of(DOME, Points((centre,)), control=(60, 60))
    field, heights = on_base(scene)
    state = next(iter(rays_of(scene, "stratified", 400, 1).chunks()))
    state = state if isinstance(state, RayState) else state.at_pupil()
    (landed,) = Tracer(System.of(scene, field), state).land({EXIT: heights}, scene.screen)
    d, lit = [c.double() for c in state.full(state.direction)], landed.power > 0
    assert int(lit.sum()) > 200
    for axis in (0, 1):
        straight = d[axis] / d[2] * (scene.screen.z - centre[2])
        assert landed.origin[axis][lit].numpy() == pytest.approx(straight[lit].numpy(), abs=1e-3)


def test_incident_light_is_that_of_the_closed_form():
    """On the outer side of a tube: density and directions by two circles, apart from reflection losses."""
    scene = scene_of(TUBE, fresnel="none")
    x, y = np.linspace(-8.0, 8.0, 33), np.linspace(-6.0, 6.0, 25)
    light, d = incident(scene, x, y, scene.lens.offset.heights(x, y))
    a, inner, outer = np.linspace(-8.0, 8.0, 100_001), 27.0, 30.0
    sine = a / inner
    turn = np.arcsin(sine) - np.arcsin(sine / INDEX)  # a diverging side
    height = np.sqrt(inner**2 - a**2)
    along = a * np.sin(turn) + height * np.cos(turn)
    out = a + (np.sqrt(along**2 - (inner**2 - outer**2)) - along) * np.sin(turn)
    assert d[0][:, 3] == pytest.approx(np.interp(x, out, np.sin(turn)), abs=1e-7)
    between = np.interp(0.5 * (x[1:] + x[:-1]), out, np.gradient(a, out))
    assert light == pytest.approx(np.repeat(between[:, None], 24, 1), abs=2e-4)


def test_fused_exit_below_the_inner_vertex_is_that_of_the_stages():
    """The edge of a deep dome lies below z_in, and is lit all the same."""
    scene = scene_of(DOME, size=(24.0, 24.0), control=(20, 20))
    field, heights = on_base(scene, 0.01)
    assert float(heights.min()) < scene.lens.z_in
    rays, how = rays_of(scene, "grid", 40_000, 1), Filter("cosine", (3, 3))
    assert is_lowered(scene, field)
    fused = expose(scene, field, heights, rays, how)
    staged = expose(scene, field, heights, rays, how, requests=Requests(stages=True))
    assert fused.image.numpy() == pytest.approx(staged.image.numpy(), rel=1e-6, abs=1e-9)
    assert float(fused.image.sum()) + math.fsum(map(float, fused.lost.values())) == pytest.approx(1.0, abs=1e-9)
    assert float(fused.lost["missed_surface"]) < 0.15  # what a wall of this thickness sends through its sides


def picture(scene: Scene) -> np.ndarray:
    """A soft picture 1.4 times as wide as the lens."""
    x, y = (np.linspace(-15.0, 15.0, n) for n in scene.screen.resolution)
    x, y = x[:, None] / (0.7 * SIZE[0]), y[None, :] / (0.7 * SIZE[1])
    inside = (np.abs(x) <= 1.0) & (np.abs(y) <= 1.0)
    return inside * (1.0 + 0.5 * np.sin(4.0 * x + 1.0) * np.cos(3.0 * y))


@pytest.mark.parametrize("radius", [TUBE, DOME, TORIC])
def test_start_is_as_good_as_on_a_flat_lens(radius):
    errors = []
    for r in (radius, (INF, INF)):
        scene = scene_of(r, control=(40, 40), pixels=(40, 40))
        goal, field = picture(scene), HeightField.of(scene.lens)
        found = first_surface(scene, goal, field, 64)
        errors.append(retrace(scene, field, found.heights, goal, rays=100_000, seed=5, noise=False)[1]["relative_rms"])
    assert errors[0] < 1.1 * errors[1] < 0.2


# Relief


def test_relief_is_moved_between_its_limits_as_little_as_possible():
    heights, low, high = np.array([[0.1, 0.5]]), np.zeros((1, 2)), np.full((1, 2), 0.45)
    moved, lacking = relief.placed(heights, low, high)
    assert moved == pytest.approx(heights - 0.05)
    assert lacking == 0.0
    moved, lacking = relief.placed(heights, low, high - 0.15)
    assert lacking == pytest.approx(0.1)
    assert moved == pytest.approx(np.array([[-0.05, 0.35]]))  # the middle, so that both ends are cut off alike
    assert relief.placed(heights, low, high + 1.0)[0] is not heights
    assert relief.placed(heights, low, high + 1.0)[0] == pytest.approx(heights)


@pytest.mark.parametrize(
    ("radius", "source", "part", "closest"),
    [
        (TUBE, None, 0.3, (0.3, 0.7)),  # a smaller picture
        (DOME, Points(((0.0, 0.0, -22.0),)), 0.5, (1.2, 4.0)),  # a larger one than the lamp throws without relief
        (BOWL, None, 0.01, None),  # none, the shallowest of which is sought
    ],
)
def test_advised_size_of_a_picture_has_the_relief_that_it_allows(radius, source, part, closest):
    """As solved for at that size, far from its own; and the sizes between have deeper ones."""
    scene = scene_of(radius, source, control=(30, 30), pixels=(30, 30), throw=200.0, width=40.0)
    goal, field = np.ones((30, 30)), HeightField.of(scene.lens)
    base = scene.lens.offset.heights(*(c.numpy() for c in field.control_xy()))

    def depth(size: float) -> float:
        larger = replace(scene, screen=replace(scene.screen, size=(40.0 * size, 40.0 * size)))
        return np.ptp(first_surface(larger, goal, field, 64, fixed=True).heights.numpy() - base)

    heights = first_surface(scene, goal, field, 64, fixed=True).heights.numpy()
    room = part * depth(1.0)
    size, said = relief.fitting(replace(scene, lens=replace(scene.lens, height_range=(-room, 0.0))), field, heights, goal)
    assert said == pytest.approx(depth(size), rel=0.03)
    if closest is None:
        assert said > room and min(depth(0.9 * size), depth(1.1 * size)) > said
    else:
        assert closest[0] < size < closest[1] and 0.95 * room < said <= room and depth(size**0.8) > room


# A face of a STEP file

STEP = """ISO-10303-21;
HEADER;
FILE_DESCRIPTION(('a face'),'2;1');
ENDSEC;
DATA;
#1=(LENGTH_UNIT() NAMED_UNIT(*) SI_UNIT(.MILLI.,.METRE.));
#2=CARTESIAN_POINT('centre',({at}));
#3=DIRECTION('axis',({axis}));
#4=DIRECTION('',(0.,0.,1.));
#5=AXIS2_PLACEMENT_3D('',#2,#3,#4);
#6={kind}('outer',#5,{radius});
ENDSEC;
END-ISO-10303-21;
"""


def step_file(folder, kind="CYLINDRICAL_SURFACE", at="0.,4.,-27.", axis="0.,-1.,0.", radius="30."):
    path = folder / "face.step"
    path.write_text(STEP.format(kind=kind, at=at, axis=axis, radius=radius))
    return path


@pytest.mark.parametrize(
    ("face", "radius"),
    [
        ({}, (-30.0, INF)),
        ({"axis": "2.,0.,0.", "at": "4.,0.,33."}, (INF, 30.0)),
        ({"kind": "SPHERICAL_SURFACE", "at": "0.,0.,-29.", "radius": "3.E1"}, (-30.0, -30.0)),
    ],
)
def test_face_of_a_cylinder_or_sphere(face, radius, tmp_path):
    assert read_face(step_file(tmp_path, **face)) == Offset(0.0, radius)


@pytest.mark.parametrize(
    ("face", "words"),
    [
        ({"axis": "0.,0.,1."}, "neither along x nor along y"),
        ({"axis": "0.,0.,0."}, "no direction"),
        ({"at": "2.,0.,-27."}, "on the z axis"),
        ({"radius": "0."}, "more than 0"),
        ({"radius": "r"}, "no number"),
        ({"kind": "CONICAL_SURFACE"}, "one cylindrical, spherical or B-spline face"),
        ({"kind": "PLANE"}, "one cylindrical, spherical or B-spline face"),
    ],
)
def test_face_that_is_refused(face, words, tmp_path):
    with pytest.raises(InputError, match=words):
        read_face(step_file(tmp_path, **face))


def test_face_of_a_spline_is_its_sphere(tmp_path):
    """A dome as a spline, exported as a solid with a flat back, read as a base: heights, slopes and the inner side."""
    base = Offset(6.0, DOME)
    lens = Lens(SIZE, 0.0, INDEX, (40, 40), offset=base, height_range=(-3.0, 3.0))
    scene = Scene(PlaneWave(), lens, Screen((30.0, 30.0), 150.0, (8, 8)))
    field, heights = on_base(scene)
    write_step(tmp_path / "dome.step", scene, field, heights, tolerance=0.0)
    face = replace(read_face(tmp_path / "dome.step"), thickness=WALL)
    rng = np.random.default_rng(4)
    x, y = rng.uniform(-1.0, 1.0, (2, 200)) * np.array(HALF)[:, None]
    assert face.sag(x, y) == pytest.approx(base.sag(x, y), abs=1e-5)
    for found, wanted in zip(face.slopes(x, y), base.slopes(x, y), strict=True):
        assert found == pytest.approx(wanted, abs=1e-4)
    assert face.heights(np.sort(x), np.sort(y)) == pytest.approx(WALL + base.sag(np.sort(x)[:, None], np.sort(y)), abs=1e-5)
    inner = parallel_side(face, WALL, HALF)
    u = np.linspace(-1.0, 1.0, 21)
    assert inner.at(u, u) == pytest.approx(
        Offset(0.0, (-22.0, -22.0)).sag(8.0 * u[:, None], 6.0 * u), abs=2e-4
    )  # continued at its edges
    larger = face.scaled(2.0)
    assert larger.sag(2.0 * x, 2.0 * y) == pytest.approx(2.0 * face.sag(x, y))
    with pytest.raises(InputError, match="smaller than the lens"):
        face.check_size((16.1, 12.0))


# Four axes


def centres(path) -> np.ndarray:
    """Centres (k, 3) of the ball of a program, mm, in its coordinates X, Y, Z, as its machine interpolates them: read by the words
    of the program and the statement of its head, that at A the tool is over Y = -Z sin A."""
    at, found, radius, unit = {"X": 0.0, "A": 0.0, "Z": 1e3}, [], None, 1.0
    for line in path.read_text().splitlines():
        if line.startswith("(tool: ball nose, radius "):
            radius = float(line.split()[4])
        unit = 25.4 if line.startswith("G20") else unit
        words = {word[0]: float(word[1:]) for word in line.split() if line[0] == "G"}
        before, at = at, at | {key: value * (1.0 if key == "A" else unit) for key, value in words.items() if key in at}
        if words.get("G") == 1:
            count = 2 + int(abs(at["X"] - before["X"]) / 0.01)
            found.append(np.linspace(list(before.values()), list(at.values()), count))
    x, a, z = np.concatenate(found).T
    assert radius is not None
    far, turn = z + radius, np.radians(a)
    return np.stack([x, -far * np.sin(turn), far * np.cos(turn)], -1)


@pytest.mark.parametrize(("radius", "dialect"), [((-30.0, INF), "mm"), ((INF, -20.0), "inch")])
def test_four_axes_leave_the_relief(radius, dialect, tmp_path):
    """The distance of points of the surface from the nearest ball: none is cut, and at most the scallop is left."""
    scene = scene_of(radius, size=(8.0, 6.0), control=(10, 9))
    field, heights = on_base(scene, 0.01)
    mill = Milling(path="rotary", tool_radius=1.0, scallop=0.004, dialect=dialect)
    made = write_gcode(tmp_path / "r.nc", part_of("gcode", scene, field, heights), mill)
    x, y = (torch.linspace(-0.99 * r, 0.99 * r, 41, dtype=torch.float64) for r in scene.lens.half_size)
    x, y = (c.reshape(-1) for c in torch.meshgrid(x, y, indexing="ij"))
    z = field.at(heights, x, y, [(0, 0)])[0] - (WALL - 20.0 if radius[1] == -20.0 else WALL - 30.0)
    points = np.stack([y, -x, z] if math.isinf(radius[1]) else [x, y, z], -1)  # X along the axis
    far = cKDTree(centres(tmp_path / "r.nc")).query(points)[0] - 1.0
    assert far.min() > -2.0 * made["tolerance_mm"]
    assert far.max() < 0.004 + 1e-4
    assert far.max() > 0.002  # passes are no closer than they have to be
    cut = cut_surface(tmp_path / "r.nc", scene, field)
    left = (cut.at(None, x, y)[0] - field.at(heights, x, y, [(0, 0)])[0]).numpy()
    assert left.min() > -2.0 * made["tolerance_mm"]
    assert left.max() == pytest.approx(far.max(), rel=0.2)  # along z, to which the surface is inclined


def test_four_axes_are_for_the_outside_of_a_cylinder(tmp_path):
    for radius in (DOME, (40.0, INF), (INF, INF)):
        base = Offset(WALL, radius)
        scene = Scene(PlaneWave(), Lens(SIZE, 0.0, INDEX, (8, 8), offset=base), Screen((30.0, 30.0), 150.0, (8, 8)))
        part = part_of("gcode", scene, *on_base(scene))
        with pytest.raises(InputError, match="outside of a cylinder"):
            write_gcode(tmp_path / "r.nc", part, Milling(path="rotary"))
    tube = scene_of(TUBE)
    with pytest.raises(InputError, match="must reach the surface's highest point"):
        write_gcode(tmp_path / "r.nc", part_of("gcode", tube, *on_base(tube)), Milling(path="rotary", stock=29.0, scallop=0.1))


@pytest.mark.parametrize("radius", [TUBE, (-14.0, -14.0), BOWL])
def test_exit_is_compared_with_its_curved_entrance(radius):
    """A convex wall lies below its inner vertex at the rim, and a concave one above it."""
    scene = scene_of(radius)
    field, base = on_base(scene)
    x, y = (np.linspace(-r, r, 97) for r in HALF)
    wall = scene.lens.offset.heights(x, y) - Offset(0.0, tuple(r + WALL for r in radius)).heights(x, y)  # concentric
    check_exit_above_entrance(scene, field, base - wall.min() + 0.02)
    with pytest.raises(InputError, match=r"dips 0.0[12].* mm below"):
        check_exit_above_entrance(scene, field, base - wall.min() - 0.02)


# Commands


def run(*arguments) -> int:
    return cli.run([str(a) for a in arguments])


@pytest.fixture(scope="module")
def tube(tmp_path_factory):
    """A finished project of a relief on a tube, engraved at most 0.4 mm deep."""
    folder = tmp_path_factory.mktemp("tube")
    write_blob(blob := folder / "blob.png")
    how = ["--base-radius=-30,inf", "--entrance", "parallel", "--relief=-0.4,0", "--mag", "1.2", "--throw", "300"]
    assert (
        run(
            "design",
            blob,
            *how,
            "--lens-size",
            16,
            "--control",
            24,
            "--resolution",
            32,
            "--iterations",
            3,
            "--start",
            "transport",
            "--out",
            folder / "t",
        )
        == 0
    )
    return folder / "t"


def test_steep_wall_is_as_thick_as_by_default_and_opened_again(tmp_path):
    """Its rim lies 5.8 mm below the vertex, its inner side 3 mm below that."""
    write_blob(blob := tmp_path / "blob.png")
    how = ["--base-radius=-20", "--lens-size", 20, "--entrance", "parallel", "--throw", 100, "--control", 12, "--resolution", 16]
    assert run("design", blob, *how, "--iterations", 1, "--rays", 2000, "--start", "offset", "--out", tmp_path / "d") == 0
    made = load(tmp_path / "d").scene.lens
    assert made.offset.thickness - made.z_in == pytest.approx(WALL)
    assert run("export", tmp_path / "d", "--format", "lighttools", "--out", tmp_path / "d.npz", "--quiet") == 0
    assert run("render", tmp_path / "d.npz", "--rays", 2000, "--out", tmp_path / "r", "--quiet") == 0


def test_design_keeps_the_limits_and_the_wall(tube):
    lens = load(tube)
    z, made = lens.heights.numpy(), lens.scene.lens
    relief_of = z - made.offset.heights(*(c.numpy() for c in lens.field.control_xy()))
    assert made.offset.radius == (-30.0, INF)
    assert made.offset.thickness - made.z_in == pytest.approx(WALL)  # the default
    assert relief_of.min() >= -0.4 - 1e-9
    assert relief_of.max() <= 1e-9
    assert lens.surface(4.0, 0.0, "entrance")[0] == pytest.approx(math.sqrt(27.0**2 - 16.0) - 27.0, abs=1e-6)


def test_solid_has_both_sides(tube, tmp_path):
    assert run("export", tube, "--out", tmp_path / "t.step", "--tolerance", 0) == 0
    assert run("export", tube, "--out", tmp_path / "m.stl", "--mould", "--samples", 33) == 0
    core = np.frombuffer(
        (tmp_path / "m-entrance.stl").read_bytes()[84:], np.dtype([("n", "<f4", 3), ("c", "<f4", (3, 3)), ("a", "<u2")])
    )
    points = core["c"].reshape(-1, 3).astype(float)
    top = points[np.abs(np.abs(points[:, 0]) - 4.0) < 1e-5]
    assert top[:, 2].max() == pytest.approx(math.sqrt(27.0**2 - 16.0) - 27.0, abs=1e-5)  # what the inner side is cast on
    assert (tmp_path / "t.step").read_text().count("B_SPLINE_SURFACE_WITH_KNOTS") == 2


def test_relief_that_is_too_shallow_is_said(tmp_path, capsys):
    write_blob(blob := tmp_path / "blob.png")
    how = ["--base-radius=-30,inf", "--entrance", "parallel", "--mag", "2", "--throw", "120", "--lens-size", 16, "--control", 16]
    assert (
        run(
            "design",
            blob,
            *how,
            "--relief=-0.05,0",
            "--resolution",
            32,
            "--iterations",
            1,
            "--start",
            "transport",
            "--out",
            tmp_path / "t",
            "--json",
        )
        == 0
    )
    out, err = capsys.readouterr()
    assert "--relief leaves 0.05 mm" in err
    assert json.loads(out)["relative_rms"] > 0.2  # and the figures show it


def test_project_keeps_its_face(tube, tmp_path):
    """The same lens by a file as by its radii, and again from the project's own copy."""
    write_blob(blob := tmp_path / "blob.png")
    how = ["--entrance", "parallel", "--relief=-0.4,0", "--mag", "1.2", "--throw", "300", "--lens-size", 16, "--control", 24]
    how += ["--resolution", 32, "--iterations", 3, "--start", "transport", "--base-file", step_file(tmp_path)]
    assert run("design", blob, *how, "--out", tmp_path / "t") == 0
    step_file(tmp_path).unlink()
    assert load(tmp_path / "t").heights.numpy() == pytest.approx(load(tube).heights.numpy(), abs=1e-9)
    assert (tmp_path / "t" / "base.step").is_file()


@pytest.mark.parametrize(
    "more",
    [
        ["--mirror"],
        ["--gradient", "axial", "--gradient-terms", "0.01"],
        ["--array", "2x2"],
        ["--gradient", "free", "--with-surface", "--index-control", "24"],
    ],
    ids=lambda more: more[0],
)
def test_a_face_is_the_base_of_whatever_has_one(more, tmp_path, monkeypatch):
    """The same lens by the cylinder of a file as by its radii, which are exactly those."""
    monkeypatch.chdir(tmp_path)
    step_file(tmp_path)
    write_blob(tmp_path / "blob.png")
    how = ["--throw", "300", "--control", 25, "--resolution", 24, "--iterations", 2, "--waves", "off", *more]
    for name, base in (("a", ["--base-file", "face.step"]), ("b", ["--base-radius=-30,inf"])):
        assert run("design", "blob.png", *how, *base, "--out", name) == 0
    a, b = (load(name) for name in "ab")
    assert a.heights.numpy() == pytest.approx(b.heights.numpy(), abs=1e-9)
    if (index := getattr(a.scene.lens.gradient, "volume", None)) is not None:
        assert index == pytest.approx(b.scene.lens.gradient.volume, abs=1e-9)


def test_a_flat_plate_has_no_face(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    step_file(tmp_path)
    write_blob(tmp_path / "blob.png")
    assert run("design", "blob.png", "--base-file", "face.step", "--gradient", "free", "--out", "p") == 2
    assert "two flat sides" in capsys.readouterr().err


@pytest.mark.parametrize(
    "element",
    ["lens z=60 thickness=6 index=1.5", "mirror z=100 tilt=45,0", "lens z=-30 thickness=6 index=1.5"],
    ids=["behind", "folded", "in front"],
)
def test_a_wall_among_other_elements(element, tmp_path, monkeypatch, capsys):
    """A plate, before or behind, and a flat mirror leave its error as it is by itself."""
    monkeypatch.chdir(tmp_path)
    write_blob(tmp_path / "blob.png")
    how = ["--base-radius=-60", "--entrance", "parallel", "--quality", "draft", "--resolution", 24, "--waves", "off", "--json"]
    errors = []
    for name, more in (("a", []), ("b", ["--element", element])):
        capsys.readouterr()
        assert run("design", "blob.png", *how, *more, "--out", name) == 0
        errors.append(json.loads(capsys.readouterr().out)["error"])
    assert errors[1] == pytest.approx(errors[0], rel=0.1)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ([], "--entrance parallel needs --base-radius or --base-file"),
        (["--base-file", "blob.png"], "a STEP file"),
        (["--base-file", "missing.step"], "missing.step"),
        (["--base-file", "face.step", "--base-radius=-30"], "both give the base surface"),
        (["--base-radius=-30", "--mirror"], "light never enters a mirror"),
        (["--base-radius=-30", "--collimate"], "designs the entrance"),
        (["--base-radius=-30", "--array", "2x2"], "is of one lens"),
        (["--base-file", "face.step", "--collimate"], "is of a lens with one designed side"),
        (["--base-radius=-10", "--lens-size", "20"], "must exceed the lens' semi-aperture"),
        (["--base-radius=-30,inf", "--relief", "0.1,0"], "must ascend"),
        (["--base-radius=x"], "with inf for straight"),
        (["--base-radius=-15", "--source", "point", "--source-position", "0,0,-2"], "z below all of its inner side, -2.3"),
    ],
)
def test_refusals(options, words, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    step_file(tmp_path)
    write_blob(blob := tmp_path / "blob.png")
    assert run("design", blob, "--entrance", "parallel", *options, "--out", tmp_path / "t") == 2
    (line,) = capsys.readouterr().err.strip().splitlines()
    assert words in line
