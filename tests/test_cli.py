"""The command line as users and scripts meet it: one line for bad input and nothing written, results alone on stdout."""

import json
import os
import re
import shlex
import shutil
import struct
import subprocess
import sys
import zlib
from pathlib import Path

import numpy as np
import pytest
import typer
from helpers import write_blob
from PIL import Image

from caustic_cli import __version__, cli
from caustic_cli.commands import console, parser
from caustic_cli.commands import help as help_of
from caustic_cli.export import FORMATS

COMMANDS = ("design", "render", "gradmap", "export", "convergence")
SHARED_KEYS = {
    "loss",
    "relative_rms",
    "psnr_db",
    "ssim",
    "in_black",
    "on_screen",
    "on_target",
    "of_source",
    "lost",
    "rays",
    "iterations",
    "seconds",
    "image",
}
LOST = {"missed_lens", "missed_surface", "total_internal_reflection", "fresnel", "absorbed", "off_screen"}
ENVIRONMENT = {**os.environ, "PYTHONPATH": str(Path(cli.__file__).parents[1])}


def png_header(width: int, height: int) -> bytes:
    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    return (
        b"\x89PNG\r\n\x1a\n"
        + chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, 8, 0, 0, 0, 0))
        + chunk(b"IDAT", zlib.compress(b"\0"))
        + chunk(b"IEND", b"")
    )


def run(text: str, capfd) -> tuple[int, str, str]:
    code = cli.run(shlex.split(text))
    return (code, *capfd.readouterr())


def listing(folder: Path) -> dict:
    return {str(p.relative_to(folder)): p.read_bytes() if p.is_file() else None for p in folder.rglob("*")}


@pytest.fixture(scope="module")
def designed(tmp_path_factory):
    """A directory with a picture and its finished project, and what `design --json` said."""
    folder = tmp_path_factory.mktemp("cli")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        patch.setenv("CAUSTIC_EFFORT", "test report=True")
        write_blob()
        text = "design blob.png --resolution 24 --control 12 --rays 4000 --iterations 2 --quiet --lens-size 5 --throw 150"
        assert cli.run(shlex.split(text)) == 0
    return folder


@pytest.fixture
def here(designed, tmp_path, monkeypatch):
    folder = tmp_path / "here"
    shutil.copytree(designed, folder)
    monkeypatch.chdir(folder)
    return folder


# bad input

