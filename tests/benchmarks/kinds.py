"""What each kind of design costs, beside that of a plain lens by rays, for one picture of few pixels.

    python tests/benchmarks/kinds.py [--resolution 96] [--only NAME,...]      some ten minutes on two cores; prints a Markdown table

Designs by `caustic design examples/flame.png --quality draft`, one after the other, on one thread; lamps have `lamps.py`.  Times
are of the whole command, less those of one that does nothing; errors are those that the design itself states, by independent light,
with their standard error.  Before the first row a design compiles the kernels.
"""

from __future__ import annotations

import argparse
import json
import resource
import subprocess
import sys
import tempfile
from pathlib import Path

EXAMPLES = Path(__file__).resolve().parents[2] / "examples"
FLAME = EXAMPLES / "flame.png"
LENS = ("--mag", "3", "--linear")
#: Options of each kind.
KINDS = {
    "lens by rays": (*LENS, "--waves", "off"),
    "lens by waves": (*LENS, "--waves", "on"),
    "mirror": (*LENS, "--waves", "off", "--mirror"),
    "light from 40 degrees": (*LENS, "--waves", "off", "--source-tilt", "40,0"),
    "curved screen": (*LENS, "--waves", "off", "--screen-radius", "60", "--throw", "60"),
    "point at 50 mm": (*LENS, "--waves", "off", "--source", "point", "--source-position", "0,0,-50"),
    "disc of 2 mm at 1 m": (*LENS, "--waves", "off", "--source", "disc", "--source-size", "2", "--source-position", "0,0,-1000"),
    "colours": ("--mag", "3", "--waves", "off", "--color"),
    "two free-form sides": ("--linear", "--waves", "off", "--collimate", "--throw", "60", "--mag", "1.4"),
    "two pictures": (
        *("--linear", "--waves", "off", "--second", f"{EXAMPLES / 'ball.png'}", "--second-at", "600", "--second-size", "60"),
        *("--throw", "100", "--lens-size", "20", "--mag", "1.5"),
    ),
    "three free-form surfaces": (
        *(*LENS, "--waves", "off", "--element", "lens z=60 thickness=6 radius=120,-120 index=1.5 free=both"),
    ),
    "lens behind a fixed one": (*LENS, "--waves", "off", "--element", "lens z=-20 thickness=4 radius=150,inf glass=N-BK7"),
    "index that varies": (*LENS, "--waves", "off", "--gradient", "radial", "--gradient-terms=-1e-3"),
    "designed index": (*LENS, "--gradient", "free"),
    "designed index and surface": (*LENS, "--gradient", "free", "--with-surface"),
    "relief on a tube": (
        *("--linear", "--waves", "off", "--lens-size", "20", "--mag", "1.5", "--throw", "200", "--glass", "acrylic"),
        *("--base-radius=-60,inf", "--entrance", "parallel"),
    ),
    "4 x 4 lenslets": (*LENS, "--waves", "off", "--array", "4x4"),
    "4 x 4 hexagonal lenslets": (*LENS, "--waves", "off", "--array", "4x4", "--packing", "hexagonal"),
    "network over a range": (*LENS, "--network", "dense", "--over", "throw=250:350", "--control", "67"),
    "laser beam": (
        *("--source", "gaussian", "--waist", "3", "--wavelengths", "1064", "--lens-size", "12", "--throw", "500", "--margin", "0"),
        *("--picture-size", "13x13", "--loss", "log-rms", "--efficiency", "0.97"),
    ),
}


def run(arguments: tuple[str, ...]) -> tuple[float, dict]:
    """Processor seconds of a command with one thread, and its JSON."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    command = [sys.executable, "-m", "caustic_cli", *arguments, "--threads", "1", "--json", "--quiet"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    if done.returncode:
        raise SystemExit(f"{' '.join(command)}: {done.stderr}")
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime, json.loads(done.stdout)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("--resolution", default="96")
    parser.add_argument("--only", default=",".join(KINDS))
    asked = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        project = f"{folder}/lens"

        def design(*options: str) -> tuple[float, dict]:
            size = ("--resolution", asked.resolution, "--quality", "draft")
            return run(("design", str(FLAME), *options, *size, "--force", "-o", project))

        design(*KINDS["lens by rays"])
        idle, _ = run(
            ("design", str(FLAME), *KINDS["lens by rays"], "--resolution", asked.resolution, "--quality", "draft", "-o", project)
        )
        print("| kind | error | by | iterations | processor s | over the plain lens |\n| --- | --- | --- | --- | --- | --- |")
        plain = 0.0
        for name in dict.fromkeys(("lens by rays", *asked.only.split(","))):
            seconds, figures = design(*KINDS[name])
            plain = plain or seconds - idle
            noise = f" ± {figures['noise']:.4f}" if figures.get("noise") and figures["error_by"] == "rays" else ""
            cost = f"{seconds - idle:.1f} | {(seconds - idle) / plain:.1f}"
            print(
                f"| {name} | {figures['error']:.4f}{noise} | {figures['error_by']} | {figures['iterations']} | {cost} |", flush=True
            )


if __name__ == "__main__":
    main()
