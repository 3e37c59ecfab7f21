"""A value that is wrong by itself is answered before torch is loaded: in a second, not in five to ten."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest
from helpers import write_blob

from caustic_cli import cli
from caustic_cli.config import presets, settings
from caustic_cli.config.values import refuse_bad_file, refuse_bad_options
from caustic_cli.schema.table import TABLE

#: Runs each line of its input as a command; loading torch is an error of its own.
RUNNER = """
import shlex, sys
sys.modules["torch"] = None
from caustic_cli import cli
for line in sys.stdin:
    status = cli.run(shlex.split(line))
    print(f"status {status}", file=sys.stderr)
"""
DESIGN = [
    ("--mag -3", "--mag must be 0.001 to 1000, got -3"),
    ("--degree 0", "--degree must be whole numbers of at least 1"),
    ("--degree 20", "--degree must be a whole number 1 to 15, got 20"),
    ("--quality fien", "--quality must be one of draft, standard, fine, got 'fien'"),
    ("--source plan", "--source must be one of plane, point, grid, disc, gaussian, measured, rays, got 'plan'"),
    ("--loss rsm", "--loss must be names with weights"),
    ("--optimizer sgd", "--optimizer must be one of lbfgs, adam"),
    ("--glass N-BK8", "--glass must be one of"),
    ("--flip z", "--flip must be one of x, y, xy, got 'z'"),
    ("--waves maybe", "--waves must be one of auto, on, off"),
    ("--start nowhere", "--start must be transport, offset, a project directory or a lens surface, got 'nowhere'"),
    ("--robust none.toml", "none.toml: no such file"),
    ("--source rays --source-file none.dat", "none.dat: no such file"),
    ("--cone 20", "--cone belongs to --source point, grid or disc, got plane"),
    ("--index 0.5", "--index must be greater than 1"),
    ("--seed -1", "--seed must be a whole number 0 to"),
    ("--device gpu", "--device must be auto, cpu or cuda"),
    ("--dtype half", "--dtype must be one of float32, float64"),
    ("--config none.toml", "none.toml: no such file"),
    ("--config bad.toml", "bad.toml: [lens] degree must be a whole number 1 to 15, got 0"),
    ("--preset plate-1000", "--preset"),
]
PROJECT = "old.caustic/project.toml: [lens] degree must be a whole number 1 to 15, got 0"
OTHERS = [
    ("design --resume old.caustic", PROJECT),
    ("render old.caustic", PROJECT),
    ("gradmap old.caustic", PROJECT),
    ("export old.caustic", PROJECT),
    ("convergence old.caustic --study rays", PROJECT),
    ("render new.caustic --tolerances none.toml", "none.toml: no such file"),
    ("render new.caustic --source plan", "--source must be one of"),
]


@pytest.fixture(autouse=True)
def _here(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)


def test_a_bad_value_is_answered_without_torch():
    write_blob()
    for name, text in (("bad.toml", "[lens]\ndegree = [0, 3]\n"), ("old.caustic/project.toml", "[lens]\ndegree = [0, 3]\n")):
        Path(name).parent.mkdir(exist_ok=True)
        Path(name).write_text(text)
    Path("new.caustic").mkdir()
    Path("new.caustic/project.toml").write_text("")
    asked = [(f"design blob.png {words}", said) for words, said in DESIGN] + OTHERS
    done = subprocess.run(
        [sys.executable, "-c", RUNNER],
        input="\n".join(line for line, _ in asked),
        env={**os.environ, "PYTHONPATH": str(Path(cli.__file__).parents[1])},
        capture_output=True,
        text=True,
        check=True,
    )
    lines = done.stderr.splitlines()
    assert len(lines) == 2 * len(asked)
    for (line, said), answer, status in zip(asked, lines[::2], lines[1::2], strict=True):
        assert said in answer and answer.startswith("caustic: ") and status == "status 2", f"{line}: {answer}, {status}"


def test_what_is_good_is_not_refused():
    """Every default of the table, every preset, and infinity where it means none."""
    checked = 0
    for path, row in TABLE.items():
        if row.default is not None:
            refuse_bad_options({path: row.default})
            checked += 1
    assert checked > 60
    for name, *_ in presets.rows()[1:]:
        refuse_bad_file(presets.path_of(name), parameters=True)
    Path("good.toml").write_text("mag = 3\n[screen]\nradius = [60.0, inf]\n[source]\nposition = [[0, 0, -50], [1, 0, -50.0]]\n")
    assert settings.read(Path("good.toml"), True) == refuse_bad_file(Path("good.toml"), True)
