"""The place of the sun, by other algorithms and published examples; rooms; designs for the sun at a place and time."""

import json
import math
from datetime import UTC, datetime, timedelta

import numpy as np
import pytest
from helpers import write_blob

from caustic_cli import cli, load
from caustic_cli.config import settings
from caustic_cli.config.settings import by_section, parse
from caustic_cli.errors import InputError
from caustic_cli.scene.room import Room
from caustic_cli.scene.screen import tilted
from caustic_cli.scene.sun import refraction, sun
from caustic_cli.scene.sunlight import Sunlight, hours, in_words, moment

MUNICH = (48.14, 11.58)
NOON = "2026-12-21T12:00+01:00"


def michalsky(latitude: float, longitude: float, time: datetime) -> tuple[float, float]:
    """Azimuth and true elevation, degrees: J. J. Michalsky, The Astronomical Almanac's algorithm for approximate solar position,
    Solar Energy 40, 227-235 (1988)."""
    days = (time - datetime(2000, 1, 1, 12, tzinfo=UTC)).total_seconds() / 86400.0
    hour = (days * 24.0 + 12.0) % 24.0
    g = math.radians(357.528 + 0.9856003 * days)
    ecliptic = math.radians(280.460 + 0.9856474 * days + 1.915 * math.sin(g) + 0.02 * math.sin(2.0 * g))
    oblique = math.radians(23.439 - 0.0000004 * days)
    ascension = math.atan2(math.cos(oblique) * math.sin(ecliptic), math.cos(ecliptic))
    declination, phi = math.asin(math.sin(oblique) * math.sin(ecliptic)), math.radians(latitude)
    angle = math.radians((6.697375 + 0.0657098242 * days + hour) * 15.0 + longitude) - ascension
    s, c = math.sin(declination), math.cos(declination)
    north = s * math.cos(phi) - c * math.sin(phi) * math.cos(angle)
    up = s * math.sin(phi) + c * math.cos(phi) * math.cos(angle)
    return math.degrees(math.atan2(-c * math.sin(angle), north)) % 360.0, math.degrees(math.asin(up))


def unit(azimuth: float, elevation: float) -> np.ndarray:
    a, e = math.radians(azimuth), math.radians(elevation)
    return np.array([math.sin(a) * math.cos(e), math.cos(a) * math.cos(e), math.sin(e)])


def test_place_of_the_sun():
    """1,000 dates and places, 1990 to 2060.

    The largest difference is 0.007 degrees, and 0.0095 from the Solar Position Algorithm of NREL over 3,000 (pvlib 0.16).
    """
    random, first, apart = np.random.default_rng(0), datetime(1990, 1, 1, tzinfo=UTC), []
    span = (datetime(2060, 1, 1, tzinfo=UTC) - first).total_seconds()
    for _ in range(1000):
        time = first + timedelta(seconds=float(random.uniform(0.0, span)))
        place = math.degrees(math.asin(random.uniform(-1.0, 1.0))), float(random.uniform(-180.0, 180.0))
        seen, (azimuth, true) = sun(*place, time), michalsky(*place, time)
        if seen.elevation > 0.0:
            found = np.linalg.norm(np.cross(seen.direction, unit(azimuth, true + refraction(true))))
            apart.append(math.degrees(math.asin(found)))
    assert len(apart) > 400 and 0.001 < max(apart) < 0.02


def test_published_example():
    """Of the Solar Position Algorithm, NREL/TP-560-34302, table A5.1: azimuth, apparent zenith angle and distance; its air is a
    fifth thinner than ours."""
    seen = sun(39.742476, -105.1786, datetime.fromisoformat("2003-10-17T12:30:30-07:00"))
    assert seen.azimuth == pytest.approx(194.34024, abs=0.01)
    assert seen.elevation == pytest.approx(90.0 - 50.11162, abs=0.01)
    assert seen.diameter == pytest.approx(0.53313 / 0.9965423, rel=1e-4)


def test_refraction():
    """Bennett's formula, of the apparent elevation, is its inverse to a tenth of an arc minute; on the horizon 34 minutes."""
    for true in np.linspace(-0.5, 89.0, 50):
        apparent = true + refraction(true)
        bennett = 1.0 / math.tan(math.radians(apparent + 7.31 / (apparent + 4.4))) / 60.0
        assert refraction(true) == pytest.approx(bennett, abs=0.2 / 60.0)
    assert refraction(-0.57) == pytest.approx(34.0 / 60.0, abs=0.02)


