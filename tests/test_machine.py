"""To the machine: height maps, programs for mills and the surface they leave, mirrors and moulds, against closed forms and brute
force."""

import json
import math
import shlex
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from scipy.spatial import cKDTree
from test_export import make

from caustic_cli import cli
from caustic_cli.errors import InputError
from caustic_cli.export.heightmap import write_heightmap
from caustic_cli.export.lighttools import write_lighttools
from caustic_cli.export.mesh import closed_mesh
from caustic_cli.export.milling import Milling
from caustic_cli.export.milling.gcode import write_gcode
from caustic_cli.export.milling.offset import BallOffset, FlatOffset
from caustic_cli.export.part import part_of
from caustic_cli.export.step import write_step
from caustic_cli.io.archive import open_archive
from caustic_cli.io.files import is_ours
from caustic_cli.io.gcode import read_program
from caustic_cli.io.surfaces import read_surface
from caustic_cli.optics.envelope import Envelope
from caustic_cli.optics.surfaces import HeightField
from caustic_cli.scene import Lens, Offset, PlaneWave, Scene, Screen
from caustic_cli.studies.scallops import PARABOLA, scallops
from caustic_cli.workflow.machining import cut_surface, form_deviation

EDGES = (-4.9, 4.9)


def spline(shape, control=(16, 14), size=(10.0, 8.0), **lens):
    """A scene whose surface is the spline through shape(x, y), which must be a polynomial of degree 3 to be met exactly."""
    made = Lens(size=size, control=control, offset=Offset(5.0), **lens)
    field = HeightField.of(made)
    x, y = field.control_xy()
    values = shape(x[:, None], y[None, :]).expand(*control).double()
    at = [torch.linalg.inv(s.matrix(s.greville)) for s in field.spaces]
    screen = Screen((30.0, 24.0), -300.0 if made.mirror else 300.0, (60, 48))
    return Scene(PlaneWave(), made, screen), field, at[0] @ values @ at[1].T


def mirrored(scene: Scene) -> Scene:
    return replace(scene, lens=replace(scene.lens, mirror=True), screen=replace(scene.screen, z=-scene.screen.z))


@pytest.fixture
def lens():
    """Rough, oblong, and alike under no turn or reflection."""
    return make(control=(16, 13), size=(10.0, 8.0), relief=0.02)


@pytest.fixture
def points():
    rng = np.random.default_rng(5)
    return rng.uniform(-4.9, 4.9, 2000), rng.uniform(-3.9, 3.9, 2000)


def at(field, heights, x, y):
    x, y = (torch.as_tensor(np.asarray(c, float)) for c in np.broadcast_arrays(x, y))
    return field.at(heights, x.reshape(-1), y.reshape(-1), [(0, 0)])[0].view(x.shape).numpy()


# the envelope of a ball


def test_the_envelope_of_segments_is_the_least_of_all_balls():
    rng = np.random.default_rng(0)
    begin = np.column_stack([rng.uniform(-4, 4, (300, 2)), rng.uniform(0, 0.4, 300)])
    end = begin + np.column_stack([rng.normal(0, 0.6, (300, 2)), rng.normal(0, 0.1, 300)])
    end[::30, :2] = begin[::30, :2]  # straight down
    x, y = rng.uniform(-6, 6, (2, 150))
    z, cx, cy = Envelope(1.3, begin, end, top=5.0)(x, y)
    w = np.linspace(0, 1, 801)[:, None]
    least = np.full(len(x), 5.0)
    for a, b in zip(begin, end, strict=True):
        c = a + w * (b - a)
        under = 1.3**2 - (x - c[:, :1]) ** 2 - (y - c[:, 1:2]) ** 2
        least = np.minimum(least, np.where(under > 0, c[:, 2:] - np.sqrt(np.maximum(under, 0)), 5.0).min(0))
    assert (z <= least + 1e-12).all() and np.abs(z - least).max() < 1e-5 and (z < 5.0).sum() > 100
    reached = z < 5.0
    assert np.hypot(x - cx, y - cy)[reached].max() < 1.3 and (cx == x)[~reached].all()


