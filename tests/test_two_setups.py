"""Both sides of a lens for a machine: programs and height maps of two setups, put together again in the coordinates of the lens."""

import json
import re
import shlex
from dataclasses import replace

import numpy as np
import pytest
import sequential
import torch
from helpers import write_blob
from scipy.interpolate import RectBivariateSpline
from test_machine import at, spline

from caustic_cli import cli
from caustic_cli.errors import InputError
from caustic_cli.export.heightmap import write_heightmap
from caustic_cli.export.mesh import closed_mesh
from caustic_cli.export.milling import Milling
from caustic_cli.export.milling.gcode import write_gcode
from caustic_cli.export.part import Part
from caustic_cli.export.points import write_csv
from caustic_cli.export.register import between_backs, parts_of, registered, sides_of, with_stock
from caustic_cli.export.zemax import write_zemax
from caustic_cli.io.gcode import read_program
from caustic_cli.io.heightmaps import beside, read_heightmap
from caustic_cli.optics.envelope import Envelope
from caustic_cli.optics.system import freeform_of

PIN = re.compile(r"X(-?[0-9.]+) Y0")


@pytest.fixture
def lens():
    """Both sides alike under no turn or reflection: 6 mm thick in the middle, entrance at z = 1."""
    scene, field, heights = spline(lambda x, y: 5.0 - 0.006 * (x * x + y * y) + 4e-4 * x**3 + 0.01 * y + 2e-4 * x * y * y)
    _, front, low = spline(lambda x, y: 0.004 * x * x - 0.005 * x * y + 3e-4 * y**3 + 0.02 * x)
    return replace(scene, lens=replace(scene.lens, z_in=-1.0, entrance=freeform_of(front, low))), field, heights, front, low - 1.0


def written(tmp_path, lens, **how):
    """Programs of both setups, and their parts."""
    m = Milling(**{"scallop": 0.002} | how)
    sides, paths = sides_of(*lens[:3], m), (tmp_path / "a.nc", tmp_path / "a-entrance.nc")
    for path, side in zip(paths, sides, strict=True):
        write_gcode(path, side, with_stock(m, side))
    return sides, paths


def surface(path, x, y):
    """Heights above Z0 that the ball leaves at points of a setup, mm."""
    ball = read_program(path).cuts[-1]
    centres = ball.tips + np.array([0.0, 0.0, ball.radius])
    return Envelope(ball.radius, centres[:-1], centres[1:])(x, y)[0]


def test_both_setups_leave_the_lens(tmp_path, lens):
    """A point of the stock at (x, y, Z) of the first setup is at (x, -y, H - Z) of the second: its thickness there is the lens'."""
    sides, paths = written(tmp_path, lens)
    thickness = read_program(paths[0]).top
    assert read_program(paths[1]).top == thickness == sides[0].register.thickness
    x, y = np.random.default_rng(0).uniform(-1.0, 1.0, (2, 4000)) * [[4.9], [3.9]]
    upper, lower = surface(paths[0], x, y), thickness - surface(paths[1], x, -y)
    exit_z, entrance_z = at(lens[1], lens[2], x, y), at(lens[3], lens[4], x, y)
    more = (upper - lower) - (exit_z - entrance_z)
    assert more.min() > -1e-4 and more.max() < 2 * 0.00205 and more.max() > 0.002
    zero = read_program(paths[0]).zero
    assert np.abs(upper + zero - exit_z).max() < 0.00205 and np.abs(lower + zero - entrance_z).max() < 0.00205
    wrong = thickness - surface(paths[1], x, y)  # not turned over
    assert np.abs(wrong + zero - entrance_z).max() > 0.05


def test_the_pins_stand_at_the_same_places_of_the_stock(tmp_path, lens):
    """Holes are drilled where the second setup has its pins, not through, beside all cuts, and unequally far from the middle."""
    sides, paths = written(tmp_path, lens, pin=2.0)
    drill, ball = read_program(paths[0]).cuts
    holes = np.unique(drill.tips[~drill.rapid][:, :2], axis=0)
    said = [[float(v) for v in PIN.findall(re.search(r"\(register: .*\)", p.read_text())[0])] for p in paths]
    assert said[0] == said[1] and sorted(said[0]) == sorted(holes[:, 0].tolist()) and (holes[:, 1] == 0).all()
    assert abs(holes[0, 0] + holes[1, 0]) > 2.0 and drill.kind == "drill" and drill.radius == 1.0
    for path in paths:
        ball = read_program(path).cuts[-1]
        for x in holes[:, 0]:
            low = ball.tips[ball.tips[:, 2] < sides[0].register.thickness]
            assert np.hypot(low[:, 0] - x, low[:, 1]).min() > ball.radius + 1.0
    assert drill.tips[:, 2].min() > 0.0 and "drill" not in paths[1].read_text()


