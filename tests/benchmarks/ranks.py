"""How a design scales over the processes that `torchrun` starts.

    python tests/benchmarks/ranks.py [--ranks 1,2] [--rays 4e6] [--rounds 3]

A few minutes on two cores; prints a Markdown table.  Every rank has one thread, so more ranks than cores gain nothing.  Medians
over the iterations of all rounds, which are taken in turn; the ratio is to one process of the same round's.
"""

from __future__ import annotations

import argparse
import statistics
import subprocess
import sys
import tempfile
from pathlib import Path

import h5py
import numpy as np

FLAME = Path(__file__).resolve().parents[2] / "examples" / "flame.png"
ITERATIONS = 20


def iteration(ranks: int, rays: str, project: Path) -> float:
    """Median seconds of an iteration of one design's last stage."""
    torchrun = ["torch.distributed.run", "--standalone", "--nproc-per-node", str(ranks)]
    command = [
        sys.executable,
        "-m",
        *torchrun,
        "-m",
        "--",
        "caustic_cli",
        "design",
        str(FLAME),
        "--mag",
        "3",
        "--rays",
        rays,
        "--iterations",
        str(ITERATIONS),
        "--threads",
        "1",
        "--force",
        "--quiet",
        "-o",
        str(project),
    ]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        raise SystemExit(done.stderr)
    with h5py.File(project / "checkpoints.h5") as f:
        history = f["history"][()]
    last = history[history[:, 1] == history[-1, 1], 4]  # seconds, of the last stage: all rays, the finest net
    return float(np.median(np.diff(last)))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("--ranks", default="1,2")
    parser.add_argument("--rays", default="4e6")
    parser.add_argument("--rounds", type=int, default=3)
    options = parser.parse_args()
    counts = [int(n) for n in options.ranks.split(",")]
    print("| rays | ranks | iteration, ms | times as fast (least to most) |\n| --- | --- | --- | --- |")
    with tempfile.TemporaryDirectory() as folder:
        for rays in options.rays.split(","):
            rounds = [[iteration(n, rays, Path(folder) / "flame.caustic") for n in counts] for _ in range(options.rounds)]
            for n, times in zip(counts, zip(*rounds, strict=True), strict=True):
                faster = sorted(first[0] / own for first, own in zip(rounds, times, strict=True))
                print(
                    f"| {rays} | {n} | {1e3 * statistics.median(times):.0f} |"
                    f" {statistics.median(faster):.2f} ({faster[0]:.2f} to {faster[-1]:.2f}) |",
                    flush=True,
                )


if __name__ == "__main__":
    main()
