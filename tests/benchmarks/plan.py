"""Fits the models of `caustic design --plan` to measured designs, and judges them by pictures left out.

    python tests/benchmarks/plan.py measure DIRECTORY [PICTURE ...]   designs, an hour for fifteen pictures; DIRECTORY/designs.jsonl
    python tests/benchmarks/plan.py fit DIRECTORY                     constants of caustic_cli/workflow/estimate.py, judged
    python tests/benchmarks/plan.py judge DIRECTORY                   the constants as they are, judged

Designs are measured one after the other on an otherwise idle machine; a design that is measured already is left out.
"""

import argparse
import json
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
from scipy.optimize import nnls

from caustic_cli.config.wave_stages import transform_samples
from caustic_cli.optics.resolution import Resolution
from caustic_cli.project.project import Project
from caustic_cli.workflow import estimate

QUALITIES = ("draft", "standard", "fine")
#: Options of further scenes, each of the first pictures.
SCENES = (("--mag", "1.5"), ("--resolution", "128"), ("--lens-size", "20"), ("--throw", "150"))
#: Ridge of the regression: the figures of pictures are alike.
RIDGE = 0.05
RESULTS = "designs.jsonl"


def main() -> None:
    """Do one of the tasks above."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("task", choices=("measure", "fit", "judge"))
    parser.add_argument("directory", type=Path)
    parser.add_argument("pictures", type=Path, nargs="*")
    asked = parser.parse_args()
    task, place = asked.task, asked.directory
    if task == "measure":
        measure(place, [p.absolute() for p in asked.pictures])
        return
    rows = [json.loads(line) for line in (place / RESULTS).read_text().splitlines()]
    cases = [case(row) for row in rows]
    if task == "fit":
        fit_errors(cases)
        fit_seconds(cases)
        fit_memory(cases)
    judge(cases)


def measure(place: Path, pictures: list[Path]) -> None:
    """Design the pictures with every quality, as light and by rays; scenes of the first three."""
    place.mkdir(parents=True, exist_ok=True)
    done = (place / RESULTS).read_text() if (place / RESULTS).exists() else ""
    plain = [(p, q, w, ()) for q in QUALITIES for p in pictures for w in ("auto", "off")]
    others = [(p, q, "auto", scene) for scene in SCENES for p in pictures[:3] for q in QUALITIES[:2]]
    for picture, quality, waves, options in plain + others:
        name = "-".join([picture.stem, quality, waves, *options]).replace("--", "")
        if f'"{name}"' in done:
            continue
        settings = ["--mag", "3", "--quality", quality, "--waves", waves, *options]
        command = [sys.executable, "-m", "caustic_cli", "design", str(picture), *settings, "-o", str(place / name), "--force"]
        slow, began = estimate.measured_slowness(), time.monotonic()
        timed = ["/usr/bin/time", "-f", "%M", *command, "--json", "--quiet"]
        found = subprocess.run(timed, capture_output=True, text=True, check=True)
        row = {"name": name, "picture": picture.stem, "quality": quality, "wall": time.monotonic() - began, "slow": slow}
        figures = json.loads(found.stdout)
        row |= {key: figures[key] for key in ("error", "error_by")} | {
            "rss": int(found.stderr.split()[-1]),
            "dir": str(place / name),
        }
        with (place / RESULTS).open("a") as file:
            file.write(json.dumps(row) + "\n")


def case(row: dict) -> dict:
    """A measured design with what the models take."""
    project = Project.open(row["dir"])
    problem, s = estimate.problem_of_plan(project), project.settings
    seen = Resolution.before(problem.scene, s.target.size)
    work = estimate.work_of(problem, transform_samples(s, seen, project.picture.lit))
    a, b = row["slow"]
    return row | {
        "work": np.array(work) * [b, b, b, b, a, a, b],
        "memory": np.array(estimate.memory_of(problem, work)),
        "features": estimate.features_of(problem, s.target.size),
    }


def fit_errors(cases: list[dict]) -> None:
    """Fit and print ERRORS; the spread is that of pictures left out."""
    near = whole = 0
    for by in ("waves", "rays"):
        for quality in QUALITIES:
            own = [c for c in cases if (c["error_by"], c["quality"]) == (by, quality)]
            if len(own) < 3:
                continue
            left = [np.log(c["error"]) - predicted(regression([o for o in own if o["picture"] != c["picture"]]), c) for c in own]
            near, whole = near + sum(abs(np.exp(-value) - 1.0) <= 0.3 for value in left), whole + len(left)
            spread = float(np.sqrt(np.mean(np.square(left))))
            estimate.ERRORS[by, quality] = tuple(np.round(regression(own), 3).tolist()), round(spread, 3)
    print("ERRORS =", estimate.ERRORS)
    print(f"of pictures left out: {near} of {whole} within 30 % of the error")


def regression(own: list[dict]) -> np.ndarray:
    """Coefficients of the logarithm of the error, with a ridge on all but the first."""
    x, y = np.array([c["features"] for c in own]), np.log([c["error"] for c in own])
    middle = x[:, 1:].mean(0)
    z = x[:, 1:] - middle
    slopes = np.linalg.solve(z.T @ z + RIDGE * len(own) * np.eye(z.shape[1]), z.T @ (y - y.mean()))
    return np.array([y.mean() - middle @ slopes, *slopes])


def predicted(coefficients: np.ndarray, one: dict) -> float:
    """Logarithm of the error."""
    return float(one["features"] @ coefficients)


def fit_seconds(cases: list[dict]) -> None:
    """Fit and print SECONDS, by relative residuals."""
    work, walls = np.array([c["work"] for c in cases]), np.array([c["wall"] for c in cases])
    found, _ = nnls(work / walls[:, None], np.ones(len(walls)))
    estimate.SECONDS = estimate.Work(*(float(f"{value:.3g}") for value in found))
    print("SECONDS =", estimate.SECONDS)


def fit_memory(cases: list[dict]) -> None:
    """Fit and print MIBS."""
    kept, used = np.array([c["memory"] for c in cases]), np.array([c["rss"] / 1024 for c in cases])
    found, _ = nnls(kept / used[:, None], np.ones(len(used)))
    estimate.MIBS = tuple(float(f"{value:.3g}") for value in found)
    print("MIBS =", estimate.MIBS)


def judge(cases: list[dict]) -> None:
    """Print measured and estimated figures of every design, and how many are within the goals."""
    near = [0, 0]
    for c in cases:
        coefficients, spread = estimate.ERRORS[c["error_by"], c["quality"]]
        error, seconds = np.exp(predicted(np.array(coefficients), c)), float(np.dot(estimate.SECONDS, c["work"]))
        memory = float(np.dot(estimate.MIBS, c["memory"]))
        near[0] += abs(seconds / c["wall"] - 1.0) <= 0.25
        near[1] += abs(error / c["error"] - 1.0) <= 0.3
        print(
            f"{c['name']:40} seconds {c['wall']:6.1f} {seconds:6.1f}  error {c['error']:.4f} {error:.4f} (+-{spread:.0%})"
            f"  MiB {c['rss'] / 1024:.0f} {memory:.0f}"
        )
    print(f"of {len(cases)}: {near[0]} within 25 % of the seconds, {near[1]} within 30 % of the error")


if __name__ == "__main__":
    main()
