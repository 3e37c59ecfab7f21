"""Photographs of parts in scenes of all kinds, judged by a tracer and a camera of their own.

Each scene has the same designed surface, whose picture need not be sharp in it: what is inferred is the deviation of the part.
"""

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from helpers import write_blob
from PIL import Image

from caustic_cli import cli, load
from caustic_cli.errors import InputError
from caustic_cli.optics.surfaces.heightfield import HeightField
from caustic_cli.scene import Component, Disc, FreeForm, Light, PlaneWave, Points, Screen
from caustic_cli.scene.gradient import Gradient
from caustic_cli.scene.light import RGB
from caustic_cli.scene.sources.rays import Measured
from caustic_cli.scene.sources.rayset import RaySet
from caustic_cli.scene.sources.several import Several
from caustic_cli.studies.photograph import inference
from caustic_cli.studies.photograph.card import marks_of_card
from caustic_cli.studies.photograph.comparison import surfaces
from caustic_cli.workflow import correction, photographs
from caustic_cli.workflow.reporter import Listener

sys.path.insert(0, str(Path(__file__).parent / "independent"))
from photographs import form_error, landed, landed_from, lattice, leaving, photographed, refracted, surface_at

LENGTH, RMS = 5.0, 1e-3
NONE = ((), ())
RAYS = 700
USUAL = ["--waves", "off", "--quiet"]
#: Linear R, G, B of sRGB of light of 611.4, 549.1 and 464.3 nm by the CIE 1931 observer, over the largest of each, columns.
SEEN = np.array([[1.0, -0.117, -0.031], [-0.019, 1.0, -0.031], [-0.018, -0.116, 1.0]])


@pytest.fixture(scope="module")
def lens(tmp_path_factory):
    """A lens of 10 mm for a picture without symmetry on 64 x 64 pixels of a screen of 30 mm at 300 mm."""
    home = tmp_path_factory.mktemp("photograph")
    x, y = np.meshgrid(np.linspace(-1, 1, 96), np.linspace(-1, 1, 96), indexing="ij")
    light = 0.25 + 0.75 * np.exp(-((x + 0.4) ** 2 + (y - 0.35) ** 2) / 0.08)
    light += 0.5 * ((np.abs(x - 0.3) < 0.35) & (np.abs(y + 0.5) < 0.12))
    np.save(home / "picture.npy", light)
    how = ["--mag", "3", "--resolution", "64", "--control", "35", "--iterations", "15", "--rays", "100000"]
    assert cli.run(["design", str(home / "picture.npy"), *how, *USUAL, "-o", str(home / "lens.caustic")]) == 0
    return load(home / "lens.caustic")


def onto_plane(point, direction, z):
    """x and y, mm, of rays on a plane."""
    far = (z - point[2]) / direction[2]
    return point[0] + far * direction[0], point[1] + far * direction[1]


def straight(lens, error, index=None):
    """Rays of a plane wave behind the part."""
    x, y = lattice(lens, RAYS)
    start, ahead = np.stack([x, y, 0.0 * x]), np.stack([0.0 * x, 0.0 * x, 1.0 + 0.0 * x])
    return leaving(lens, lens.heights, error, start, ahead, index or lens.scene.lens.index)


def behind_a_plate(lens, error):
    """Through a plane-parallel plate of 20 mm and index 1.6, which displaces light."""
    point, ahead = straight(lens, error)
    x, y = onto_plane(point, ahead, lens.scene.screen.z - 20.0)
    inside = 1.0 / np.sqrt(1.6**2 - ahead[0] ** 2 - ahead[1] ** 2)
    return x + 20.0 * inside * ahead[0], y + 20.0 * inside * ahead[1]


def by_directions(lens, error):
    """In the far field: direction cosines, mrad."""
    _, ahead = straight(lens, error)
    return 1e3 * ahead[0], 1e3 * ahead[1]


RADIUS = 45.0


