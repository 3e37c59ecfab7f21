"""Programs for lathes with a tool servo: the surface that the edge leaves, and the room of the flank, anew from the blocks."""

import json
import re
import shlex

import numpy as np
import pytest
import torch
from helpers import write_blob
from test_export import make
from test_machine import at, spline

from caustic_cli import cli
from caustic_cli.errors import InputError
from caustic_cli.export.lighttools import write_lighttools
from caustic_cli.export.milling import Milling
from caustic_cli.export.milling.gcode import write_gcode
from caustic_cli.export.milling.turning import Blank
from caustic_cli.export.part import part_of
from caustic_cli.workflow.machining import cut_surface, form_deviation

BLOCK = re.compile(r"^G1 X(\S+) C(\S+) Z(\S+) F(\S+)$", re.MULTILINE)


def blocks(path, unit=1.0):
    """X, mm, C, degrees, Z, mm, and F of the blocks in inverse time."""
    rows = np.array([[float(v) for v in row] for row in BLOCK.findall(path.read_text())])
    return rows * [unit, 1.0, unit, 1.0]


def cut(rows, angle, rho, radius):
    """Height, mm, that the edge leaves at places rho (N,), mm, of the section at an angle, degrees: the lowest of all arcs in it,
    with X and Z linear in C between blocks, from both sides of the axis."""
    x, c, z, _ = rows.T
    place, low = [], []
    for side, first in ((1.0, angle), (-1.0, angle + 180.0)):
        turns = np.arange(first % 360.0, c[-1], 360.0)
        turns = turns[turns >= c[0]]
        place.append(side * np.interp(turns, c, x))
        low.append(np.interp(turns, c, z))
    square = radius**2 - (rho[:, None] - np.concatenate(place)) ** 2
    return np.where(square > 0, np.concatenate(low) + radius - np.sqrt(np.maximum(square, 0.0)), np.inf).min(1)


def left(path, lens, radius, angles=40):
    """Material left above the surface, mm, negative where it is cut too deep, at random points of the aperture."""
    scene, field, heights = lens
    rows, random, found = blocks(path), np.random.default_rng(0), []
    for angle in random.uniform(0.0, 360.0, angles):
        rho = random.uniform(-1.0, 1.0, 300) * scene.lens.opening.reach
        x, y = rho * np.cos(np.radians(angle)), rho * np.sin(np.radians(angle))
        inside = scene.lens.opening.contains(x, y)
        z = at(field, heights, x[inside], y[inside]) - scene.lens.z_in
        found.append(cut(rows, angle, rho[inside], radius) - z)
    return np.concatenate(found)


@pytest.mark.parametrize("shape", ["rough rectangle", "round bowl", "round dome"])
def test_cusps_are_as_high_as_asked_and_nothing_is_gouged(tmp_path, shape):
    bend = {"round bowl": 0.01, "round dome": -0.01}.get(shape)
    if bend is None:
        lens = make(control=(16, 13), size=(10.0, 8.0), relief=0.02)
    else:
        lens = spline(lambda x, y: 5.0 + bend * (x * x + y * y) + 1e-4 * x**3, aperture="circle", size=(8.0, 8.0))
    f = write_gcode(tmp_path / "a.nc", part_of("gcode", *lens), Milling(path="turning", tool_radius=0.5, scallop=5e-4))
    off = left(tmp_path / "a.nc", lens, 0.5)
    assert f["scallop_mm"] <= 5e-4 and off.min() > -1.05 * f["tolerance_mm"]
    assert off.max() < f["scallop_mm"] + 1.05 * f["tolerance_mm"]
    assert off.max() > (0.8 if bend is None else 0.95) * f["scallop_mm"]
    rows = blocks(tmp_path / "a.nc")
    minutes = (1.0 / rows[:, 3]).sum()
    assert minutes == pytest.approx(f["minutes"], rel=1e-3) and (np.diff(rows[:, 1]) > 0).all() and (np.diff(rows[:, 0]) <= 0).all()


def test_compensation_is_of_each_section(tmp_path):
    """Of a tilted cylinder the point of contact and the height change along the turn: a program without it would be off by this."""
    lens = spline(lambda x, y: 5.0 + 0.02 * (x + 0.5 * y) ** 2, aperture="circle", size=(8.0, 8.0))
    f = write_gcode(tmp_path / "a.nc", part_of("gcode", *lens), Milling(path="turning", tool_radius=1.0, scallop=1e-4))
    off = left(tmp_path / "a.nc", lens, 1.0)
    assert -1.2 * f["tolerance_mm"] < off.min() and off.max() < 1.3e-4
    x, c, z, _ = blocks(tmp_path / "a.nc").T
    inside = x < 3.5
    plain = at(*lens[1:], *(x * f(np.radians(c)) for f in (np.cos, np.sin)))[inside]
    assert np.abs(z[inside] - plain).max() > 5e-3