def test_both_height_maps_are_read_back(tmp_path, lens):
    for side, name, field, heights in zip(
        sides_of(*lens[:3], Milling()), ("a.tif", "b.tif"), (lens[1], lens[3]), (lens[2], lens[4]), strict=True
    ):
        write_heightmap(tmp_path / name, side, 2)
        found = read_heightmap(tmp_path / name, field.half_size)
        x, y = np.random.default_rng(1).uniform(-3.9, 3.9, (2, 500))
        assert np.abs(at(*found, x, y) - at(field, heights, x, y)).max() < 1e-6
    said = [json.loads(beside(tmp_path / name).read_text()) for name in ("a.tif", "b.tif")]
    assert said[0]["register"] == said[1]["register"] and [s["turned"] for s in said] == [False, True]
    stock = said[0]["register"]["stock_mm"][2]
    assert said[0]["z_of_flat_face"] == pytest.approx(-(said[1]["z_of_flat_face"] + stock))


@pytest.mark.parametrize(
    ("how", "words"),
    [({"stock": 5.0}, "as thick as the lens"), ({"tool_radius": 30.0, "scallop": 1.0}, "beside the lens|below the flat face")],
)
def test_what_no_stock_holds_is_refused(tmp_path, lens, how, words):
    with pytest.raises(InputError, match=words):
        written(tmp_path, lens, **how)


def test_a_turned_lens_has_two_setups_too(tmp_path, lens):
    _, paths = written(tmp_path, lens, path="turning", scallop=0.005, tool_radius=1.0)
    assert all("(register: dowel pins" in p.read_text() and "C" in p.read_text() for p in paths)


def test_the_commands_write_both_sides(tmp_path, monkeypatch, capfd):
    monkeypatch.chdir(tmp_path)
    write_blob()
    order = "design blob.png --linear --throw 50 --mag 1 --margin 0.3 --control 35 --resolution 40 --collimate --iterations 1"
    assert cli.run(shlex.split(f"{order} -o p.caustic -q")) == 0
    capfd.readouterr()
    assert cli.run(shlex.split("export p.caustic --format gcode,heightmap --scallop 0.01 --json")) == 0
    program, heights = json.loads(capfd.readouterr().out)["exports"]
    assert program["beside"] == ["p-entrance.nc"] and program["entrance"]["lines"] > 100
    assert heights["beside"] == ["p.tif.json", "p-entrance.tif", "p-entrance.tif.json"]
    assert program["register"]["stock_mm"] == heights["register"]["stock_mm"]
    assert heights["error"] == pytest.approx(heights["lens_error"], rel=0.06) and heights["keeps_picture"]
    assert cli.run(shlex.split("export p.caustic --format gcode,heightmap --scallop 0.01")) == 0
    assert "turned over about x" in capfd.readouterr().out
    x = torch.linspace(-3.0, 3.0, 50, dtype=torch.float64).numpy()
    stock = read_program("p.nc").top
    thick = surface("p.nc", x, 0.5 * x) + surface("p-entrance.nc", x, -0.5 * x) - stock
    assert (np.diff(thick) != 0).all() and (thick > 0.0).all()


def test_the_halves_of_a_mould_enclose_the_lens(tmp_path, lens):
    """Closed on a frame between their faces: the lower half as it lies, the upper one turned over, both on the same pins."""
    m = Milling(scallop=0.002)
    halves = parts_of("gcode", *lens[:3], m, mould=True)
    paths = (tmp_path / "a.nc", tmp_path / "a-entrance.nc")
    for path, half in zip(paths, halves, strict=True):
        write_gcode(path, half, with_stock(m, half))
    upper, lower = (read_program(path) for path in paths)
    frame = halves[0].register.frame
    x, y = np.random.default_rng(0).uniform(-1.0, 1.0, (2, 4000)) * [[4.9], [3.9]]
    below = surface(paths[1], x, y)  # above the back of the lower half
    above = lower.top + frame + (upper.top - surface(paths[0], x, -y))
    less = at(lens[1], lens[2], x, y) - at(lens[3], lens[4], x, y) - (above - below)  # what the balls leave is not glass
    assert less.min() > -1e-4 and 0.002 < less.max() < 2 * 0.00205
    assert registered(halves)["register"]["between_backs_mm"] == pytest.approx(lower.top + frame + upper.top)
    holes = [{tuple(p) for p in program.cuts[0].tips[~program.cuts[0].rapid][:, :2].tolist()} for program in (upper, lower)]
    assert holes[0] == holes[1] and len(holes[0]) == 2 and all("pins" in path.read_text() for path in paths)


