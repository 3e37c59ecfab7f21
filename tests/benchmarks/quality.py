"""What a design reaches and what it costs: the README's table, and the pictures that its text speaks of.

    python tests/benchmarks/quality.py [--pictures flame,ball] [--qualities standard] [--source point] [-o DIR]

All pictures at standard quality and flame, ball and portrait at all three take about ten minutes on two cores; prints a Markdown
table.  Every design is a whole command, from its start to its exit, in a process of its own, with kernels compiled before; each
figure is what `caustic render` says afterwards, by rays and of the wave image (`--waves off`: designs for rays).  The portrait is
matplotlib's sample picture (Grace Hopper, US Navy, public domain), its upper square; text, lines, gradient and the oblong picture
are drawn here or cut from it.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import matplotlib
import numpy as np
from PIL import Image, ImageDraw, ImageFont

EXAMPLES = Path(__file__).resolve().parents[2] / "examples"
DATA = Path(matplotlib.get_data_path())
QUALITIES = ("draft", "standard", "fine")
MAIN = ("flame", "ball", "portrait")
OTHERS = ("tall", "gradient", "text", "lines")


def caustic(*arguments) -> dict:
    done = subprocess.run(
        [sys.executable, "-m", "caustic_cli", *map(str, arguments), "--json", "--quiet", "--force"],
        capture_output=True,
        text=True,
        check=False,
    )
    if done.returncode:
        raise SystemExit(done.stderr)
    return json.loads(done.stdout)


def pictures(folder: Path) -> dict[str, Path]:
    """Every picture by name; what examples/ does not hold is written to `folder`."""
    hopper = Image.open(DATA / "sample_data/grace_hopper.jpg").convert("L")
    text, lines = Image.new("L", (500, 500)), Image.new("L", (500, 500))
    font = ImageFont.truetype(str(DATA / "fonts/ttf/DejaVuSans.ttf"), 90)
    for k, words in enumerate(("caustic", "lens 42", "TU Delft")):
        ImageDraw.Draw(text).text((40, 60 + 130 * k), words, fill=255, font=font)
    for k in range(6):
        ImageDraw.Draw(lines).line((50, 50 + 80 * k, 450, 80 + 70 * k), fill=255, width=3)
    ImageDraw.Draw(lines).ellipse((100, 100, 400, 400), outline=255, width=3)
    made = {
        "portrait": hopper.crop((0, 0, hopper.width, hopper.width)).resize((500, 500)),
        "tall": hopper.resize((300, 360)),
        "gradient": Image.fromarray(np.tile(np.arange(256, dtype=np.uint8), (256, 1))),
        "text": text,
        "lines": lines,
    }
    for name, image in made.items():
        image.save(folder / f"{name}.png")
    return {"flame": EXAMPLES / "flame.png", "ball": EXAMPLES / "ball.png", **{name: folder / f"{name}.png" for name in made}}


def row(picture: Path, quality: str, folder: Path, more: list[str]) -> list[str]:
    """Design, then retrace with eight times the rays."""
    name = picture.stem
    project = folder / f"{name}-{quality}.caustic"
    began = time.monotonic()
    said = caustic("design", picture, "--mag", 3, "--margin", 0, "--linear", "--quality", quality, *more, "-o", project)
    seconds = time.monotonic() - began
    sharp = caustic("render", project, "--rays", "3.2e7")
    light = sharp["on_screen"] + sharp["lost"]["fresnel"]
    waves = "-" if sharp.get("wave_relative_rms") is None else f"{sharp['wave_relative_rms']:.3f}"
    whole = 1.0 - sharp["lost"]["fresnel"]
    kept = "-" if sharp.get("wave_relative_rms") is None else f"{sharp['wave_on_target'] / whole:.3f}"
    return [
        name,
        quality,
        waves,
        kept,
        f"{said['relative_rms']:.3f}",
        f"{sharp['relative_rms']:.3f}",
        f"{light:.4f}",
        f"{sharp['on_target'] / sharp['on_screen']:.3f}",
        "-" if sharp["in_black"] is None else f"{sharp['in_black']:.2%}",
        f"{seconds:.0f}",
    ]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("--pictures", default=",".join(MAIN + OTHERS), help=f"of {', '.join(MAIN + OTHERS)}")
    parser.add_argument("--qualities", default=",".join(QUALITIES))
    parser.add_argument("-o", "--out", type=Path, help="keep the projects here")
    options, more = parser.parse_known_args()  # what is left goes to `caustic design`
    with tempfile.TemporaryDirectory() as scratch:
        folder = options.out or Path(scratch)
        folder.mkdir(parents=True, exist_ok=True)
        known = pictures(folder)
        caustic("design", known["flame"], "--quality", "draft", "--time-limit", 1, *more, "-o", folder / "warm.caustic")
        print(
            "| picture | quality | as a wave | of its light on the picture | by rays | with 3.2e7 rays | light | of it on the"
            " picture | in black | seconds |\n| --- | --- | --- | --- | --- | --- | --- | --- | --- | --- |"
        )
        for name in options.pictures.split(","):
            for quality in options.qualities.split(","):
                if name in MAIN or quality == "standard" or options.qualities != ",".join(QUALITIES):
                    print("| " + " | ".join(row(known[name], quality, folder, more)) + " |", flush=True)


if __name__ == "__main__":
    main()
