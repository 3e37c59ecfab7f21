"""The picture of a lens in a window through a day, against renders of its project at single times and against geometry."""

import json
import math
from dataclasses import replace
from datetime import datetime, timedelta
from functools import partial

import numpy as np
import pytest
import torch
from helpers import write_blob
from PIL import Image

from caustic_cli import cli, load
from caustic_cli.optics.emission import rays_of
from caustic_cli.optics.surfaces import HeightField
from caustic_cli.optics.trace import expose
from caustic_cli.scene import Disc, Lens, Offset, PlaneWave, Points, Scene, Screen
from caustic_cli.scene.room import Room
from caustic_cli.scene.room_screen import placed
from caustic_cli.scene.screen import tilted
from caustic_cli.scene.sources.gaussian import Gaussian
from caustic_cli.scene.sources.measured_beam import MeasuredBeam
from caustic_cli.scene.sources.several import Several
from caustic_cli.scene.sunlight import Sunlight, moment
from caustic_cli.studies import day as study
from caustic_cli.studies.day import Day, Follower, Instant, _under, follow_day, hours_of_sun, moved, smoothed

MUNICH, DATE = (48.14, 11.58), "2026-12-21"
NOON = moment(f"{DATE}T12:00+01:00")
LIGHT = Sunlight(Room(), MUNICH)


@pytest.fixture(scope="module")
def project(tmp_path_factory):
    folder = tmp_path_factory.mktemp("window")
    write_blob(folder / "blob.png")
    sun = f"{MUNICH[0]},{MUNICH[1]},{NOON.isoformat()}"
    command = ["design", str(folder / "blob.png"), "--sun", sun, "--source", "plane", "--waves", "off", "--quality", "draft"]
    assert cli.run([*command, "--resolution", "24", "-o", str(folder / "p"), "--quiet"]) == 0
    return folder / "p"


@pytest.fixture
def follower(project):
    lens = load(project)
    plan = lens.plan()
    return Follower(plan.scene, lens.field, lens.heights, lens.target, LIGHT, rays=20_000)


def test_a_screen_moves_in_its_plane():
    screen = Screen((30.0, 20.0), 200.0, tilt=(20.0, -30.0), shift=(5.0, -3.0))
    there = moved(screen, 7.0, -11.0)
    away = np.subtract(there.centre, screen.centre)
    assert np.array(screen.axes) @ away == pytest.approx([7.0, -11.0, 0.0])
    assert there.axes == screen.axes and there.size == screen.size


def test_at_the_time_of_the_design(follower):
    """Nothing has moved, and the picture is as designed."""
    now = follower.at(NOON).instant
    assert now.moved == pytest.approx((0.0, 0.0), abs=0.05)
    assert now.followed == pytest.approx(follower.error, abs=0.01) and now.error == pytest.approx(follower.error, abs=0.02)
    assert now.brightness == pytest.approx(1.0, abs=1e-3) and now.on_screen == pytest.approx(1.0, abs=1e-3)
    assert now.incidence == pytest.approx(LIGHT.room.incidence([-c for c in LIGHT.sun(NOON).direction]), abs=1e-3)


@pytest.mark.parametrize("minutes", [-40, 3, 25])
def test_it_wanders_like_a_ray_through_the_middle(follower, minutes):
    """The ray straight through the lens meets the plane of the screen where the light has gone, within a tenth of the way."""
    time, screen = NOON + timedelta(minutes=minutes), follower.scene.screen
    places = []
    for tilt in (follower.scene.source.tilt, LIGHT.tilt(time)):
        ahead = np.array(tilted(tilt)[2])
        places.append(ahead * np.dot(screen.centre, screen.axes[2]) / np.dot(ahead, screen.axes[2]))
    expected = np.array(screen.axes[:2]) @ (places[1] - places[0])
    found = follower.at(time).instant
    assert np.linalg.norm(np.subtract(found.moved, expected)) < 0.1 * np.linalg.norm(expected) + 0.1
    assert abs(expected[0]) > abs(minutes)  # in mm, at 300 mm from the lens


