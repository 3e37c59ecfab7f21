"""Machining around an axis: roughing in four axes and rings of panels, by a simulation of the swept tools in closed form.

The stock is the radius along rays from the axis, at places along it and angles.  A ray e(phi) meets a ball with its centre at rho
e(theta), its place da away along the axis, at r = rho cos(phi - theta) - sqrt(R^2 - da^2 - rho^2 sin^2(phi - theta)), and the flat
end of a tool at r = Z / cos(phi - theta), if that is within its disc.
"""

import math
import re
from dataclasses import replace

import numpy as np
import pytest
import torch

from caustic_cli.export.milling import Milling
from caustic_cli.export.milling.gcode import write_gcode
from caustic_cli.export.part import part_of
from caustic_cli.optics.parallel import parallel_side
from caustic_cli.optics.surfaces import HeightField
from caustic_cli.scene import Lens, Offset, PlaneWave, Scene, Screen

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
    """Distances of the surface from the axis, mm, at places a and angles phi: (n, m), by bisection along rays."""
    shape = len(a), len(phi)
    a, phi = (c.ravel() for c in np.meshgrid(a, phi, indexing="ij"))
    low, high = np.full(len(a), 0.5 * abs(axis)), np.full(len(a), 2.0 * abs(axis))
    for _ in range(60):
        r = 0.5 * (low + high)
        across = torch.from_numpy(r * np.sin(phi))
        xy = (across, torch.from_numpy(a)) if bent == 0 else (torch.from_numpy(a), across)
        below = r * np.cos(phi) + axis < field.at(heights, *xy, [(0, 0)])[0].numpy()
        low, high = np.where(below, r, low), np.where(below, high, r)
    return r.reshape(shape)


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
    surface = relief(field, heights, axis, a[own], phi[own], bent)
    left, slope, apart = stock[1][own, own] - surface, 0.6, 0.5 * mill.rough_radius
    between = apart * slope if how["roughing_tool"] == "flat" else apart**2 / 8.0 * (1.0 / mill.rough_radius + 1.0 / 20.0)
    assert left.min() > allowance
    assert left.max() < allowance + step + between
    assert left.mean() < allowance + between  # it follows the relief, not the layers
    finished = stock[2][own, own] - surface
    assert finished.min() > -2.0 * made["tolerance_mm"]
    assert finished.max() < 0.1
    assert (stock[1] - stock[2]).max() < allowance + step + between
