"""Arrays of lamps on a board: one part, whose light is that of all."""

import json
import math
from pathlib import Path

import numpy as np
import pytest
import torch
from helpers import edges_of, read_step, step_in_opencascade

from caustic_cli import cli
from caustic_cli.errors import InputError
from caustic_cli.export.lamp import lamp_mesh
from caustic_cli.export.lamp_mitsuba import plane_of, write_lamp_mitsuba
from caustic_cli.export.lamp_step import write_lamp_step
from caustic_cli.io.photometry import read_photometry
from caustic_cli.optics.lamp import LampLight, emissions, through
from caustic_cli.optics.lamp_array import among, clear_pitch, meets_neighbour
from caustic_cli.optics.surfaces.polarfield import PolarField
from caustic_cli.scene.lamp import Chip, Goal, Lamp
from caustic_cli.studies.lamp import lamp_image
from caustic_cli.studies.lamp_verify import _emitted, verify_lamp
from caustic_cli.workflow.lamp import warnings

FIELD = PolarField.uniform((12, 9), (3, 4))
NOISE = torch.randn(FIELD.shape, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
VALUES = FIELD.sphere(12.0) * (0.05 * NOISE).exp()
#: Lamp, and points of a ring.
ARRAYS = {
    "row": (Lamp(base=2.0, array=(3, 1), pitch=(34.0, 34.0), flange=3.0), 12),
    "oblong": (Lamp(base=2.0, array=(2, 3), pitch=(34.0, 40.0)), 60),
    "square": (Lamp(base=1.0, array=(2, 2), pitch=(34.0, 34.0), flange=1.0), 64),
    "flat": (Lamp(base=1.0, array=(2, 1), pitch=(34.0, 34.0), flat=0.5), 20),
}


def volume(vertices, faces):
    """Signed volume of a closed mesh."""
    a, b, c = vertices[faces].transpose(1, 0, 2)
    return float((np.cross(a, b) * c).sum() / 6.0)


# The part


@pytest.mark.parametrize("name", ARRAYS)
def test_the_mesh_is_one_closed_body_of_the_volume_of_lamps_and_board(name):
    lamp, around = ARRAYS[name]
    points, faces = lamp_mesh(lamp, FIELD, VALUES, (20, around))
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    seen = {tuple(edge) for edge in edges.tolist()}
    assert len(seen) == len(edges) and all((b, a) in seen for a, b in seen)
    half = lamp.board
    opening = 0.5 * around * math.sin(2.0 * math.pi / around) * lamp.inner**2  # a polygon
    own = volume(*lamp_mesh(Lamp(flat=lamp.flat), FIELD, VALUES, (20, around)))
    assert volume(points, faces) == pytest.approx(lamp.count * own + lamp.base * (4.0 * half[0] * half[1] - lamp.count * opening))
    assert np.abs(points[:, :2]).max(0) == pytest.approx(half) and points[:, 2].min() == -lamp.base


def test_rings_of_an_array_have_points_that_adjoin():
    with pytest.raises(InputError, match="a multiple of 4 points"):
        lamp_mesh(ARRAYS["square"][0], FIELD, VALUES, (20, 61))


@pytest.mark.parametrize("name", ARRAYS)
def test_the_step_file_is_one_closed_shell(name, tmp_path):
    lamp, _ = ARRAYS[name]
    write_lamp_step(tmp_path / "a.step", lamp, FIELD, VALUES)
    entities = read_step(tmp_path / "a.step")
    assert edges_of(entities) == 8 * lamp.count + 12  # rims and openings of two curves, with two posts; and a box
    assert sum(body.startswith("ADVANCED_FACE") for body in entities.values()) == 4 * lamp.count + 6
    assert sum(body.startswith("MANIFOLD_SOLID_BREP") for body in entities.values()) == 1


def test_step_in_opencascade(tmp_path):
    """Only where OpenCASCADE (cadquery-ocp) is installed."""
    pytest.importorskip("OCP.STEPControl", exc_type=ImportError)
    from OCP.Geom import Geom_BSplineSurface  # noqa: PLC0415

    lamp, _ = ARRAYS["oblong"]
    write_lamp_step(tmp_path / "a.step", lamp, FIELD, VALUES)
    surfaces, mass = step_in_opencascade(tmp_path / "a.step")
    assert mass() == pytest.approx(volume(*lamp_mesh(lamp, FIELD, VALUES, (200, 800))), rel=1e-4)
    rng = np.random.default_rng(2)
    u, v = (torch.from_numpy(c) for c in rng.uniform(-0.6, 0.6, (2, 100)))
    outer = np.stack(FIELD.points(VALUES, u, v), 1)
    found = [s for s in surfaces if isinstance(s, Geom_BSplineSurface)][::2]
    assert len(found) == lamp.count
    for surface, place in zip(found, lamp.places, strict=True):
        points = [surface.Value(0.5 * (a + 1.0), 0.5 * (b + 1.0)) for a, b in zip(u.tolist(), v.tolist(), strict=True)]
        seen = np.array([(p.X(), p.Y(), p.Z()) for p in points])
        assert np.abs(seen - outer - np.append(place, 0.0)).max() < 1e-9


def test_a_scene_for_mitsuba_has_all_chips(tmp_path):
    lamp = Lamp(Chip("disc", (2.0, 1.0)), base=2.0, array=(2, 3), pitch=(34.0, 40.0))
    write_lamp_mitsuba(tmp_path / "a.xml", lamp, Goal((3000.0, 3000.0), 1000.0), FIELD, VALUES, (9, 9), (5, 20))
    text = (tmp_path / "a.xml").read_text()
    assert text.count("<emitter") == 6 and text.count("translate") >= 6
    radiance = float(text.split('name="radiance" value="')[1].split('"')[0])
    assert 6 * radiance * math.pi * math.pi * 2.0 * 1.0 / 4.0 == pytest.approx(1.0)
    origin, _ = _emitted(lamp, 60_000, np.random.default_rng(1))
    cells = np.unique(np.rint((origin[:2].T - lamp.places.min(0)) / lamp.pitch), axis=0, return_counts=True)
    assert len(cells[0]) == 6 and cells[1].min() > 9500


def test_mitsuba_agrees(tmp_path):
    """Only where Mitsuba is installed: light of all lamps, without that which meets another lens."""
    pytest.importorskip("mitsuba", exc_type=ImportError)
    lamp = Lamp(Chip("rectangle", (1.0, 2.0)), base=2.0, array=(2, 1), pitch=(31.0, 31.0))
    for goal in (Goal((900.0, 600.0), 400.0), Goal((160.0, 100.0))):
        write_lamp_mitsuba(tmp_path / "a.xml", lamp, goal, FIELD, VALUES, (24, 16), (300, 1200), dark=True)
        found = verify_lamp(tmp_path / "a.xml", lamp, plane_of(goal, lamp.radius), FIELD, VALUES, (24, 16), 100_000)
        assert found.agree and 0.8 < found.figures["z_mean_square"] < 1.2, found.figures


# Its light


def test_light_is_lost_to_those_neighbours_that_it_meets():
    """Against the exact intersections with spheres."""
    lamp = Lamp(base=2.0, array=(3, 2), pitch=(31.0, 33.0))
    rng = np.random.default_rng(3)
    z, turn = 0.3 * rng.uniform(size=20_000), 2.0 * math.pi * rng.uniform(size=20_000)
    sine = np.sqrt(1.0 - z * z)
    d = np.stack([sine * np.cos(turn), sine * np.sin(turn), z], 1)
    start = 12.0 * d  # on a sphere about the own chip
    which = rng.integers(6, size=len(d))
    torched = [tuple(torch.from_numpy(c).unbind(1)) for c in (start, d)]
    one = torch.ones(len(d), dtype=torch.float64)
    light = LampLight(*torched, one, {}, one)
    found = meets_neighbour(lamp, FIELD, FIELD.sphere(12.0), light, torch.from_numpy(which)).numpy()
    expected = np.zeros(len(d), dtype=bool)
    chord = np.zeros(len(d))
    for k, place in enumerate(lamp.places):
        o = start + np.append(lamp.places[which] - place, np.zeros((len(d), 1)), 1)
        along = (o * d).sum(1)
        square = along**2 - (o * o).sum(1) + 144.0
        meets = (which != k) & (square > 0) & (along < 0)
        expected |= meets
        chord = np.where(meets, np.maximum(chord, 2.0 * np.sqrt(square.clip(0.0))), chord)
    assert 0.05 < expected.mean() < 0.6
    assert not (found & ~expected).any() and (found == expected)[(chord == 0) | (chord > 1.5)].all()


def test_the_light_of_an_array_is_that_of_one_displaced_and_none_is_lost():
    lamp = Lamp(base=2.0, array=(2, 2), pitch=(34.0, 36.0))
    (rays,) = emissions(lamp.chip, 40_000, 1)
    alone = through(lamp, FIELD, rays, VALUES)
    light = among(lamp, FIELD, VALUES, alone, np.random.default_rng(1))
    moved = torch.stack(light.point, 1)[:, :2] - torch.stack(alone.point, 1)[:, :2]
    assert {tuple(place) for place in moved.round(decimals=6).tolist()} == {tuple(place) for place in lamp.places.tolist()}
    total = sum(float(part.sum()) for part in (light.power, *light.lost.values()))
    assert total == pytest.approx(1.0, abs=1e-12) and float(light.lost["neighbours"].sum()) > 0.0
    goal = Goal((400.0, 400.0), 100.0)
    found = lamp_image(lamp, goal, FIELD, VALUES, (40, 40), rays=40_000)
    assert found.image.sum() + math.fsum(found.lost.values()) == pytest.approx(1.0, abs=1e-12)
    one = lamp_image(Lamp(), goal, FIELD, VALUES, (40, 40), rays=40_000)
    assert "neighbours" not in one.lost
    assert np.ptp(found.image.sum(1)) < np.ptp(one.image.sum(1))  # wider


@pytest.mark.parametrize("format", ["ies", "ldt"])
def test_an_array_is_designed_and_its_photometric_file_holds_the_light_of_all(format, tmp_path, monkeypatch, capfd):
    monkeypatch.chdir(tmp_path)
    given = ["--lamp", "15", "--angles", "100x60", "--quiet", "--json"]
    lights = {}
    for name, more in (("one", []), ("many", ["--array", "3x2"])):
        assert cli.run(["design", "uniform", *given, *more, "-o", name]) == 0
        figures = json.loads(capfd.readouterr().out)
        assert cli.run(["export", name, "--format", format, "--quiet", "--json"]) == 0
        found = json.loads(capfd.readouterr().out)
        lights[name] = read_photometry(Path(found["file"])), figures, found
    one, many = (light[0] for light in lights.values())
    assert many.lumens == 6.0 * one.lumens and many.diameter > one.diameter
    assert many.values.max() == pytest.approx(6.0 * one.values.max(), rel=0.15)
    assert lights["many"][1]["lost"]["neighbours"] < 0.02 and lights["many"][2]["peak_candela"] == pytest.approx(
        many.values.max() / 6.0, rel=1e-5
    )
    assert lights["many"][1]["of_source"] == pytest.approx(lights["one"][1]["of_source"], abs=0.02)
    assert "pitch = [32.0, 32.0]" in Path("many/project.toml").read_text() and "pitch" not in Path("one/project.toml").read_text()


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--pitch", "40"], "--pitch belongs to an array of lamps"),
        (["--array", "3", "--pitch", "20"], "--pitch must be greater than twice --lamp, 30 mm"),
        (["--array", "30x30"], "holds 1 to 400 lamps"),
        (["--array", "2", "--lamp-base", "0"], "the board that holds an array"),
    ],
)
def test_an_array_that_is_none_is_refused_in_one_line(options, words, tmp_path, monkeypatch, capfd):
    monkeypatch.chdir(tmp_path)
    assert cli.run(["design", "uniform", "--lamp", "15", "--angles", "60", *options, "--quiet"]) == 2
    (line,) = capfd.readouterr().err.splitlines()
    assert words in line and not list(Path().iterdir())


