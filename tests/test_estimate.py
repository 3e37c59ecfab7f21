"""What a design costs, told before it: --plan; and designs for an error: --error."""

import json
from pathlib import Path

import numpy as np
import pytest
from helpers import write_blob

from caustic_cli import cli
from caustic_cli.inverse.accuracy_cost import Aim
from caustic_cli.kinds import problem_of
from caustic_cli.project.new import new_project
from caustic_cli.project.project import Project
from caustic_cli.workflow import estimate
from caustic_cli.workflow.reporter import Listener

SMALL = ["--resolution", "24", "--control", "35", "--waves", "off"]


@pytest.fixture(autouse=True)
def _here(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(estimate, "slowness", lambda: (1.0, 1.0))
    write_blob()


def figures_of(capfd, *arguments, code=0) -> dict:
    assert cli.run(["design", "blob.png", *arguments, "--json"]) == code
    return json.loads(capfd.readouterr().out.splitlines()[-1]) if code == 0 else {}


def test_a_plan_designs_nothing(capfd):
    before = sorted(Path().iterdir())
    found = figures_of(capfd, "--plan")["plan"]
    assert sorted(Path().iterdir()) == before
    assert [(row["error_by"], row["quality"]) for row in found] == [
        (by, q) for by in ("waves", "rays") for q in ("draft", "standard", "fine")
    ]
    for by in ("waves", "rays"):
        own = [row for row in found if row["error_by"] == by]
        for key, order in (("seconds", 1), ("memory_mib", 1), ("relative_rms", -1)):
            values = [order * row[key] for row in own]
            assert values == sorted(values) and len(set(values)) > 1, key
        assert all(0 < row["low"] < row["relative_rms"] < row["high"] and row["project_mib"] > 0 for row in own)
    assert {row["error_by"] for row in figures_of(capfd, "--plan", "--waves", "off")["plan"]} == {"rays"}


def test_more_work_takes_longer(capfd):
    def seconds(*options):
        return [row["seconds"] for row in figures_of(capfd, "--plan", "--waves", "off", *options)["plan"]]

    assert all(a < b for a, b in zip(seconds("--resolution", "100"), seconds("--resolution", "300"), strict=True))


def test_speeds_are_kept_for_an_hour(tmp_path, monkeypatch):
    monkeypatch.undo()
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "cache"))
    monkeypatch.setattr(estimate, "CALIBRATION", 0.02)
    first = estimate.slowness()
    assert all(0.1 < value < 1e3 for value in first) and estimate.slowness() == first
    kept = tmp_path / "cache" / estimate.SPEEDS
    monkeypatch.setattr(estimate, "measured_slowness", lambda: (7.0, 8.0))
    assert estimate.slowness() == first
    for damaged in (b"", b"[]", b'{"at": "now"}', json.dumps(json.loads(kept.read_text()) | {"at": 0}).encode()):
        kept.write_bytes(damaged)
        assert estimate.slowness() == (7.0, 8.0) and estimate.slowness() == (7.0, 8.0)
    kept.unlink()
    kept.mkdir()  # cannot be written
    assert estimate.slowness() == (7.0, 8.0)


def test_diffraction_bounds_what_is_finer_than_its_cut_off():
    def bound(throw):
        given = {"target.encoding": "linear", "screen.resolution": (32, 32), "throw": throw, "mag": 0.02}
        project, _ = new_project(Path("dots.npy"), given, None, None, None, lambda _: None)
        return estimate.cut_off_error(problem_of(project))

    dots = np.zeros((32, 32))
    dots[8:24:2, 8:24:2] = 1.0
    np.save("dots.npy", dots)
    assert bound(20.0) == 0.0  # a cut-off of 1000 per mm, pixels of 6 micrometres
    assert 0.5 < bound(2000.0) < np.sqrt(np.mean((dots / dots.mean() - 1) ** 2)) + 1e-9


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--plan", "--quality", "draft"], "--quality is what --plan compares"),
        (["--error", "0.1", "--quality", "draft"], "--quality is what --error chooses"),
        (["--error", "0"], "--error must be greater than 0"),
        (["--error", "nan"], "--error must be greater than 0"),
        (["--error", "0.1", "--plan"], "leave one out"),
        (["--plan", "--source", "disc", "--source-size", "1"], "for a plane wave"),
        (["--error", "0.1", "--network", "dense"], "for a plane wave"),
    ],
)
def test_what_cannot_be_planned_is_refused(capfd, arguments, words):
    assert cli.run(["design", "blob.png", *arguments]) == 2
    assert words in capfd.readouterr().err
    assert not Path("blob.caustic").exists()


