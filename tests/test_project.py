"""A project directory and its checkpoint: kept bitwise, refused in one line when damaged, and edited by hand."""

import json
import re
import shutil
import tracemalloc
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest
import torch
from PIL import Image

from caustic_cli import cli
from caustic_cli.commands.console import ConsoleReporter
from caustic_cli.errors import InputError
from caustic_cli.inverse.accuracy_cost import Row, Start
from caustic_cli.inverse.designer import State
from caustic_cli.optics.bspline import SplineSpace
from caustic_cli.project import checkpoint, directory, uptodate
from caustic_cli.project.checkpoint import Checkpoint
from caustic_cli.project.project import MADE, Project, beside
from caustic_cli.workflow import design as workflow
from caustic_cli.workflow import preparation

CONFIG = """
[lens]
control = [9, 8]
[screen]
resolution = [20, 20]
[[design.stages]]
control = [9, 8]
rays = 3000
iterations = 4
tolerance = 0.0
"""


@pytest.fixture(scope="module")
def designed(tmp_path_factory):
    """A finished little design; tests copy it."""
    folder = tmp_path_factory.mktemp("designed")
    x = np.arange(20)
    np.save(folder / "blob.npy", np.exp(-((x[:, None] - 6) ** 2 + (x - 12) ** 2) / 20.0) + 0.1)
    (folder / "c.toml").write_text(CONFIG)
    begun = preparation.prepare(
        folder / "blob.npy", {}, config=folder / "c.toml", out=folder / "blob.caustic", say=ConsoleReporter(quiet=True)
    )
    workflow.design(begun, "cpu", ConsoleReporter(quiet=True), Start.now())
    return begun.project.path


@pytest.fixture
def copy(designed, tmp_path):
    return shutil.copytree(designed, tmp_path / "blob.caustic")


def edit(project, pattern, replacement):
    path = project / "project.toml"
    text, count = re.subn(pattern, replacement, path.read_text(), flags=re.M)
    assert count >= 1
    path.write_text(text)


def render(project, capfd, *options):
    """Figures and image of `caustic render`."""
    npy = project / "image.npy"
    code = cli.run(["render", str(project), "--rays", "20000", "--npy", str(npy), "--json", "--quiet", *options])
    out, err = capfd.readouterr()
    assert code == 0, err
    return json.loads(out), np.load(npy)


def refusal(arguments, capfd):
    assert cli.run([str(a) for a in arguments]) == 2
    out, err = capfd.readouterr()
    assert out == "" and err.startswith("caustic: ") and err.count("\n") == 1
    return err


# the checkpoint


def sample(seed=0) -> Checkpoint:
    g = torch.Generator().manual_seed(seed)
    spaces = (
        SplineSpace(3, torch.tensor([0, 0, 0, 0, 0.3, 1, 1, 1, 1.0])),
        SplineSpace(2, torch.tensor([0, 0, 0, 0.1, 0.6, 1, 1, 1.0])),
    )
    state = State(
        torch.rand(5, 5, generator=g, dtype=torch.float64) * 1e-7 + 1 / 3,
        2,
        7,
        31,
        {"w.0": torch.rand(3, 2, generator=g), "b": torch.rand(4, generator=g, dtype=torch.float64)},
        {"0.step": torch.tensor(31.0), "k": torch.tensor(5), "empty": torch.zeros(0, 3)},
        [(1, 0, 0.1, 1.0, 0.5), (31, 2, 1e-300, 1 / 3, 1e9)],
        12.25,
        "time limit",
        accuracy=[Row(0, 1.5, 2.75, 1 / 3), Row(31, 9.5, 17.0, 0.1)],
    )
    return Checkpoint(state, spaces, {"seed": 0, "é": "ü"}, {"loss": 1 / 3, "lost": {"fresnel": 0.1}, "psnr_db": None})