def test_slopes_of_a_cut_are_its_heights_derivatives(tmp_path, lens):
    write_gcode(tmp_path / "a.nc", part_of("gcode", *lens), Milling(scallop=0.05))
    for turned in (False, True):
        cut = replace(cut_surface(tmp_path / "a.nc", *lens[:2]), turned=turned)
        x, y = (torch.rand(500, dtype=torch.float64) * r * 1.9 - 0.95 * r for r in (5.0, 4.0))
        z, gx, gy = cut.at(None, x, y)
        step = 1e-7
        for moved, g in (((x + step, y), gx), ((x, y + step), gy)):
            off = (cut.at(None, *moved)[0] - z) / step - g
            assert off.abs().median() < 1e-5 and (off.abs() < 1e-5).double().mean() > 0.99  # but for points beside an edge


# the tool's place


def test_a_ball_on_a_sphere_stands_on_the_offset_sphere():
    """A dome of radius 30 lies under a ball of 2 as a sphere of 32 around the same centre; a bowl of 30 as one of 28."""
    for sign in (1.0, -1.0):
        middle = 5.0 - sign * 30.0
        _scene, field, heights = spline(lambda x, y, s=sign, m=middle: m + s * torch.sqrt(900.0 - x * x - y * y), control=(60, 50))
        offset = BallOffset(field, heights, 2.0)
        x, y = np.random.default_rng(1).uniform(-3.5, 3.5, (2, 500))
        centre = offset(x, y) + 2.0
        expected = middle + sign * np.sqrt((30.0 + sign * 2.0) ** 2 - x * x - y * y)
        assert np.abs(centre - expected).max() < 1e-8  # what the spline through the sphere is off by


def test_a_ball_never_cuts_in_even_where_it_does_not_fit():
    """Grooves narrower than the ball: it touches both sides, and brute force finds no point of the surface within it."""
    _, field, heights = spline(lambda x, y: 3.0 + 0.1 * torch.cos(5.0 * x) + 0.08 * torch.cos(6.0 * y + x), control=(70, 60))
    offset = BallOffset(field, heights, 2.0)
    x, y = np.random.default_rng(2).uniform(-5.5, 5.5, (2, 60))
    tip, u = offset(x, y), np.linspace(-5, 5, 601)
    z = at(field, heights, *(c.ravel() for c in np.meshgrid(u, 0.8 * u, indexing="ij"))).reshape(601, 601)
    depths = []
    for px, py, pz in zip(x, y, tip, strict=True):
        under = 4.0 - (u[:, None] - px) ** 2 - (0.8 * u[None, :] - py) ** 2
        low = np.where(under > 0, pz + 2.0 - np.sqrt(np.maximum(under, 0)), np.inf)
        depths.append(float((z - low).max()))
    assert max(depths) < 2e-6  # mm: what the search may miss where two places are as high, see `offset`
    assert min(depths) > -2e-4  # and it touches; brute force looks at a grid of 17 um


def test_a_flat_end_stays_above(lens):
    _, field, heights = lens
    offset = FlatOffset(field, heights, 1.5, 0.05)
    rng = np.random.default_rng(3)
    x, y = rng.uniform(-5.5, 5.5, 40), rng.uniform(-4.5, 4.5, 40)
    tip = offset(x, y)
    for px, py, pz in zip(x, y, tip, strict=True):
        r, t = 1.5 * np.sqrt(rng.uniform(0, 1, 4000)), rng.uniform(0, 2 * np.pi, 4000)
        qx, qy = px + r * np.cos(t), py + r * np.sin(t)
        inside = (np.abs(qx) <= 5) & (np.abs(qy) <= 4)
        if inside.any():
            room = pz - at(field, heights, qx[inside], qy[inside]).max()
            assert 0.05 <= room < 0.15


# programs