def test_a_design_for_an_error_takes_the_cheapest_and_stops_there(capfd, monkeypatch):
    fixed = {
        (by, q): ((np.log(e), 0.0, 0.0, 0.0, 0.0), 0.1)
        for by in ("rays", "waves")
        for q, e in zip(estimate.QUALITIES, (0.9, 0.05, 0.01), strict=True)
    }
    monkeypatch.setattr(estimate, "ERRORS", fixed)
    assert figures_of(capfd, "--error", "0.5", "-o", "at once", *SMALL)["iterations"] == 0  # by transport
    wanted = 0.8
    found = figures_of(capfd, "--error", str(wanted), "--start", "offset", *SMALL)
    assert found["iterations"] > 0 and found["error"] <= wanted + found["noise"] and found["reason"].startswith("error reached")
    assert found["accuracy_cost"][-2]["error"] > wanted >= found["accuracy_cost"][-1]["error"]
    further = figures_of(capfd, "--error", "0.2", "--start", "offset", *SMALL)  # goes on from there
    assert further["iterations"] > found["iterations"] and further["error"] <= 0.2 + further["noise"]
    assert further["accuracy_cost"][: len(found["accuracy_cost"])] == found["accuracy_cost"]
    same = figures_of(capfd, "--error", "0.2", "--start", "offset", *SMALL)
    assert (same["iterations"], same["error"]) == (further["iterations"], further["error"])
    found = further
    assert json.loads(json.dumps(Project.open("blob.caustic").load().results))["error"] == found["error"]


def test_a_design_for_an_error_takes_further_iterations_that_should_reach_it(capfd, monkeypatch):
    Path("few.toml").write_text("[[design.stages]]\niterations = 6\nrays = 40_000\n")
    few = [*SMALL, "--start", "offset", "--config", "few.toml", "--force"]
    planned = figures_of(capfd, *few)
    assert planned["iterations"] == 6
    monkeypatch.setattr(estimate, "cheapest", lambda *_, **__: [(None, Aim(0.9 * planned["error"], 60.0))])
    found = figures_of(capfd, "--error", "0.1", *few)
    assert 6 < found["iterations"] < 30 and found["error"] <= 0.9 * planned["error"] + found["noise"]
    monkeypatch.setattr(estimate, "cheapest", lambda *_, **__: [(None, Aim(1e-6, 60.0))])
    assert figures_of(capfd, "--error", "0.1", *few)["iterations"] == 6


def test_a_design_goes_on_and_says_what_no_quality_reaches(monkeypatch):
    fixed = {(by, q): ((np.log(0.01), 0.0, 0.0, 0.0, 0.0), 0.1) for by in ("rays", "waves") for q in estimate.QUALITIES}
    monkeypatch.setattr(estimate, "ERRORS", fixed)
    said: list[str] = []
    say = Listener(on_message=said.append)
    given = {"screen.resolution": (24, 24), "design.waves": "off"}
    qualities, aims = zip(*estimate.cheapest(Path("blob.png"), given, 0.02, say), strict=True)
    assert qualities == ("draft", "standard", "fine") and "draft: an error of 0.01" in said[0]
    assert {aim.error for aim in aims} == {0.02} and aims[0].seconds <= aims[1].seconds == aims[2].seconds
    figures = {"error": 0.03, "error_by": "rays", "noise": 0.001}
    assert not estimate.reached(figures, 0.02, "draft", say) and not said[-1].endswith("no quality reaches it")
    assert not estimate.reached(figures, 0.02, "fine", say) and said[-1].endswith("no quality reaches it")
    assert estimate.reached(figures, 0.0295, "fine", say)
    estimate.cheapest(Path("blob.png"), given, 0.005, say)
    assert "less than any quality is expected to reach" in said[-1]