@pytest.mark.parametrize("source", [PlaneWave(), Disc(angle=0.53)])
@pytest.mark.parametrize("place", ["floor:900", "wall:1500"])
def test_light_through_a_pane_without_a_picture_goes_straight(place, source):
    """At the equinox, when the sun moves in a plane, its spot wanders over the floor on a straight line from west to east; anywhere
    as the ray through the middle, but for the thickness of the pane."""
    noon, room = moment("2026-03-20T12:20+01:00"), Room()
    source = replace(source, tilt=LIGHT.tilt(noon))
    z, tilt, shift = placed(place, room, source.axis, 1)
    screen = Screen((60.0, 60.0), z, (40, 40), tilt=tilt, shift=shift)
    scene = Scene(source, Lens((10.0, 10.0), control=(8, 8), offset=Offset(5.0)), screen)
    heights = torch.full((8, 8), 5.0, dtype=torch.float64)
    spot = expose(scene, HeightField.of(scene.lens), heights, rays_of(scene, "sobol", 1 << 14)).image.numpy()
    follower = Follower(scene, HeightField.of(scene.lens), heights, spot, LIGHT, rays=20_000)
    for minutes in (-90, -20, 2, 60):
        found = follower.at(noon + timedelta(minutes=minutes)).instant
        there = np.array([-c for c in room.to_lens(LIGHT.sun(found.time).direction)])
        place_on = there * np.dot(screen.centre, screen.axes[2]) / np.dot(there, screen.axes[2]) - screen.centre
        assert found.moved == pytest.approx(np.array(screen.axes[:2]) @ place_on, abs=2.5)
        if place.startswith("floor"):
            assert abs(found.moved[1]) < 0.01 * abs(found.moved[0]) + 0.5
        assert (room.to_room(tuple(place_on))[0] < 0) == (minutes < 0)  # it comes from the other side


@pytest.mark.parametrize("shape", [{}, {"screen_radius": [600.0, 600.0]}, {"screen_radius": [-400.0, float("inf")]}])
def test_error_and_light_are_those_of_renders(project, shape):
    """On the screen where it stands, and on one at the place to which the picture was followed; plane or curved."""
    time, designed = NOON + timedelta(minutes=3), load(project, **shape)
    follower = Follower(designed.plan().scene, designed.field, designed.heights, designed.target, LIGHT, rays=20_000)
    found = follower.at(time).instant
    lens = load(project, room_time=time.isoformat(), source="plane", **shape)
    there = moved(lens.scene.screen, *(a + b for a, b in zip(found.moved, follower.offset, strict=True)))
    image, still = lens.render(rays=200_000)
    on_it, followed = replace(lens, scene=lens.scene.onto(there)).render(rays=200_000)
    assert found.error == pytest.approx(still["relative_rms"], rel=0.03)
    assert found.followed == pytest.approx(followed["relative_rms"], abs=0.01) and found.error > 2.0 * found.followed
    assert found.on_screen == pytest.approx(image.sum() / on_it.sum(), rel=0.02)
    gain = [math.cos(math.radians(LIGHT.room.incidence([-c for c in LIGHT.sun(t).direction]))) for t in (time, NOON)]
    power = gain[0] * followed["on_target"] / (gain[1] * designed.render(rays=200_000).figures["on_target"])
    assert found.brightness == pytest.approx(power, rel=0.01)


def test_lamps_stand_still_beside_the_sun():
    """Light of the sun and of a lamp before the pane: their sum is that of each by itself, with the sun's cosine; a source alone at
    infinity takes no notice of what the lamp is."""
    lens, screen = Lens((10.0, 10.0), control=(8, 8), offset=Offset(5.0)), Screen((60.0, 60.0), 200.0, (20, 20))
    heights, field = torch.full((8, 8), 5.0, dtype=torch.float64), HeightField.of(lens)
    noon, later = (replace(PlaneWave(3.0), tilt=LIGHT.tilt(NOON + timedelta(minutes=m))) for m in (0, 8))
    lamp = Points(((5.0, 0.0, -150.0),), (2.0,))
    both = Scene(Several((noon, lamp), (((), ()), ((), ()))), lens, screen)
    target = expose(both, field, heights, rays_of(both, "sobol", 1 << 14)).image.numpy()
    follower = Follower(both, field, heights, target, LIGHT, rays=200_000)
    seen = follower.at(NOON + timedelta(minutes=8))
    watts = np.zeros(seen.around.shape)
    around = screen.grown((20, 20))
    for source, cosine in ((later, later.axis[2] / noon.axis[2]), (lamp, 1.0)):
        one = Scene(source, lens, around)
        image = expose(one, field, heights, rays_of(one, "sobol", 1 << 16)).image.numpy()
        watts += source.power * cosine * image
    coarse = [a.reshape(6, 10, 6, 10).sum((1, 3)) for a in (5.0 * seen.around, watts)]
    assert coarse[0] == pytest.approx(coarse[1], abs=0.01 * coarse[1].max()) and watts.sum() > 2.5
    assert follower.white.sum() == pytest.approx(target.sum(), rel=0.02)


@pytest.mark.parametrize("laser", [Gaussian((3.0, 3.0), 633.0), MeasuredBeam(np.zeros((5, 5)), 633.0)])
def test_lasers_stand_still_beside_the_sun(laser):
    both = Several((PlaneWave(), laser), (((), ()), ((), ()))).each(partial(_under, (20.0, 0.0)))
    assert both.members[0].oblique and both.members[1] is laser