def test_beyond_the_clear_pitch_all_light_for_the_picture_passes():
    goal, lamp = Goal((30e3, 10e3), 8e3, (0.0, 2e3)), Lamp()
    turn = torch.linspace(-0.5 * math.pi, 0.5 * math.pi, 4001, dtype=torch.float64)
    outer = FIELD.sphere(lamp.radius)
    for axis, tangent in ((0, 15.0 / 8.0), (1, 7.0 / 8.0)):
        d, zero = [torch.zeros_like(turn), torch.zeros_like(turn), torch.full_like(turn, math.cos(math.atan(tangent)))], 0.0 * turn
        d[axis] = torch.full_like(turn, math.sin(math.atan(tangent)))
        point = [zero, zero, lamp.radius * torch.cos(turn)]
        point[axis] = lamp.radius * torch.sin(turn)
        light = LampLight(tuple(point), tuple(d), torch.ones_like(turn), {}, zero)
        pitch = clear_pitch(lamp, goal)[axis]
        for scale, blocked in ((1.001, False), (0.99, True)):
            array = Lamp(base=2.0, array=(2, 2), pitch=(scale * pitch,) * 2)
            found = meets_neighbour(array, FIELD, outer, light, torch.zeros(len(turn), dtype=torch.long))
            assert bool(found.any()) is blocked


def test_shadows_of_neighbours_are_told_in_one_line():
    lamp, goal = Lamp(base=2.0, array=(4, 4), pitch=(32.0, 32.0)), Goal((30e3, 10e3), 8e3)
    (words,) = warnings(lamp, goal, {"lost": {"neighbours": 0.013}})
    assert "1.3% of the light meets the lens of a neighbour" in words and "47 x 33 mm" in words
    assert not [*warnings(lamp, goal, {"lost": {"neighbours": 0.0007}}), *warnings(lamp, goal, {"lost": {}})]
