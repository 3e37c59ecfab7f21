"""Screens that are part of a room: geometry against plain vectors, pictures as a person sees them, and what is refused."""

import json
import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from helpers import write_blob

from caustic_cli import cli
from caustic_cli.config import settings
from caustic_cli.errors import InputError
from caustic_cli.inverse.projection import seen_by_light, stretching_surface
from caustic_cli.optics.emission import rays_of
from caustic_cli.optics.emission.coherent import modes, spots
from caustic_cli.optics.spread import spread_at
from caustic_cli.optics.surfaces import HeightField
from caustic_cli.optics.trace import expose
from caustic_cli.scene import Disc, Lens, Offset, PlaneWave, Scene, Screen
from caustic_cli.scene.room import Room
from caustic_cli.scene.room_screen import placed
from caustic_cli.scene.screen import tilt_to, tilted

SOUTH = Room()


def axes(placement, room=SOUTH) -> np.ndarray:
    """x, y and the normal of a screen as (east, north, up)."""
    return np.array([room.to_room(axis) for axis in tilted(placement.tilt)])


def centre(placement, room=SOUTH) -> np.ndarray:
    return np.array(room.to_room((*placement.shift, placement.z)))


def light(down: float, aside: float = 0.0, room=SOUTH) -> tuple[float, float, float]:
    """Light that goes down and to the east of north, degrees, in the lens' frame."""
    d, a = math.radians(down), math.radians(aside)
    return room.to_lens((math.sin(a) * math.cos(d), math.cos(a) * math.cos(d), -math.sin(d)))


def test_a_floor():
    """Who stands in the room and looks south, to the window, has the top of the picture towards it and its right in the west."""
    found = placed("floor:1000", SOUTH, light(40.0, 10.0), 1)
    assert axes(found) == pytest.approx(np.array([[-1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [0.0, 0.0, 1.0]]), abs=1e-9)
    way = 1000.0 / math.tan(math.radians(40.0))
    aside = math.radians(10.0)
    assert centre(found) == pytest.approx([way * math.sin(aside), way * math.cos(aside), -1000.0], abs=1e-6)
    other = placed("floor:1000,90", SOUTH, light(40.0), 1)  # its top in the east: seen from the west
    assert axes(other) == pytest.approx(np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]), abs=1e-9)


def test_walls_and_a_ceiling():
    opposite = placed("wall:2000", SOUTH, light(20.0), 1)
    assert axes(opposite) == pytest.approx(np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]]), abs=1e-9)
    assert centre(opposite) == pytest.approx([0.0, 2000.0, -2000.0 * math.tan(math.radians(20.0))], abs=1e-6)
    beside = placed("wall:800,90", SOUTH, light(20.0, 30.0), 1)
    assert axes(beside) == pytest.approx(np.array([[0.0, -1.0, 0.0], [0.0, 0.0, 1.0], [-1.0, 0.0, 0.0]]), abs=1e-9)
    assert centre(beside)[0] == pytest.approx(800.0, abs=1e-6)
    ceiling = placed("ceiling:500", SOUTH, light(-50.0), 1)
    assert axes(ceiling)[2] == pytest.approx([0.0, 0.0, -1.0], abs=1e-9) and centre(ceiling)[2] == pytest.approx(500.0, abs=1e-6)


def test_other_windows():
    """A skylight, and a window that looks to the east; a mirror on a wall sends light back."""
    skylight = Room(180.0, 0.0)
    found = placed("floor:2500", skylight, skylight.to_lens((0.0, 0.6, -0.8)), 1)
    assert centre(found, skylight) == pytest.approx([0.0, 1875.0, -2500.0], abs=1e-6)
    assert axes(found, skylight)[1] == pytest.approx([0.0, -1.0, 0.0], abs=1e-9)
    east = Room(90.0, 90.0)
    found = placed("wall:3000", east, east.to_lens((-1.0, 0.0, 0.0)), 1)
    assert centre(found, east) == pytest.approx([-3000.0, 0.0, 0.0], abs=1e-6)
    back = placed("floor:1000", SOUTH, SOUTH.to_lens((0.0, -0.8, -0.6)), -1)
    assert axes(back)[1] == pytest.approx([0.0, 1.0, 0.0], abs=1e-9) and back.z < 0