@pytest.mark.parametrize("path", ["raster", "raster-y", "spiral"])
@pytest.mark.parametrize("shape", ["rectangle", "circle"])
def test_scallops_are_as_high_as_asked(tmp_path, path, shape):
    """On a flat surface, in a bowl, and no higher on a dome: and nothing is cut too deep but by the tolerance."""
    for bend in (0.0, 0.01, -0.01):
        scene, field, heights = spline(lambda x, y, b=bend: 4.0 + b * (x * x + y * y), size=(6.0, 6.0), aperture=shape)
        found = write_gcode(tmp_path / "a.nc", part_of("gcode", scene, field, heights), Milling(scallop=0.005, path=path))
        f = form_deviation(cut_surface(tmp_path / "a.nc", scene, field), field, heights, scene.lens.opening)
        high, corners = found["scallop_mm"], 1.4 if path == "spiral" else 1.005
        assert high <= 0.005 * (1 + 1e-9) and f["cut_left_mm"] < high * corners and f["cut_gouge_mm"] < 2.0 * found["tolerance_mm"]
        if bend >= 0.0:
            assert high > 0.0045 and f["cut_left_mm"] > 0.98 * high
            if (path, shape, bend) == ("raster", "rectangle", 0.0):
                assert f["cut_rms_mm"] == pytest.approx(high * PARABOLA, rel=0.05)


def test_a_cut_converges_to_the_design(tmp_path):
    """What is left falls with the scallops; slopes with their root: where the ball fits everywhere."""
    lens = make(control=(16, 13), size=(10.0, 8.0), relief=0.004)
    left, slopes, heights = [], [], (8e-3, 2e-3, 5e-4)
    for h in heights:
        write_gcode(tmp_path / "a.nc", part_of("gcode", *lens), Milling(scallop=h, tool_radius=1.0), tolerance=0.05 * h)
        f = form_deviation(cut_surface(tmp_path / "a.nc", *lens[:2]), *lens[1:], lens[0].lens.opening)
        left.append(f["cut_rms_mm"])
        slopes.append(f["cut_slope_rms"])
    assert 0.9 < np.polyfit(np.log(heights), np.log(left), 1)[0] < 1.1
    assert 0.42 < np.polyfit(np.log(heights), np.log(slopes), 1)[0] < 0.58


def test_the_program_says_what_it_is(tmp_path, lens):
    path = tmp_path / "a.nc"
    found = write_gcode(path, part_of("gcode", *lens), Milling(scallop=0.05, roughing=0.1, stock=7.0, feed=450))
    text = path.read_text()
    assert is_ours(path) and text.count("\n") == found["lines"]
    assert f"({found['lines']} lines, {found['length_mm']:.0f} mm of cut, about {found['minutes']:.1f} minutes)" in text
    for words in (
        "G21 G90 G17 G94",
        "(tool: flat end, radius 2 mm)",
        "(tool: ball nose, radius 2 mm)",
        "top at Z7)",
        "M3 S20000",
        "M0 (",
    ):
        assert words in text
    assert text.rstrip().endswith("M30") and "F450" in text and text.isascii()
    program = read_program(path)
    rough, fine = program.cuts
    assert (program.top, program.zero, program.turned) == (7.0, -0.5, False)
    assert rough.kind == "flat end" and fine.tips[:, 2].max() == 12.0  # above the stock by the safe height
    z = at(*lens[1:], *np.meshgrid(np.linspace(-5, 5, 201), np.linspace(-4, 4, 201))) + 0.5
    assert rough.tips[:, 2].min() >= z.min() + 0.0999 and not rough.rapid[rough.tips[:, 2] < 7.0].any()
    layers = np.unique(np.round(rough.tips[:, 2], 3))
    assert len(layers) > 5 and (np.diff(np.unique(np.round(7.0 - layers[layers < 7.0], 2))) > 0).all()


@pytest.mark.parametrize("path", ["raster", "spiral"])
def test_two_parsers_read_the_same_path(tmp_path, lens, path):
    gcodeparser = pytest.importorskip("gcodeparser")
    write_gcode(tmp_path / "a.nc", part_of("gcode", *lens), Milling(scallop=0.05, path=path, roughing=0.5))
    ours = read_program(tmp_path / "a.nc")
    place, found = {}, []
    for line in gcodeparser.parse_gcode_lines((tmp_path / "a.nc").read_text()):
        if line.command[0] == "G" and line.command[1] in (0, 1) and set("XYZ") & set(line.params):
            place |= {k: v for k, v in line.params.items() if k in "XYZ"}
            found.append((*(place.get(k, math.nan) for k in "XYZ"), line.command[1] == 0))
        elif line.command == ("M", 0):
            place = {}
    theirs = np.array([f for f in found if np.isfinite(f[:3]).all()])
    mine = np.concatenate([np.column_stack([c.tips, c.rapid]) for c in ours.cuts])
    assert theirs.shape == mine.shape and len(mine) > 500 and (theirs == mine).all()


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("G91\nG1 X0 Y0 Z0\n", "line 1: G91"),
        ("G2 X1 Y1 I1 J0\n", "G2 is not read"),
        ("G91\nG1 X1 Y1 Z1\n", "G91"),
        ("X1 Y2 Z3\n", "without G0 or G1"),
        ("hello world!\n", "no block of words"),
        ("G21\nM30\n", "moves no tool"),
        ("", "moves no tool"),
        ("(tool: ball nose, radius 1e mm)\nG1 X0 Y0 Z0\n", "no number"),
    ],
)
def test_other_programs_are_refused(tmp_path, text, words):
    (tmp_path / "a.nc").write_text(text)
    with pytest.raises(InputError, match=words):
        read_program(tmp_path / "a.nc")


