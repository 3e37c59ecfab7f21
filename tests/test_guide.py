"""The guide's commands and Python run as they stand, in a directory with the examples' pictures, on few rays and pixels."""

from __future__ import annotations

import os
import re
import runpy
import shlex
import shutil
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from caustic_cli import cli

ROOT = Path(__file__).resolve().parent.parent
GUIDE = ROOT / "examples" / "guide"
CHAPTERS = sorted(GUIDE.glob("[0-9]*-*.md"))
#: So that every design is a small one; what a line says itself goes before.
SMALL = {
    f"CAUSTIC_{name}": value
    for name, value in {
        "DESIGN_RESOLUTION": "24",
        "DESIGN_ITERATIONS": "2",
        "DESIGN_CONTROL": "40",
        "DESIGN_LENS_SIZE": "6",
        "DESIGN_THROW": "180",
        "DESIGN_WAVES": "off",
        "DESIGN_QUIET": "1",
        "DESIGN_THREADS": "1",
        "DESIGN_FORCE": "1",
        "RENDER_QUIET": "1",
        "RENDER_RAYS": "20000",
        "RENDER_FORCE": "1",
        "CONVERGENCE_QUIET": "1",
        "CONVERGENCE_FORCE": "1",
    }.items()
}
OF_HEIGHT_FIELDS = [f"CAUSTIC_DESIGN_{name}" for name in ("RESOLUTION", "ITERATIONS", "CONTROL", "LENS_SIZE", "THROW", "WAVES")]
#: Lines that need what no chapter makes, and studies of minutes, which tests of their own run smaller.
NEEDS_MORE = ("--verify", "--source-file led.tm25ray", "--study diffraction", "led.caustic --study light", "--explain")
NEEDS_MORE += ("--tolerances", "--robust", "--day", "blank.caustic", "flat.npy")
#: Networks, which `test_over_range.py` trains smaller.
NEEDS_MORE += ("zoom.caustic", "--networks")
#: What takes longest, and is tested by itself: limits, movies, programs for a mill.
NEEDS_MORE += ("--photo", "--correct", "--min-radius 2", "--movie", "--roughing", "portrait.nc", "--tolerance 0.01", "--rays 1e7")


def blocks(path: Path, language: str) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```", path.read_text("utf-8"), re.M | re.S)


def commands(path: Path) -> list[list[str]]:
    """The arguments of each line that calls caustic."""
    lines = [line.strip() for block in blocks(path, "sh") for line in block.splitlines()]
    return [
        shlex.split(line, comments=True)[1:]
        for line in lines
        if line.startswith("caustic ") and not any(word in line for word in NEEDS_MORE)
    ]


@pytest.fixture(scope="module")
def home(tmp_path_factory):
    """A directory with the pictures, the thesis' configurations and three projects, that all chapters work in."""
    directory = tmp_path_factory.mktemp("guide")
    before = Path.cwd()
    with pytest.MonkeyPatch.context() as patch:
        for name, value in SMALL.items():
            patch.setenv(name, value)
        os.chdir(directory)
        for name in ("flame.png", "tophat.png", "ball.png", "house.png", "array-sheet.png", "array-wanted.png", "dial.png"):
            shutil.copy(ROOT / "examples" / name, directory)
        shutil.copytree(ROOT / "examples" / "thesis", directory / "thesis")
        for name in ("globe.toml", "folded.toml"):
            shutil.copy(ROOT / "examples" / name, directory)
        np.save(directory / "wave.npy", 0.5 * np.sin(np.linspace(0.0, 6.0, 40))[:, None] * np.cos(np.linspace(0.0, 4.0, 40)))
        x = np.linspace(0.0, 255.0, 64)
        Image.fromarray((0.5 * (x[:, None] + x[None, :])).astype(np.uint8)).save("portrait.jpg")
        for project, *more in (
            ("portrait.caustic", "portrait.jpg"),
            ("flame.caustic", "flame.png"),
            ("point.caustic", "flame.png", "--source", "point"),
            ("led.caustic", "flame.png", "--source", "disc", "--source-size", "1", "--control", "40"),
        ):
            assert cli.run(["design", *more, "-o", project]) == 0
        yield directory
        os.chdir(before)


@pytest.mark.parametrize("chapter", CHAPTERS, ids=lambda p: p.stem)
def test_the_commands_of_a_chapter_run(chapter, home, monkeypatch, capfd):
    monkeypatch.chdir(home)
    for arguments in commands(chapter):
        few = ["2e4" if k and arguments[k - 1] == "--rays" and float(a) > 2e4 else a for k, a in enumerate(arguments)]
        where = few.index("2>") if "2>" in few else len(few)
        if "--screen" in few or "window-floor" in few or "sundial" in few:  # which say where the screen is
            monkeypatch.delenv("CAUSTIC_DESIGN_THROW")
        if "--config" in few:  # which says how many control points there are
            monkeypatch.delenv("CAUSTIC_DESIGN_CONTROL")
        elif "--array" in few:  # which 3 or 5 lenslets share
            monkeypatch.setenv("CAUSTIC_DESIGN_CONTROL", "106")
        if "--lamp" in few or {"street", "spot", "headlamp"} & {*few}:  # which have no settings of a height field
            for name in OF_HEIGHT_FIELDS:
                monkeypatch.delenv(name, raising=False)
        status = cli.run(few[:where])
        for name in OF_HEIGHT_FIELDS:
            monkeypatch.setenv(name, SMALL[name])
        assert status == 0, f"caustic {shlex.join(arguments)}\n{capfd.readouterr().err}"


@pytest.mark.parametrize("chapter", [c for c in CHAPTERS if blocks(c, "python")], ids=lambda p: p.stem)
def test_the_python_of_a_chapter_runs(chapter, home, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    Image.open(home / "flame.png").resize((48, 48)).save("flame.png")
    for block in blocks(chapter, "python"):
        made: dict = {}
        exec(compile(block, str(chapter), "exec"), made)
        assert {"figures", "image", "near"} & made.keys()
        assert "lens.export" not in block or Path("lens.step").stat().st_size > 1000


@pytest.mark.parametrize("script", sorted((ROOT / "tests" / "benchmarks").glob("*.py")), ids=lambda p: p.stem)
def test_a_benchmark_says_what_it_takes(script, tmp_path, monkeypatch, capsys):
    pytest.importorskip("mitsuba" if script.stem == "intersection" else "caustic_cli")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", [str(script), "--help"])
    monkeypatch.setattr(sys, "path", [str(script.parent), *sys.path])
    with pytest.raises(SystemExit) as ended:
        runpy.run_path(str(script), run_name="__main__")
    assert not ended.value.code and capsys.readouterr().out.startswith("usage:") and not list(tmp_path.iterdir())


def test_links_of_the_documents_lead_somewhere():
    documents = [*(ROOT / name / "README.md" for name in ("", "caustic_cli", "tests/benchmarks")), *GUIDE.glob("*.md")]
    checked = 0
    for path in documents:
        for link in re.findall(r"\]\(([^)#]+)\)", path.read_text("utf-8")):
            if "://" not in link:
                assert (path.parent / link).exists(), f"{path}: {link}"
                checked += 1
    assert checked > 20 and len(CHAPTERS) >= 12


def test_the_readme_is_short_and_its_python_is_the_library():
    text = (ROOT / "README.md").read_text("utf-8")
    assert len(text.splitlines()) <= 140
    names = re.search(r"`from caustic_cli import ([a-z, ]+)`", text)[1].split(", ")
    assert set(names) <= set(__import__("caustic_cli").__all__)