def test_a_plane_in_either_frame():
    of_lens = placed("point=0,0,300;normal=0,0,-1;up=0,1,0", SOUTH, (0.0, 0.0, 1.0), 1)
    of_room = placed("room;point=0,300,0;normal=0,-2,0;up=0,1,3", SOUTH, (0.0, 0.0, 1.0), 1)
    assert of_lens == of_room and of_lens.z == 300.0 and axes(of_lens)[0] == pytest.approx([1.0, 0.0, 0.0], abs=1e-9)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("floor:-1", "greater than 0"),
        ("floor:1000", "not reached by the light"),
        ("ceiling:1000", "20.0 degrees down"),
        ("wall:1000,0", ""),
        ("wall:1000,180", "not reached"),
        ("attic:1", "must be floor"),
        ("floor:1,2,3", "must be floor"),
        ("floor:nan", "must be floor"),
        ("point=0,0,300;normal=0,0,0;up=0,1,0", "0,0,0"),
        ("point=0,0,300;normal=0,1,0;up=0,2,0", "along the normal"),
        ("point=0,0,300;normal=0,0,1;up=0,1,0", "faces away"),
        ("point=0,0,300;up=0,1,0", "must be floor"),
    ],
)
def test_places_out_of_the_light_are_refused(text, words):
    sent = light(-20.0 if text == "floor:1000" else 20.0)
    if not words:
        assert placed(text, SOUTH, sent, 1).z == pytest.approx(1000.0)
        return
    with pytest.raises(InputError, match=words):
        placed(text, SOUTH, sent, 1)


@pytest.mark.parametrize("turn", [0.0, 90.0, 180.0, -90.0])
@pytest.mark.parametrize("over", [False, True])
def test_axes_as_the_light_sees_them(turn, over):
    """Picture and screen are changed together: power stays where it is in space."""
    x, _, z = tilted((20.0, 0.0, turn))
    screen = Screen((30.0, 20.0), 100.0, (3, 2), tilt_to(x, (-z[0], -z[1], -z[2])) if over else (20.0, 0.0, turn), (0.0, -36.0))
    scene, target = Scene(PlaneWave(tilt=(20.0, 0.0)), Lens(), screen), np.arange(6.0).reshape(3, 2)
    other, moved = seen_by_light(scene, target)

    def places(screen: Screen, values: np.ndarray) -> dict:
        (nx, ny), (wx, wy), (a, b, _) = screen.resolution, screen.pixel, np.array(screen.axes)
        assert values.shape == (nx, ny)
        at = {}
        for i, j in np.ndindex(nx, ny):
            point = screen.centre + (i + 0.5 - nx / 2) * wx * a + (j + 0.5 - ny / 2) * wy * b
            at[tuple(np.round(point, 6) + 0.0)] = values[i, j]
        return at

    assert places(other.screen, moved) == places(screen, target)
    assert other.screen.axes[0] == pytest.approx(tilted((20.0, 0.0))[0], abs=1e-12)
    assert other.screen.axes[2] == pytest.approx(tilted((20.0, 0.0))[2], abs=1e-12)


@pytest.fixture
def in_tmp(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return tmp_path


def design(*options: str, picture: str = "blob.png") -> int:
    return cli.run(["design", picture, "--waves", "off", "--quality", "draft", "--resolution", "24", "-o", "p", *options])


@pytest.mark.parametrize("place", ["floor:1m", "floor:1m,90", "wall:1m,0", "wall:500,270"])
def test_designs_in_a_room(in_tmp, capfd, place):
    """A picture without symmetry appears on floor and wall as it was given."""
    x, y = np.meshgrid(*[np.linspace(-1.0, 1.0, 24)] * 2, indexing="ij")
    blob = np.exp(-6.0 * ((x - 0.3) ** 2 + (y + 0.1) ** 2)) + 0.5 * np.exp(-20.0 * ((x + 0.5) ** 2 + (y - 0.5) ** 2)) + 0.1
    np.save("blob.npy", blob)
    assert (
        design(
            "--source-tilt", "40,20", "--screen", place, "--lens-size", "30", "--picture-size", "20cm", "--json", picture="blob.npy"
        )
        == 0
    )
    made = json.loads(capfd.readouterr().out)
    assert made["error"] < 0.16
    assert settings.read(in_tmp / "p" / "project.toml")["target"]["size"] == [200.0, 200.0]


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (("--screen", "floor:1m"), "level"),
        (("--source-tilt", "30,0", "--screen", "floor:1m", "--throw", "200"), "--throw"),
        (("--source-tilt", "30,0", "--screen", "floor:1m", "--screen-tilt", "20,0"), "--screen-tilt"),
        (("--picture-size", "100", "--mag", "3"), "--mag"),
        (("--screen", "300"), "floor:DISTANCE"),
        (("--screen", "wall:1m", "--element", "mirror z=100 tilt=45,0"), "own axis"),
    ],
)
def test_nonsense_is_refused_in_a_line(in_tmp, capfd, options, words):
    write_blob()
    assert design(*options) == 2
    error = capfd.readouterr().err
    assert words in error.splitlines()[-1] and "Traceback" not in error