@pytest.mark.parametrize(
    ("kw", "words"),
    [
        ({"tool_radius": 0.0}, "tool_radius"),
        ({"scallop": 3.0}, "scallop"),
        ({"step_over": 4.0}, "step_over"),
        ({"path": "zigzag"}, "path"),
        ({"feed": math.nan}, "feed"),
        ({"stock": 5.0}, "highest point"),
    ],
)
def test_impossible_settings_are_refused(tmp_path, lens, kw, words):
    with pytest.raises(InputError, match=words):
        write_gcode(tmp_path / "a.nc", part_of("gcode", *lens), Milling(**kw))
    assert not list(tmp_path.iterdir())


# what it does to light


def test_the_blur_of_scallops_is_that_of_the_rays(tmp_path):
    """Parallel light through a flat surface lands where it stood, evenly spread over the width that `scallops` says."""
    from caustic_cli.optics.emission import rays_of  # noqa: PLC0415
    from caustic_cli.optics.system import EXIT, System  # noqa: PLC0415
    from caustic_cli.optics.trace import Tracer  # noqa: PLC0415

    scene, field, heights = spline(lambda x, y: 5.0 + 0 * x * y)
    found = write_gcode(tmp_path / "a.nc", part_of("gcode", scene, field, heights), Milling(scallop=1e-3))
    cut = cut_surface(tmp_path / "a.nc", scene, field)
    rays = next(rays_of(scene, "stratified", 40_000).chunks(40_000))
    ray = Tracer(System.of(scene, cut), rays).land({EXIT: heights}, scene.screen)[0]
    straight = Tracer(System.of(scene, field), rays).land({EXIT: heights}, scene.screen)[0]
    x, y = ((a - b).numpy() for a, b in zip(ray.origin[:2], straight.origin[:2], strict=True))
    f = scallops(scene, found["step_over_mm"], found["tool_radius_mm"])
    assert np.ptp(y) == pytest.approx(f["blur_mm"], rel=0.02) and y.std() == pytest.approx(f["blur_mm"] / math.sqrt(12), rel=0.02)
    middle = straight.origin[0].abs().numpy() < 4.5  # at the edges the tool turns round
    assert np.abs(x[middle]).max() < 1e-6 * f["blur_mm"]
    again = scallops(scene, f["step_over_of_half_a_pixel_mm"], 2.0)
    assert again["blur_pixels"] == pytest.approx(0.5)
    assert scallops(scene, f["step_over_of_waves_mm"], 2.0)["scattered"] == pytest.approx(0.01)


# parts


@pytest.mark.parametrize("mirror", [False, True])
@pytest.mark.parametrize("mould", [False, True])
def test_pressing_a_mould_gives_the_part(lens, points, mirror, mould):
    """The program's coordinates go to the scene's by a rotation, and the surface is the same one; material on opposite sides."""
    scene, field, heights = (mirrored(lens[0]) if mirror else lens[0], *lens[1:])
    part = part_of("gcode", scene, field, heights, mould)
    assert part.turned == (mirror != mould) and (part.heights > part.lens.z_in).all()
    x, y = points
    z = at(part.field, part.heights, x, -y if part.turned else y)
    assert np.abs((-z if part.turned else z) - at(field, heights, x, y)).max() < 1e-12
    assert sorted(part.heights.abs().flatten().tolist()) == sorted(heights.abs().flatten().tolist())
    turn = np.diag([1.0, -1.0, -1.0]) if part.turned else np.eye(3)
    assert np.linalg.det(turn) == 1.0