def test_axes_of_a_room():
    """A south window: x to the west, y up, z to the north; a skylight, whose light comes from above; any other is orthonormal."""
    np.testing.assert_allclose(Room().axes, [[-1, 0, 0], [0, 0, 1], [0, 1, 0]], atol=1e-15)
    np.testing.assert_allclose(Room(180.0, 0.0).axes, [[-1, 0, 0], [0, 1, 0], [0, 0, -1]], atol=1e-15)
    np.testing.assert_allclose(Room(90.0, 90.0).axes, [[0, -1, 0], [0, 0, 1], [-1, 0, 0]], atol=1e-15)
    room = Room(213.0, 35.0)
    axes = np.array(room.axes)
    np.testing.assert_allclose(axes @ axes.T, np.eye(3), atol=1e-15)
    assert np.linalg.det(axes) == pytest.approx(1.0)
    np.testing.assert_allclose(-axes[2], unit(213.0, 55.0), atol=1e-15)
    vector = (0.3, -0.5, 0.7)
    assert room.to_room(room.to_lens(vector)) == pytest.approx(vector)


@pytest.mark.parametrize(("faces", "slope"), [(180.0, 90.0), (230.0, 60.0), (120.0, 10.0)])
def test_tilt_of_the_light(faces, slope):
    """The lens' z axis, turned by it as screens and beams are, is the direction of the light in the room."""
    room, (east, north, up) = Room(faces, slope), unit(190.0, 40.0)
    tilt = room.tilt((-east, -north, -up))
    assert room.to_room(tilted(tilt)[2]) == pytest.approx((-east, -north, -up))
    assert room.incidence((-east, -north, -up)) == pytest.approx(math.degrees(math.acos(tilted(tilt)[2][2])))


def test_a_higher_sun_shines_farther_down():
    """In the afternoon it comes from the west, +x of a south window."""
    light = Sunlight(Room(), MUNICH)
    low, high, late = (light.tilt(moment(t)) for t in (NOON, "2026-06-21T13:00+02:00", "2026-12-21T15:00+01:00"))
    assert 17.0 < low[0] < 20.0 and 60.0 < high[0] < 66.0
    assert tilted(late)[2][0] < -0.5


def test_hours_of_sunlight():
    """At the equinox the day is 12 hours long and a little; an east window has sun in the morning; a polar night none."""
    day, zone = moment("2026-03-20T12:00+01:00"), moment(NOON).tzinfo
    light = Sunlight(Room(90.0), MUNICH)
    ((rises, sets),) = hours(lambda t: light.sun(t).elevation > 0.0, day.date(), zone)
    assert 12 * 3600 < (sets - rises).total_seconds() < 12.2 * 3600
    ((begins, ends),) = hours(light.shines, day.date(), zone)
    assert begins == rises and ends.hour == 11
    arctic = Sunlight(Room(), (80.0, 0.0))
    assert in_words(hours(lambda t: arctic.sun(t).elevation > 0.0, moment(NOON).date(), zone)) == "at no time"
    assert in_words(hours(lambda t: arctic.sun(t).elevation > 0.0, moment("2026-06-21T12:00Z").date(), zone)) == "all day"


def test_times():
    assert moment("2026-06-21T12:00+02:00") == moment("2026-06-21T10:00Z")
    for text, words in (("2026-06-21T12:00", "offset"), ("noon", "date and time"), ("1066-10-14T09:00Z", "1900 to 2099")):
        with pytest.raises(InputError, match=words):
            moment(text)
    with pytest.raises(InputError, match="latitude"):
        Sunlight(Room(), (91.0, 0.0))
    assert parse("[room]\ntime = 2026-06-21T12:00:00+02:00\n", "x")["room"]["time"] == "2026-06-21T12:00:00+02:00"