@pytest.mark.parametrize("place", ["floor:1000", "floor:1000,90", "wall:1000,0", "wall:500,270"])
def test_the_surface_that_stands_for_a_lens_before_its_design(place):
    """It spreads tilted light over the screen, a plane in the room, where the offset sphere does not."""
    source = PlaneWave(tilt=(40.0, 20.0))
    at = placed(place, SOUTH, source.axis, 1)
    lens = Lens((30.0, 30.0), control=(24, 24), degree=(3, 3), offset=Offset(3.0, (80.0, 80.0)))
    scene = Scene(source, lens, Screen((300.0, 300.0), at.z, (60, 60), at.tilt, at.shift))
    field = HeightField.of(lens)
    x, y = (c.numpy() for c in field.control_xy())

    def spread(z: np.ndarray) -> np.ndarray:
        """Standard deviations of the light along both axes of a screen three times as wide, over those of a uniform square of the
        first one's size."""
        wide = replace(scene, screen=replace(scene.screen, size=(900.0, 900.0)))
        seen = expose(wide, field, torch.from_numpy(z), rays_of(wide, "grid", 1 << 16)).image.numpy()
        c, parts = np.linspace(-443.0, 443.0, 60), [seen.sum(1 - k) / seen.sum() for k in (0, 1)]
        return np.array([math.sqrt(float(p @ (c - p @ c) ** 2)) for p in parts]) * math.sqrt(12.0) / 300.0

    assert np.abs(spread(stretching_surface(scene, x, y)) - 1.0).max() < 0.1
    assert np.abs(spread(lens.offset.heights(x, y)) - 1.0).max() > 1.0


@pytest.mark.parametrize("place", ["floor:1000", "floor:1000,90", "wall:500,270", "wall:1000,0"])
def test_the_blur_of_the_sun_on_floor_and_wall(place):
    """Of a smooth lens, the image of the sun's centre convolved with it is the image in sunlight; so is that of its parts, on a
    screen turned by a right angle too."""
    source = Disc(angle=2.0, tilt=(40.0, 20.0))
    at = placed(place, SOUTH, source.axis, 1)
    lens = Lens((30.0, 30.0), control=(16, 16), degree=(3, 3), offset=Offset(3.0, (150.0, 150.0)))
    scene = Scene(source, lens, Screen((400.0, 400.0), at.z, (50, 50), at.tilt, at.shift))
    field = HeightField.of(lens)
    heights = torch.from_numpy(lens.offset.heights(*(c.numpy() for c in field.control_xy())))
    spread = spread_at(scene, field, heights)
    seen = expose(scene, field, heights, rays_of(scene, "sobol", 1 << 19)).image.numpy()

    def blurred(blur, way) -> np.ndarray:
        aside = [-(-n // blur.cut) for n in blur.beside]
        grown = scene.screen.grown((aside[0], aside[1]))
        fine = replace(grown, resolution=(grown.resolution[0] * blur.cut, grown.resolution[1] * blur.cut))
        one = replace(scene, source=way, screen=fine)
        return blur(expose(one, field, heights, rays_of(one, "stratified", 400_000)).image).numpy()

    found = blurred(spread.on(scene.screen.pixel), source.pointlike())
    assert found.sum() == pytest.approx(seen.sum(), rel=5e-3)
    assert np.linalg.norm(found - seen) < 0.12 * np.linalg.norm(seen)
    assert np.allclose(spread.turn, np.eye(2)) == (place != "floor:1000,90")
    parts = spread.parts_on(scene.screen.pixel, spots(source, 2))
    ways = [PlaneWave(tilt=tilt_to((1.0, 0.0, 0.0), mode.position)[:2]) for mode in modes(scene, 2)]
    both = sum(blurred(part, way) for part, way in zip(parts, ways, strict=True)) / 2.0
    assert np.linalg.norm(both - seen) < 1.1 * np.linalg.norm(found - seen)
