"""Processes that torchrun starts give the bytes of one: designs of every kind, tolerances, studies; and end when one stops."""

import json
import os
import subprocess
import sys
from pathlib import Path

import h5py
import numpy as np
import pytest
import ranks_designs
import torch
from helpers import write_blob

from caustic_cli import cli
from caustic_cli.optics import ranks
from caustic_cli.optics.emission import rays_of
from caustic_cli.optics.surfaces.heightfield import HeightField
from caustic_cli.optics.trace import dealt_tracers
from caustic_cli.scene import Lens, Offset, PlaneWave, Points, Scene, Screen

needs_processes = pytest.mark.skipif(not torch.distributed.is_available(), reason="this torch has no torch.distributed")
ROOT = Path(cli.__file__).parents[1]
#: What differs from run to run.
UNEQUAL, TIMES = ("history", "accuracy"), ("seconds", "accuracy_cost", "image", "project")


def started(processes: int, *command: str) -> subprocess.Popen:
    """torchrun with this many processes of one thread each; command: a script or a module with its arguments."""
    environment = {**os.environ, "PYTHONPATH": f"{ROOT}:{ROOT / 'tests'}", "OMP_NUM_THREADS": "1"}
    torchrun = ["-m", "torch.distributed.run", "--standalone", "--nproc-per-node", str(processes)]
    run = [sys.executable, *(torchrun if processes > 1 else []), *command]
    return subprocess.Popen(run, env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def caustic(processes: int, *arguments: str) -> subprocess.Popen:
    """`caustic` by torchrun."""
    return started(processes, "-m", *(["--"] if processes > 1 else []), "caustic_cli", *arguments, "--quiet")


def ended(*runs: subprocess.Popen) -> None:
    """Wait for runs that must end well."""
    try:
        for run in runs:
            said = run.communicate(timeout=600)
            assert run.returncode == 0, said
    finally:
        for run in runs:
            run.terminate()


def contents(folder: Path) -> dict[str, object]:
    """All that a project holds but times and its own place."""
    found: dict[str, object] = {}
    for path in sorted(p for p in folder.rglob("*") if p.is_file()):
        found[path.name] = path.read_bytes()
        if path.suffix == ".h5":
            with h5py.File(path) as file:
                data: dict[str, object] = {"history": file["history"][:, :4].tobytes()}

                def keep(name, one, data=data):
                    if isinstance(one, h5py.Dataset) and name not in UNEQUAL:
                        data[name] = one[()].tobytes()

                file.visititems(keep)
                data |= {key: value for key, value in json.loads(file.attrs["results"]).items() if key not in TIMES}
            found[path.name] = data
    return found


@needs_processes
def test_designs_of_every_kind_are_the_bytes_of_one_process(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    lamps = "lamp_stages=((300,5000,4,0.1),) two_stages=((300,5000,4,0.1),) chip_stages=((300,5000,4,0.1),)"
    monkeypatch.setenv("CAUSTIC_EFFORT", f"test {lamps}")
    write_blob("blob.png", 16, (5, 6), 15.0)
    Path("errors.toml").write_text("draws = 10\n[index]\nsigma = 1e-3\n[throw]\nsigma = 1.0\n")
    ended(*(started(n, str(ROOT / "tests" / "ranks_designs.py"), f"by-{n}") for n in (1, 2, 3)))
    for name in ranks_designs.DESIGNS:
        one = contents(tmp_path / "by-1" / name)
        assert {"checkpoints.h5", "render.png"} <= set(one), name
        for n in (2, 3):
            assert contents(tmp_path / f"by-{n}" / name) == one, (name, n)
    rows = [json.loads(Path(f"by-{n}/studies.json").read_text()) for n in (1, 2, 3)]
    assert rows[0] == rows[1] == rows[2] and set(rows[0]) == set(ranks_designs.STUDIES) and all(map(len, rows[0].values()))
    shares = {n: [int(Path(f"by-{n}/rank-{k}.txt").read_text()) for k in range(n)] for n in (1, 2, 3)}
    assert {sum(share) for share in shares.values()} == {shares[1][0]}  # nothing is computed twice
    assert all(count > 0.2 * sum(share) for share in shares.values() for count in share)


@pytest.fixture(scope="module")
def lens(tmp_path_factory) -> Path:
    """A directory with a project, lens."""
    folder = tmp_path_factory.mktemp("ranks")
    write_blob(str(folder / "blob.png"), 16, (5, 6), 15.0)
    design = ["design", str(folder / "blob.png"), "--resolution", "16", "--control", "9", "--rays", "2000", "--start", "offset"]
    assert cli.run([*design, "--iterations", "2", "--waves", "off", "--quiet", "-o", str(folder / "lens")]) == 0
    errors = ("draws = 11", "[index]", "sigma = 1e-3", "[throw]", "sigma = 1.0", "[form_error]", "rms = 1e-4", "shortest = 2.0")
    (folder / "errors.toml").write_text("\n".join(errors))
    return folder


@needs_processes
def test_draws_and_finishes_are_the_bytes_of_one_process(lens, tmp_path):
    """Draws and sensitivities of a tolerance analysis, and figures of finishes."""
    render = ["render", str(lens / "lens"), "--tolerances", str(lens / "errors.toml"), "--finish", "list", "--rays", "1000"]
    for n in (1, 3):
        (tmp_path / f"{n}").mkdir()
    ended(*(caustic(n, *render, "-o", str(tmp_path / f"{n}" / "image.png")) for n in (1, 3)))
    one, three = ({p.name: p.read_bytes() for p in (tmp_path / f"{n}").iterdir()} for n in (1, 3))
    assert one == three and {path.rpartition("-")[2] for path in one} == {"image.png", "tolerances.csv", "tolerances.png"}


@needs_processes
def test_maps_and_files_of_several_processes(lens, tmp_path):
    runs = [
        caustic(2, "export", str(lens / "lens"), "--format", "stl", "-o", str(tmp_path / "lens.stl")),
        caustic(2, "gradmap", str(lens / "lens"), "--control", "3,4", "--control", "2,2", "--npy", str(tmp_path / "map.npy")),
    ]
    ended(*runs)
    assert {path.name for path in tmp_path.iterdir()} == {"lens.stl", "map-3-4.npy", "map-2-2.npy"}


LOST = """
import os, signal, sys
from caustic_cli import cli
from caustic_cli.studies import tolerances

def dies(*given):
    if int(os.environ["RANK"]) == 1:
        os.kill(os.getpid(), signal.SIGKILL)
    return usual(*given)

usual, tolerances._drawn = tolerances._drawn, dies
dies.__module__, dies.__qualname__ = "caustic_cli.studies.tolerances", "_drawn"
cli.main()
"""


@needs_processes
def test_a_lost_process_is_one_line_and_nothing_is_half_written(lens, tmp_path):
    (tmp_path / "lost.py").write_text(LOST)
    command = [
        "render",
        str(lens / "lens"),
        "--tolerances",
        str(lens / "errors.toml"),
        "--rays",
        "1000",
        "--quiet",
        "--threads",
        "1",
    ]
    run = started(2, str(tmp_path / "lost.py"), *command, "-o", str(tmp_path / "out" / "image.png"))
    (tmp_path / "out").mkdir()
    _, said = run.communicate(timeout=300)
    own = [line for line in said.splitlines() if line.startswith("caustic: ")]
    assert run.returncode == 1 and len(own) == 1, said
    assert own[0].startswith("caustic: another process has stopped") or own[0].startswith("caustic: terminated"), said
    assert [path.name for path in (tmp_path / "out").iterdir()] == ["image.png"]  # which was complete before the draws


FAILING = """
import sys, time
from caustic_cli import spread
from caustic_cli.errors import InputError

def one(k):
    time.sleep(0.02 * (k == 4))
    if k in (4, 5):
        raise InputError(f"item {k}")
    return k * k


try:
    print(spread(one, range(8)))
except InputError as error:
    print(f"caught {error}")
"""


@needs_processes
def test_the_first_item_that_fails_is_told_of(tmp_path):
    (tmp_path / "script.py").write_text(FAILING)
    runs = [started(n, str(tmp_path / "script.py")) for n in (1, 3)]
    assert {run.communicate(timeout=300)[0] for run in runs} == {"caught item 4\n"}


def test_items_in_their_order():
    seen: list[int] = []
    assert ranks.mapped(str, range(3), seen.append) == ["0", "1", "2"] and seen == [1, 2, 3]


LENS = Lens((10.0, 8.0), 0.0, 1.5, (7, 6), (3, 2), offset=Offset(3.0))
SOURCES = {
    "plane": PlaneWave(),
    "points": Points(((0.0, 0.0, -50.0), (1.0, 0.0, -40.0)), (1.0, 2.0)),
    "profile": PlaneWave(1.0, np.arange(1.0, 7.0).reshape(2, 3)),
}


@pytest.mark.parametrize("source", SOURCES)
@pytest.mark.parametrize("count", [2, 3, 50])
def test_every_chunk_of_rays_is_that_of_one_rank(source, count):
    scene = Scene(SOURCES[source], LENS, Screen((11.0, 9.0), 60.0, (12, 9)))
    rays, field = rays_of(scene, "uniform", 1000, 3), HeightField.of(LENS)

    def dealt(rank):
        return list(dealt_tracers(scene, field, rays, torch.float64, 130, own=ranks.turns((rank, count))))

    whole = list(dealt_tracers(scene, field, rays, torch.float64, 130))
    parts = [dealt(rank) for rank in range(count)]
    assert len(whole) >= 7 and {len(part) for part in parts} == {len(whole)}
    for k, chunks in enumerate(zip(*parts, strict=True)):
        (own,) = (chunk for chunk in chunks if chunk is not None)
        assert chunks[k % count] is own and torch.equal(own.entering, whole[k].entering)


def test_alone_nothing_is_sent():
    tensor = torch.ones(3)
    ranks.broadcast(tensor)
    with ranks.process_group("cpu") as rank, ranks.together(lambda: None):
        assert rank == 0 and ranks.rank_and_size() == (0, 1)
        assert ranks.decide(lambda: True) and not ranks.decide(lambda: False) and torch.equal(tensor, torch.ones(3))
        assert list(ranks.in_order(iter([[tensor]]), [tensor], (0, 1))) == [[tensor]]
        assert ranks.divided([lambda: 1, lambda: 2]) == [1, 2]