#: Small, so that a row which is wrongly accepted fails at once.
DESIGN = "design blob.png -o new.caustic --resolution 24 --control 12 --iterations 1 --rays 1000 "
BAD = {
    "missing file": ("design none.png", "none.png"),
    "directory": ("design folder", "folder"),
    "not an image": ("design notes.png", "notes.png"),
    "truncated image": ("design cut.png", "cut.png"),
    "all black": ("design black.png", "black"),
    "one pixel": ("design pixel.png", "2 x 2"),
    "NaN": ("design nan.npy", "NaN"),
    "huge": ("design huge.png", "8192 x 8192"),
    "mag 0": (DESIGN + "--mag 0", "--mag"),
    "mag nan": (DESIGN + "--mag nan", "--mag"),
    "mag text": (DESIGN + "--mag three", "--mag"),
    "mag too large for the lens": ("design blob.png -o x --resolution 24 --mag 500", "--mag of at most about 50 is within reach"),
    "sun": (DESIGN + "--source sun", "--source disc with --source-angle 0.533"),
    "led": (DESIGN + "--source led", "--intensity lambertian"),
    "degree": (DESIGN + "--degree 99", "--degree"),
    "screen inside the lens": (DESIGN + "--throw 3", "--throw"),
    "throw nan": (DESIGN + "--throw nan", "--throw"),
    "source": (DESIGN + "--source moon", "--source"),
    "control": (DESIGN + "--control 2", "--control"),
    "control 1e9": (DESIGN + "--control 1e9", "--control"),
    "resolution": (DESIGN + "--resolution 0", "--resolution"),
    "resolution 1": (DESIGN + "--resolution 1", "--resolution"),
    "resolution 1e6": (DESIGN + "--resolution 1000000", "--resolution"),
    "rays": (DESIGN + "--rays 1.5", "--rays"),
    "rays 0": (DESIGN + "--rays 0", "--rays"),
    "glass": (DESIGN + "--glass wood", "wood"),
    "index": (DESIGN + "--index 1", "--index"),
    "lens size": (DESIGN + "--lens-size 0", "--lens-size"),
    "lens size text": (DESIGN + "--lens-size 10x10x10", "--lens-size"),
    "screen size": (DESIGN + "--screen-size -5", "--screen-size"),
    "margin": (DESIGN + "--margin -1", "--margin"),
    "min thickness": (DESIGN + "--min-thickness 50 --thickness 5", "--min-thickness of 50 mm leaves no room for the heights"),
    "loss": (DESIGN + "--loss moon", "--loss"),
    "network": (DESIGN + "--network moon", "--network"),
    "network and lbfgs": (DESIGN + "--network sparse --optimizer lbfgs", "--optimizer"),
    "optimizer": (DESIGN + "--optimizer moon", "--optimizer"),
    "lr": (DESIGN + "--lr 0", "--lr"),
    "quality": (DESIGN + "--quality moon", "--quality"),
    "flip": (DESIGN + "--flip q", "--flip"),
    "start": (DESIGN + "--start nowhere", "--start"),
    "iterations": (DESIGN + "--iterations 0", "--iterations"),
    "time limit": (DESIGN + "--time-limit 0", "--time-limit"),
    "time limit nan": (DESIGN + "--time-limit nan", "--time-limit"),
    "seed": (DESIGN + "--seed -1", "--seed"),
    "dtype": (DESIGN + "--dtype float16", "--dtype"),
    "device": (DESIGN + "--device moon", "--device"),
    "threads": (DESIGN + "--threads 0", "--threads"),
    "missing configuration": (DESIGN + "--config none.toml", "none.toml"),
    "bad configuration": (DESIGN + "--config bad.toml", "degree"),
    "foreign directory": ("design blob.png -o folder", "folder"),
    "file in the way": ("design blob.png -o blob.png", "blob.png"),
    "nowhere": ("design blob.png -o blob.png/x.caustic", "blob.png is not a directory"),
    "project in the way": ("design blob.png", "--force"),
    "resume of nothing": ("design --resume nothing.png", "nothing"),
    "unknown option": ("design blob.png --moon", "--moon"),
    "unknown command": ("moon", "moon"),
    "no target": ("design", "TARGET"),
    "two targets": ("design blob.png blob.png", "blob.png"),
    "render nothing": ("render none.caustic", "none.caustic"),
    "render rays": ("render blob.caustic --rays 0", "--rays"),
    "render reconstruction": ("render blob.caustic --reconstruction moon", "moon"),
    "render filter": ("render blob.caustic --reconstruction cosine --filter-size 2", "filter"),
    "render alpha": ("render blob.caustic --alpha 1", "--alpha"),
    "render screen in the lens": ("render blob.caustic --screen-at 1", "--screen-at"),
    "render over a foreign file": ("render blob.caustic -o blob.png", "--force"),
    "render npy over a foreign file": ("render blob.caustic --npy notes.png", "--force"),
    "render dtype": ("render blob.caustic --dtype moon", "--dtype"),
    "gradmap control": ("gradmap blob.caustic --control 99,0", "--control"),
    "gradmap control text": ("gradmap blob.caustic --control 1", "--control"),
    "gradmap bincount": ("gradmap blob.caustic --reconstruction bincount", "bincount"),
    "export format": ("export blob.caustic --format moon", "--format"),
    "export samples": ("export blob.caustic --samples 0", "--samples"),
    "export suffix": ("export blob.caustic -o lens.iges", "its suffix is not that of a format"),
    "export against the suffix": ("export blob.caustic --format step -o x.stl", "step is written to .step or .stp, not to .stl"),
    "export several to one": ("export blob.caustic --format step,stl -o x.step", "--out names one file"),
    "render a jpeg": ("render blob.caustic -o x.jpg", ".png"),
    "export samples of a step": ("export blob.caustic --format step --samples 9", "--samples"),
    "export tolerance": ("export blob.caustic --format stl --tolerance 0", "--tolerance"),
    "export tolerance of a table": ("export blob.caustic --format zemax --tolerance 1", "--tolerance"),
    "export tolerance gcode": ("export blob.caustic --format gcode --tolerance 0", "--tolerance"),
    "export script of a mesh": ("export blob.caustic --format ply --script", "--script"),
    "export mesh over a foreign file": ("export blob.caustic --format mitsuba -o mine.xml", "--force"),
    "start file": (DESIGN + "--start none.npz", "none.npz"),
    "start text": (DESIGN + "--start notes.step", "notes.step"),
    "render verify": ("render blob.caustic --verify moon", "--verify"),
    "render verify elsewhere": ("render blob.caustic --verify mitsuba --screen-at 280", "--screen-at"),
    "render no archive": ("render notes.npz", "notes.npz"),
    "export over the project": ("export blob.caustic -o blob.caustic/project.toml", "project.toml"),
    "render over the project": ("render blob.caustic --rays 1000 -o blob.caustic/project.toml", "project.toml"),
    "export over a foreign file": ("export blob.caustic -o blob.png", "--force"),
    "convergence study": ("convergence --study moon", "--study"),
    "convergence seconds of another study": ("convergence --study rays --seconds 3", "--seconds"),
    "convergence repeats of designs": ("convergence --study design --repeats 3", "--repeats"),
    "convergence precision of intersections": ("convergence --dtype float32", "--dtype"),
    "convergence no time": ("convergence blob.caustic --study design --seconds 0", "--seconds"),
    "convergence into a file": ("convergence -o blob.png", "blob.png"),
}


