"""Sundials: which lenslet has which hour, and what each shows at its own."""

import json
import math

import numpy as np
import pytest

from caustic_cli import cli
from caustic_cli.config import settings
from caustic_cli.errors import InputError
from caustic_cli.inverse.lenslets import lenslets
from caustic_cli.project.project import Project
from caustic_cli.scene.sunlight import instants
from caustic_cli.studies import day as study

DAY = "2026-06-21T"
SUNDIAL = ("--array", "2x1", "--sheet", "--slope", "30", "--screen", "floor:1m", "--picture-size", "60", "--lens-size", "20x10")
SUN = f"52,4.36,{DAY}13:00+02:00/14:30"


def test_instants():
    found = instants(f"{DAY}11:00+02:00/13:00", 5)
    assert [f"{t:%H:%M}" for t in found] == ["11:00", "11:30", "12:00", "12:30", "13:00"]
    assert all(t.utcoffset().total_seconds() == 7200 for t in found)
    assert instants(f"{DAY}11:00Z/{DAY}12:00Z", 2)[1].hour == 12 and len(instants(f"{DAY}11:00Z", 9)) == 1


@pytest.mark.parametrize(
    ("text", "count", "words"),
    [
        (f"{DAY}11:00+02:00/13:00", 1, "array"),
        (f"{DAY}11:00+02:00/10:00", 4, "end after it begins"),
        (f"{DAY}11:00+02:00/", 4, "date and time"),
        (f"{DAY}11:00/12:00", 4, "offset"),
    ],
)
def test_instants_that_are_none(text, count, words):
    with pytest.raises(InputError, match=words):
        instants(text, count)


@pytest.fixture
def in_tmp(tmp_path, monkeypatch):
    """Two pictures beside each other: a spot at the upper left, and one at the lower right."""
    monkeypatch.chdir(tmp_path)
    x, y = np.meshgrid(*[np.linspace(-1.0, 1.0, 16)] * 2, indexing="ij")
    left, right = (np.exp(-8.0 * ((x - a) ** 2 + (y - b) ** 2)) for a, b in ((-0.4, 0.4), (0.4, -0.4)))
    np.save("sheet.npy", np.concatenate([left, right], 0))
    return tmp_path


def design(*options: str) -> int:
    small = ("--quality", "draft", "--resolution", "24", "--control", "99x51", "--waves", "off", "--rays", "20000")
    return cli.run(["design", "sheet.npy", *SUNDIAL, *small, "-o", "p", *options])


def test_each_lenslet_shows_its_picture_at_its_hour(in_tmp, capfd):
    assert design("--sun", SUN, "--quiet") == 0
    project = Project.open("p")
    scene = project.scene()
    first, second = (one.scene.source for one in lenslets(scene))
    assert scene.source.in_turn and len(scene.source.members) == 2 and not first.in_turn
    # At 13:00 the sun stands to the east of south: its light goes to the west, +x of a lens that faces south.
    assert first.axis[0] > 0.1 > second.axis[0] and first.half_angle == pytest.approx(math.radians(0.2622), abs=1e-4)
    capfd.readouterr()
    assert cli.run(["render", "p", "--json", "--rays", "60000"]) == 0
    found = json.loads(capfd.readouterr().out)
    assert len(found["hours"]) == 2 and (in_tmp / "p" / "hours.png").exists()
    for hour in found["hours"]:
        assert hour["contrast"] is None or hour["contrast"] > 5.0
        assert hour["relative_rms"] < 1.0  # the spots are as small as the sun's blur


def test_a_day(in_tmp, capfd, monkeypatch):
    """At its hour each picture is as designed where it stands; halfway to the next one it is beside its place, on either side."""
    monkeypatch.setattr(study, "STEP", 30)
    monkeypatch.setattr(study, "MOST_BETWEEN", 4)
    assert design("--sun", SUN, "--quiet") == 0
    capfd.readouterr()
    assert cli.run(["render", "p", "--day", DAY[:-1], "--json", "--rays", "40000", "-o", "p.png"]) == 0
    found = json.loads(capfd.readouterr().out)["day"]
    assert (in_tmp / "p-day.gif").exists() and (in_tmp / "p-day.png").exists()
    rows = {row["time"][11:16]: row for row in found["times"]}
    for hour in ("13:00", "14:30"):
        row = rows[hour]
        assert row["moved"] == pytest.approx((0.0, 0.0), abs=1.0) and row["brightness"] == pytest.approx(1.0, abs=0.02)
        assert row["on_screen"] > 0.95 and row["error"] == pytest.approx(row["followed_error"], abs=0.05)
    before, after = rows["13:30"], rows["14:00"]  # the light of the hour before goes on as that of the next one comes
    assert max(row["on_screen"] for row in (before, after)) < 0.3
    assert before["moved"][0] * after["moved"][0] < 0 and min(abs(row["moved"][0]) for row in (before, after)) > 30.0


def test_the_light_of_another_time(in_tmp, capfd):
    """A single time is one sun for all lenslets; the hours of the design are not shown then."""
    assert design("--sun", SUN, "--quiet") == 0
    given = {"room.place": [52.0, 4.36], "room.time": f"{DAY}13:00+02:00"}
    source = Project.open("p").scene(given).source
    assert len(source.members) == 1 and source.oblique


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (("--sun", SUN, "--array", "1", "--sheet"), "--array"),
        (("--sun", f"52,4.36,{DAY}01:00+02:00/02:00"), "below the horizon"),
    ],
)
def test_nonsense_is_refused_in_a_line(in_tmp, capfd, options, words):
    assert design(*options) == 2
    error = capfd.readouterr().err
    assert words in error.splitlines()[-1] and "Traceback" not in error


def test_several_tilted_sources_need_as_many_lenslets(in_tmp, capfd):
    table = '[[source]]\ntype = "plane"\ntilt = [10.0, 0.0]\n[[source]]\ntype = "plane"\ntilt = [20.0, 0.0]\n'
    (in_tmp / "c.toml").write_text(table)
    assert settings.read(in_tmp / "c.toml")["source"]["also"]
    assert cli.run(["design", "sheet.npy", "--config", "c.toml"]) == 2
    assert "2 sources and 1 lenslets" in capfd.readouterr().err