def onto_a_sphere(lens, error):
    """On a sphere about a point in front of the screen, and power by its area."""
    point, ahead = straight(lens, error)
    away = point - np.array([0.0, 0.0, lens.scene.screen.z + RADIUS])[:, None]
    b = (away * ahead).sum(0)
    t = -b - np.sqrt(b * b - (away * away).sum(0) + RADIUS**2)  # the near side
    x, y, _ = point + t * ahead
    return x, y, np.sqrt(1.0 - (x * x + y * y) / RADIUS**2)


def with_gradient(lens, error):
    """An index that grows along the axis, which light along it does not notice before it leaves."""
    return onto_plane(*straight(lens, error, lambda p: lens.scene.lens.index + 0.004 * p[2]), lens.scene.screen.z)


def behind_a_curved_entrance(lens, error):
    """A plane wave refracted by a paraboloid of radius 400 mm."""
    (x, y), n = lattice(lens, RAYS), lens.scene.lens.index
    slope = np.stack([-x / 400.0, -y / 400.0, 1.0 + 0.0 * x])
    inside = refracted(np.stack([0.0 * x, 0.0 * x, 1.0 + 0.0 * x]), slope / np.linalg.norm(slope, axis=0), 1.0 / n)
    start = np.stack([x, y, (x * x + y * y) / 800.0])
    point, ahead = leaving(lens, lens.heights, error, start, inside, n)
    within = (np.abs(point[:2]) < 5.0).all(0)
    return *onto_plane(point, ahead, lens.scene.screen.z), within.astype(float)


def paraboloid(radius):
    """The surface r^2 / 2 R over the aperture as a spline, of which it is one exactly."""
    square = np.array([25.0, -25.0, 25.0])  # control points of x^2 over [-5, 5], by its blossom
    return FreeForm((square[:, None] + square[None, :]) / (2.0 * radius), (2, 2))


def two_points(lens, error):
    parts = [landed_from(lens, lens.heights, error, point=(x, 0.0, -2000.0)) for x in (-12.0, 20.0)]
    return tuple(np.concatenate(c) for c in zip(*parts, strict=True))


def sun_and_beam(lens, error):
    """A plane wave, and the sun with twice its power."""
    x, y, power = landed_from(lens, lens.heights, error, angle=0.265)
    px, py = landed(lens, lens.heights, error, rays=600)
    parts = (x, px), (y, py), (2.0 * power / power.sum(), np.full(len(px), 1.0 / len(px)))
    return tuple(np.concatenate(c) for c in parts)


def rays_of_a_file():
    """A plane wave as the rays of a file."""
    places = np.random.default_rng(0).uniform(-5.0, 5.0, (400_000, 2))
    ahead = np.tile([0.0, 0.0, 1.0], (len(places), 1))
    return Measured(RaySet(np.column_stack([places, np.full(len(places), -1.0)]), ahead, np.ones(len(places))), (0.0, 0.0, 0.0))


def arrayed(lens):
    """2 x 2 lenslets, each the surface in half its size, mirrored into its neighbours so that edges meet."""
    own = replace(lens.scene.lens, array=(2, 2), control=(67, 67))
    field = HeightField.of(own)
    x, y = (c.numpy() for c in field.control_xy())
    folded = [2.0 * np.abs(c) - 5.0 for c in (x, y)]
    order = [np.argsort(c, kind="stable") for c in folded]
    values = np.empty((len(x), len(y)))
    values[np.ix_(*order)] = surface_at(lens.field, lens.heights, *(np.sort(c) for c in folded))[0]
    values = values.mean() + 0.5 * (values - values.mean())
    return replace(lens, scene=replace(lens.scene, lens=own), field=field, heights=field.interpolated(torch.from_numpy(values)))


def of(**changes):
    return lambda lens: replace(lens, scene=replace(lens.scene, **changes))


def of_lens(**changes):
    return lambda lens: replace(lens, scene=replace(lens.scene, lens=replace(lens.scene.lens, **changes)))


def curved(lens):
    return replace(lens, scene=replace(lens.scene, screen=replace(lens.scene.screen, radius=(RADIUS, RADIUS))))