def test_solid_halves_fill_their_block_with_the_lens(lens):
    """Of meshes: closed, outward, and with volumes that add up to the aperture times the distance of the backs."""
    scene, field, heights = lens[:3]
    halves = parts_of("stl", scene, field, heights, Milling(), mould=True, block=1.5)
    turned_over = halves[0].turned, halves[1].turned
    assert turned_over == (True, False) and [half.register for half in halves] == [None, None]
    volumes = []
    for part in (*halves, Part(scene, field, heights, "lens")):
        vertices, faces = closed_mesh(part.scene, part.field, torch.as_tensor(part.heights), (41, 37))
        edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
        assert {tuple(e) for e in edges.tolist()} == {tuple(e[::-1]) for e in edges.tolist()}
        a, b, c = (vertices[faces[:, k]] for k in range(3))
        volumes.append(np.einsum("ij,ij->i", a, np.cross(b, c)).sum() / 6.0)
    assert min(volumes) > 0 and sum(volumes) == pytest.approx(80.0 * between_backs(halves), rel=1e-4)
    low = min(float((-half.heights if half.turned else half.heights).min()) for half in halves[1:])
    assert low - halves[1].lens.z_in == pytest.approx(1.5)


def test_sides_that_reach_past_each_other_have_no_faces_between_them(lens):
    scene, field, heights = lens[:3]
    x = field.control_xy()[0]
    tilted = heights + 1.5 * x[:, None]
    with pytest.raises(InputError, match="reach past each other"):
        parts_of("gcode", scene, field, tilted, Milling(), mould=True)
    assert len(parts_of("step", scene, field, tilted, Milling(), mould=True)) == 2


def read_zemax(path):
    """x, y, z - vertex (nx, ny) of a Grid Sag file, and the numbers of its comment on the vertex."""
    lines = path.read_text().splitlines()
    head, rows = [one for one in lines if one.startswith("!")], [one for one in lines if one and not one.startswith("!")]
    nx, ny, dx, dy, *_ = map(float, rows[0].split())
    z = np.array([float(row.split()[0]) for row in rows[1:]]).reshape(int(ny), int(nx))[::-1].T
    x, y = ((np.arange(n) - 0.5 * (n - 1)) * d for n, d in ((nx, dx), (ny, dy)))
    (said,) = (one for one in head if "vertex" in one)
    return x, y, z, [float(n) for n in re.findall(r"-?\d+\.?\d*(?:e-?\d+)?(?= mm| *,)", said)]


def read_csv(path):
    table = np.loadtxt(path, delimiter=",", skiprows=1)
    x, y = np.unique(table[:, 0]), np.unique(table[:, 1])
    return x, y, table[:, 2].reshape(len(y), len(x)).T


@pytest.mark.parametrize("format", ["csv", "zemax"])
def test_both_sides_are_read_from_files_of_one_surface_each(tmp_path, lens, format):
    """And light goes where it does through the lens, by a tracer and splines of others."""
    scene, field, heights = lens[:3]
    sides, paths = parts_of(format, scene, field, heights, Milling()), [tmp_path / "a", tmp_path / "a-entrance"]
    writer = {"csv": write_csv, "zemax": write_zemax}[format]
    for path, side in zip(paths, sides, strict=True):
        writer(path, side.scene, side.field, side.heights, 4)
    if format == "csv":
        read = [RectBivariateSpline(*read_csv(path)) for path in paths]
    else:
        (*exit, said), (*front, back) = (read_zemax(path) for path in paths)
        middle = float(at(lens[3], lens[4], np.zeros(1), np.zeros(1))[0])
        assert back[0] == pytest.approx(0.0, abs=1e-12)
        read = [RectBivariateSpline(a, b, z + up) for (a, b, z), up in ((exit, middle + said[0]), (front, middle))]
    own = [lambda x, y, s=s: at(*s, x, y) for s in ((field, heights), (lens[3], lens[4]))]
    rng, n = np.random.default_rng(2), scene.lens.index
    start = np.stack([*rng.uniform(-3.5, 3.5, (2, 300)), np.full(300, -5.0)], 1)
    ahead = np.tile([0.05, -0.03, np.sqrt(1 - 0.05**2 - 0.03**2)], (300, 1))
    found = []
    for exit_side, entrance in (read, own):
        faces = ((getattr(s, "ev", s), (0, 0, 0), (0, 0), *indices) for s, indices in ((entrance, (1.0, n)), (exit_side, (n, 1.0))))
        o, d, _ = sequential.walk(start, ahead, faces)
        found.append(sequential.onto(o, d, (0.0, 0.0, 300.0)))
    assert np.abs(found[0] - found[1]).max() < 5e-4  # of roundings of heights, on a screen 300 mm away
