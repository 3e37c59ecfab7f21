"""Lamps: light on the target and its error, on the pixels of a point's loss, of a chip on half as wide ones, and on finer ones.

    python tests/benchmarks/lamps.py [--only street,two] [--rays 16e6] [-o FILE.json]

Every lamp is designed by the command's own defaults from acrylic with a radius of 15 mm and judged by rays that the design did not
use, whose noise is subtracted: with the images A and B of two halves of them and the target T, each over its mean, the mean of
(A - T) (B - T) is the squared error.  +- is what the noise leaves of it.  "Finer" is the error of the whole target on pixels half
as wide again, of a point half as wide as those of its loss.  Of a disc those pixels count that lie within it wholly.  Light is a
fraction of all that the chip emits, with all losses of uncoated surfaces.  Seconds are those of the processor, and of the clock, of
the design with its own verdict.

The files of a lamp's light (`ldt`) are written, designed for, and written again: the root mean square of the difference of their
candela, each file scaled to the same light, over that of the first file, each direction weighted with its solid angle.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import tempfile
import time
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

import caustic_cli
from caustic_cli.inverse.lamp import wanted
from caustic_cli.io.photometry import read_photometry
from caustic_cli.studies.lamp import lamp_figures


class Problem(NamedTuple):
    """Target and options of a design; least part of the light and largest error within the border that are asked for."""

    target: str
    options: dict[str, Any]
    light: float
    error: float


STREET = {"lamp": 15, "throw": 8000.0, "picture_size": [30_000.0, 10_000.0]}
TWO = {"lamp_surfaces": 2, "lamp_wall": 1.5}
PROBLEMS = {
    "spot": Problem("disc", {"lamp": 15, "throw": 1000.0, "picture_size": [2000.0, 2000.0]}, 0.89, 0.005),
    "street": Problem("uniform", STREET, 0.85, 0.015),
    "two": Problem("uniform", STREET | TWO, 0.91, 0.012),
    "path": Problem("uniform", {"lamp": 15, "throw": 5000.0, "picture_size": [17_000.0, 4000.0]} | TWO, 0.89, 0.015),
    "far": Problem("uniform", {"lamp": 15, "angles": [120.0, 40.0]}, 0.84, 0.012),
    "edge": Problem("uniform", STREET | TWO | {"screen_shift": [0.0, 4000.0]}, 0.85, 0.02),
    "chip": Problem("uniform", STREET | TWO | {"chip": [1.0, 1.0]}, 0.90, 0.01),
    "large chip": Problem("uniform", STREET | TWO | {"chip": [3.0, 3.0], "lamp_inner": 3.0}, 0.88, 0.03),
}
WORDS = {
    "spot": "disc of 2 m from 1 m",
    "street": "30 x 10 m from 8 m",
    "two": "30 x 10 m from 8 m, two surfaces",
    "path": "17 x 4 m from 5 m, two surfaces",
    "far": "120 x 40 degrees",
    "edge": "30 x 10 m from 8 m, 1 m inside the long edge, two surfaces",
    "chip": "30 x 10 m from 8 m, two surfaces, chip of 1 mm",
    "large chip": "30 x 10 m from 8 m, two surfaces, chip of 3 mm",
}
#: Difference of the files that is asked for.
FILES = 0.01


def batwing() -> np.ndarray:
    """Intensity over 140 x 70 degrees with smooth edges."""
    x, y = np.meshgrid(np.linspace(-70.0, 70.0, 281), np.linspace(-35.0, 35.0, 141), indexing="ij")
    return (0.4 + 0.6 * np.minimum(abs(x) / 50.0, 1.0) ** 2) * np.exp(-((x / 60.0) ** 8) - (y / 25.0) ** 4)


def processor() -> float:
    """Seconds of the processor of this process, of all threads, and of those that it started."""
    return sum(used.ru_utime + used.ru_stime for used in map(resource.getrusage, (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)))


#: Designs of this run, by target and options.
MADE: dict[str, Any] = {}


def designed(target: Any, options: dict[str, Any]) -> tuple[Any, float, float]:
    """A lamp, and the seconds of the processor and of the clock that it took."""
    asked = repr((target, options))
    if asked not in MADE:
        began, clock = processor(), time.monotonic()
        lamp = caustic_cli.design(target, **options)
        MADE[asked] = lamp, processor() - began, time.monotonic() - clock
    return MADE[asked]


def measured(problem: Problem, rays: float) -> dict[str, Any]:
    """Figures of a problem."""
    lamp, seconds, wall = designed(problem.target, problem.options)
    figures = lamp.render(rays, seed=11).figures
    finer, coarse = (
        wanted(lamp.goal, lamp.picture, (k * n // 2, k * m // 2)).numpy() for n, m in [figures["pixels"]] for k in (4, 1)
    )
    _, seen = lamp_figures(lamp.lamp, lamp.goal, lamp.field, lamp.values, finer, coarse, rays=int(rays), seed=12)
    more = {"finer_rms": seen["relative_rms"], "finer_noise": seen["noise"], "seconds": seconds, "wall": wall}
    return figures | more


def difference(wanted: Path, seen: Path) -> float:
    """Of two photometric files up to 89 degrees, see the module."""
    weight = np.sin(np.radians(np.arange(90.0)))
    one, other = (read_photometry(path).values[:, :90] for path in (wanted, seen))
    one, other = (values / (weight * values).sum() for values in (one, other))
    return float(np.sqrt((weight * (one - other) ** 2).sum() / (weight * one**2).sum()))


def passage(target: Any, options: dict[str, Any]) -> dict[str, float]:
    """Difference of the file of a lamp and that of the lamp designed for it."""
    with tempfile.TemporaryDirectory() as folder:
        first, second = (Path(folder) / f"{name}.ldt" for name in ("first", "second"))
        designed(target, options)[0].export(first)
        lamp, seconds, _ = designed(str(first), {"lamp": 15})
        lamp.export(second)
        return {"difference": difference(first, second), "of_source": lamp.figures["of_source"], "seconds": seconds}


PASSAGES = {
    "batwing": (batwing, {"lamp": 15, "angles": [140.0, 70.0]}),
    "rectangle": (lambda: "uniform", {"lamp": 15, "angles": [120.0, 40.0]}),
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("--only", default=",".join((*PROBLEMS, *PASSAGES)), help="some of " + ", ".join((*PROBLEMS, *PASSAGES)))
    parser.add_argument("--rays", type=float, default=16e6, help="of the verdict")
    parser.add_argument("-o", "--out", type=Path, help="a JSON file for the figures, to which those of other problems are added")
    options = parser.parse_args()
    found = json.loads(options.out.read_text()) if options.out and options.out.exists() else {}
    for name in options.only.split(","):
        found[name] = (
            measured(PROBLEMS[name], options.rays) if name in PROBLEMS else passage(PASSAGES[name][0](), PASSAGES[name][1])
        )
        print(f"{name}: {found[name]}", flush=True)
        if options.out:
            options.out.write_text(json.dumps(found, indent=1))
    print(f"on {os.cpu_count()} cores")
    print("| lamp | light | asked | error | without a border | finer | asked | least wall, mm | pixels | seconds | of the clock |")
    print("| --- " * 11 + "|")
    for name, problem in PROBLEMS.items():
        if name in found:
            f = found[name]
            print(
                f"| {WORDS[name]} | {f['of_source']:.4f} | {problem.light:g} | {f['relative_rms']:.4f} ± {f['noise']:.4f}"
                f" | {f['interior_rms']:.4f} ± {f['interior_noise']:.4f}"
                f" | {f['finer_rms']:.4f} ± {f['finer_noise']:.4f} | {problem.error:g} | {f['least_wall']:.2f}"
                f" | {' x '.join(map(str, f['pixels']))} | {f['seconds']:.0f} | {f['wall']:.0f} |"
            )
    for name in PASSAGES:
        if name in found:
            print(f"{name}: files differ by {found[name]['difference']:.2%}, asked {FILES:.0%}")


if __name__ == "__main__":
    main()