@pytest.mark.parametrize("dialect", ["mm", "simple-inch"])
def test_the_simulated_cut_is_that_of_the_arcs(tmp_path, dialect):
    """As `render --cut` traces it: heights as above, slopes as their differences."""
    lens = make(control=(16, 13), size=(10.0, 8.0), relief=0.02)
    how = {"path": "turning", "tool_radius": 0.5, "scallop": 5e-4, "dialect": dialect}
    write_gcode(tmp_path / "a.nc", part_of("gcode", *lens), Milling(**how))
    whole, rows = cut_surface(tmp_path / "a.nc", *lens[:2]), blocks(tmp_path / "a.nc", 25.4 if dialect == "simple-inch" else 1.0)
    assert (whole.base, whole.turned) == (lens[0].lens.z_in, False)
    rng = np.random.default_rng(4)
    for angle in (10.0, 77.0, 200.0):
        rho = rng.uniform(0.001, 3.9, 300)
        x, y = rho * np.cos(np.radians(angle)), rho * np.sin(np.radians(angle))
        z, gx, gy = whole.heights_and_slopes(x, y)
        assert np.abs(z - whole.base - cut(rows, angle, rho, 0.5)).max() < 1e-9
        for moved, g in (((x + 1e-6, y), gx), ((x, y + 1e-6), gy)):
            off = np.abs((whole.heights_and_slopes(*moved)[0] - z) / 1e-6 - g)[rho > 0.05]
            assert np.median(off) < 1e-4 and (off < 1e-3).mean() > 0.98  # but at cusps and ends of blocks
    f = form_deviation(whole, *lens[1:], lens[0].lens.opening)
    assert f["cut_gouge_mm"] < 1.4e-4 and 4e-4 < f["cut_left_mm"] < 6.5e-4


def test_programs_that_no_lathe_cuts_are_refused(tmp_path):
    head = "(tool: round nose, radius 1 mm, no rake)\nG21\n"
    (tmp_path / "a.nc").write_text(head + "G1 X5 C0 Z1\nX4 C10\nX5 C20\n")
    lens = make(control=(8, 8), relief=0.005)
    with pytest.raises(InputError, match="towards the axis"):
        cut_surface(tmp_path / "a.nc", *lens[:2])
    (tmp_path / "a.nc").write_text("(tool: ball nose, radius 1 mm)\nG1 X5 C0 Z1\n")
    with pytest.raises(InputError, match="C is not read"):
        cut_surface(tmp_path / "a.nc", *lens[:2])


