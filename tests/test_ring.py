"""Machining around an axis: roughing in four axes and rings of panels, by a simulation of the swept tools in closed form.

The stock is the radius along rays from the axis, at places along it and angles.  A ray e(phi) meets a ball with its centre at rho
e(theta), its place da away along the axis, at r = rho cos(phi - theta) - sqrt(R^2 - da^2 - rho^2 sin^2(phi - theta)), and the flat
end of a tool at r = Z / cos(phi - theta), if that is within its disc.
"""

import json
import math
import re
from dataclasses import replace

import numpy as np
import pytest
import torch
from helpers import write_blob
from scipy.interpolate import NdBSpline

from caustic_cli import cli
from caustic_cli.errors import InputError
from caustic_cli.export.milling import Milling
from caustic_cli.export.milling.gcode import write_gcode
from caustic_cli.export.panels import Panels
from caustic_cli.export.part import part_of
from caustic_cli.export.ring import ring_of
from caustic_cli.export.stl import write_mesh
from caustic_cli.optics.parallel import parallel_side
from caustic_cli.optics.surfaces import HeightField
from caustic_cli.scene import Lens, Offset, PlaneWave, Points, Scene, Screen
from caustic_cli.workflow.machining import cut_surface

INF, WALL = math.inf, 3.0


def panel(radius=(-20.0, INF), size=(5.0, 5.0), bumps=0.03, seed=2, control=(10, 9), wave=0.0):
    """A wall of 3 mm around an axis with a random relief, and a wave of 0.3 mm along its axis where asked."""
    base = Offset(WALL, radius)
    entrance = parallel_side(base, WALL, (0.5 * size[0], 0.5 * size[1]))
    lens = Lens(size, 0.0, 1.49, control, offset=base, entrance=entrance, min_thickness=1.0, height_range=(-2.0, 2.0))
    field = HeightField.of(lens)
    x, y = (c.numpy() for c in field.control_xy())
    heights = base.heights(x, y) - 0.3 + wave * (np.sin(2.0 * x)[:, None] * np.ones_like(y))
    heights += bumps * np.random.default_rng(seed).normal(size=field.shape)
    return Scene(PlaneWave(), lens, Screen((30.0, 30.0), 150.0, (8, 8))), field, field.interpolated(torch.from_numpy(heights))


def tools_of(path):
    """(kind, radius, moves) of each tool: moves (k, 4) of X, A in radians, Z and whether rapid, at most 0.05 mm or 0.2 degrees
    apart; read by the words of the program."""
    found, at, unit = [], {"X": 0.0, "A": 0.0, "Z": 1e3}, 1.0
    for line in path.read_text().splitlines():
        if tool := re.match(r"\(tool: (\w+) \w+, radius (\S+) mm", line):
            found.append((tool[1], float(tool[2]), []))
        unit = 25.4 if line.startswith("G20") else unit
        if line.startswith("(") or " " not in line or not set("XAZ") & set(line):
            continue
        words = {word[0]: float(word[1:]) for word in line.split()}
        before = at
        at = at | {k: words[k] * (1.0 if k == "A" else unit) for k in "XAZ" if k in words}
        moves = np.array([list(before.values()), list(at.values())])
        count = 2 + int(max(np.abs(moves[1, :2] - moves[0, :2]) / [0.05, 0.2]))
        moves = np.linspace(*moves, count)[1:]
        found[-1][2].append(np.column_stack([moves, np.full(len(moves), words["G"] == 0)]))
    return [(kind, radius, np.concatenate(moves) * [1.0, math.pi / 180.0, 1.0, 1.0]) for kind, radius, moves in found]


def swept(stock, a, phi, kind, radius, moves):
    """Stock (n, m), mm, at places a (n,) and angles phi (m,), after the moves of a tool."""
    left = stock.copy()
    for theta in np.unique(moves[:, 1]):
        x, _, z, _ = moves[moves[:, 1] == theta].T
        turn = np.abs((phi - theta + math.pi) % (2.0 * math.pi) - math.pi)
        columns = np.flatnonzero(turn < math.asin(min(1.0, 1.1 * radius / z.min())))
        if not len(columns) or z.min() > stock.max():
            continue
        turn, away = turn[columns][None, :, None], (a[:, None] - x)[:, None, :]
        if kind == "flat":
            r = z / np.cos(turn)
            meets = away**2 + (r * np.sin(turn)) ** 2 <= radius**2
        else:
            room = radius**2 - away**2 - ((z + radius) * np.sin(turn)) ** 2
            r, meets = (z + radius) * np.cos(turn) - np.sqrt(np.maximum(room, 0.0)), room >= 0.0
        left[:, columns] = np.minimum(left[:, columns], np.where(meets, r, INF).min(-1))
    return left


