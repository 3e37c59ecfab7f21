"""SIGKILL at random instants: the project always opens, and goes on from a checkpoint no older than was promised.

CAUSTIC_KILLS says how many kills (12 unless set; 300 take about five minutes).
"""

import json
import os
import random
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import torch
from helpers import write_blob

from caustic_cli import cli
from caustic_cli.project import checkpoint
from caustic_cli.project.project import Project

KILLS = int(os.environ.get("CAUSTIC_KILLS", "12"))
EVERY = 0.05  # s between checkpoints
SLACK = 0.5  # s that a busy machine may keep a process from running
CONFIG = f"""
[screen]
resolution = [16, 16]
[lens]
control = [9, 9]
[design]
optimizer = "adam"
checkpoint_every = {EVERY}
[[design.stages]]
control = [9, 9]
rays = 1500
iterations = 100000000
"""
DESIGN = ["design", "blob.png", "--config", "c.toml", "--quiet"]
BOARD = 1 << 20  # bytes: one double an iteration


class Server:
    """Commands in processes of their own that may be killed; see server.py."""

    def __init__(self, folder: Path):
        self.board, self.log = folder / "board", folder / "log"
        self.board.write_bytes(bytes(BOARD))
        environment = {
            **os.environ,
            "PYTHONPATH": str(Path(cli.__file__).parents[1]),
            "CAUSTIC_KERNELS": "torch",
            "OMP_NUM_THREADS": "1",
        }
        self.process = subprocess.Popen(
            [sys.executable, Path(__file__).with_name("server.py"), self.board, self.log],
            cwd=folder,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            env=environment,
        )

    def __call__(self, arguments: list[str], after: float | None = None) -> tuple[int, np.ndarray]:
        """Run a command, kill it `after` so many seconds; its exit code (-9 when killed) and when each iteration was done."""
        with open(self.board, "r+b") as f:  # in place: the server has it mapped
            f.write(bytes(BOARD))
        self.process.stdin.write(json.dumps([arguments, after]) + "\n")
        self.process.stdin.flush()
        code = int(self.process.stdout.readline())
        return code, np.frombuffer(self.board.read_bytes(), dtype=float)


@pytest.fixture
def server(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    write_blob("blob.png", 16, (5, 6), 15.0)
    Path("c.toml").write_text(CONFIG)
    running = Server(tmp_path)
    with running.process:
        yield running
        running.process.stdin.close()


def killed(server, arguments, after) -> np.ndarray:
    code, times = server(arguments, after)
    assert code in (-9, 0), server.log.read_text()
    return times


def lost_seconds(times: np.ndarray, total: int) -> tuple[float, float]:
    """Seconds of work done that a checkpoint of `total` iterations does not hold, and the longest step between two iterations."""
    done = np.flatnonzero(times)
    steps = np.diff(times[done])
    missing = done[done > total]
    lost = times[done[-1]] - times[missing[0]] if len(missing) else 0.0
    return lost, float(steps.max(initial=0.0))


def test_a_killed_design_goes_on_and_nothing_is_lost(server):
    """Fresh designs, designs begun anew and resumed ones, killed anywhere from their first moment on; before the first
    checkpoint the same command needs no --force."""
    for _ in range(2):  # the first waits for the server
        began = time.monotonic()
        assert server([*DESIGN, "--iterations", "20", "-o", "first", "--force"])[0] == 0, server.log.read_text()
    span = time.monotonic() - began + 5 * EVERY
    chance, path, total, survivors, losses = random.Random(KILLS), Path("blob.caustic"), 0, 0, []
    for kill in range(KILLS):
        fresh, begun = not path.exists(), (path / "checkpoints.h5").exists()
        anew = fresh or chance.random() < 0.2
        arguments = [*DESIGN, *(["--force"] if begun else [])] if anew else ["design", "--resume", str(path), "--quiet"]
        times = killed(server, arguments, chance.uniform(0.0, span))
        if anew and (fresh or (times > 0).any()):
            total = 0
        if not path.exists():
            assert fresh and not (times > 0).any()
            continue
        project = Project.open(path)
        if not (path / "checkpoints.h5").exists():  # killed before the first: --resume begins it
            assert (anew or not begun) and not (times > 0).any()
            total = 0
            continue
        now = project.load().state.total
        assert now >= total or anew, f"kill {kill}: {total} iterations became {now}"
        lost, step = lost_seconds(times, now)
        assert lost <= EVERY + step + SLACK, f"kill {kill}: {lost:.3f} s of work lost, a step took {step:.3f} s"
        total, survivors = now, survivors + 1
        losses.append(lost)
    # The kills came while there was something to lose; of a dozen on a busy machine, few may.
    assert survivors > 0 and (KILLS < 100 or (survivors > KILLS // 4 and max(losses) > 0))

    # and where it was killed leaves no trace: the same as in one go, bit for bit
    end = str(total + 3)
    assert server(["design", "--resume", str(path), "--iterations", end, "--quiet"])[0] == 0, server.log.read_text()
    assert server([*DESIGN, "--iterations", end, "-o", "whole"])[0] == 0, server.log.read_text()
    a, b = (checkpoint.load(p / "checkpoints.h5").state for p in (path, Path("whole")))
    assert torch.equal(a.heights, b.heights) and [r[:4] for r in a.history] == [r[:4] for r in b.history]


def test_a_killed_export_or_render_leaves_the_old_file_or_the_new(server):
    assert server([*DESIGN, "--iterations", "3"])[0] == 0, server.log.read_text()
    outputs = {
        "lens.npz": ["export", "blob.caustic", "--samples", "301"],
        "lens.stl": ["export", "blob.caustic", "--format", "stl"],
        "image.png": ["render", "blob.caustic", "--rays", "200000"],
    }
    chance, whole, late = random.Random(KILLS), {}, 0
    for name, command in outputs.items():
        began = time.monotonic()
        assert server([*command, "-o", name, "--quiet", "--force"])[0] == 0, server.log.read_text()
        whole[name] = Path(name).read_bytes(), time.monotonic() - began
    before = checkpoint.load(Path("blob.caustic/checkpoints.h5"))
    for kill in range(KILLS):
        name = [*outputs][kill % 3]
        if chance.random() < 0.5:
            Path(name).unlink(missing_ok=True)
        there = Path(name).exists()
        killed(server, [*outputs[name], "-o", name, "--quiet", "--force"], chance.uniform(0.0, 1.2 * whole[name][1]))
        assert Path(name).exists() or not there
        if Path(name).exists():
            assert Path(name).read_bytes() == whole[name][0]
            late += 1
    assert late > 0
    after = checkpoint.load(Path("blob.caustic/checkpoints.h5"))
    assert torch.equal(before.state.heights, after.state.heights)