def test_save_then_load_is_bitwise(tmp_path):
    before = sample()
    checkpoint.save(tmp_path / "c.h5", before)
    after = checkpoint.load(tmp_path / "c.h5")
    for name in ("parameters", "optimizer"):
        a, b = getattr(before.state, name), getattr(after.state, name)
        assert a.keys() == b.keys()
        assert all(torch.equal(a[k], b[k]) and a[k].dtype == b[k].dtype and a[k].shape == b[k].shape for k in a)
    assert torch.equal(before.state.heights, after.state.heights)
    for name in ("stage", "iteration", "total", "history", "accuracy", "seconds", "reason"):
        assert getattr(before.state, name) == getattr(after.state, name), name
    assert [s.degree for s in after.spaces] == [3, 2]
    assert all(torch.equal(a.knots, b.knots) for a, b in zip(before.spaces, after.spaces, strict=True))
    assert after.provenance == before.provenance and after.results == before.results


def test_the_same_state_is_the_same_bytes(tmp_path):
    for name in ("a.h5", "b.h5"):
        checkpoint.save(tmp_path / name, sample())
    assert (tmp_path / "a.h5").read_bytes() == (tmp_path / "b.h5").read_bytes()
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a.h5", "b.h5"]


def test_a_failed_save_spares_the_last(tmp_path):
    checkpoint.save(tmp_path / "c.h5", sample())
    before, broken = (tmp_path / "c.h5").read_bytes(), sample()
    broken.provenance["x"] = object()
    with pytest.raises(TypeError):
        checkpoint.save(tmp_path / "c.h5", broken)
    assert (tmp_path / "c.h5").read_bytes() == before and len(list(tmp_path.iterdir())) == 1


def _foreign(path):
    with h5py.File(path, "w") as f:
        f["x"] = [1, 2, 3]


def _changed(change):
    def apply(path):
        with h5py.File(path, "r+") as f:
            change(f)

    return apply


def _bad_heights(f):
    f["lens/heights"][0, 0] = np.nan


def _replace(name, value):
    def change(f):
        del f[name]
        f[name] = value

    return _changed(change)


