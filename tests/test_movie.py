"""`caustic design --movie`: its frames are the images of the objective, and its file is written atomically."""

import os
import stat
from pathlib import Path

import numpy as np
import pytest
import torch
from helpers import write_blob
from PIL import Image

from caustic_cli import cli, design
from caustic_cli.errors import CausticError, InputError
from caustic_cli.inverse.designer import State
from caustic_cli.io import movie as files
from caustic_cli.io.files import is_ours
from caustic_cli.workflow import movie as movies

FEW = {"design": {"iterations": 3}, "screen": {"resolution": [24, 24]}}
SMALL = ["--resolution", "24", "--waves", "off", "--threads", "1", "--quiet"]


@pytest.fixture
def small(monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    write_blob()


def pictures(path: str) -> tuple[list[np.ndarray], list[int]]:
    """Frames of a GIF and how long each is shown, ms."""
    with Image.open(path) as file:
        found = []
        for k in range(file.n_frames):
            file.seek(k)
            found.append((np.asarray(file.convert("L")), file.info["duration"]))
    shown, times = zip(*found, strict=True)
    return list(shown), list(times)


def test_a_design_is_recorded(small, monkeypatch):
    """A frame for every iteration, and the finished lens' image for two seconds, as render.png has it."""
    held = []
    drawn = movies._drawn
    monkeypatch.setattr(movies, "_drawn", lambda frame: held.append(frame) or drawn(frame))
    assert cli.run(["design", "blob.png", *SMALL, "--iterations", "6", "--movie", "blob.gif"]) == 0
    shown, times = pictures("blob.gif")
    assert len(shown) == len(held) == 7 and times[-1] == 2000 and len(set(times[:-1])) == 1
    assert is_ours("blob.gif")
    errors = [float(frame.words[1].split()[3].strip(",")) for frame in held]
    assert errors[5] < errors[0]
    with Image.open("blob.caustic/render.png") as last:
        times = last.size[0] // held[-1].codes.shape[1]
        assert last.size[0] >= 800 and (np.asarray(last)[::times, ::times] == held[-1].codes).all()
    assert held[-1].words[0].startswith("finished after iteration 6")
    for frame, seen in zip(held, shown, strict=True):
        picture = np.asarray(Image.fromarray(frame.codes).resize((480, 480), Image.Resampling.BILINEAR)).astype(int)
        assert np.abs(seen[:480].astype(int) - picture).max() <= 2


def test_recording_changes_no_lens(small):
    with_one = design("blob.png", waves="off", settings=FEW, movie="one.gif")
    without = design("blob.png", waves="off", settings=FEW)
    assert (with_one.heights == without.heights).all() and "movie" in with_one.figures and "movie" not in without.figures


def test_an_interrupted_design_leaves_the_movie_of_what_was_done(small, monkeypatch):
    record, told = movies.Movie.record, []

    def counted(self, *given):
        record(self, *given)
        told.append(1)
        if len(told) == 3:
            os.kill(os.getpid(), 2)

    monkeypatch.setattr(movies.Movie, "record", counted)
    assert cli.run(["design", "blob.png", *SMALL, "--iterations", "6", "--movie", "blob.gif"]) == 130
    assert len(pictures("blob.gif")[0]) == 3
    assert cli.run(["design", "--resume", "blob.caustic", "--quiet", "--movie", "rest.gif"]) == 0
    assert len(pictures("rest.gif")[0]) == 4


def test_what_is_no_movie_is_refused_before_anything_is_done(small, monkeypatch, capfd):
    monkeypatch.setattr(files, "_ffmpeg", lambda: None)
    Path("mine.gif").write_bytes(b"GIF89a, mine")
    for name, words in (("a.avi", "must end in .gif or .mp4"), ("a.mp4", "needs ffmpeg"), ("mine.gif", "was not made by caustic")):
        assert cli.run(["design", "blob.png", *SMALL, "--movie", name]) == 2
        said = capfd.readouterr().err
        assert words in said and len(said.splitlines()) == 1
        with pytest.raises(InputError, match=words):
            design("blob.png", movie=name)
    assert not Path("blob.caustic").exists() and Path("mine.gif").read_bytes() == b"GIF89a, mine"


def test_a_design_found_finished_says_that_there_is_no_movie(small, capfd):
    given = ["design", "blob.png", *SMALL[:-1], "--iterations", "2"]
    assert cli.run(given) == 0
    Path("blob.caustic/report.png").touch()  # which small designs leave out
    assert cli.run([*given, "--movie", "late.gif"]) == 0
    assert "late.gif: is not written" in capfd.readouterr().err and not Path("late.gif").exists()


def test_long_designs_keep_few_frames(tmp_path):
    movie, target = movies.Movie(tmp_path / "long.gif"), np.ones((4, 4))
    for k in range(1000):
        image = np.full((4, 4), 1.0 + k)
        state = State(None, total=k + 1, history=[(k + 1, 0, 0.0, 1.0, 0.1 * k)])
        state.image = torch.from_numpy(image)
        movie.record(state, target, "srgb", waves=False)
    seen = [int(frame.words[0].split()[3].strip(",")) for frame in movie.frames]
    assert movies.MOST / 2 <= len(seen) <= movies.MOST and seen[0] == 1 and len(set(np.diff(seen))) == 1


def test_an_mp4_is_encoded_by_ffmpeg_whole_or_not_at_all(tmp_path, monkeypatch):
    """Against a program that keeps what it is given in place of encoding it."""
    program = tmp_path / "ffmpeg"
    program.write_text('#!/bin/sh\nfor last; do :; done\nprintf "%s " "$@" > "$0.said"\ncat > "$last"\n')
    program.chmod(program.stat().st_mode | stat.S_IXUSR)
    monkeypatch.setenv("PATH", f"{tmp_path}{os.pathsep}{os.environ['PATH']}")
    frames = [Image.fromarray(np.full((3, 5), grey, dtype=np.uint8)) for grey in (10, 20)]
    made = tmp_path / "made.mp4"
    files.write_movie(made, frames, [80, 40])
    said, data = (tmp_path / "ffmpeg.said").read_text(), np.frombuffer(made.read_bytes(), dtype=np.uint8).reshape(-1, 4, 6, 3)
    assert "-s 6x4" in said and "comment=created by caustic" in said and data[:, 0, 0, 0].tolist() == [10, 10, 20]
    assert (data[:, 3] == 0).all() and (data[:, :, 5] == 0).all()
    program.write_text("#!/bin/sh\ncat > /dev/null\necho no such codec >&2\nexit 3\n")
    with pytest.raises(CausticError, match="no such codec"):
        files.write_movie(tmp_path / "broken.mp4", frames, [80, 40])
    assert not list(tmp_path.glob("*broken*"))
