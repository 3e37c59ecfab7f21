"""What was begun, or done, can be asked for again: no file of ours stands in the way."""

import json
import shutil
import threading
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from helpers import write_blob

from caustic_cli import cli, load
from caustic_cli.errors import CausticError
from caustic_cli.export import FORMATS
from caustic_cli.inverse.designer import Designer
from caustic_cli.kinds import problem_of
from caustic_cli.project import checkpoint, directory, packing
from caustic_cli.project.project import Project
from caustic_cli.studies import report
from caustic_cli.studies.report import Study
from caustic_cli.workflow import design as workflow
from caustic_cli.workflow import progress

DESIGN = ["design", "blob.png", "--resolution", "16", "--control", "9", "--rays", "2000", "--start", "offset", "--iterations", "1"]


def write_picture():
    write_blob("blob.png", 16, (5, 6), 15.0)


@pytest.fixture(scope="module")
def designed(tmp_path_factory):
    folder = tmp_path_factory.mktemp("again")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        write_picture()
        assert cli.run([*DESIGN, "--quiet", "--threads", "1"]) == 0
    return folder / "blob.caustic"


@pytest.fixture(autouse=True)
def _here(designed, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("CAUSTIC_EFFORT", "test report=True")  # without its report a design is not complete
    monkeypatch.setattr("caustic_cli.studies.design_report.write_report", lambda path, *rest: path.write_bytes(b"a report"))
    shutil.copytree(designed, "blob.caustic")


class Killed(Exception):
    """In place of a kill, behind which nothing more is written either."""


def no_room(*_):
    raise CausticError("no room")


def killed(*_):
    raise Killed


@pytest.mark.parametrize("at", ["first stage", "first checkpoint", "index"])
def test_a_design_killed_before_its_first_checkpoint_is_begun_anew(at, capfd, monkeypatch):
    """By the same command, as if nothing had been there; another command, or an edit, still finds a design in its way."""
    kept = "keep" if at == "index" else "keep_behind"
    where, name = (workflow, "_run") if at == "first stage" else (progress.Records, kept)
    options = ["--quiet", "--threads", "1", *(["--gradient", "free", "--index-control", "8"] if at == "index" else [])]
    command = [*(a for a in DESIGN if at != "index" or a not in ("--start", "offset")), *options]
    shutil.rmtree("blob.caustic")
    write_picture()
    with monkeypatch.context() as patch:
        patch.setattr(where, name, killed)
        assert cli.run(command) == 1
    files = {p.name: p.read_bytes() for p in Path("blob.caustic").iterdir()}
    assert "project.toml" in files and "checkpoints.h5" not in files and ("index.npy" in files) == (at == "index")
    capfd.readouterr()
    assert cli.run([*command, "--mag", "2"]) == 2 and "holds a design already" in capfd.readouterr().err
    toml = Path("blob.caustic/project.toml")
    toml.write_text(toml.read_text().replace("seed = 0", "seed = 7"))
    assert cli.run(command) == 2 and "holds a design already" in capfd.readouterr().err
    toml.write_bytes(files["project.toml"])
    assert {p.name: p.read_bytes() for p in Path("blob.caustic").iterdir()} == files
    assert cli.run([*command, "-o", "whole.caustic"]) == cli.run(command) == 0
    again, whole = (load(f"{name}.caustic") for name in ("blob", "whole"))
    assert torch.equal(again.heights, whole.heights) and again.figures["relative_rms"] == whole.figures["relative_rms"]
    assert cli.run([*command[: command.index("--quiet")], *command[command.index("--quiet") + 1 :]]) == 0
    assert "nothing to do" in capfd.readouterr().err


def test_a_checkpoint_that_cannot_be_written_behind_ends_the_design(capfd, monkeypatch):
    """The first by the next iteration at the latest, a later one with the word that the one before is intact."""
    shutil.rmtree("blob.caustic")
    write_picture()
    command = [*DESIGN, "--quiet", "--threads", "1"]
    with monkeypatch.context() as patch:
        patch.setattr(Project, "save", no_room)
        assert cli.run(command) == 1
    assert capfd.readouterr().err == "caustic: no room after iteration 0; nothing of it is on disk\n"
    assert not Path("blob.caustic/checkpoints.h5").exists()
    assert cli.run(command) == 0
    with monkeypatch.context() as patch:
        patch.setattr(Project, "save", no_room)
        patch.setattr(progress.Watch, "keep_if_due", lambda watch, now: watch.records.keep_behind(now))
        assert cli.run(["design", "--resume", "blob.caustic", "--iterations", "5", "--quiet", "--threads", "1"]) == 1
    said = capfd.readouterr().err
    assert said.count("\n") == 1 and "no room after iteration" in said and "the one before is intact" in said
    assert load("blob.caustic").figures["iterations"] == 1


@pytest.mark.parametrize("optimizer", ["adam", "lbfgs"])
def test_a_checkpoint_written_behind_is_that_of_its_iteration(optimizer, monkeypatch):
    """Adam changes parameters and moments in place, which a resumed design would find of another iteration than the lens."""
    shutil.rmtree("blob.caustic")
    write_picture()
    assert cli.run([*DESIGN, "--optimizer", optimizer, "--quiet", "--threads", "1"]) == 0
    project, further, kept = Project.open("blob.caustic"), threading.Event(), {}
    designer, write = Designer(problem_of(project)), checkpoint.save

    def slowly(*what):
        further.wait(0.3)
        write(*what)

    def on_iteration(now):
        if now.total == 3:
            further.set()
        if now.total == 2:
            kept.update({name: value.clone() for name, value in (now.parameters | now.optimizer).items()})
            records.keep_behind(now)

    monkeypatch.setattr(checkpoint, "save", slowly)
    with progress.Records(project, designer) as records:
        designer.run(designer.initial_state(), iterations=4, on_iteration=on_iteration)
    found = project.load().state
    assert found.total == 2
    for name, value in (found.parameters | found.optimizer).items():
        assert torch.equal(value, kept[name]), name


def test_a_checkpoint_written_behind_does_not_wait_for_nets_behind_it():
    """Those of a design whose last checkpoint is still to be written when its lens is evaluated."""
    project, written = Project.open("blob.caustic"), threading.Event()
    designer, state = Designer(problem_of(project)), project.load().state
    records = progress.Records(project, designer)
    records._behind.submit(written.wait)
    records.keep_behind(state)
    writing = records._writing
    records.prepare(state)
    written.set()
    try:
        assert writing.result(5.0) is None
    finally:
        records._packed[1].cancel()  # what it would wait for without end
        records._behind.shutdown()


def test_nets_compressed_before_they_are_kept_are_those_that_are_kept(monkeypatch):
    """Also where the lens that is kept is another than was expected."""
    monkeypatch.setattr(packing, "LARGE", 1)
    project = Project.open("blob.caustic")
    designer, state = Designer(problem_of(project)), project.load().state
    state.heights = packing.rounded(state.heights)
    start = packing.rounded(state.start)
    for other in (False, True):
        with progress.Records(project, designer) as records:
            records.prepare(state)
            kept = replace(state, start=start) if other else state
            records.keep(kept)
        found = project.load().state
        assert torch.equal(found.heights, state.heights) and torch.equal(found.start, kept.start)


def test_a_resumed_design_remembers_its_command(capfd, monkeypatch):
    """Resumed before its first checkpoint, it is found by the command that began it, which has nothing left to do."""
    shutil.rmtree("blob.caustic")
    write_picture()
    with monkeypatch.context() as patch:
        patch.setattr(workflow, "_run", killed)
        assert cli.run([*DESIGN, "--quiet", "--threads", "1"]) == 1
    assert cli.run(["design", "--resume", "blob.caustic", "--quiet", "--threads", "1"]) == 0
    capfd.readouterr()
    assert cli.run([*DESIGN, "--threads", "1"]) == 0 and "nothing to do" in capfd.readouterr().err


def test_a_lens_is_saved_as_a_whole(monkeypatch):
    lens = load("blob.caustic")
    with monkeypatch.context() as patch, pytest.raises(Killed):
        patch.setattr(directory.checkpoint, "save", killed)
        lens.save("saved.caustic")
    assert not Path("saved.caustic").exists()
    lens.save("saved.caustic")
    assert torch.equal(load("saved.caustic").heights, lens.heights)


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
