"""Batch life: the same again is no work, progress a program can read, defaults from the environment, completion, make -j."""

import io
import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from helpers import write_blob
from rich.console import Console

from caustic_cli import cli
from caustic_cli.commands.console import ConsoleReporter
from caustic_cli.commands.figures import ended_words
from caustic_cli.inverse.designer import Designer
from caustic_cli.kinds import OneSurface
from caustic_cli.project import checkpoint
from caustic_cli.studies.radius import cost_of_radius
from caustic_cli.workflow import design as workflow
from caustic_cli.workflow import preparation, progress

DESIGN = [
    "design",
    "blob.png",
    "--resolution",
    "16",
    "--control",
    "9",
    "--rays",
    "2000",
    "--start",
    "offset",
    "--iterations",
    "3",
    "--threads",
    "1",
]
EXAMPLES = Path(__file__).parents[1] / "examples"
ENVIRONMENT = {**os.environ, "PYTHONPATH": str(Path(cli.__file__).parents[1])}


@pytest.fixture(autouse=True)
def _here(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    paint("blob.png", 5)
    monkeypatch.setenv("CAUSTIC_EFFORT", "test report=True")
    monkeypatch.setattr("caustic_cli.studies.design_report.write_report", lambda path, *rest: path.write_bytes(b"a report"))


def paint(name, centre):
    write_blob(name, 16, (centre, 6), 15.0)


def run(arguments, capfd, code=0):
    assert cli.run(list(map(str, arguments))) == code
    return capfd.readouterr()


def age(*paths):
    for path in paths:
        os.utime(path, (1000, 1000))


def forbidden(*args, **options):
    pytest.fail("worked although there was nothing to do")


def interrupt(*args, **options):
    raise KeyboardInterrupt


# the same again


def test_the_same_design_again_is_no_work(capfd, monkeypatch):
    first, _ = run([*DESIGN, "--json"], capfd)
    files = [Path("blob.caustic") / name for name in ("checkpoints.h5", "render.png", "report.png", "project.toml")]
    before = [p.read_bytes() for p in files]
    age(*files)
    monkeypatch.setattr(Designer, "run", forbidden)
    monkeypatch.setattr(OneSurface, "evaluate", forbidden)
    again, err = run([*DESIGN, "--json"], capfd)
    assert again == first and "nothing to do" in err and "--force" in err
    assert [p.read_bytes() for p in files] == before
    stamps = [p.stat().st_mtime for p in files]
    assert 1000 < stamps[0] <= stamps[1] <= stamps[2] and stamps[3] == 1000  # make finds them newer than the picture


def test_a_file_called_as_a_start_is_no_input(capfd):
    """DESIGN starts from the offset, whatever the directory holds of that name."""
    run(DESIGN, capfd)
    Path("offset").write_text("notes")
    assert "nothing to do" in run(DESIGN, capfd).err


def test_force_designs_the_same_again(capfd):
    run([*DESIGN, "--quiet"], capfd)
    age("blob.caustic/checkpoints.h5")
    _, err = run([*DESIGN, "--force"], capfd)
    assert "nothing to do" not in err and os.path.getmtime("blob.caustic/checkpoints.h5") > 1000


@pytest.mark.parametrize("change", ["option", "picture", "edited", "raised"])
def test_another_design_is_refused_as_before(capfd, change):
    run([*DESIGN, "--quiet"], capfd)
    more = ["--mag", "2"] if change == "option" else []
    if change == "picture":
        paint("blob.png", 7)
    if change == "edited":
        path = Path("blob.caustic/project.toml")
        path.write_text(path.read_text().replace("z = 300.0", "z = 301.0"))
    if change == "raised":
        run(["design", "--resume", "blob.caustic", "--iterations", "5", "--quiet"], capfd)
    assert "holds a design already" in run([*DESIGN, *more], capfd, 2).err


def test_an_unfinished_design_goes_on_when_it_is_asked_for_again(capfd, monkeypatch):
    with monkeypatch.context() as patch:  # killed after its last iteration, before the evaluation
        patch.setattr(workflow, "evaluate_and_write", interrupt)
        assert run([*DESIGN, "--quiet"], capfd, 130).err == "caustic: interrupted\n"
    assert not checkpoint.load(Path("blob.caustic/checkpoints.h5")).results
    out, err = run([*DESIGN, "--json"], capfd)
    assert "continues from its checkpoint" in err and json.loads(out)["iterations"] == 3
    Path("blob.caustic/render.png").unlink()  # and what is missing is made again
    assert "continues" in run(DESIGN, capfd).err and Path("blob.caustic/render.png").exists()
    assert "nothing to do" in run(DESIGN, capfd).err


@pytest.mark.parametrize("command", [DESIGN, ["render", "blob.caustic", "--rays", "3000"]], ids=["design", "render"])
def test_no_wave_image_of_another_lens_stands_beside_a_new_image(capfd, command):
    run([*DESIGN, "--quiet"], capfd)
    wave, mine, aside = (Path("blob.caustic") / name for name in ("wave.png", "mine-wave.png", "aside.png"))
    for path in (wave, mine):
        shutil.copy("blob.caustic/render.png", path)
    run(["render", "blob.caustic", "--rays", "3000", "-o", aside, "--effects", "fresnel"], capfd)
    assert wave.exists()  # render.png is as it was
    Path("blob.caustic/render.png").unlink()
    run(command, capfd)
    assert not wave.exists() and mine.exists()


def test_a_picture_that_is_not_ours_is_never_removed(capfd):
    run([*DESIGN, "--quiet"], capfd)
    wave = Path("blob.caustic/wave.png")
    shutil.copy("blob.png", wave)
    render = ["render", "blob.caustic", "--rays", "3000", "--effects", "fresnel"]
    assert "was not made by caustic" in run(render, capfd, 2).err
    run([*render, "--force"], capfd)
    assert wave.read_bytes() == Path("blob.png").read_bytes()


def test_a_start_from_another_lens_is_an_input(capfd):
    run([*DESIGN, "--quiet"], capfd)
    second = [*DESIGN[:8], "--start", "blob.caustic", "--iterations", "1", "-o", "second.caustic", "--threads", "1"]
    run(second, capfd)
    assert "nothing to do" in run(second, capfd).err
    run(["design", "--resume", "blob.caustic", "--iterations", "6", "--quiet"], capfd)
    assert "holds a design already" in run(second, capfd, 2).err


RENDER = ["render", "blob.caustic", "--rays", "3000", "-o", "a.png", "--npy", "a.npy", "--json"]
EXPORT = ["export", "blob.caustic", "--samples", "9", "-o", "a.npz", "--json"]


@pytest.mark.parametrize("command", [RENDER, EXPORT], ids=["render", "export"])
def test_the_same_output_again_is_no_work(capfd, monkeypatch, command):
    run([*DESIGN, "--quiet"], capfd)
    first, err = run(command, capfd)
    files = sorted(Path().glob("a.*"))
    assert "nothing to do" not in err and files
    age(*files)
    with monkeypatch.context() as patch:
        patch.setattr("caustic_cli.studies.retrace.retrace", forbidden)
        patch.setattr("caustic_cli.export.lighttools.write_lighttools", forbidden)
        again, err = run(command, capfd)
    assert again == first and "nothing to do" in err and all(p.stat().st_mtime > 1000 for p in files)
    assert "nothing to do" not in run([*command, "--force"], capfd).err
    option = ["--seed", "4"] if command is RENDER else ["--samples", "8"]
    assert "nothing to do" not in run([*command, *option], capfd).err
    assert "nothing to do" not in run(command, capfd).err  # that was another file
    for spoil in ("missing", "other bytes", "broken record"):
        if spoil == "missing":
            files[0].unlink()
        elif spoil == "other bytes":
            files[-1].write_bytes(files[-1].read_bytes()[:700] + files[-1].read_bytes()[701:] + b"caustic")
        else:
            Path("blob.caustic/.outputs.json").write_text('{"a": [1')
        assert "nothing to do" not in run(command, capfd).err
        assert "nothing to do" in run(command, capfd).err
    text = Path("blob.caustic/project.toml").read_text()
    Path("blob.caustic/project.toml").write_text(text.replace("z = 300.0", "z = 200.0"))
    assert "nothing to do" not in run(command, capfd).err


# progress


def test_progress_as_json_lines(capfd):
    out, err = run([*DESIGN, "--progress", "json", "--json"], capfd)
    lines = [json.loads(line) for line in err.splitlines()]
    assert json.loads(out)["iterations"] == 3
    steps = [line for line in lines if line["event"] == "progress"]
    assert steps and steps[-1]["done"] == steps[-1]["total"] == 3 and "loss" in steps[-1]["text"] and steps[-1]["seconds"] >= 0
    assert steps[-1]["seconds_left"] == 0 and all(step["seconds_left"] >= 0 for step in steps)
    assert {line["event"] for line in lines} == {"message", "progress", "result"}
    assert run([*DESIGN, "--progress", "json", "--quiet", "--force"], capfd).err == ""
    assert "--progress" in run([*DESIGN, "--progress", "moon"], capfd, 2).err


# the environment


def test_defaults_from_the_environment(capfd, monkeypatch):
    monkeypatch.setenv("CAUSTIC_DESIGN_MAG", "2")
    monkeypatch.setenv("CAUSTIC_DESIGN_LINEAR", "1")
    monkeypatch.setenv("CAUSTIC_SEED", "7")
    monkeypatch.setenv("CAUSTIC_QUIET", "1")
    assert run([*DESIGN, "--seed", "8"], capfd).err == ""
    text = Path("blob.caustic/project.toml").read_text()
    assert "size = [20.0, 20.0]" in text and 'encoding = "linear"' in text and "seed = 8" in text  # the command line wins
    run([*DESIGN, "-o", "other"], capfd)
    assert "seed = 7" in Path("other/project.toml").read_text()
    monkeypatch.setenv("CAUSTIC_DESIGN_MAG", "three")
    err = run(DESIGN, capfd, 2).err
    assert "--mag" in err and err.count("\n") == 1


# the shell and make


def test_completion_is_installed_and_completes(tmp_path):
    home = tmp_path / "home"
    home.mkdir()
    done = subprocess.run(
        ["bash", "-c", f"{sys.executable} -m caustic_cli --install-completion; exit $?"],  # the shell is that which calls it
        check=True,
        text=True,
        capture_output=True,
        env={**ENVIRONMENT, "HOME": str(home)},
    )
    assert "installed" in done.stdout and (home / ".bash_completions" / "caustic.sh").exists()
    asked = {"_CAUSTIC_COMPLETE": "complete_bash", "COMP_WORDS": "caustic render --screen", "COMP_CWORD": "2"}
    done = subprocess.run(
        [sys.executable, "-m", "caustic_cli"], check=True, text=True, capture_output=True, env=ENVIRONMENT | asked
    )
    assert "--screen-at" in done.stdout.split() and all(o.startswith("--screen") for o in done.stdout.split())


@pytest.mark.skipif(shutil.which("make") is None, reason="make is not installed")
def test_make_gives_each_of_several_jobs_one_thread():
    for name in ("Makefile", "flame.png", "flame.toml", "ball.png", "ball.toml", "tophat.png", "tophat.toml"):
        shutil.copy(EXAMPLES / name, name)
    Path("caustic").write_text(
        '#!/bin/sh\necho "$@" >> log\nmkdir -p "${2%.png}.caustic"\n'
        "if [ $1 = design ]; then touch ${2%.png}.caustic/checkpoints.h5; echo stage 1/1 >&2; else touch $2/render.png; fi\n"
    )
    Path("caustic").chmod(0o755)
    for jobs, expected in ((["-j2"], True), ([], False)):
        subprocess.run(["make", *jobs, "CAUSTIC=./caustic"], check=True, capture_output=True)
        said = Path("log").read_text().splitlines()
        assert all(Path(f"{name}.log").read_text() == "stage 1/1\n" for name in ("flame", "ball", "tophat"))
        assert len(said) == 6 and all(("--threads 1" in line) == expected for line in said)
        Path("log").unlink()
        done = subprocess.run(["make", *jobs, "CAUSTIC=./caustic"], check=True, capture_output=True, text=True)
        assert "Nothing to be done" in done.stdout
        subprocess.run(["make", "clean"], check=True, capture_output=True)


@pytest.mark.skipif(shutil.which("make") is None, reason="make is not installed")
def test_make_takes_a_bare_picture_and_tabulates_a_batch():
    """Settings are used where there are some; a design that fails says why, and leaves no figures."""
    shutil.copy(EXAMPLES / "Makefile", "Makefile")
    for name in ("plain", "set", "broken"):
        paint(f"{name}.png", 5)
    Path("set.toml").write_text("")
    Path("caustic").write_text(
        '#!/bin/sh\n[ $2 = broken.png ] && echo no light >&2 && exit 1\nmkdir -p "${2%.png}.caustic"; echo "$@" >&2\n'
        "touch ${2%.png}.caustic/checkpoints.h5\n"
        'echo \'{"error": 0.125, "error_by": "waves", "on_target": 0.5, "iterations": 3, "seconds": 1.5, "image": "x"}\'\n'
    )
    Path("caustic").chmod(0o755)
    ask = ["make", "CAUSTIC=./caustic"]
    subprocess.run([*ask, "PICTURES=plain set", "figures.csv"], check=True, capture_output=True)
    assert Path("figures.csv").read_text().split() == [
        "picture,error,error_by,on_target,iterations,seconds",
        "plain,0.125,waves,0.5,3,1.5",
        "set,0.125,waves,0.5,3,1.5",
    ]
    assert "--config" not in Path("plain.log").read_text() and "--config set.toml" in Path("set.log").read_text()
    again = subprocess.run([*ask, "PICTURES=plain set", "figures.csv"], check=True, capture_output=True, text=True)
    assert "design" not in again.stdout  # only the table, since PICTURES may be others
    os.utime("set.toml", (2**31, 2**31))
    again = subprocess.run([*ask, "-n", "PICTURES=plain set", "figures.csv"], check=True, capture_output=True, text=True)
    assert "design set.png" in again.stdout and "design plain.png" not in again.stdout
    done = subprocess.run([*ask, "PICTURES=broken", "figures.csv"], check=False, capture_output=True, text=True)
    assert done.returncode == 2 and "no light" in done.stderr and not Path("broken.json").exists()


# what a run says


def test_an_interruption_before_the_first_checkpoint_says_what_is_kept(capfd, monkeypatch):
    with monkeypatch.context() as patch:
        patch.setattr(preparation, "first_heights", interrupt)
        said = run([*DESIGN, "--quiet"], capfd, 130).err
    assert said == "caustic: interrupted; before the first checkpoint: nothing was written to blob.caustic\n"
    assert not Path("blob.caustic").exists()
    with monkeypatch.context() as patch:
        patch.setattr(progress.Records, "keep_behind", interrupt)
        said = run([*DESIGN, "--quiet"], capfd, 130).err
    assert "blob.caustic holds the settings and the picture" in said and "design --resume blob.caustic" in said
    assert json.loads(run(["design", "--resume", "blob.caustic", "--json", "--quiet"], capfd).out)["iterations"] == 3
    assert run(["render", "nowhere"], capfd, 2).err.count("\n") == 1  # and nothing of it is left for the next command


def test_how_a_design_ended_is_said_in_words():
    assert ended_words("iterations") == "after all its iterations"
    assert ended_words("no progress; its start was better and is kept").endswith("progress; its start was better and is kept")
    assert ended_words("no wave image") == "no wave image"


@pytest.mark.parametrize(
    ("value", "noise", "words"),
    [
        (0.0123, 0.0004, "1.23% a mm, noise 0.04%"),
        (-0.0123, None, "-1.23% a mm"),
        (2e-6, 1e-7, "0.0002% a mm, noise 1e-05%"),
        (2e-6, 1e-5, "no difference beyond the noise of 0.001% a mm"),
        (0.0, None, "no difference"),
    ],
)
def test_a_small_cost_is_not_rounded_to_nothing(value, noise, words):
    assert cost_of_radius({"in_black_per_mm": value, "noise": noise}) == words


@pytest.mark.parametrize("width", [80, 120])
def test_time_left_is_shown_on_every_terminal(width):
    """Of the iterations, and of the evaluation after the last one."""
    shown = io.StringIO()
    reporter = ConsoleReporter()
    reporter.console = Console(file=shown, force_terminal=True, width=width)
    with reporter.progress(14) as show:
        show("stage 1/1", "loss 0.1000  on screen 91.0%", 14, 14)
    assert "14/14" in shown.getvalue() and "left" in shown.getvalue()
    with reporter.waiting("evaluation with independent rays", 100.0):
        pass
    assert "evaluation with independent rays about 100 s left" in shown.getvalue()