@pytest.mark.parametrize("mirror", [False, True])
@pytest.mark.parametrize("mould", [False, True])
def test_meshes_of_parts_are_solids(lens, mirror, mould):
    """Closed, outward, of the volume between surface and back; that of a mould and its part fill their block."""
    scene, field, heights = (mirrored(lens[0]) if mirror else lens[0], *lens[1:])
    part = part_of("stl", scene, field, heights, mould)
    vertices, faces = closed_mesh(part.scene, part.field, part.heights, (81, 71))
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    volume = float(np.einsum("ij,ij->i", a, np.cross(b, c)).sum() / 6.0)
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    assert len(np.unique(edges, axis=0)) == len(edges)
    assert {tuple(e) for e in edges.tolist()} == {tuple(e[::-1]) for e in edges.tolist()}
    x, y = np.meshgrid(np.linspace(-5, 5, 401), np.linspace(-4, 4, 401), indexing="ij")
    mean = at(part.field, part.heights, x.ravel(), y.ravel()).mean()
    assert volume == pytest.approx(80.0 * abs(mean - part.lens.z_in), rel=2e-3)


@pytest.mark.parametrize("shape", ["rectangle", "circle"])
@pytest.mark.parametrize("border", [0.0, 1.5])
def test_steps_of_mirrors_and_moulds_are_valid(tmp_path, shape, border):
    """By OpenCASCADE: closed solids of the right volume and orientation, with the poles to the last bit."""
    pytest.importorskip("OCP.STEPControl", exc_type=ImportError)
    from OCP.BRep import BRep_Tool  # noqa: PLC0415
    from OCP.BRepCheck import BRepCheck_Analyzer  # noqa: PLC0415
    from OCP.BRepGProp import BRepGProp  # noqa: PLC0415
    from OCP.Geom import Geom_BSplineSurface  # noqa: PLC0415
    from OCP.GProp import GProp_GProps  # noqa: PLC0415
    from OCP.STEPControl import STEPControl_Reader  # noqa: PLC0415
    from OCP.TopAbs import TopAbs_FACE, TopAbs_SOLID  # noqa: PLC0415
    from OCP.TopExp import TopExp_Explorer  # noqa: PLC0415
    from OCP.TopoDS import TopoDS  # noqa: PLC0415

    scene, field, heights = make(control=(12, 11), size=(10.0, 10.0))
    scene = replace(scene, lens=replace(scene.lens, aperture=shape, border=border))
    for mirror, mould in ((True, False), (False, True), (True, True), (False, False)):
        part = part_of("step", mirrored(scene) if mirror else scene, field, heights, mould)
        write_step(tmp_path / "a.step", part.scene, part.field, part.heights, tolerance=0.0)
        reader = STEPControl_Reader()
        assert int(reader.ReadFile(str(tmp_path / "a.step"))) == 1
        reader.TransferRoots()
        solid = reader.OneShape()
        assert solid.ShapeType() == TopAbs_SOLID and BRepCheck_Analyzer(solid).IsValid()
        volume = GProp_GProps()
        BRepGProp.VolumeProperties_s(solid, volume)
        assert volume.Mass() > 0
        x = np.linspace(-5, 5, 601)
        x, y = (c.ravel() for c in np.meshgrid(x, x, indexing="ij"))
        inside = x * x + y * y <= (25.0 if shape == "circle" else 50.0)
        area = 25.0 * math.pi if shape == "circle" else 100.0
        block = area * abs(at(part.field, part.heights, x[inside], y[inside]).mean() - part.lens.z_in)
        if not part.lens.border:
            assert volume.Mass() == pytest.approx(block, rel=4e-3)
        found, explorer = None, TopExp_Explorer(solid, TopAbs_FACE)
        while explorer.More():
            surface = BRep_Tool.Surface_s((getattr(TopoDS, "Face_s", None) or TopoDS.Face)(explorer.Current()))
            found = surface if isinstance(surface, Geom_BSplineSurface) else found
            explorer.Next()
        n, m = part.heights.shape
        poles = np.array([[found.Pole(i + 1, j + 1).Z() for j in range(m)] for i in range(n)])
        assert (poles == part.heights.numpy()).all()
        if not mould:
            assert (poles == heights.numpy()).all()
            _again, net = read_surface(tmp_path / "a.step", part.lens.half_size)
            assert (net == heights).all()


