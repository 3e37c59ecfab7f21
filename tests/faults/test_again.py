"""What was begun, or done, can be asked for again: no file of ours stands in the way."""

import json
import shutil
from pathlib import Path

import pytest
from helpers import write_blob

from caustic_cli import cli
from caustic_cli.errors import CausticError
from caustic_cli.export import FORMATS
from caustic_cli.studies import report
from caustic_cli.studies.report import Study
from caustic_cli.workflow import evaluation

DESIGN = ["design", "blob.png", "--resolution", "16", "--control", "9", "--rays", "2000", "--start", "offset", "--iterations", "1"]


@pytest.fixture(scope="module")
def designed(tmp_path_factory):
    folder = tmp_path_factory.mktemp("again")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        patch.setattr(evaluation, "FINAL_RAYS", 2000)
        patch.setattr(evaluation, "write_report", lambda *args: None)
        write_blob("blob.png", 16, (5, 6), 15.0)
        assert cli.run([*DESIGN, "--quiet", "--threads", "1"]) == 0
    return folder / "blob.caustic"


@pytest.fixture(autouse=True)
def _here(designed, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    shutil.copytree(designed, "blob.caustic")


@pytest.mark.parametrize("format", FORMATS)
def test_every_format_again(format, capfd):
    """The same is no work; with other options it takes the place of what it was; what is not ours, or edited, stays."""
    more = {"step": [], "gcode": ["--step-over", "0.3"]}.get(format, ["--samples", "11"])
    export = ["export", "blob.caustic", "--format", format]
    assert cli.run([*export, "--json"]) == 0
    path = Path(json.loads(capfd.readouterr().out)["file"])
    first = path.read_bytes()
    assert cli.run(export) == 0 and "nothing to do" in capfd.readouterr().err
    assert cli.run([*export, *more]) == 0 and ("nothing to do" in capfd.readouterr().err) == (not more)
    assert (path.read_bytes() == first) == (not more or format == "mitsuba")  # whose meshes are beside it
    path.write_bytes(b"x_mm,y_mm,z_mm\n1,2,3\n")
    assert cli.run(export) == 2 and "was not made by caustic" in capfd.readouterr().err
    assert cli.run([*export, "--force"]) == 0 and path.read_bytes() == first


def test_a_study_that_could_not_be_written_whole(monkeypatch):
    """Whichever file the disk had no room for, the study can be written once it has."""
    rows = [{"series": "a", "error": 0.1, "seconds": 1.0}, {"series": "a", "error": 0.2, "seconds": 0.5}]
    about = {"reference_error": 0.0, "orders_of": "error"}
    study = Study("probe", dict.fromkeys(rows[0], ""), rows, {}, "none", about)
    paths, really = report.paths_of("probe", "out"), report.write_bytes
    for full in paths[:2]:

        def write(path, data, full=full):
            if path == full:
                raise CausticError("no room")
            really(path, data)

        with monkeypatch.context() as patch, pytest.raises(CausticError, match="no room"):
            patch.setattr(report, "write_bytes", write)
            report.write(study, "out")
        report.refuse_foreign_files(paths)
    assert report.write(study, "out") == paths and all(p.stat().st_size for p in paths)