#: Each scene: how a lens gets it, where light lands there, (x, y) or with its power, mm; and by how large a part of the deviation's
#: RMS what is inferred may be off: by more where light of several places of the part falls onto each other, or in noise.
SCENES = {
    "other elements": (of(elements=(Component(60.0, (60.0, 60.0), thickness=20.0, index=1.6),)), behind_a_plate, 0.15),
    "far field": (of(screen=Screen((100.0, 100.0), 1000.0, (64, 64), far=True)), by_directions, 0.15),
    "curved screen": (curved, onto_a_sphere, 0.15),
    "gradient index": (of_lens(gradient=Gradient("axial", (0.004,))), with_gradient, 0.15),
    "curved entrance": (of_lens(entrance=paraboloid(400.0)), behind_a_curved_entrance, 0.15),
    "lenslets": (arrayed, lambda lens, error: onto_plane(*straight(lens, error), lens.scene.screen.z), 0.5),
    "separate places": (of(source=Points(((-12.0, 0.0, -2000.0), (20.0, 0.0, -2000.0)))), two_points, 0.4),
    "several sources": (of(source=Several((PlaneWave(1.0), Disc(power=2.0, angle=0.53)), (NONE, NONE))), sun_and_beam, 0.2),
    "ray file": (of(source=rays_of_a_file()), lambda lens, error: landed(lens, lens.heights, error, rays=RAYS), 0.4),
}


def photographed_part(lens, light, **how):
    """Write wall.jpg, and marks.csv with errors of a twentieth of a pixel."""
    data, project = photographed(lens, lens.heights, None, light=light, size=(450, 400), blur=0.8, **how)
    Path("wall.jpg").write_bytes(data)
    known, screen = marks_of_card(), lens.scene.screen
    pixels = np.stack(project(*known.T), 1) + 0.05 * np.random.default_rng(1).standard_normal(known.shape)
    places = known * np.array(screen.half_size) + np.array(screen.shift)
    np.savetxt("marks.csv", np.concatenate([pixels, places], 1), delimiter=",")


@pytest.mark.parametrize("name", SCENES)
def test_a_part_is_judged_in_scenes_of_all_kinds(name, lens, tmp_path, monkeypatch):
    """The inferred surface is the true one, within what is said of it."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(inference, "LEVELS", ((32, 6, 1.0, 4), (48, 8, 1.0, 5)))
    monkeypatch.setattr(photographs, "RAYS", 120)
    change, light, close = SCENES[name]
    other, error = change(lens), form_error(5.0, RMS, LENGTH, 3)
    how = {}
    if other.scene.screen.curved:
        rx = other.scene.screen.half_size[0]
        sag = lambda X, Y: (RADIUS - np.sqrt(RADIUS**2 - rx * rx * (X * X + Y * Y))) / rx  # noqa: E731
        how = {"sag": sag, "lift": (30.0, 25.0, 0.12)}
    photographed_part(other, light(other, error), **how)
    found = photographs.judge(other, photographs.shots([Path("wall.jpg")], "marks.csv"), Listener())
    off = surfaces(found.found)[1] - error
    assert found.found.explained > (0.97 if name == "ray file" else 0.998)
    assert off.std() < close * RMS and off.std() < 3.0 * found.found.uncertainty()
    words = " ".join(found.figures["part"]["not_told_apart"])
    assert ("other surfaces" in words) == (name in ("other elements", "curved entrance"))


def bk7(um):
    """Index of N-BK7 by the dispersion formula of its maker (Schott, optical glass data sheets, 2017)."""
    B, C = (1.03961212, 0.231792344, 1.01046945), (0.00600069867, 0.0200179144, 103.560653)
    return float(np.sqrt(1 + sum(b * um**2 / (um**2 - c) for b, c in zip(B, C, strict=True))))


def coloured(lens):
    """The lens of N-BK7 in light of three colours."""
    own = replace(lens.scene.lens, glass="BK7")
    scene = replace(lens.scene, lens=own, light=Light(wavelengths=RGB, color=True))
    return replace(lens, scene=scene, target=np.stack([lens.target] * 3) / 3.0)


def test_a_photograph_in_colour_is_one_in_each_colour(lens, tmp_path, monkeypatch):
    """The camera's red, green and blue are those of sRGB, in which lines mix; the index is that of the maker's formula in each."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(inference, "LEVELS", ((32, 6, 1.0, 4), (48, 8, 1.0, 4)))
    monkeypatch.setattr(photographs, "RAYS", 90)
    other, error = coloured(lens), form_error(5.0, RMS, LENGTH, 3)
    each = [landed(lens, lens.heights, error, rays=500, index=bk7(1e-3 * w)) for w in RGB]
    photographed_part(other, [(x, y, np.ones_like(x)) for x, y in each], colours=SEEN, gamma=2.2)
    shot = photographs.shots([Path("wall.jpg")], "marks.csv", color=True)
    found = photographs.judge(other, shot, Listener())
    off = surfaces(found.found)[1] - error
    assert found.channels == (0, 1, 2) and found.of_first.shape == (3, 64, 64)
    assert [f["file"] for f in found.figures["others"]] == ["wall.jpg (green)", "wall.jpg (blue)"]
    assert found.found.explained > 0.998 and off.std() < 0.2 * RMS and off.std() < 3.0 * found.found.uncertainty()
    scale, sigma = found.found.scale
    assert abs(scale - 1.0) < 3.0 * sigma
    Image.open("wall.jpg").convert("L").save("grey.png")
    with pytest.raises(InputError, match="has no colours"):
        photographs.shots([Path("grey.png")], color=True)