def relief(field, heights, axis, a, phi, bent):
    """Distances of the surface from the axis, mm, at places a and angles phi, which are broadcast, by bisection along rays."""
    a, phi = np.broadcast_arrays(a, phi)
    shape, a, phi = a.shape, a.ravel().copy(), phi.ravel().copy()
    low, high = np.full(len(a), 0.8 * abs(axis)), np.full(len(a), 2.0 * abs(axis))
    for _ in range(45):
        r = 0.5 * (low + high)
        across = torch.from_numpy(r * np.sin(phi))
        xy = (across, torch.from_numpy(a)) if bent == 0 else (torch.from_numpy(a), across)
        below = r * np.cos(phi) + axis < field.at(heights, *xy, [(0, 0)])[0].numpy()
        low, high = np.where(below, r, low), np.where(below, high, r)
    return r.reshape(shape)


# roughing


@pytest.mark.parametrize(
    ("radius", "how"),
    [
        ((-20.0, INF), {"roughing": 0.4, "roughing_tool": "flat"}),
        ((-20.0, INF), {"roughing": 0.8, "roughing_tool": "ball", "roughing_radius": 0.9}),
        ((INF, -30.0), {"roughing": 0.4, "roughing_tool": "flat", "dialect": "inch"}),
    ],
)
def test_roughing_in_four_axes_leaves_its_allowance(radius, how, tmp_path):
    """On a relief with waves of 0.2 mm: nowhere less than the allowance, nowhere more than that, a layer and what is between
    passes; and finishing takes no more, beyond the edges either."""
    step, allowance = how["roughing"], 0.1
    scene, field, heights = panel(radius, wave=0.2)
    mill = Milling(path="rotary", tool_radius=1.0, scallop=0.1, allowance=allowance, **how)
    mill = replace(mill, stock=abs(min(radius)) + 1.5)
    made = write_gcode(tmp_path / "r.nc", part_of("gcode", scene, field, heights), mill)
    bent, axis = int(math.isinf(radius[0])), WALL + min(radius)
    reach = math.asin(0.99 * scene.lens.half_size[bent] / -min(radius))
    a, phi = np.linspace(-1.2, 1.2, 61) * scene.lens.half_size[1 - bent], np.linspace(-1.2, 1.2, 61) * reach
    stock, turned = [np.full((61, 61), made["stock_mm"])], 1.0 if bent == 0 else -1.0  # A is about y, or about x
    tools = tools_of(tmp_path / "r.nc")
    assert [kind for kind, *_ in tools] == [how["roughing_tool"], "ball"]
    for kind, size, moves in tools:
        assert moves[moves[:, 3] > 0, 2].min() > made["stock_mm"] - 1e-4  # no rapid move in the stock
        stock.append(swept(stock[-1], a, turned * phi, kind, size, moves))
    own = slice(6, -6)  # of the panel itself; finishing goes beyond its edges
    surface = relief(field, heights, axis, a[own, None], phi[own], bent)
    left, slope, apart = stock[1][own, own] - surface, 0.6, 0.5 * mill.rough_radius
    between = apart * slope if how["roughing_tool"] == "flat" else apart**2 / 8.0 * (1.0 / mill.rough_radius + 1.0 / 20.0)
    assert left.min() > allowance
    assert left.max() < allowance + step + between
    assert left.mean() < allowance + between  # it follows the relief, not the layers
    finished = stock[2][own, own] - surface
    assert finished.min() > -2.0 * made["tolerance_mm"]
    assert finished.max() < 0.1
    assert (stock[1] - stock[2]).max() < allowance + step + between


# rings

#: Which of two panels each of the six is.
ORDER = (0, 1, 0, 0, 1, 1)


def ring_part(radius, format="stl", length=4.0, order=ORDER, across=10.0):
    """Panels of 60 degrees around an axis, of two reliefs, as a part; and the two."""
    order_of = slice(None, None, 1 if math.isinf(radius[1]) else -1)
    size, control = (across, length)[order_of], (14, 6)[order_of]
    (scene, field, heights), (_, *other) = (panel(radius, size, bumps=0.04, seed=k, control=control) for k in (3, 4))
    sides = ((field, heights), tuple(other))
    part = part_of(format, scene, field, heights)
    return replace(part, others=tuple(sides[k] for k in order[1:])), sides