def test_the_archive_of_a_mirror_comes_back(tmp_path, lens):
    scene = mirrored(lens[0])
    write_lighttools(tmp_path / "m.npz", scene, *lens[1:])
    again, _field, heights = open_archive(tmp_path / "m.npz")
    assert again.lens.mirror and (heights == lens[2]).all() and again.screen.z == -300.0


# height maps


@pytest.mark.parametrize("suffix", [".png", ".tif"])
@pytest.mark.parametrize(("mirror", "mould"), [(False, False), (True, False), (False, True)])
def test_a_height_map_comes_back_to_its_quantum(tmp_path, lens, points, suffix, mirror, mould, capsys):
    scene, field, heights = (mirrored(lens[0]) if mirror else lens[0], *lens[1:])
    part = part_of("heightmap", scene, field, heights, mould)
    path = tmp_path / f"z{suffix}"
    said = write_heightmap(path, part)
    assert is_ours(path) and is_ours(tmp_path / f"z{suffix}.json") and said["turned"] == part.turned
    again, net = read_surface(path, scene.lens.half_size)
    off = np.abs(at(again, net, *points) - at(field, heights, *points)).max()
    with capsys.disabled():
        print(f"\n  {suffix}: {off / said['quantum_mm']:.3f} quanta of {said['quantum_mm']:.2g} mm", end="")
    assert off < said["quantum_mm"] and [s.n for s in again.spaces] == [s.n for s in field.spaces]
    # as the JSON says, without a reader of ours
    with Image.open(path) as image:
        values = np.asarray(image).astype(float)
    assert values.shape == (said["rows"], said["columns"])
    row, column = said["rows"] // 5, said["columns"] // 3
    x, y = said["x_of_column_0"] + column * said["mm_per_column"], said["y_of_row_0"] - row * said["mm_per_row"]
    z = said["z_of_zero"] + values[row, column] * said["mm_per_count"]
    assert z == pytest.approx(float(at(part.field, part.heights, [x], [y])[0]), abs=said["quantum_mm"])
    # and without the net: what lies between is interpolated
    said = json.loads((tmp_path / f"z{suffix}.json").read_text())
    del said["spline"]
    (tmp_path / f"z{suffix}.json").write_text(json.dumps(said))
    again, net = read_surface(path, scene.lens.half_size)
    assert np.abs(at(again, net, *points) - at(field, heights, *points)).max() < 1e-5


def test_the_default_map_is_as_fine_as_said(tmp_path, lens):
    part = part_of("heightmap", *lens)
    said = write_heightmap(tmp_path / "z.tif", part, tolerance=1e-5)
    x = -5 + said["mm_per_column"] * (np.arange(said["columns"] - 1) + 0.5)
    y = 4 - said["mm_per_row"] * (np.arange(said["rows"] - 1) + 0.5)
    with Image.open(tmp_path / "z.tif") as image:
        v = said["z_of_zero"] + np.asarray(image).astype(float)
    middle = 0.25 * (v[1:, 1:] + v[1:, :-1] + v[:-1, 1:] + v[:-1, :-1])
    exact = at(*lens[1:], *(c.ravel() for c in np.meshgrid(x, y))).reshape(middle.shape)
    assert 1e-7 < np.abs(middle - exact).max() < 1e-5