def flank_room(path, lens, radius, clearance, rows=2000):
    """Least height of a conical flank above the cut surface, mm, at random blocks, up to 1 mm behind the edge."""
    scene, field, heights = lens
    blank, random = Blank(field, heights - scene.lens.z_in), np.random.default_rng(1)
    x, c, z, _ = blocks(path)[random.integers(0, len(blocks(path)), rows)].T
    keep = x < scene.lens.opening.reach - 0.1
    x, angle, z = x[keep], np.radians(c[keep]), z[keep] + radius
    x, angle, z = (np.repeat(v, 61) for v in (x, angle, z))
    back = random.choice([0.01, 0.05, 0.2, 1.0], len(x))
    around = np.tile(np.linspace(-0.15, 0.15, 61), len(x) // 61)  # along the arc
    here = radius - back * np.tan(np.radians(clearance))
    along, high = x + here * np.sin(around), z - here * np.cos(around)
    px, py = along * np.cos(angle) + back * np.sin(angle), along * np.sin(angle) - back * np.cos(angle)
    inside = scene.lens.opening.contains(px, py) & (here > 0)
    return (high - blank(px, py)[0])[inside].min()


def test_the_flank_stays_off_with_the_clearance_said_to_be_needed(tmp_path):
    """With a little more it never touches; with half of it, it does, and the program is refused."""
    lens = make(control=(16, 13), size=(10.0, 8.0), relief=0.02)
    part, how = part_of("gcode", *lens), {"path": "turning", "tool_radius": 2.0, "scallop": 5e-4}
    f = write_gcode(tmp_path / "a.nc", part, Milling(**how))
    needed = f["clearance_needed_deg"]
    slope = float(torch.hypot(*lens[1].at(lens[2], *torch.rand(2, 20000, dtype=torch.float64) * 7.9 - 3.95)[1:]).max())
    assert 1.0 < needed < np.degrees(np.arctan(slope)) * 1.1
    assert flank_room(tmp_path / "a.nc", lens, 2.0, 1.05 * needed) > -2.0 * f["tolerance_mm"]
    assert flank_room(tmp_path / "a.nc", lens, 2.0, 0.5 * needed) < -2.0 * f["tolerance_mm"]
    with pytest.raises(InputError, match=f"clearance must exceed {needed:.3g} degrees"):
        write_gcode(tmp_path / "b.nc", part, Milling(**how, clearance=0.99 * needed))
    assert not (tmp_path / "b.nc").exists()


def test_a_blank_continues_the_surface_beyond_its_rectangle():
    _, field, heights = lens = make(control=(16, 13), size=(10.0, 8.0), relief=0.02)
    blank, step = Blank(field, lens[2]), 1e-6
    rng = np.random.default_rng(2)
    x, y = rng.uniform(-7.0, 7.0, 400), rng.uniform(-6.0, 6.0, 400)
    z, gx, gy = blank(x, y)
    for moved, g in (((x + step, y), gx), ((x, y + step), gy)):
        assert np.abs((blank(*moved)[0] - z) / step - g).max() < 1e-5
    edge = blank(np.array([5.0 - 1e-7, 5.0 + 1e-7]), np.array([1.0, 1.0]))
    assert all(abs(a - b) < 1e-6 for a, b in edge)
    assert np.hypot(gx, gy).max() < 2.0 * float(
        torch.hypot(*field.at(heights, *(torch.rand(2, 20000).double() * 7.9 - 3.95))[1:]).max()
    )


def test_inches_without_rapid_moves(tmp_path):
    lens = spline(lambda x, y: 5.0 + 0.002 * (x * x + y * y), aperture="circle", size=(4.0, 4.0))
    rows = {}
    for dialect, unit in (("mm", 1.0), ("simple-inch", 25.4)):
        milling = Milling(path="turning", scallop=1e-3, dialect=dialect)
        write_gcode(tmp_path / dialect, part_of("gcode", *lens), milling)
        rows[dialect] = blocks(tmp_path / dialect, unit)
    text = (tmp_path / "simple-inch").read_text()
    assert "G20" in text and "G0 " not in text and text.isascii()
    assert np.abs(rows["mm"] - rows["simple-inch"])[:, :3].max() < 1e-4


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ("--path turning --roughing 1", "--roughing belongs to another --path"),
        ("--path turning --spindle 1000", "--spindle belongs to another --path"),
        ("--clearance 12", "--clearance belongs to --path turning, got raster"),
        ("--path turning --clearance 90", "--clearance"),
    ],
)
def test_what_a_lathe_cannot_do_is_refused(tmp_path, monkeypatch, capfd, options, words):
    monkeypatch.chdir(tmp_path)
    write_lighttools("lens.npz", *make(control=(8, 8), relief=0.005))
    assert cli.run(shlex.split(f"export lens.npz --format gcode -o a.nc {options}")) == 2
    err = capfd.readouterr().err
    assert words in err and err.count("\n") == 1


def test_the_command_says_what_lathe_is_needed(tmp_path, monkeypatch, capfd):
    monkeypatch.chdir(tmp_path)
    write_blob()
    order = "design blob.png --mag 2 --resolution 24 --waves off --rays 20000 --lens-size 4 -o a.caustic -q"
    assert cli.run(shlex.split(order)) == 0
    capfd.readouterr()
    assert cli.run(shlex.split("export a.caustic --format gcode --path turning --scallop 0.005")) == 0
    out = capfd.readouterr().out
    assert re.search(r"turns of a blank of 6\.\d+ mm; clearance above .* degrees; Z up to .* mm/s and .* m/s", out)
    assert cli.run(shlex.split("export a.caustic --format gcode --path turning --scallop 0.005 --force --json")) == 0
    found = json.loads(capfd.readouterr().out)["milling"]
    assert found["turns"] == found["minutes"] * 60 and "blur_mm" in found
    assert cli.run(shlex.split("export a.caustic --format gcode --path turning --clearance 0.1 -o b.nc")) == 2
    assert "--clearance must exceed" in capfd.readouterr().err and not (tmp_path / "b.nc").exists()
    assert cli.run(shlex.split("export a.caustic --format gcode --scallop 0.01 -o c.nc")) == 0
    assert "lathe" not in capfd.readouterr().out