def around(sides, radius, a, phi):
    """Distances of the surface of the ring from the axis, mm, at places a and angles phi, which are broadcast."""
    bent, axis = int(math.isinf(radius[0])), WALL + min(radius)
    number = np.rint(np.degrees(phi) / 60.0)
    turn, which = phi - np.radians(60.0 * number), np.take(ORDER, number.astype(int) % 6)
    return np.where(which == 0, *(relief(*side, axis, a, turn, bent) for side in sides))


@pytest.mark.parametrize("radius", [(-10.0, INF), (INF, -10.0)])
def test_ring_is_a_closed_body_with_every_relief_in_its_place(radius):
    part, sides = ring_part(radius)
    ring = ring_of(Panels.of(part, part.others), part.lens, 4)
    edges = np.concatenate([ring.faces[:, k] for k in ([0, 1], [1, 2], [2, 0])])
    forth = set(map(tuple, edges.tolist()))
    assert len(forth) == len(edges)  # every edge once in each direction: closed and oriented
    assert {(b, a) for a, b in forth} == forth
    assert len(ring.vertices) - len(edges) // 2 + len(ring.faces) == 0  # Euler's characteristic of a torus
    bent, axis = int(math.isinf(radius[0])), WALL + min(radius)
    across, along, up = ring.vertices[:, bent], ring.vertices[:, 1 - bent], ring.vertices[:, 2] - axis
    rho, phi = np.hypot(across, up), np.arctan2(across, up)
    inner = rho < 8.5
    assert rho[inner] == pytest.approx(7.0, abs=1e-6)
    seam = np.abs((np.degrees(phi) + 30.0 + 30.0) % 60.0 - 30.0) < 1e-6
    some = np.flatnonzero(~inner & ~seam)[::29]
    assert len(some) > 50
    assert rho[some] == pytest.approx(around(sides, radius, along[some], phi[some]), abs=1e-8)
    a, turn = np.linspace(-2.0, 2.0, 41), math.radians(0.75) * (np.arange(480) + 0.5)
    square = np.trapezoid(around(sides, radius, a[:, None], turn) ** 2 - 49.0, a, axis=0)
    assert ring.volume == pytest.approx(0.5 * square.mean() * 2.0 * math.pi, rel=1e-3)
    assert 0.01 < ring.step < 0.3


def test_edges_that_cross_at_a_mitre_leave_no_crossed_step():
    part, _ = ring_part((-10.0, INF))
    ring = ring_of(Panels.of(part, part.others), part.lens, 4)
    corners = ring.vertices.astype(np.float32)[ring.faces].astype(float)
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    turn = np.arctan2(corners[..., 0], corners[..., 2] - WALL + 10.0)
    mitre = (np.abs((np.degrees(turn) + 30.0 + 30.0) % 60.0 - 30.0) < 1e-4).all(1)
    assert 50 < mitre.sum() < 12 * 45
    assert np.linalg.norm(normal, axis=1).min() > 1e-7  # no triangle without area, in float32 either


def test_ring_is_milled_in_one_program(tmp_path):
    """All the way around: no relief is cut, roughing leaves its allowance, finishing the scallops but beside the mitres, in whose
    steps no ball fits."""
    radius = (-10.0, INF)
    part, sides = ring_part(radius, "gcode", 2.0)
    mill = Milling(path="rotary", tool_radius=1.5, scallop=0.25, roughing=0.8, stock=10.6)
    made = write_gcode(tmp_path / "ring.nc", part, mill)
    a, phi = np.linspace(-0.95, 0.95, 15), math.radians(1.5) * (np.arange(240) + 0.5) - math.pi
    surface, stock = around(sides, radius, a[:, None], phi), [np.full((15, 240), 10.6)]
    for kind, size, moves in tools_of(tmp_path / "ring.nc"):
        stock.append(swept(stock[-1], a, phi, kind, size, moves))
    assert (stock[1] - surface).min() > mill.allowance
    assert (stock[1] - surface).max() < mill.allowance + 0.8
    left, beside = stock[2] - surface, np.abs((np.degrees(phi) + 60.0) % 60.0 - 30.0) < 6.0
    assert left.min() > -2.0 * made["tolerance_mm"]
    assert left[:, ~beside].max() < 1.05 * mill.scallop
    assert made["turned_deg"] == 180.0
    field, heights = sides[0]  # the first panel as the program's own reader sees it, not what is cut behind the axis
    x, y = (c.ravel() for c in torch.meshgrid(*(torch.linspace(-r, r, 21).double() for r in (4.0, 0.9)), indexing="ij"))
    off = (cut_surface(tmp_path / "ring.nc", part.scene, field).at(None, x, y)[0] - field.at(heights, x, y)[0]).numpy()
    assert off.min() > -2.0 * made["tolerance_mm"]
    assert off.max() < 1.2 * mill.scallop