def behind_a_free_entrance(two, error):
    """A plane wave refracted by a free-form entrance and an exit."""
    lens, x = two.scene.lens, (2.0 * (np.arange(RAYS) + 0.5) / RAYS - 1.0) * 5.0
    z, zx, zy = surface_at(two.field, torch.from_numpy(lens.entrance.heights), x, x)
    normal = np.stack([-zx, -zy, np.ones_like(z)]) / np.sqrt(1.0 + zx * zx + zy * zy)
    inside = refracted(np.broadcast_to([[[0.0]], [[0.0]], [[1.0]]], normal.shape), normal, 1.0 / lens.index)
    start = np.stack([*np.meshgrid(x, x, indexing="ij"), lens.z_in + z])
    point, ahead = leaving(two, two.heights, error, start.reshape(3, -1), inside.reshape(3, -1), lens.index)
    within = (np.abs(point[:2]) < 5.0).all(0)
    return *onto_plane(point, ahead, two.scene.screen.z), within.astype(float)


def test_a_lens_with_two_free_sides_is_corrected_by_its_exit(tmp_path, monkeypatch):
    """A deviation of the exit of a collimating lens: the exit alone is changed, by its negative."""
    monkeypatch.chdir(tmp_path)
    write_blob(tmp_path / "blob.png")
    how = ["--collimate", "--resolution", "32", "--control", "19", "--iterations", "5", "--rays", "20000", "--throw", "100"]
    assert cli.run(["design", "blob.png", *how, *USUAL, "-o", "two.caustic"]) == 0
    two, error = load("two.caustic"), form_error(5.0, 3.0 * RMS, LENGTH, 3)
    monkeypatch.setattr(inference, "LEVELS", ((32, 6, 1.0, 4),))
    monkeypatch.setattr(photographs, "RAYS", 64)
    photographed_part(two, behind_a_free_entrance(two, error))
    found = photographs.judge(two, photographs.shots([Path("wall.jpg")], "marks.csv"), Listener())
    every = correction.corrected_heights(two.project, two, found, "cpu")
    assert every.shape == two.state.heights.shape and (every[0] == two.state.heights[0]).all()
    at = np.linspace(-5.0, 5.0, error.shape[0])
    moved = surface_at(two.field, every[1] - two.heights, at, at)[0]
    assert (moved + error).std() < 0.5 * error.std()