DAMAGE = {
    "missing": lambda p: p.unlink(),
    "empty": lambda p: p.write_bytes(b""),
    "text": lambda p: p.write_text("hello"),
    "half": lambda p: p.write_bytes(p.read_bytes()[: p.stat().st_size // 2]),
    "foreign": _foreign,
    "newer": _changed(lambda f: f.attrs.__setitem__("format_version", 99)),
    "no lens": _changed(lambda f: f.__delitem__("lens")),
    "no provenance": _changed(lambda f: f.attrs.__delitem__("provenance")),
    "bad json": _changed(lambda f: f.attrs.__setitem__("results", "{")),
    "nan": _changed(_bad_heights),
    "other shape": _replace("lens/heights", np.zeros((3, 3))),
    "one-dimensional": _replace("lens/heights", np.zeros(25)),
    "knots out of order": _replace("lens/knots_u", np.array([0, 0, 0, 0, 2, 1, 1, 1, 1.0])),
    "text for heights": _replace("lens/heights", "hello"),
    "short history": _replace("history", np.zeros((3, 2))),
}


@pytest.mark.parametrize("kind", DAMAGE)
def test_a_damaged_checkpoint_is_refused(tmp_path, kind):
    path = tmp_path / "c.h5"
    checkpoint.save(path, sample())
    DAMAGE[kind](path)
    with pytest.raises(InputError) as caught:
        checkpoint.load(path)
    assert str(path) in str(caught.value) and "\n" not in str(caught.value)
    assert kind != "newer" or "99" in str(caught.value)


def test_a_truncated_checkpoint_is_refused_wherever_it_ends(tmp_path, monkeypatch):
    monkeypatch.setattr(checkpoint, "_version", lambda path: 1)  # takes half a second, and would not object
    path = tmp_path / "c.h5"
    checkpoint.save(path, sample())
    data = path.read_bytes()
    for length in np.linspace(0, len(data) - 1, 25).astype(int):
        path.write_bytes(data[:length])
        with pytest.raises(InputError):
            checkpoint.load(path)


# the project


def test_open_gives_back_what_was_written(copy):
    project = Project.open(copy)
    before = (copy / "project.toml").read_bytes(), (copy / "target.npy").read_bytes()
    project.write()
    assert ((copy / "project.toml").read_bytes(), (copy / "target.npy").read_bytes()) == before
    _, field, _, state = project.lens(project.scene())
    assert field.shape == (9, 8) and state.state.total == 4 and state.results["iterations"] == 4
    assert state.provenance["seed"] == 0 and len(state.provenance["target_sha256"]) == 64


def test_moving_a_project_keeps_it_whole(copy, tmp_path, capfd):
    first, _ = render(copy, capfd)
    moved = copy.rename(tmp_path / "elsewhere")
    second, _ = render(moved, capfd)
    assert second["loss"] == first["loss"]


def test_editing_the_throw_changes_the_image(copy, capfd):
    _, far = render(copy, capfd)
    edit(copy, r"^z = 300\.0", "z = 150.0")
    _, near = render(copy, capfd)
    x = np.arange(20) - 9.5

    def width(image):
        column = image.sum(1) / image.sum()
        return np.sqrt((column * x**2).sum() - (column * x).sum() ** 2)

    assert width(near) < 0.75 * width(far)  # half way, the spread beyond the aperture's own width is about half


def test_editing_the_resolution_keeps_the_light(copy, capfd):
    first, _ = render(copy, capfd)
    edit(copy, r"^resolution = .*$", "resolution = [10, 14]")
    second, image = render(copy, capfd)
    assert image.shape == (10, 14) and second["on_screen"] == pytest.approx(first["on_screen"], abs=1e-6)


@pytest.mark.parametrize(
    ("pattern", "replacement", "words"),
    [
        (r"^control = \[9, 8\]", "control = [12, 12]", ["control", "[12, 12]", "[9, 8]"]),
        (r"^degree = \[3, 3\]", "degree = [2, 2]", ["degree", "[2, 2]", "[3, 3]"]),
        (r"^degree = \[3, 3\]", "degree = [0, 3]", ["degree", "1", "15"]),
        (r"^index = .*$", "indx = 1.5", ["indx", "index"]),
        (r"^format_version = 1", "format_version = 2", ["format_version"]),
        (r"^size = \[10\.0, 10\.0\]", "size = [-1, 10]", ["[lens] size"]),
        (r"^file = .*$", "file = '../target.npy'", ["file"]),
        (r"^file = .*$", "file = 'none.png'", ["none.png"]),
        (r"^file = .*$", "file = 'wave.png'", ["'wave.png'"]),
        (r"^type = .*$", "type = 'sun'", ["[source] type", "plane"]),
        (r"^flip = .*$", "flip = 'q'", ["[target] flip"]),
        (r"^encoding = .*$", "encoding = 'moon'", ["[target] encoding"]),
        (r"^\[lens\]$", "[lens", ["TOML"]),
    ],
)
def test_a_bad_edit_is_refused_in_one_line(copy, capfd, pattern, replacement, words):
    edit(copy, pattern, replacement)
    before = sorted((p.name, p.read_bytes()) for p in copy.iterdir())
    message = refusal(["render", copy, "--rays", "1000"], capfd)
    assert "project.toml" in message and all(word in message for word in words), message
    assert sorted((p.name, p.read_bytes()) for p in copy.iterdir()) == before


def test_editing_the_stages_away_from_the_checkpoint_is_refused_on_resume(copy, capfd):
    edit(copy, r"^control = \[9, 8\]", "control = [12, 12]")
    assert "control" in refusal(["design", "--resume", copy], capfd)


@pytest.mark.parametrize("command", [["render"], ["gradmap"], ["export"], ["design", "--resume"]])
def test_not_a_project(tmp_path, monkeypatch, capfd, command):
    monkeypatch.chdir(tmp_path)
    for name in ("none", "empty"):
        if name == "empty":
            (tmp_path / name).mkdir()
        assert "project" in refusal([*command, name], capfd)
    assert [p.name for p in tmp_path.iterdir()] == ["empty"] and not any((tmp_path / "empty").iterdir())


@pytest.mark.parametrize("name", ["project.toml", "checkpoints.h5", "target.npy"])
def test_an_output_never_replaces_what_the_project_is_made_of(copy, capfd, name):
    before = (copy / name).read_bytes()
    refusal(["render", copy, "--rays", "1000", "-o", copy / name], capfd)
    assert (copy / name).read_bytes() == before


# the wave image beside the ray image


@pytest.mark.parametrize(("ray", "wave"), [("p/render.png", "p/wave.png"), ("render.npy", "wave.npy"), ("a.b.png", "a.b-wave.png")])
def test_where_a_wave_image_belongs(ray, wave):
    assert beside(Path(ray)) == Path(wave)


def test_a_new_design_leaves_nothing_of_the_one_before(copy):
    for name in MADE:
        (copy / name).write_bytes(b"of before")
    (copy / "notes.txt").write_text("mine")
    directory.create(Project.open(copy), True)
    assert sorted(p.name for p in copy.iterdir()) == [".outputs.json", "notes.txt", "project.toml", "target.npy"]


def test_a_directory_that_cannot_be_replaced_is_unlocked_again(copy):
    (copy / "render.png").unlink(missing_ok=True)
    (copy / "render.png").mkdir()
    with pytest.raises(InputError, match="is a directory") as refused:  # which keeps everything of the attempt alive
        directory.create(Project.open(copy), True)
    with directory.locked(copy):
        assert refused.value is not None


@pytest.mark.parametrize("results", [{"loss": 1.0}, {"loss": 1.0, "wave_relative_rms": None}, {"wave_relative_rms": 0.1}])
def test_finished_where_every_image_stands_that_was_made(copy, results):
    project = Project.open(copy)
    state = replace(project.load(), results=results)
    (copy / "report.png").touch()
    assert (uptodate.finished(project, state) is None) == (results.get("wave_relative_rms") is not None)
    (copy / "wave.png").touch()
    assert uptodate.finished(project, state)["project"] == str(copy)


# the source's profile


def test_a_profile_weights_the_light(designed, tmp_path, monkeypatch, capfd):
    """Only the aperture's +x half shines, so light arrives on that side only, and all of it is accounted for."""
    monkeypatch.chdir(tmp_path)
    profile = np.zeros((4, 3))
    profile[2:] = 1.0
    np.save("half.npy", profile)
    Image.fromarray(np.full((8, 8), 200, dtype=np.uint8)).save("even.png")
    (tmp_path / "c.toml").write_text("[source]\nprofile = 'half.npy'\n" + CONFIG.replace("iterations = 4", "iterations = 1"))
    assert cli.run(["design", "even.png", "--config", "c.toml", "--start", "offset", "--quiet"]) == 0
    capfd.readouterr()
    assert np.array_equal(np.load("even.caustic/profile.npy"), profile)
    figures, image = render(tmp_path / "even.caustic", capfd)
    assert image[:8].sum() < 1e-3 * image.sum() < image[12:].sum()
    assert figures["on_screen"] + sum(figures["lost"].values()) == pytest.approx(1.0, abs=1e-12)


@pytest.mark.parametrize("profile", ["none.npy", "dark.npy", "text.npy"])
def test_a_bad_profile_is_refused_before_anything_is_made(tmp_path, monkeypatch, capfd, profile):
    monkeypatch.chdir(tmp_path)
    np.save("dark.npy", np.zeros((4, 4)))
    (tmp_path / "text.npy").write_text("no")
    Image.fromarray(np.full((8, 8), 200, dtype=np.uint8)).save("even.png")
    (tmp_path / "c.toml").write_text(f"[source]\nprofile = '{profile}'\n" + CONFIG)
    assert profile in refusal(["design", "even.png", "--config", "c.toml"], capfd)
    assert not (tmp_path / "even.caustic").exists()


def test_a_checkpoint_is_held_once_while_it_is_written(tmp_path):
    """Of an optimiser's pairs, many times the lens, memory gets one copy."""
    pairs = {name: torch.ones(20, 200_000, dtype=torch.float64) for name in "sy"}  # 64 MB
    net = torch.ones(4, 4, dtype=torch.float64)
    state = State(net, parameters={"raw": net}, optimizer=pairs)
    tracemalloc.start()
    try:
        checkpoint.save(tmp_path / "c.h5", Checkpoint(state, (SplineSpace.uniform(4, 3),) * 2, {}, {}))
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    size = (tmp_path / "c.h5").stat().st_size
    assert size > 60e6
    assert peak < 1.5 * size
    assert torch.equal(checkpoint.load(tmp_path / "c.h5").state.optimizer["y"], pairs["y"])