@pytest.mark.parametrize(
    ("how", "words"),
    [
        ({"across": 9.5}, "has 60 degrees, and these reach 57.84 around"),
        ({"order": (0, 0)}, "at least 3 panels"),
        ({"order": (0, 1) * 4}, "has 45 degrees, and these reach 61"),
    ],
)
def test_panels_that_do_not_close_are_refused(how, words):
    part, _ = ring_part((-10.0, INF), **how)
    with pytest.raises(InputError, match=re.escape(words)):
        Panels.of(part, part.others)


def test_command_writes_rings(tmp_path, monkeypatch, capsys):
    """Of equal panels and of two projects, and again where nothing has changed; and what does not go with a ring."""
    monkeypatch.chdir(tmp_path)
    write_blob(tmp_path / "blob.png")
    how = "--base-radius=-10,inf --entrance parallel --relief=-0.4,0 --mag 1.2 --throw 200 --lens-size 10x6 --start transport"
    few = "--control 16 --resolution 24 --iterations 1 --waves off --quiet"
    for name, more in (("a", ""), ("b", "--flip x"), ("c", "--index 1.6")):
        assert cli.run(["design", "blob.png", *f"{how} {few} {more} --out {name}.caustic".split()]) == 0
    capsys.readouterr()
    order = "b.caustic,a.caustic,b.caustic,a.caustic,b.caustic"
    for options in ("6 --format ply --samples 9x7", f"{order} --format stl --samples 9x7 --json"):
        assert cli.run(["export", "a.caustic", "--ring", *options.split()]) == 0
    said, found = capsys.readouterr().out.split("{", 1)
    assert "ring of 6 panels of 60 degrees and 9 x 7 points" in said
    ring = json.loads("{" + found)["ring"]
    count = int(np.frombuffer((tmp_path / "a.stl").read_bytes()[80:84], "<u4")[0])
    assert ring["triangles"] == count > 6 * 2 * 2 * 8 * 6  # two sides of 8 x 6 cells, and ends
    refused = {
        "6 --format step": "belongs to --format",
        "6 --format gcode": "--path rotary is needed",
        "6 --format 3mf --orientation up": "stands on its end",
        "6 --format stl --mould": "got a mould",
        "5 --format stl": "has 72 degrees",
        "1 --format stl": "at least 3 panels",
        "100000000 --format stl": "at most 360",
        "none.caustic --format stl": "none.caustic",
        "² --format stl": "²: is not a caustic project",
        "a.caustic,a.caustic,a.caustic,a.caustic,c.caustic --format stl": "same material",
    }
    for options, words in refused.items():
        assert cli.run(["export", "a.caustic", "--ring", *options.split()]) == 2
        assert words in capsys.readouterr().err


# light


def bent_by(d, normal, ratio):
    """Unit directions (N, 3) behind a surface with unit normals (N, 3) by Snell's law; ratio of the indices before and behind."""
    normal = normal * np.sign((d * normal).sum(1))[:, None]
    cosine = (d * normal).sum(1)[:, None]
    return ratio * d + (np.sqrt(1.0 - ratio**2 * (1.0 - cosine**2)) - ratio * cosine) * normal


def first_met(corners, normals, o, d):
    """Distances (N,) to the first triangle (T, 3, 3) that rays meet (Möller and Trumbore, 1997), and the unit normal there, (N, 3),
    between those of its corners (T, 3, 3)."""
    a, u, v = corners[:, 0], corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    far, found = np.full(len(o), INF), np.zeros((len(o), 3))
    for k in range(len(o)):
        p, s = np.cross(d[k], v), o[k] - a
        q, over = np.cross(s, u), (u * p).sum(1)
        over = 1.0 / np.where(over == 0.0, INF, over)
        b, c, t = (s * p).sum(1) * over, (q @ d[k]) * over, (v * q).sum(1) * over
        t = np.where((b >= -1e-9) & (c >= -1e-9) & (b + c <= 1.0 + 1e-9) & (t > 1e-6), t, INF)
        first = t.argmin()
        far[k] = t[first]
        found[k] = np.array([1.0 - b[first] - c[first], b[first], c[first]]) @ normals[first]
    return far, found / np.linalg.norm(found, axis=1)[:, None]


def smoothed(corners):
    """Normals (T, 3, 3) at the corners of triangles (T, 3, 3): means over those that share a corner, by their areas."""
    area = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    _, point = np.unique(corners.reshape(-1, 3), axis=0, return_inverse=True)
    total = np.zeros((point.max() + 1, 3))
    np.add.at(total, point.ravel(), np.repeat(area, 3, axis=0))
    return (total / np.linalg.norm(total, axis=1)[:, None])[point.ravel()].reshape(-1, 3, 3)


