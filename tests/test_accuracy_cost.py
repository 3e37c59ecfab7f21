"""The error against time that a design keeps."""

import json

import pytest

from caustic_cli import cli
from caustic_cli.inverse import accuracy_cost
from caustic_cli.inverse.accuracy_cost import CostOfAccuracy, Row, Start, iterations_to_measure, price, seconds_to
from caustic_cli.inverse.designer import Designer
from caustic_cli.kinds import problem_of
from caustic_cli.project.project import Project


@pytest.mark.parametrize("total", [1, 2, 5, 7, 8, 12, 40, 92, 1000])
@pytest.mark.parametrize("count", [3, 8])
def test_measured_iterations(total, count):
    found = sorted(iterations_to_measure(total, count))
    assert found[0] == 0 and found[-1] == total and len(found) == min(count, total + 1)


def test_measuring_is_no_part_of_the_time(monkeypatch):
    now = {"wall": 100.0, "processor": 10.0}
    monkeypatch.setattr(accuracy_cost.time, "monotonic", lambda: now["wall"])
    monkeypatch.setattr(accuracy_cost.time, "process_time", lambda: now["processor"])

    def later(wall, processor):
        now["wall"] += wall
        now["processor"] += processor

    def error_of(lens):
        later(7.0, 9.0)
        return lens

    start = Start.now()
    later(1.0, 2.0)
    cost = CostOfAccuracy(start, error_of, 10, 9, [])
    later(0.5, 0.5)  # its objective, a part of what follows
    cost.measure(0, 0.4, always=True)
    later(2.0, 3.0)
    cost.measure(1, 0.3, always=True)
    cost.measure(1, 0.2, always=True)  # known
    cost.measure(2, None, always=True)  # no image
    later(0.5, 0.5)
    rows = cost.measure(3, 0.1, always=True)
    assert rows == [Row(0, 1.0, 2.0, 0.4), Row(1, 3.5, 5.5, 0.3), Row(3, 4.0, 6.0, 0.1)]
    resumed = CostOfAccuracy(Start.now(), error_of, 10, 9, rows)
    later(1.0, 1.0)
    assert resumed.measure(4, 0.05, always=True)[-1] == Row(4, 5.0, 7.0, 0.05)


def test_long_measurements_are_few(monkeypatch):
    now = {"wall": 0.0}
    monkeypatch.setattr(accuracy_cost.time, "monotonic", lambda: now["wall"])

    def error_of(lens):
        now["wall"] += 2.0
        return lens

    cost = CostOfAccuracy(Start.now(), error_of, 40, 8, [])
    for k in range(41):
        cost.measure(k, 1.0, always=k == 40)
        now["wall"] += 0.1
    found = [row.iteration for row in cost.rows]
    assert found[:2] == [0, 1] and found[-1] == 40 and len(found) <= 4


def test_the_price_of_a_smaller_error():
    rows = [Row(0, 2.0, 2.0, 1.0), *(Row(k, 2.0 + t, 2.0, t**-0.5) for k, t in enumerate((1.0, 2.0, 4.0, 8.0), 1))]
    assert "about 1.9 s more" in price(rows)  # 8 (0.9^-2 - 1)
    assert "not lower" in price([row._replace(error=0.3) for row in rows])
    assert price(rows[:2]) == "" and seconds_to(rows[:2], 0.1) is None
    assert abs(seconds_to(rows, 0.5 * 8**-0.5) - 24.0) < 1e-9 and seconds_to(rows, 1.0) == 0.0  # a fourfold time


def test_a_design_keeps_its_curve(tmp_path, capsys):
    def figures_of(*arguments):
        assert cli.run(["design", *arguments, "--json", "-q"]) == 0
        return json.loads(capsys.readouterr().out)

    out = tmp_path / "a.caustic"
    figures = figures_of("examples/flame.png", "--resolution", "32", "--waves", "off", "--control", "35", "-o", str(out))
    rows = figures["accuracy_cost"]
    assert rows[0]["iteration"] == 0 and rows[-1]["iteration"] == figures["iterations"]
    for key in ("seconds", "processor_seconds"):
        times = [row[key] for row in rows]
        assert times == sorted(times) and times[0] > 0 and times[-1] < figures["seconds"] * 4
    assert rows[-1]["error"] == pytest.approx(figures["relative_rms"], rel=0.3) and rows[-1]["error"] < rows[0]["error"]
    resumed = figures_of("--resume", str(out), "--iterations", "40")
    assert resumed["accuracy_cost"][: len(rows)] == rows
    assert resumed["accuracy_cost"][-1]["iteration"] == resumed["iterations"]


def test_a_lens_is_traced_once(tmp_path, capsys):
    """The image by the same rays is kept, and none of it for another lens or for a net that has changed in place since."""
    out = tmp_path / "a.caustic"
    command = "design examples/flame.png --resolution 32 --waves off --control 35 --iterations 1 -q -o"
    assert cli.run([*command.split(), str(out)]) == 0
    project = Project.open(out)
    problem = problem_of(project)
    designer, state = Designer(problem), project.load().state
    how = 40_000, problem.options.seed
    before = problem.errors(designer, state, *how, noise=False)[0]["relative_rms"]
    image = problem.traced(state.heights.clone(), *how)
    assert image is not None
    assert problem.traced(state.heights + 1e-9, *how) is None and problem.traced(state.heights, 10, how[1]) is None
    state.heights *= 0.5
    assert problem.traced(state.heights, *how) is None
    assert problem.errors(designer, state, *how, noise=False)[0]["relative_rms"] != before


def test_the_curve_ends_with_the_verdict(tmp_path, capsys):
    """By rays the first and the last row are those of the start and of the lens that is kept."""
    command = "design examples/flame.png --resolution 32 --waves off --control 35 --iterations 2 --json -q -o"
    assert cli.run([*command.split(), str(tmp_path / "a.caustic")]) == 0
    figures = json.loads(capsys.readouterr().out)
    rows = figures["accuracy_cost"]
    assert (rows[0]["error"], rows[-1]["error"]) == (figures["start_relative_rms"], figures["relative_rms"])