@pytest.fixture
def hazards(here):
    """The files the rows of BAD name."""
    (here / "folder").mkdir()
    (here / "folder" / "mine.txt").write_text("mine")
    for name in ("notes.png", "notes.step", "notes.npz", "mine-exit.ply"):
        (here / name).write_text("no picture")
    whole = (here / "blob.png").read_bytes()
    (here / "cut.png").write_bytes(whole[: len(whole) // 2])
    Image.new("L", (9, 9)).save(here / "black.png")
    Image.new("L", (1, 1), 9).save(here / "pixel.png")
    np.save(here / "nan.npy", np.array([[np.nan, 1.0], [1.0, 1.0]]))
    (here / "huge.png").write_bytes(png_header(20000, 20000))
    (here / "bad.toml").write_text("[lens]\ndegre = [3, 3]\n")
    return here


@pytest.mark.parametrize("row", BAD)
def test_bad_input_is_one_line_and_nothing_written(hazards, capfd, row):
    text, word = BAD[row]
    before = listing(hazards)
    code, out, err = run(text, capfd)
    assert listing(hazards) == before
    assert (code, out) == (2, "")
    assert err.startswith("caustic: ") and err.count("\n") == 1 and err.endswith("\n")
    assert word in err, err
    assert "internal error" not in err


def test_bad_input_is_quiet_about_nothing_else(hazards, capfd):
    _, _, loud = run("design black.png --quiet --json", capfd)
    assert loud == run("design black.png", capfd)[2]


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write anywhere")
def test_read_only_directory(here, capfd):
    here.chmod(0o500)
    try:
        code, out, err = run(DESIGN, capfd)
    finally:
        here.chmod(0o700)
    assert (code, out, err.count("\n")) == (2, "", 1)


def test_debug_shows_the_traceback(hazards):
    with pytest.raises(Exception, match="black"):
        cli.run(["design", "black.png", "--debug"])


def test_force_begins_anew_and_spares_other_files(here, capfd):
    (here / "blob.caustic" / "mine.txt").write_text("mine")
    code, _, err = run("design blob.png --force --resolution 20 --control 9 --rays 2000 --iterations 1 --quiet", capfd)
    assert code == 0, err
    assert (here / "blob.caustic" / "mine.txt").read_text() == "mine"
    assert "resolution = [20, 20]" in (here / "blob.caustic" / "project.toml").read_text()


# what goes where


def test_design_json(here, capfd):
    code, out, err = run("design blob.png --force --resolution 24 --control 12 --rays 4000 --iterations 2 --json", capfd)
    assert code == 0 and err != "" and "\x1b" not in err and "\r" not in err
    assert out.count("\n") == 1
    figures = json.loads(out)
    assert set(figures) >= SHARED_KEYS and set(figures["lost"]) == LOST
    assert figures["on_screen"] + sum(figures["lost"].values()) == pytest.approx(1.0, abs=1e-12)
    assert figures["relative_rms"] == pytest.approx(figures["loss"] * 24 * 24)
    assert 0 <= figures["on_target"] <= figures["on_screen"] <= 1
    assert figures["iterations"] == 2 and figures["seconds"] > 0 and Path(figures["image"]).is_file()


@pytest.mark.parametrize(
    "options",
    [
        "",
        "--reconstruction cosine --filter-size 5",
        "--screen-at 200",
        "--reconstruction gaussian --alpha 2 -o near.png --npy near.npy",
    ],
)
def test_render_json(here, capfd, options):
    code, out, err = run(f"render blob.caustic --rays 5000 --json --quiet {options}", capfd)
    assert (code, err) == (0, "") and out.count("\n") == 1
    figures = json.loads(out)
    assert set(figures) >= SHARED_KEYS and set(figures["lost"]) == LOST
    assert figures["on_screen"] + sum(figures["lost"].values()) == pytest.approx(1.0, abs=1e-12)
    assert 4500 < figures["rays"] < 5500 and Path(figures["image"]).is_file()


@pytest.mark.parametrize(
    "text",
    [
        "gradmap blob.caustic --rays 2000",
        "export blob.caustic",
        "export blob.caustic --format stl",
        "export blob.caustic --format mitsuba",
        "export blob.caustic --script",
        "convergence blob.caustic --rays 2000 --repeats 1 -o c",
        "convergence blob.caustic --study rays --rays 4000 --repeats 2 -o c",
        "convergence blob.caustic --study design --rays 2000 --seconds 0.05 -o c",
    ],
)
def test_the_others_print_one_object_too(here, capfd, text):
    code, out, err = run(text + " --json --quiet", capfd)
    assert (code, err) == (0, "") and out.count("\n") == 1 and isinstance(json.loads(out), dict)


@pytest.mark.parametrize(
    ("text", "result"),
    [
        ("design blob.png --force --resolution 24 --control 12 --rays 4000 --iterations 1", "relative RMS error"),
        ("render blob.caustic --rays 2000", "relative RMS error"),
        ("render blob.caustic --rays 2000 --explain", "normal incidence"),
        ("gradmap blob.caustic --rays 2000", "largest pixel"),
        ("export blob.caustic", " bytes"),
        ("convergence blob.caustic --study rays --rays 2000 --repeats 2", "advice"),
    ],
)
def test_quiet_is_silent_and_stdout_is_for_results(here, capfd, text, result):
    """The closing table; a repeated command prints it again.  With --json one object stands there instead."""
    code, out, err = run(text + " --quiet", capfd)
    assert (code, err) == (0, "") and result in out and "\x1b" not in out
    code, again, err = run(text, capfd)
    assert code == 0 and result in again and result not in err
    assert err != "" or text.startswith(("gradmap", "convergence"))  # these have nothing to say
    code, out, err = run(text + " --json", capfd)
    assert code == 0 and isinstance(json.loads(out), dict) and out.count("\n") == 1 and result not in err


@pytest.mark.parametrize(
    "text",
    [
        "render blob.caustic --rays 1000 -o a.png --npy a.npy",
        "gradmap blob.caustic --rays 1000 -o b.png",
        "export blob.caustic",
        *(f"export blob.caustic --format {name}" for name in FORMATS if name != "csv"),
        "export blob.caustic --script",
        "convergence blob.caustic --study rays --rays 2000 --repeats 2",
    ],
)
def test_what_it_made_it_replaces_unasked(here, capfd, text):
    for _ in range(2):
        code, _, err = run(text + " --quiet", capfd)
        assert code == 0, err


def test_the_table_names_the_file_whole(here, capfd):
    """Piped to a log there is no window to fit: a path cut short is a path lost."""
    name = "a-rather-long-name-" * 6 + ".png"
    _, out, _ = run(f"render blob.caustic --rays 1000 -o {name}", capfd)
    assert name in out


@pytest.mark.parametrize("encoding", ["utf-8", "ascii"])
def test_the_table_fits_a_terminal_and_any_encoding(monkeypatch, capfd, encoding):
    """Values are folded beside their names; what an encoding lacks is escaped, and control characters do nothing."""
    rows = [("lost", "a clause of nine words, µ, that is folded " * 4), ("image", "/no\x1b[2J\udcff.png")]
    with monkeypatch.context() as patch:
        patch.setattr(sys.stdout, "isatty", lambda: True)
        patch.setenv("COLUMNS", "50")
        sys.stdout.reconfigure(encoding=encoding)
        console.ConsoleReporter().table("a title", rows)
    sys.stdout.reconfigure(encoding="utf-8")
    lines = capfd.readouterr().out.splitlines()
    assert len(lines) > 5 and max(map(len, lines)) <= 50 + 3 * (encoding == "ascii")
    assert all(line.startswith("         ") for line in lines[2:-1]) and lines[-1] == "  image  /no?[2J?.png"


def test_render_traces_the_rays_of_the_verdict_and_keeps_the_better_picture(here, capfd, monkeypatch):
    monkeypatch.setenv("CAUSTIC_EFFORT", "test final_rays=200000")
    picture = Path("blob.caustic/render.png")
    of_design = picture.read_bytes()
    assert "so it is kept" in run("render blob.caustic --rays 500", capfd)[2] and picture.read_bytes() == of_design
    assert run("render blob.caustic --quiet --force", capfd)[0] == 0
    with Image.open(picture) as image:
        assert image.size[0] >= 800 and image.info["noise"]
    better = picture.read_bytes()
    code, out, err = run("render blob.caustic --rays 2000 --json", capfd)
    assert code == 0 and "so it is kept" in err and "--force" in err
    assert picture.read_bytes() == better and json.loads(out)["image_kept"]
    _, out, _ = run("render blob.caustic --json --quiet", capfd)
    assert 190_000 < json.loads(out)["rays"] < 210_000 and picture.read_bytes() == better  # the same again, to the byte
    for asked in ("--rays 2000 --force", "--screen-at 149 --rays 2000"):  # asked for, and of something else
        _, out, err = run(f"render blob.caustic {asked} --json", capfd)
        assert picture.read_bytes() != better and "image_kept" not in json.loads(out) and "is kept" not in err
        assert run("render blob.caustic --quiet --force", capfd)[0] == 0 and picture.read_bytes() == better
    assert run("render blob.caustic --rays 2000 --quiet -o small.png", capfd)[0] == 0
    with Image.open("small.png") as image:
        assert image.size == (24, 24)  # a pixel for each of the screen's


def test_no_color(here, capfd, monkeypatch):
    monkeypatch.setenv("FORCE_COLOR", "1")
    monkeypatch.setenv("TERM", "xterm-256color")
    monkeypatch.setenv("NO_COLOR", "1")
    _, _, err = run("render blob.caustic --rays 1000", capfd)
    assert not re.search(r"\x1b\[[0-9;]*(3[0-9]|4[0-9]|9[0-7])[0-9;]*m", err)


def test_a_picture_from_anywhere_makes_its_project_here(here, capfd):
    (here / "pictures").mkdir()
    (here / "blob.png").rename(here / "pictures" / "dot.png")
    code, _, err = run("design pictures/dot.png --resolution 20 --control 9 --rays 2000 --iterations 1 --quiet", capfd)
    assert code == 0, err
    assert sorted(p.name for p in (here / "dot.caustic").iterdir()) == [
        "checkpoints.h5",
        "project.toml",
        "render.png",
        "target.png",
    ]


def test_the_finished_project_has_all_five_files(designed):
    assert sorted(p.name for p in (designed / "blob.caustic").iterdir()) == [
        "checkpoints.h5",
        "project.toml",
        "render.png",
        "report.png",
        "target.png",
    ]


@pytest.mark.parametrize(
    ("options", "line"),
    [
        ("--lens-size 20x10", "size = [20.0, 10.0]"),
        ("--throw 200", "z = 200.0"),
        ("--index 1.49", "index = 1.49"),
        ("--glass PMMA", 'glass = "PMMA"'),
        ("--degree 2x4", "degree = [2, 4]"),
        ("--flip x", 'flip = "x"'),
        ("--linear", 'encoding = "linear"'),
        ("--min-thickness 2", "min_thickness = 2.0"),
        ("--loss rms", 'loss = "rms"'),
        ("--margin 1", "size = [60.0, 60.0]"),
        ("--mag 2", "size = [20.0, 20.0]"),
        ("--screen-size 50x40", "size = [50.0, 40.0]"),
        ("--resolution 24x12", "resolution = [24, 12]"),
        ("--config c.toml --seed 7", "seed = 7"),
        ("--config c.toml", "z = 250.0"),
        ("--config c.toml --throw 260", "z = 260.0"),
    ],
)
def test_options_reach_project_toml(here, capfd, options, line):
    (here / "c.toml").write_text("[screen]\nz = 250\n[design]\nseed = 5\n")
    resolution = "" if "--resolution" in options else "--resolution 20"
    code, _, err = run(f"design blob.png -o n {resolution} --control 9 --rays 1000 --iterations 1 --quiet {options}", capfd)
    assert code == 0, err
    assert any(row.startswith(line) for row in (here / "n" / "project.toml").read_text().splitlines())


# lenses from files


@pytest.mark.parametrize("file", ["lens.npz", "lens.step", "lens.npy"])
def test_a_design_begins_from_an_exported_lens(here, capfd, file):
    """With next to no iterations it is that lens still."""
    assert run("export blob.caustic -o lens.npz --samples 37 --quiet", capfd)[0] == 0
    assert run("export blob.caustic --format step -o lens.step --quiet", capfd)[0] == 0
    with np.load("lens.npz") as data:
        surface = data["z"]
        np.save("lens.npy", surface)
    code, _, err = run(
        f"design blob.png -o again --start {file} --lens-size 5 --throw 150 --resolution 24 --control 12 --rays 4000 --iterations 1"
        " --lr 1e-9 --optimizer adam --quiet",
        capfd,
    )
    assert code == 0, err
    assert run("export again -o again.npz --samples 37 --quiet", capfd)[0] == 0
    with np.load("again.npz") as data:
        assert data["control_points"].shape == (12, 12, 3)
        assert np.abs(data["z"] - surface).max() < 1e-6  # mm
        assert np.ptp(surface) > 0.1


def test_an_archive_renders_like_its_project(here, capfd):
    assert run("export blob.caustic -o lens.npz --quiet", capfd)[0] == 0
    assert run("render blob.caustic --rays 9000 --npy a.npy --quiet", capfd)[0] == 0
    code, out, err = run("render lens.npz --rays 9000 --npy b.npy --json --quiet", capfd)
    assert (code, err) == (0, "")
    figures = json.loads(out)
    assert figures["image"] == "lens-render.png" and figures["relative_rms"] is None and figures["on_target"] is None
    assert (np.load("a.npy") == np.load("b.npy")).all() and Path("lens-render.png").is_file()
    assert run("render lens.npz --source point", capfd)[0] == 2
    Path("e.toml").write_text("[z]\n")
    before = sorted(Path().iterdir())
    assert run("render lens.npz --rays 9000 -o t.png --tolerances e.toml", capfd)[0] == 2
    assert sorted(Path().iterdir()) == before


def test_a_script_of_a_scene_that_it_does_not_build_leaves_nothing_behind(here, capfd):
    shutil.copytree("blob.caustic", "tilted.caustic")
    toml = Path("tilted.caustic/project.toml")
    toml.write_text(toml.read_text().replace("[screen]\n", "[screen]\ntilt = [5.0, 0.0]\n"))
    code, out, err = run("export tilted.caustic --script -o lens.npz --quiet", capfd)
    assert (code, out) == (2, "") and "a tilted screen" in err and not [*Path().glob("lens*")]


# help and the process


def test_version(capfd):
    assert run("--version", capfd) == (0, f"caustic {__version__}\n", "")


def test_help_loads_no_torch():
    program = (
        "import sys; from caustic_cli.cli import run\n"
        f"for c in ([], *[[n] for n in {COMMANDS!r}]): assert run([*c, '--help']) == 0\n"
        "assert not {'torch', 'numba', 'matplotlib', 'h5py', 'scipy'} & set(sys.modules), 'help is slow'"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, env=ENVIRONMENT, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stderr == "" and done.stdout.count("Usage: caustic") == 1 + len(COMMANDS)


@pytest.mark.parametrize("name", COMMANDS)
def test_help_ends_with_two_examples_that_parse(capfd, name):
    code, out, err = run(f"{name} --help", capfd)
    assert (code, err) == (0, "")
    lines = [line.strip() for line in out.splitlines() if line.strip()]
    examples = lines[lines.index("Examples:") + 1 :]
    assert len(examples) == 2
    root = typer.main.get_command(parser.app)
    for example in examples:
        program, command, *arguments = shlex.split(example)
        assert (program, command) == ("caustic", name)
        context = root.commands[command].make_context(command, arguments)
        assert context.params


def test_every_option_has_help(capfd):
    checked = 0
    for name, command in typer.main.get_command(parser.app).commands.items():
        for parameter in command.params:
            assert parameter.help and parameter.help[0] != " ", (name, parameter.name)
            checked += 1
    assert checked > 60


@pytest.mark.parametrize("command", help_of.BASICS)
def test_help_is_grouped_and_begins_with_the_basics(capfd, command):
    _, out, _ = run(f"{command} --help", capfd)
    headings = [line[:-1] for line in out.splitlines() if line.endswith(":") and not line.startswith(" ")]
    assert headings[:2] == ["Arguments", "Basics"] and len(headings) > 5
    assert headings[2:] == [heading for heading in help_of.GROUPS if heading in headings]
    options = {o for p in typer.main.get_command(parser.app).commands[command].params for o in p.opts if o.startswith("--")}
    assert all(len(re.findall(rf"^  (-[a-z], )?{o}(?![-\w])", out, re.MULTILINE)) == 1 for o in options)


@pytest.mark.parametrize(
    ("text", "meant"),
    [
        ("design blob.png --magnification 3", "did you mean --mag?"),
        ("design blob.png --material PMMA", "did you mean --glass?"),
        ("design blob.png --lens-sizes 3", "did you mean --lens-size or --lenslets?"),
        ("render blob.caustic --output x.png", "did you mean --out?"),
        ("design -x.png", "a file whose name begins with a hyphen is given as ./-x.png"),
        ("design", "(caustic design --help says more)"),
        ("designn", "Did you mean 'design'? (caustic --help says more)"),
        ("design made.caustic", "made.caustic: is a project, not a picture; caustic design --resume made.caustic goes on with it"),
        ("render blob.png", "is a picture, not a project; caustic design blob.png makes its lens first"),
        ("render made", "did you mean made.caustic?"),
        ("design blob.png -o made.caustic --loss mse", "--loss must be names with weights"),
    ],
)
def test_what_was_meant(tmp_path, monkeypatch, capfd, text, meant):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", ["caustic", *text.split()])
    write_blob()
    Path("made.caustic").mkdir()
    Path("made.caustic/project.toml").touch()
    code, out, err = run(text, capfd)
    assert (code, out) == (2, "") and err.count("\n") == 1 and meant in err, err


def test_a_place_in_a_new_directory(tmp_path, monkeypatch, capfd):
    monkeypatch.chdir(tmp_path)
    write_blob()
    small = "--resolution 24 --control 12 --start offset --rays 4000 --iterations 1 --waves off --quiet"
    assert run(f"design blob.png -o 'new place/deeper/x.caustic' --glass acrylic --index 1.49 {small}", capfd)[0] == 0
    assert "index = 1.49" in Path("new place/deeper/x.caustic/project.toml").read_text()


def test_several_formats_at_once_and_the_format_of_a_suffix(here, capfd):
    code, out, err = run("export blob.caustic --format step,stl,heightmap --tolerance 0.01 --json --quiet", capfd)
    assert (code, err) == (0, "")
    assert [e["format"] for e in json.loads(out)["exports"]] == ["step", "stl", "heightmap"]
    assert run("export blob.caustic -o named.stl --tolerance 0.01 --quiet", capfd)[0] == 0
    assert Path("named.stl").read_bytes() == Path("blob.stl").read_bytes()
    code, out, _ = run("export blob.caustic -o named.stp", capfd)
    assert code == 0 and "heights are at most a nanometre off" in out and "; --tolerance 0 writes the exact one" in out
    code, out, _ = run("export blob.caustic --format step --tolerance 0 -o exact.step", capfd)
    assert code == 0 and "bytes, the spline itself" in out and Path("exact.step").stat().st_size > Path("named.stp").stat().st_size
    assert Path("named.stp").read_text().startswith("ISO-10303-21;")


def test_alone_it_shows_its_help(capfd):
    _, out, err = run("", capfd)
    said = out + err
    assert "Usage: caustic" in said and all(re.search(rf"^\W*{name}\b", said, re.M) for name in COMMANDS)


@pytest.mark.parametrize("arguments", [["--version"], ["--help"], ["design", "--help"]])
def test_a_closed_pipe_is_not_an_error(arguments):
    reading, writing = os.pipe()
    os.close(reading)
    try:
        done = subprocess.run(
            [sys.executable, "-m", "caustic_cli", *arguments],
            stdout=writing,
            stderr=subprocess.PIPE,
            text=True,
            env=ENVIRONMENT,
            check=False,
        )
    finally:
        os.close(writing)
    assert (done.returncode, done.stderr) == (0, "")


def test_results_into_a_closed_pipe(here):
    program = f"{shlex.quote(sys.executable)} -m caustic_cli export blob.caustic --json --quiet; echo $? >&2"
    done = subprocess.run(["bash", "-c", f"({program}) | true"], capture_output=True, text=True, env=ENVIRONMENT, check=False)
    assert done.stderr == "0\n"


@pytest.mark.parametrize("total", [None, 30])
def test_the_progress_bar_draws_on_a_terminal(total, monkeypatch, capfd):
    """Also while its total is not known yet, as a study's is not at first."""
    monkeypatch.setenv("TTY_COMPATIBLE", "1")
    monkeypatch.setenv("TERM", "xterm")
    reporter = console.ConsoleReporter()
    reporter.console._force_terminal = True
    with reporter.progress(total) as show:
        reporter.console.print("", end="")
        show("stage 1/2", "loss 0.5", 10, 30)
    assert "10/30" in capfd.readouterr().err