def landing_of(scene, heights, o, d):
    """Landing points (N, 2) of rays (N, 3) through a concentric inner side and a spline of SciPy, by Newton's method."""
    lens = scene.lens
    bent, axis, half = int(math.isinf(lens.offset.radius[0])), WALL + min(lens.offset.radius), np.array(lens.half_size)
    spline = NdBSpline(
        tuple(np.r_[np.zeros(3), np.linspace(0.0, 1.0, n - 2), np.ones(3)] for n in lens.control), heights.numpy(), 3
    )
    section = np.ones(3)
    section[1 - bent] = 0.0
    from_axis, across = (o - [0.0, 0.0, axis]) * section, d * section
    a, b, c = (across**2).sum(1), (from_axis * across).sum(1), (from_axis**2).sum(1) - (min(lens.offset.radius) + WALL) ** 2
    o = o + ((np.sqrt(b * b - a * c) - b) / a)[:, None] * d
    normal = (o - [0.0, 0.0, axis]) * section
    d = bent_by(d, normal / np.linalg.norm(normal, axis=1)[:, None], 1.0 / lens.index)

    def at(x, nu=(0, 0)):
        return spline(0.5 * (x / half + 1.0), nu=nu) / np.prod((2.0 * half) ** np.array(nu))

    t = np.full(len(o), WALL)
    for _ in range(30):
        x = o[:, :2] + t[:, None] * d[:, :2]
        slopes = at(x, (1, 0)), at(x, (0, 1))
        t = t - (o[:, 2] + t * d[:, 2] - at(x)) / (d[:, 2] - slopes[0] * d[:, 0] - slopes[1] * d[:, 1])
    o = o + t[:, None] * d
    normal = np.stack([-at(o[:, :2], (1, 0)), -at(o[:, :2], (0, 1)), np.ones(len(o))], 1)
    d = bent_by(d, normal / np.linalg.norm(normal, axis=1)[:, None], lens.index)
    return (o + ((scene.screen.z - o[:, 2]) / d[:, 2])[:, None] * d)[:, :2]


def about(bent, angle, axis, points):
    """Points (N, 3) turned about the ring's axis, from z towards the coordinate with curvature."""
    found, up = points.copy(), points[:, 2] - axis
    found[:, bent] = points[:, bent] * math.cos(angle) + up * math.sin(angle)
    found[:, 2] = axis + up * math.cos(angle) - points[:, bent] * math.sin(angle)
    return found


@pytest.mark.parametrize("radius", [(-10.0, INF), (INF, -10.0)])
def test_every_panel_of_a_file_throws_the_picture_of_its_design(radius, tmp_path):
    """A lamp on the axis: its rays through the triangles of the STL file, smoothed, land as those of the panel by itself, turned
    with it, through SciPy's spline and a concentric inner side, and not as those of the other panel.  Finer triangles, nearer."""
    part, sides = ring_part(radius)
    ring = ring_of(Panels.of(part, part.others), part.lens, 10)
    write_mesh(tmp_path / "ring.stl", ring.vertices, ring.faces)
    record = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("rest", "<u2")])
    corners = np.frombuffer((tmp_path / "ring.stl").read_bytes()[84:], record)["corners"].astype(float)
    normals, count = smoothed(corners), 10
    bent, axis, rng = int(math.isinf(radius[0])), WALL + min(radius), np.random.default_rng(5)
    o, d = np.tile([0.0, 0.0, axis], (count, 1)), np.ones((count, 3))
    d[:, bent], d[:, 1 - bent] = rng.uniform(-0.45, 0.45, count), rng.uniform(-0.12, 0.12, count)
    d /= np.linalg.norm(d, axis=1)[:, None]
    scene = replace(part.scene, source=Points(((0.0, 0.0, axis),)))
    for k in (0, 1, 5):
        turn = math.radians(60.0 * k)
        p, end = (about(bent, turn, axis, points) for points in (o, o + d))
        way = end - p
        for ratio in (1.0 / 1.49, 1.49):
            t, normal = first_met(corners, normals, p, way)
            p, way = p + t[:, None] * way, bent_by(way, normal, ratio)
        p, end = (about(bent, -turn, axis, points) for points in (p, p + way))
        found = (p + ((scene.screen.z - p[:, 2]) / (end - p)[:, 2])[:, None] * (end - p))[:, :2]
        own, other = (np.sqrt(((found - landing_of(scene, sides[j][1], o, d)) ** 2).mean()) for j in (ORDER[k], 1 - ORDER[k]))
        assert own < 0.4 and other > 5.0