@pytest.fixture
def in_tmp(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return tmp_path


def design(*options: str) -> int:
    write_blob()
    usual = ("--source", "plane", "--waves", "off", "--quality", "draft", "--resolution", "24", "-o", "p")
    return cli.run(["design", "blob.png", *usual, *options])


def sun_option(time: str = NOON, place: tuple[float, float] = MUNICH) -> str:
    return f"{place[0]},{place[1]},{time}"


def test_design_for_the_sun(in_tmp, capfd):
    """The light follows from place, time and window, and is stored with them; under the sun of another time the picture is
    elsewhere, and a project whose direction is not that of its sun is refused."""
    assert design("--sun", sun_option(), "--faces", "170", "--json") == 0
    assert json.loads(capfd.readouterr().out)["error"] < 0.2
    light, lens = Sunlight(Room(170.0), MUNICH), load("p")
    assert lens.scene.source.tilt == pytest.approx(light.tilt(moment(NOON)), abs=1e-4)
    assert lens.scene.screen.tilt == lens.scene.source.tilt
    later = load("p", room_time="2026-12-21T12:30+01:00", source="plane").scene.source.tilt
    assert later == pytest.approx(light.tilt(moment("2026-12-21T12:30+01:00")), abs=1e-4)
    assert load("p", faces=175.0, source="plane").scene.source.tilt[1] != lens.scene.source.tilt[1]
    file = in_tmp / "p" / "project.toml"
    text = file.read_text()
    file.write_text(text.replace("T12:00", "T12:04"))
    assert cli.run(["render", "p", "--rays", "1000"]) == 2
    said = capfd.readouterr().err.splitlines()[-1]
    assert "project.toml: [source] tilt" in said and "remove" in said
    file.write_text(text.replace(f'"{NOON}"', "2026-12-21T12:00:00+01:00"))  # as a date and time of TOML
    assert load("p").scene.source.tilt == lens.scene.source.tilt


def test_the_sun_is_a_disc(in_tmp):
    """Unless told otherwise, as wide as it is on that day: in December, near perihelion, at its widest; also in a render of a lens
    for a plane wave."""
    assert design("--sun", sun_option(), "--source", "disc") == 0
    source = load("p").scene.source
    assert source.kind == "disc" and source.angle == pytest.approx(0.5331 / 0.9838, abs=2e-4)
    assert source.tilt == pytest.approx(Sunlight(Room(), MUNICH).tilt(moment(NOON)), abs=1e-4)
    assert design("--sun", sun_option(), "--force") == 0
    other = load("p", room_time="2026-07-03T13:00+02:00").scene.source
    assert other.kind == "disc" and other.angle == pytest.approx(0.5331 / 1.0167, abs=2e-4) and other.tilt[0] > 60.0
    implied = by_section({"room.place": [*MUNICH], "room.time": NOON}), by_section({"lens.size": [10.0, 10.0]})
    assert [settings.implied(given).get("source") for given in implied] == [{"type": "disc"}, None]


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (("--sun", sun_option("2026-12-21T03:00+01:00")), ("below the horizon", "from 08:04 to 16:20")),
        (("--sun", sun_option(place=(80.0, 0.0))), ("at no time",)),
        (("--sun", sun_option(), "--faces", "0"), ("from behind", "--faces", "at no time")),
        (("--sun", sun_option("2026-06-21T12:00+01:00"), "--faces", "90"), ("grazes the pane", "from 04:16 to 11:30")),
        (("--sun", sun_option("2026-12-21T12:00")), ("offset",)),
        (("--sun", "48.14,11.58"), ("latitude, longitude and time",)),
        (("--sun", sun_option(place=(91.0, 0.0))), ("latitude of -90 to 90",)),
        (("--sun", sun_option(place=(0.0, 200.0))), ("-180 to 180",)),
        (("--sun", sun_option(), "--slope", "200"), ("--slope must be 0 to 180",)),
        (("--sun", sun_option(), "--slope", "nan"), ("slope",)),
        (("--faces", "90"), ("--faces", "needs --sun")),
        (("--sun", sun_option(), "--source", "point"), ("--sun needs --source plane",)),
        (("--sun", sun_option(), "--source-tilt", "10,2"), ("--source-tilt is 10,2", "remove")),
    ],
)
def test_nonsense_is_refused_in_a_line(in_tmp, capfd, options, words):
    assert design(*options) == 2
    error = capfd.readouterr().err
    assert all(word in error.splitlines()[-1] for word in words) and "Traceback" not in error