def test_periods():
    """Times are as designed, legible, and legible on the screen by their own bounds; each period ends where one is not."""

    def at(minute: int, followed: float, on_screen: float, brightness: float = 1.0) -> Instant:
        time, sun = NOON + timedelta(minutes=minute), (180.0, 20.0, 20.0)
        return Instant(time, *sun, None, followed, (0.0, 0.0), (0.2, 0.5), brightness, on_screen)

    rows = [(0, 0.9, 1.0), (1, 0.4, 0.2), (2, 0.1, 1.0), (3, 0.4, 1.0), (4, 0.6, 1.0), (5, 0.1, 0.6), (6, 0.1, 1.0, 0.05)]
    day = Day(0.1, (0.2, 0.5), tuple(at(*row) for row in rows))
    minutes = lambda periods: [((a - NOON).seconds // 60, (b - NOON).seconds // 60) for a, b in periods]  # noqa: E731
    assert minutes(day.as_designed) == [(2, 2), (5, 5)]
    assert minutes(day.legible) == [(1, 3), (5, 5)]
    assert minutes(day.on_screen) == [(2, 3), (5, 5)]


def test_steps_of_a_day(follower, monkeypatch):
    """They cover the hours of sun, and the minutes at which light is on the screen; the power of an image is kept for display."""
    monkeypatch.setattr(study, "STEP", 60)
    monkeypatch.setattr(study, "MOST_BETWEEN", 12)
    found, kept = follow_day(follower, hours_of_sun(LIGHT, NOON.date(), NOON.tzinfo), lambda seen: seen.image.sum())
    times = [i.time for i in found.instants]
    assert times == sorted(set(times)) and len(times) == len(kept)
    assert f"{times[0]:%H:%M} {times[-1]:%H:%M}" == "08:04 16:20"
    assert {f"{hour:02d}:00" for hour in range(9, 17)} <= {f"{t:%H:%M}" for t in times}
    assert 0 < len([t for t in times if t.minute]) - 2 <= 2 * 12
    assert found.bounds[1] == pytest.approx(0.5 * follower.target.std() / follower.target.mean())
    ((first, last),) = found.legible
    assert first <= NOON <= last
    noisy = np.random.default_rng(0).random((40, 30))
    assert smoothed(noisy, 2000).std() < 0.5 * noisy.std() and smoothed(noisy, 10**6) is noisy


def test_render(project, monkeypatch, capfd, tmp_path):
    monkeypatch.setattr(study, "STEP", 120)
    monkeypatch.setattr(study, "MOST_BETWEEN", 5)
    monkeypatch.chdir(tmp_path)
    command = ["render", str(project), "--day", DATE, "--rays", "20000", "-o", "a.png"]
    assert cli.run([*command, "--json"]) == 0
    found = json.loads(capfd.readouterr().out)["day"]
    assert found["film"] == "a-day.gif" and found["plot"] == "a-day.png" and found["legible_error"] > 0
    times = [datetime.fromisoformat(row["time"]) for row in found["times"]]
    assert all(t.utcoffset() == timedelta(hours=1) and t.date().isoformat() == DATE for t in times)
    assert {"azimuth", "elevation", "incidence", "error", "followed_error", "moved", "brightness", "on_screen"} < {
        *found["times"][0]
    }
    with Image.open("a-day.gif") as film:
        assert film.n_frames == len(times) > 5
    assert cli.run([*command, "--force"]) == 0
    said = capfd.readouterr().out
    assert f"the sun on {DATE}" in said and "legible on the screen" in said and "from 08:04 to 16:20" in said


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (("--day", "tomorrow"), "a date like 2026-06-21"),
        (("--day", "1066-10-14"), "1900 to 2099"),
        (("--day", DATE, "--cut", "a.gcode"), "--cut goes without --day"),
        (("--day", DATE, "--faces", "0"), "from behind"),
        (("--day", DATE, "--sun", "70,20,2026-06-21T12:00+02:00", "--source", "plane", "--slope", "60"), "no time that day"),
    ],
)
def test_nonsense_is_refused_in_a_line(project, capfd, options, words):
    code = cli.run(["render", str(project), "--rays", "1000", *options])
    error = capfd.readouterr().err
    assert code == 2 and words in error.splitlines()[-1] and "Traceback" not in error


def test_a_day_needs_a_window(project, capfd, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    write_blob()
    usual = ["--waves", "off", "--quality", "draft", "--resolution", "24", "-o", "p", "--quiet"]
    assert cli.run(["design", "blob.png", *usual]) == 0
    assert cli.run(["render", "p", "--day", DATE]) == 2
    assert "--day needs a place" in capfd.readouterr().err.splitlines()[-1]
    assert cli.run(["export", str(project), "--format", "lighttools", "-o", "a.npz"]) == 0
    assert cli.run(["render", "a.npz", "--day", DATE]) == 2
    assert "archive" in capfd.readouterr().err.splitlines()[-1]