def test_height_maps_that_are_none_are_refused(tmp_path, lens):
    half = lens[0].lens.half_size
    write_heightmap(tmp_path / "z.png", part_of("heightmap", *lens))
    good = json.loads((tmp_path / "z.png.json").read_text())
    for change in ({"unit": "inch"}, {"mm_per_count": "x"}, {"columns": 7}, {"turned": 1}, {"spline": {}}, {"y_of_row_0": -4.0}):
        (tmp_path / "z.png.json").write_text(json.dumps(good | change))
        with pytest.raises(InputError, match=r"z\.png"):
            read_surface(tmp_path / "z.png", half)
    (tmp_path / "z.png.json").write_text(json.dumps(good))
    with pytest.raises(InputError, match="lens_size"):
        read_surface(tmp_path / "z.png", (5.0, 5.0))
    with Image.open(tmp_path / "z.png") as image:
        values = np.asarray(image).copy()
    values[3:9, 3:9] += 500
    Image.fromarray(values).save(tmp_path / "z.png")
    with pytest.raises(InputError, match="edited"):
        read_surface(tmp_path / "z.png", half)
    (tmp_path / "z.png.json").write_text("{")
    with pytest.raises(InputError, match="JSON"):
        read_surface(tmp_path / "z.png", half)
    Image.fromarray(np.zeros((4, 4), np.uint8)).save(tmp_path / "z.png")
    with pytest.raises(InputError):
        read_surface(tmp_path / "z.png", half)


@pytest.mark.parametrize("dialect", ["inch", "simple", "simple-inch"])
def test_dialects_say_the_same(tmp_path, dialect):
    scene, field, heights = spline(lambda x, y: 5.0 + 0.002 * (x * x + y * y))
    part = part_of("gcode", scene, field, heights)
    tips, figures = {}, {}
    for one in ("mm", dialect):
        milling = Milling(scallop=0.02, roughing=0.5, dialect=one)
        figures[one] = write_gcode(tmp_path / one, part, milling)
        tips[one] = np.concatenate([cut.tips for cut in read_program(tmp_path / one).cuts])
    text = (tmp_path / dialect).read_text()
    assert ("G20" in text) == dialect.endswith("inch") and ("G21" in text) != dialect.endswith("inch")
    moves = [line for line in text.splitlines() if line.startswith(("G0", "G1 "))]
    if dialect.startswith("simple"):
        assert all(line.startswith("G1 ") and " F" in line for line in moves)
    else:
        assert any(line.startswith("G0") for line in moves) and sum(" F" in line for line in moves) < 0.2 * len(moves)
    assert cKDTree(tips[dialect]).query(tips["mm"])[0].max() < 2e-4  # with more digits some more moves are not empty
    for key in ("length_mm", "minutes"):
        assert figures[dialect][key] == pytest.approx(figures["mm"][key], rel=1e-4)


# the command


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ("--format step --tool-radius 2", "--tool-radius belongs to --format gcode"),
        ("--format gcode --samples 10", "--samples"),
        ("--format gcode --scallop -1", "--scallop"),
        ("--format csv --tolerance 1e-3", "--tolerance"),
        ("--format npz", "--format"),
        ("--format heightmap --block 0", "--block"),
    ],
)
def test_options_belong_to_formats(tmp_path, monkeypatch, capfd, options, words):
    monkeypatch.chdir(tmp_path)
    assert cli.run(shlex.split(f"export nothing {options}")) == 2
    err = capfd.readouterr().err
    assert words in err and err.count("\n") == 1


def test_an_archive_as_cut(tmp_path, monkeypatch, capfd):
    """Rendered from the program alone, whose rays are spread as the figures say."""
    monkeypatch.chdir(tmp_path)
    scene, field, heights = spline(lambda x, y: 5.0 + 0.002 * (x * x + y * y))
    write_lighttools("lens.npz", scene, field, heights)
    write_gcode("lens.nc", part_of("gcode", scene, field, heights), Milling(scallop=0.01))
    assert cli.run(shlex.split("render lens.npz --rays 20000 --effects none --cut lens.nc --json")) == 0
    f = json.loads(capfd.readouterr().out)
    assert f["cut"]["cut_left_mm"] < 0.011 and f["error"] is f["error_by"] is f["cut"]["nominal_error"] is None  # no picture
    assert cli.run(shlex.split("render lens.npz --rays 20000 --effects none --cut lens.nc")) == 0
    out = capfd.readouterr().out
    assert "left on the surface" in out and out.count("relative RMS error") == 1
    assert f["on_screen"] + math.fsum(f["lost"].values()) == pytest.approx(1.0, abs=1e-9)
    Path("lens.nc").write_text(Path("lens.nc").read_text().replace("ball nose, radius 2 mm", "some tool"))
    assert cli.run(shlex.split("render lens.npz --rays 20000 --cut lens.nc")) == 2
    assert "--tool-radius" in capfd.readouterr().err
