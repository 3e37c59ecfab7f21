"""Fits the models of `caustic design --plan` to measured designs, and judges them by pictures left out.

    python tests/benchmarks/plan.py measure DIRECTORY [NAME ...]      designs, an hour for all pictures; DIRECTORY/designs.jsonl
    python tests/benchmarks/plan.py fit DIRECTORY                     constants of caustic_cli/workflow/estimate.py, judged
    python tests/benchmarks/plan.py judge DIRECTORY                   the constants as they are, judged

Designs are measured one after the other on an otherwise idle machine; a design that is measured already is left out.
"""

import argparse
import gzip
import json
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
from PIL import Image
from quality import DATA, EXAMPLES
from quality import pictures as photographs
from scipy.ndimage import gaussian_filter
from scipy.optimize import least_squares, nnls

from caustic_cli.config.wave_stages import transform_samples
from caustic_cli.optics.resolution import Resolution
from caustic_cli.project.project import Project
from caustic_cli.workflow import estimate

QUALITIES = ("draft", "standard", "fine")
#: Options of further scenes, each of the first pictures.
SCENES = (("--mag", "1.5"), ("--resolution", "128"), ("--lens-size", "20"), ("--throw", "150"))
#: Ridge of the regression: the figures of pictures are alike; and the deviation of the error that is allowed.
RIDGE, GOAL = 0.02, 0.3
#: Weight of the seconds before in a fit, of a design's.
KEPT = 0.1
RESULTS = "designs.jsonl"


def main() -> None:
    """Do one of the tasks above."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("task", choices=("measure", "fit", "judge"))
    parser.add_argument("directory", type=Path)
    parser.add_argument("names", nargs="*")
    asked = parser.parse_args()
    task, place = asked.task, asked.directory
    if task == "measure":
        known = pictures(place)
        measure(place, [known[name] for name in asked.names or known])
        return
    rows = [json.loads(line) for line in (place / RESULTS).read_text().splitlines()]
    cases = [case(row) for row in rows]
    if task == "fit":
        fit_errors(cases)
        fit_seconds(cases)
        fit_memory(cases)
    judge(cases)


def pictures(folder: Path) -> dict[str, Path]:
    """Name -> file of the pictures: those of `quality.py`, of examples/, and such as have no photograph's spectrum."""
    folder.mkdir(parents=True, exist_ok=True)
    u, v = np.meshgrid(np.linspace(-1, 1, 200), np.linspace(-1, 1, 200))
    generator = np.random.default_rng(0)
    with gzip.open(DATA / "sample_data/s1045.ima.gz") as file:
        scan = np.frombuffer(file.read(), np.uint16)
    made = {
        "rings": 0.5 + 0.5 * np.cos(40 * np.hypot(u, v) ** 1.5),
        "clouds": gaussian_filter(generator.random((200, 200)), 8, mode="wrap"),
        "stars": gaussian_filter((generator.random((200, 200)) > 0.998).astype(float), 1.2),
        "chequers": (np.floor(8 * u) + np.floor(8 * v)) % 2,
        "head": scan.reshape(256, 256).astype(float),
        "mountains": np.load(DATA / "sample_data/jacksboro_fault_dem.npz")["elevation"].astype(float),
        "disc": (np.hypot(u, v) < 0.7).astype(float),
    }
    for name, values in made.items():
        values = (values - values.min()) / np.ptp(values)
        Image.fromarray((255 * values).round().astype(np.uint8)).save(folder / f"{name}.png")
    known = photographs(folder) | {name: EXAMPLES / f"{name}.png" for name in ("tophat", "house")}
    return known | {name: folder / f"{name}.png" for name in made}


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
        timed = ["/usr/bin/time", "-f", "%U %S %M", *command, "--json", "--quiet"]
        found = subprocess.run(timed, capture_output=True, text=True, check=True)
        row = {"name": name, "picture": picture.stem, "quality": quality, "wall": time.monotonic() - began, "slow": slow}
        figures = json.loads(found.stdout)
        user, system, most = found.stderr.split()[-3:]
        row |= {key: figures[key] for key in ("error", "error_by")}
        row |= {"processor": float(user) + float(system), "rss": int(most), "dir": str(place / name)}
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
            left = [np.log(c["error"] / predicted(regression([o for o in own if o["picture"] != c["picture"]]), c)) for c in own]
            near, whole = near + sum(abs(np.exp(-value) - 1.0) <= 0.3 for value in left), whole + len(left)
            spread = float(np.sqrt(np.mean(np.square(left))))
            estimate.ERRORS[by, quality] = tuple(np.round(regression(own), 3).tolist()), round(spread, 3)
    print("ERRORS =", estimate.ERRORS)
    print(f"of pictures left out: {near} of {whole} within 30 % of the error")


def regression(own: list[dict]) -> np.ndarray:
    """Coefficients of the logarithm of the error, with a ridge on all but the first, by the fourth power of its deviations over
    GOAL: the goal is a bound."""
    x, y = np.array([c["features"] for c in own]), np.log([c["error"] for c in own])
    middle = x[:, 1:].mean(0)

    def deviations(w: np.ndarray) -> np.ndarray:
        found = [predicted(np.array([w[0] - middle @ w[1:], *w[1:]]), one) for one in own]
        off = (np.log(found) - y) / GOAL
        return np.concatenate([np.sign(off) * off * off, np.sqrt(RIDGE * len(own)) * w[1:]])

    w = least_squares(deviations, [y.mean(), *np.zeros(x.shape[1] - 1)]).x
    return np.array([w[0] - middle @ w[1:], *w[1:]])


def predicted(coefficients: np.ndarray, one: dict) -> float:
    """The error."""
    return estimate.expected_error(coefficients, one["features"], one["error_by"])


def fit_seconds(cases: list[dict]) -> None:
    """Fit and print SECONDS, by relative residuals; what these designs do not tell apart keeps its value."""
    work, walls, before = np.array([c["work"] for c in cases]), np.array([c["wall"] for c in cases]), np.array(estimate.SECONDS)
    kept = KEPT**0.5 * np.diag(1.0 / before)
    found, _ = nnls(np.vstack([work / walls[:, None], kept]), np.concatenate([np.ones(len(walls)), kept @ before]))
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
        error, seconds = predicted(np.array(coefficients), c), float(np.dot(estimate.SECONDS, c["work"]))
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
