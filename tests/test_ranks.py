"""Two ranks trace one design between them: the rays are dealt out whole, and the lens is that of one process to rounding."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from helpers import write_blob

from caustic_cli import cli
from caustic_cli.optics import ranks
from caustic_cli.optics.emission import rays_of
from caustic_cli.optics.sampling import Sample
from caustic_cli.project import checkpoint
from caustic_cli.scene import Lens, Offset, PlaneWave, Points, Scene, Screen

DRIVER = """
import sys
from caustic_cli import cli
from caustic_cli.workflow import design as workflow
sys.exit(cli.run(["design", "blob.png", "--config", "c.toml", "--quiet", "--threads", "1", "-o", "two"]))
"""
#: Both ways of emitting rays; 12 iterations of L-BFGS, whose line searches ask for more evaluations than that.
CONFIG = """
[screen]
resolution = [16, 16]
[lens]
control = [9, 9]
[design]
start = "offset"
dtype = "float64"
""" + "".join(
    f"""
[[design.stages]]
{source}
control = [{net}, {net}]
rays = {rays}
apron = 2
iterations = 6
tolerance = 0.0
"""
    for source, net, rays in (("source = 'point'", 7, 1500), ("", 9, 3000))
)


@pytest.mark.skipif(not torch.distributed.is_available(), reason="this torch has no torch.distributed")
def test_two_ranks_design_what_one_process_does(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("CAUSTIC_KERNELS", "torch")
    write_blob("blob.png", 16, (5, 6), 15.0)
    Path("c.toml").write_text(CONFIG)
    Path("two.py").write_text(DRIVER)
    torchrun = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2", "two.py"]
    environment = {**os.environ, "PYTHONPATH": str(Path(cli.__file__).parents[1])}
    with subprocess.Popen(torchrun, env=environment, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True) as two:
        assert cli.run(["design", "blob.png", "--config", "c.toml", "--iterations", "12", "--quiet", "-o", "one"]) == 0
        said = two.communicate(timeout=300)[0]
    assert two.returncode == 0, said
    a, b = (checkpoint.load(Path(folder) / "checkpoints.h5") for folder in ("one", "two"))
    assert a.state.total == b.state.total == 12 and [r[:2] for r in a.state.history] == [r[:2] for r in b.state.history]
    moved = float((a.state.heights - a.state.heights.mean()).abs().max())
    assert torch.allclose(a.state.heights, b.state.heights, rtol=0, atol=1e-9 * moved)
    assert np.allclose([r[2] for r in a.state.history], [r[2] for r in b.state.history], rtol=1e-9)
    assert a.results["loss"] == pytest.approx(b.results["loss"], rel=1e-6)


@pytest.mark.skipif(not torch.distributed.is_available(), reason="this torch has no torch.distributed")
def test_two_ranks_draw_the_bytes_of_one(tmp_path, monkeypatch):
    """Draws and sensitivities of a tolerance analysis, and figures of finishes, dealt out to the ranks."""
    monkeypatch.chdir(tmp_path)
    write_blob("blob.png", 16, (5, 6), 15.0)
    Path("c.toml").write_text(CONFIG)
    assert cli.run(["design", "blob.png", "--config", "c.toml", "--quiet", "--iterations", "2", "-o", "lens"]) == 0
    errors = ("draws = 11", "[index]", "sigma = 1e-3", "[throw]", "sigma = 1.0", "[form_error]", "rms = 1e-4", "shortest = 2.0")
    Path("errors.toml").write_text("\n".join(errors))
    render = ["render", "lens", "--tolerances", "errors.toml", "--finish", "list", "--quiet", "--threads", "1", "--rays", "1000"]
    Path("one").mkdir(), Path("two").mkdir()
    Path("two.py").write_text(f"import sys\nfrom caustic_cli import cli\nsys.exit(cli.run({[*render, '-o', 'two/image.png']}))")
    environment = {**os.environ, "PYTHONPATH": str(Path(cli.__file__).parents[1])}
    torchrun = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2", "two.py"]
    done = subprocess.run(torchrun, env=environment, check=False, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    assert cli.run([*render, "-o", "one/image.png"]) == 0
    one, two = ({p.name: p.read_bytes() for p in (tmp_path / name).iterdir()} for name in ("one", "two"))
    assert one == two and {path.rpartition("-")[2] for path in one} == {"image.png", "tolerances.csv", "tolerances.png"}


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
@pytest.mark.parametrize("kind", ["lines", "stratified"])
@pytest.mark.parametrize("count", [2, 3, 50])
def test_the_ranks_chunks_are_all_rays_once(source, kind, count):
    scene = Scene(SOURCES[source], LENS, Screen((11.0, 9.0), 60.0, (12, 9)))
    if source == "points" and kind == "lines":
        kind = "uniform"
    rays = rays_of(scene, kind, 1000, 3)

    def shares(chunks):
        out = []
        for c in chunks:
            out.append(torch.broadcast_to(c.flux, c.shape).reshape(-1) if isinstance(c, Sample) else c.power)
        return torch.cat(out) if out else torch.zeros(0, dtype=torch.float64)

    whole = shares(rays.chunks(130))
    parts = [shares(rays.chunks(130, rank, count)) for rank in range(count)]
    assert sum(map(len, parts)) == len(whole) >= 900
    assert torch.allclose(torch.sort(torch.cat(parts))[0], torch.sort(whole)[0], rtol=1e-14)
    assert max(map(len, parts)) < len(whole)


def test_alone_nothing_is_sent():
    tensor = torch.ones(3)
    ranks.all_reduce(tensor), ranks.broadcast(tensor), ranks.send("nothing")
    assert ranks.rank_and_size() == (0, 1) and ranks.decide(True) and not ranks.decide(False) and torch.equal(tensor, torch.ones(3))
    with ranks.process_group("cpu") as rank:
        assert rank == 0
