"""The cases of the study of stability, and its command."""

import dataclasses
import json
import math
import re
from pathlib import Path

import pytest

from caustic_cli import cli
from caustic_cli.errors import InputError
from caustic_cli.studies import stability
from caustic_cli.workflow.convergence import STUDIES, StudyRequest

GUIDE = Path(__file__).parents[2] / "examples" / "guide" / "15-hard-cases.md"


@pytest.mark.parametrize("case", stability.CASES, ids=lambda case: case.family)
def test_case_holds(case, kernels, compare):
    """In every setting, this program within the bound and the naive formula ten times beyond it."""
    for naive, ours in case.errors.values():
        compare(case.family, case.error_of, naive, ours, case.bound)


def test_command(tmp_path, capfd):
    assert cli.run(["convergence", "--study", "stability", "--json", "--quiet", "-o", str(tmp_path)]) == 0
    found = json.loads(capfd.readouterr().out)
    assert [row["series"] for row in found["rows"]] == [case.family for case in stability.CASES]
    assert all(row["holds"] and row["error"] <= row["bound"] and row["naive_words"] for row in found["rows"])
    assert all((tmp_path / f"stability.{end}").stat().st_size for end in ("csv", "json", "png"))


def figure(text: str) -> float:
    return {"NaN": math.nan, "infinite": math.inf}.get(text) or float(text)


def test_the_table_of_the_guide():
    """Cases and bounds as they are, naive errors as measured, errors of this program within their bounds."""
    lines = [line.strip("| ").split(" | ") for line in GUIDE.read_text("utf-8").splitlines() if line.startswith("| ")][2:]
    assert [(a, b, e) for a, b, _, _, e in lines] == [(c.family, c.error_of, stability.words(c.bound)) for c in stability.CASES]
    for (_, _, naive, here, bound), case in zip(lines, stability.CASES, strict=True):
        assert figure(naive) == pytest.approx(case.worst()[0], rel=0.1, nan_ok=True)
        assert figure(here) <= figure(bound)


def test_every_case_is_explained_in_the_guide():
    explained = re.findall(r"^- \*\*", GUIDE.read_text("utf-8").split("## ")[0], re.M)
    assert len(explained) == len(stability.CASES)


def test_every_file_of_hard_cases_is_mentioned_in_the_guide():
    files = [p.stem for p in Path(__file__).parent.glob("test_*.py") if p.stem != "test_cases"]
    assert len(files) > 10 and not [name for name in files if f"`{name}`" not in GUIDE.read_text("utf-8")]


def test_the_table_on_the_terminal(tmp_path, monkeypatch, capfd):
    monkeypatch.setattr(stability, "CASES", stability.CASES[2:4])
    assert cli.run(["convergence", "--study", "stability", "-o", str(tmp_path)]) == 0
    heading, *lines = [line for line in capfd.readouterr().out.splitlines() if line.startswith("  ")][:3]
    assert heading.split()[:5] == ["case", "naively", "here", "bound", "seconds"]
    starts = [heading.index(word) for word in ("naively", "here", "bound", "seconds", "error of")]
    for line, case in zip(lines, stability.CASES, strict=True):
        assert line[2:].startswith(case.family) and line.endswith(case.naively)
        assert all(line[k - 1] == " " and line[k] != " " for k in starts)


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
