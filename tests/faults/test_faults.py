"""Disks that are full, files that are damaged, places that vanish or are taken, memory that runs out: one sentence each."""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from helpers import write_blob

from caustic_cli import cli
from caustic_cli.errors import CausticError
from caustic_cli.inverse.objective import Objective
from caustic_cli.inverse.schedule import LossImage
from caustic_cli.io import files
from caustic_cli.optics import memory, trace
from caustic_cli.optics.reconstruction import Filter
from caustic_cli.optics.sampling import Sampler
from caustic_cli.optics.surfaces.heightfield import HeightField
from caustic_cli.project import checkpoint, directory
from caustic_cli.project.project import Project
from caustic_cli.scene import Lens, Offset, PlaneWave, Scene, Screen
from caustic_cli.workflow import design as workflow
from caustic_cli.workflow import preparation

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
    "--quiet",
    "--threads",
    "1",
]


@pytest.fixture(autouse=True)
def _here(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    write_blob("blob.png", 16, (5, 6), 15.0)


def run(arguments, capfd, code):
    """The error line of a command that ends with `code`."""
    assert cli.run([str(a) for a in arguments]) == code
    out, err = capfd.readouterr()
    assert (out != "") == (code == 0) and (code == 0 or (err.startswith("caustic: ") and err.count("\n") == 1)), err
    return err


def content(folder) -> dict:
    return {str(p.relative_to(folder)): p.read_bytes() for p in sorted(Path(folder).rglob("*")) if p.is_file()}


# full disk

FULL = """
import json, resource, sys
from caustic_cli import cli
from caustic_cli.workflow import design as workflow
from caustic_cli.workflow import preparation
resource.setrlimit(resource.RLIMIT_FSIZE, (9500, 9500))  # writing beyond fails as on a full disk
for arguments in json.load(sys.stdin):
    print(cli.run(arguments), flush=True)
"""


def test_a_full_disk_ends_in_1_with_what_was_there_before(capfd):
    run(DESIGN, capfd, 0)
    assert Path("blob.caustic/checkpoints.h5").stat().st_size > 9500 > Path("blob.caustic/project.toml").stat().st_size
    before = content("blob.caustic")
    orders = [
        ["design", "--resume", "blob.caustic", "--iterations", "5", "--quiet"],
        [*DESIGN, "-o", "new.caustic"],
        *(["export", "blob.caustic", "--samples", "40", "--quiet", "--format", f] for f in ("lighttools", "stl")),
    ]
    environment = {**os.environ, "PYTHONPATH": str(Path(cli.__file__).parents[1]), "CAUSTIC_KERNELS": "torch"}
    done = subprocess.run(
        [sys.executable, "-c", FULL], input=json.dumps(orders), capture_output=True, text=True, check=False, env=environment
    )
    assert done.stdout.split() == ["1"] * 4, done.stderr
    said = done.stderr.splitlines()
    assert len(said) == 4 and all("could not be written (File too large)" in line for line in said)
    assert "the one before is intact" in said[0] and "nothing of it is on disk" in said[1]
    after = content("blob.caustic")
    assert {k: v for k, v in after.items() if k != "project.toml"} == {k: v for k, v in before.items() if k != "project.toml"}
    assert sorted(p.name for p in Path().iterdir()) == ["blob.caustic", "blob.png", "new.caustic"]
    assert sorted(p.name for p in Path("new.caustic").iterdir()) == [".outputs.json", "project.toml", "target.png"]
    run(["design", "--resume", "new.caustic", "--quiet"], capfd, 0)  # with room again, it begins
    assert Project.open("new.caustic").load().state.total == 3


def test_a_directory_that_vanishes_is_said(capfd, monkeypatch):
    def save(self, state, nets):
        if state.state.total == 3:
            self.path.rename("elsewhere")
        checkpoint.save(self.path / "checkpoints.h5", state)

    monkeypatch.setattr(Project, "save", save)
    err = run(DESIGN, capfd, 1)
    assert "blob.caustic/checkpoints.h5" in err and "No such file or directory" in err and "iteration 0" in err


def test_what_killed_writers_left_is_swept(monkeypatch):
    old, young, other = Path(".a.npy.abcdefgh.npy"), Path(".a.npy.12345678.npy"), Path(".a.npy.mine.npy")
    for path in (old, young, other):
        path.write_bytes(b"half")
    os.utime(old, (1, 1)), os.utime(other, (1, 1))
    files.write_bytes("a.npy", b"whole")
    assert not old.exists() and young.exists() and other.exists()


# damage


def test_a_flipped_bit_anywhere_in_a_checkpoint_is_found(capfd, monkeypatch):
    run(DESIGN, capfd, 0)
    path, chance = Path("blob.caustic/checkpoints.h5"), np.random.default_rng(0)
    whole = path.read_bytes()
    places = np.unique(np.concatenate([np.arange(0, 600, 7), chance.integers(0, len(whole), 250)]))
    look = checkpoint._version
    monkeypatch.setattr(checkpoint, "_version", lambda path: 1)  # takes half a second, and would not object
    for k in places:
        data = bytearray(whole)
        data[k] ^= 1 << int(chance.integers(8))
        path.write_bytes(data)
        with pytest.raises(CausticError, match=r"checkpoints\.h5"):
            checkpoint.load(path)
    assert len(places) > 200
    monkeypatch.setattr(checkpoint, "_version", look)
    for command in (["render", "blob.caustic"], ["export", "blob.caustic"], ["design", "--resume", "blob.caustic"]):
        assert "damaged" in run([*command, "--quiet"], capfd, 2)


def test_a_checkpoint_without_checksum_still_opens(capfd):
    run(DESIGN, capfd, 0)
    path = Path("blob.caustic/checkpoints.h5")
    before = checkpoint.load(path).state.heights
    path.write_bytes(path.read_bytes()[checkpoint.SEAL :])
    assert torch.equal(checkpoint.load(path).state.heights, before)


def test_a_flipped_bit_in_project_toml_is_refused_or_harmless(capfd):
    run(DESIGN, capfd, 0)
    path, chance, codes = Path("blob.caustic/project.toml"), np.random.default_rng(0), []
    whole = path.read_bytes()
    for k in chance.integers(0, len(whole), 30):
        data = bytearray(whole)
        data[k] ^= 1 << int(chance.integers(8))
        path.write_bytes(data)
        codes.append(cli.run(["export", "blob.caustic", "--samples", "3", "-o", "a.npz", "--quiet"]))
        err = capfd.readouterr().err
        assert codes[-1] in (0, 2) and err.count("\n") == (codes[-1] == 2), err
    assert set(codes) == {0, 2}


# two at once


def test_one_design_at_a_time_holds_a_project(capfd, monkeypatch):
    run(DESIGN, capfd, 0)
    before, inner = content("blob.caustic"), []
    with directory.locked(Path("blob.caustic")):
        for arguments in (["design", "--resume", "blob.caustic", "--iterations", "5", "--quiet"], [*DESIGN, "--force"]):
            assert "another caustic design is running there" in run(arguments, capfd, 2)
        assert content("blob.caustic") == before
        run(["export", "blob.caustic", "--quiet"], capfd, 0)  # to look is allowed
    judged = workflow.evaluate_and_write

    def judge(*arguments):
        inner.append(cli.run(["design", "--resume", str(arguments[0].path), "--quiet"]))
        return judged(*arguments)

    monkeypatch.setattr(workflow, "evaluate_and_write", judge)
    for arguments in ([*DESIGN, "-o", "fresh"], [*DESIGN, "--force"], ["design", "--resume", "fresh", "--quiet"]):
        assert cli.run(arguments) == 0
    assert inner == [2, 2, 2]
    capfd.readouterr()
    assert {p.name for p in Path().glob("*/.*")} == {".outputs.json"}


def test_a_place_half_born_is_free(capfd):
    Path("empty").mkdir()
    run([*DESIGN, "-o", "empty"], capfd, 0)
    for name in ("project.toml", "checkpoints.h5", "render.png"):
        (Path("empty") / name).unlink()
    run([*DESIGN, "-o", "empty"], capfd, 0)
    for name in ("project.toml", "checkpoints.h5", "render.png"):
        (Path("empty") / name).unlink()
    shutil.copy("empty/target.png", "empty/second.png")  # and whatever else is written before project.toml
    for name in ("screen.npy", "index.npy", "tolerances.toml", "source.csv", ".second.png.1"):
        (Path("empty") / name).touch()
    run([*DESIGN, "-o", "empty"], capfd, 0)
    (Path("empty") / "project.toml").unlink()  # a lens is there
    assert "not a caustic project" in run([*DESIGN, "-o", "empty"], capfd, 2)


# out of memory

LENS = Lens((10.0, 8.0), 0.0, 1.5, (7, 6), (3, 2), offset=Offset(3.0))
SCENE = Scene(PlaneWave(), LENS, Screen((11.0, 9.0), 60.0, (12, 9)))
FIELD = HeightField.of(LENS)


def scarce(monkeypatch, most: int) -> list:
    """Let there be memory for `most` rays at a time, as torch says it on a CPU; the sizes that were tried."""
    tried, whole = [], trace.Tracer

    class Tracer(whole):
        def __init__(self, system, rays, *rest, **options):
            tried.append(int(np.prod(rays.shape)))
            if tried[-1] > most:
                raise RuntimeError(
                    "[enforce fail at alloc_cpu.cpp:121] data. DefaultCPUAllocator: can't allocate memory: you tried"
                    " to allocate 8388608 bytes. Error code 12 (Cannot allocate memory)"
                )
            super().__init__(system, rays, *rest, **options)

    monkeypatch.setattr(trace, "Tracer", Tracer)
    return tried


@pytest.mark.parametrize("kind", ["lines", "uniform"])
def test_fewer_rays_at_a_time_are_tried_when_memory_runs_out(kind, monkeypatch):
    sampler, z = Sampler(kind, (200, 200), 1), 3.0 + 0.1 * torch.randn(7, 6, dtype=torch.float64)
    target = torch.rand(12, 9, dtype=torch.float64)
    make = lambda: Objective(SCENE, FIELD, sampler, target, "rms", LossImage(Filter("cosine", (3, 3))), dtype=torch.float64)  # noqa: E731
    plenty, image = make()(z), trace.expose(SCENE, FIELD, z, sampler).image
    tried = scarce(monkeypatch, 20_000)
    found = make()(z)
    assert max(tried) == 40_000 and min(tried) <= 20_000
    tried.clear()
    assert found.loss == pytest.approx(plenty.loss, rel=1e-12) and torch.allclose(found.gradient, plenty.gradient, rtol=1e-9)
    assert torch.allclose(trace.expose(SCENE, FIELD, z, sampler).image, image, rtol=1e-12)
    assert max(tried) == 40_000 and min(tried) <= 20_000


def test_memory_too_short_for_any_ray_is_one_sentence(monkeypatch, capfd):
    tried = scarce(monkeypatch, 0)
    err = run(DESIGN, capfd, 1)
    assert "out of memory" in err and "--control" in err and tried
    assert Project.open("blob.caustic").load().state.total == 0


def test_other_errors_are_not_taken_for_short_memory():
    tried = []

    def work(chunk):
        tried.append(chunk)
        raise RuntimeError("mat1 and mat2 shapes cannot be multiplied")

    with pytest.raises(RuntimeError, match="shapes") as caught:
        memory.with_smaller_chunks(work, 1 << 20)
    assert tried == [1 << 20] and caught.traceback[-1].name == "work"  # --debug shows where it came from


@pytest.mark.parametrize("error", [MemoryError(), RuntimeError("CUDA out of memory. Tried to allocate 2 GiB")])
def test_memory_short_anywhere_is_one_sentence(error, monkeypatch, capfd):
    def prepare(*args, **options):
        raise error

    monkeypatch.setattr(preparation, "prepare", prepare)
    assert "out of memory" in run(DESIGN, capfd, 1)
