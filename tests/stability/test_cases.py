"""The cases of the study of stability, and its command."""

import dataclasses
import json

import pytest

from caustic_cli import cli
from caustic_cli.errors import InputError
from caustic_cli.studies import stability
from caustic_cli.workflow.convergence import STUDIES, StudyRequest


@pytest.mark.parametrize("case", stability.CASES, ids=lambda case: case.family)
def test_case_holds(case, kernels, compare):
    naive, ours = case.worst()
    compare(case.family, case.error_of, naive, ours, case.bound)


def test_command(tmp_path, capfd):
    assert cli.run(["convergence", "--study", "stability", "--json", "--quiet", "-o", str(tmp_path)]) == 0
    found = json.loads(capfd.readouterr().out)
    assert [row["series"] for row in found["rows"]] == [case.family for case in stability.CASES]
    assert all(row["holds"] and row["error"] <= row["bound"] and row["naive_words"] for row in found["rows"])
    assert all((tmp_path / f"stability.{end}").stat().st_size for end in ("csv", "json", "png"))


def test_a_broken_bound_and_an_infinite_error_end_with_status_1(tmp_path, monkeypatch, capfd):
    broken = dataclasses.replace(stability.CASES[0], measure=lambda _: (float("inf"), float("nan")))
    monkeypatch.setattr(stability, "CASES", (broken,))
    assert cli.run(["convergence", "--study", "stability", "--json", "--quiet", "-o", str(tmp_path)]) == 1
    (row,) = json.loads(capfd.readouterr().out)["rows"]
    assert not row["holds"] and row["error"] is None and row["naive"] is None and row["naive_words"] == "infinite"


def test_rays_are_refused(tmp_path, capfd):
    assert cli.run(["convergence", "--study", "stability", "--rays", "100", "-o", str(tmp_path)]) == 2
    assert "--rays has no meaning" in capfd.readouterr().err


def test_a_project_is_refused():
    asked = StudyRequest(lens=object(), device="cpu", say=None, progress=None)
    with pytest.raises(InputError, match="PROJECT has no meaning"):
        STUDIES["stability"].measure(asked)
