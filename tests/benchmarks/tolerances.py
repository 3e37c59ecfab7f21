"""Percentiles over draws of errors beside brute force: `python tests/benchmarks/tolerances.py PROJECT TOLERANCES`.

The study takes 200 draws, a Latin hypercube, of one set of rays in the lens' frame.  Brute force takes 5,000 independent draws,
each traced in the room's frame with turned and shifted surfaces and random rays of its own (tests/misaligned.py).  For plane waves
judged by rays, and errors of index and places; prints Markdown.
"""

from __future__ import annotations

import argparse
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
import misaligned

from caustic_cli.config import tolerances as schema
from caustic_cli.optics.misalignment import Misalignment
from caustic_cli.scene.tolerances import NORMAL
from caustic_cli.studies import tolerances as study
from caustic_cli.workflow.lens import load


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("project", help="made by caustic design, of a plane wave")
    parser.add_argument("tolerances", type=Path, help="TOML of errors")
    parser.add_argument("--draws", type=int, default=5000, help="of brute force")
    parser.add_argument("--rays", type=int, default=study.RAYS, help="of a draw, of both")
    parser.add_argument("--seeds", type=int, default=3, help="studies of 200 draws")
    asked = parser.parse_args()
    lens, off = load(asked.project), schema.read(asked.tolerances)
    off = replace(off, form=None, waviness=None, draws=200)
    print(f"{asked.project}, {asked.tolerances}, {asked.rays:,} rays a draw, {torch.get_num_threads()} threads\n")
    print("| draws | p50 | p95 | standard error of p95 | seconds |\n| --- | --- | --- | --- | --- |")
    found = []
    for seed in range(asked.seeds):
        began = time.monotonic()
        trials = study.Trials(lens.scene, lens.field, lens.heights, lens.target, replace(off, seed=seed), rays=asked.rays)
        f = study.figures(study.study(trials))
        found.append(f["error"]["p95"])
        row(f"200, seed {seed}", f["error"], f["error"]["p95_standard_error"], time.monotonic() - began)
    rng, brute, began = np.random.default_rng(12345), [], time.monotonic()
    for _ in range(asked.draws):
        values = {}
        for p in trials.parameters:
            size = rng.standard_normal() if p.distribution == NORMAL else 2.0 * rng.random() - 1.0
            values[p.error, p.axis] = float(p.width * size)
        e = Misalignment.of(values)
        brute.append(misaligned.relative_rms(lens.scene, lens.field, lens.heights, e, lens.target, asked.rays, rng))
    exact = {f"p{q}": float(np.quantile(brute, q / 100)) for q in (50, 95)}
    row(f"{asked.draws:,}, brute force", exact, study.percentile_error(np.array(brute), 0.95), time.monotonic() - began)
    print("\np95 against brute force: " + ", ".join(f"{p / exact['p95'] - 1:+.1%}" for p in found))


def row(name: str, f: dict, error: float, seconds: float) -> None:
    """A line of the table."""
    print(f"| {name} | {f['p50']:.4f} | {f['p95']:.4f} | {error:.4f} | {seconds:.0f} |", flush=True)


if __name__ == "__main__":
    main()
