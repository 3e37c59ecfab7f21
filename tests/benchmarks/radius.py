"""What the radius of a tool costs: light in a picture's black against --min-radius, for the README's table.

    python tests/benchmarks/radius.py [--picture lines] [--quality draft] [--radii 0,5,10,20] [-o DIR] --control 503

A picture, designed for rays (`--mag 3 --margin 0 --linear --waves off`) once for each radius, mm; in black is what `caustic
render --rays 3.2e7` says.  The estimate of what a radius R adds is from the first surface without it: where its largest curvature
k is above 1 / R, it turns into strips of radius R in which the slope changes as much, so their area grows by the integral of
k R - 1, and the light through what they gain is taken to land in the black.  Prints a Markdown table.
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path

import numpy as np
import torch
from quality import MAIN, OTHERS, caustic, pictures

from caustic_cli.inverse.designer import State
from caustic_cli.optics import curvature
from caustic_cli.optics.surfaces.heightfield import HeightField
from caustic_cli.project.project import Project

#: Points of the lens at which curvatures are taken.
POINTS = 2_000_000


def bends(field: HeightField, heights: torch.Tensor) -> torch.Tensor:
    """Largest principal curvature at random points of the aperture, 1/mm, (POINTS,)."""
    rng = np.random.default_rng(1)
    x, y = (torch.as_tensor(rng.uniform(-r, r, POINTS)) for r in field.half_size)
    parts = zip(x.split(100_000), y.split(100_000), strict=True)
    return torch.cat([curvature.largest(*field.at(heights, a, b, curvature.ORDERS)) for a, b in parts])


def surfaces(path: Path) -> tuple[HeightField, State]:
    project = Project.open(path)
    return project.lens(project.scene())[1], project.load().state


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("--picture", default="lines", help=f"of {', '.join(MAIN + OTHERS)}")
    parser.add_argument("--quality", default="draft")
    parser.add_argument("--radii", default="0,5,10,20", help="mm, ascending from 0")
    parser.add_argument("-o", "--out", type=Path, help="keep the projects here")
    options, more = parser.parse_known_args()  # what is left goes to `caustic design`
    with tempfile.TemporaryDirectory() as scratch:
        folder = options.out or Path(scratch)
        folder.mkdir(parents=True, exist_ok=True)
        picture = pictures(folder)[options.picture]
        print(
            "| radius | least found at 2e6 points | estimate of what it adds | first surface, for without | designed | relative RMS"
            " error |\n"
            "| --- | --- | --- | --- | --- | --- |"
        )
        for radius in map(float, options.radii.split(",")):
            path = folder / f"{options.picture}-{radius:g}.caustic"
            common = ["--mag", 3, "--margin", 0, "--linear", "--waves", "off", "--quality", options.quality, *more]
            said = caustic("design", picture, *common, *(["--min-radius", radius] if radius else []), "-o", path)
            sharp = caustic("render", path, "--rays", "3.2e7")
            field, state = surfaces(path)
            finest = 1.0 / float(bends(field, state.heights).max())
            estimate = start = "-"
            if radius:
                k = bends(field, state.unrounded)
                estimate, cost = f"{float((k * radius - 1.0).clamp_min(0.0).sum()) / POINTS:.1%}", said["min_radius"]
                start = f"{cost['start_in_black']:.1%} for {cost['start_in_black_without']:.1%}"
            cells = [
                f"{radius:g} mm",
                f"{finest:.3f} mm",
                estimate,
                start,
                f"{sharp['in_black']:.1%}",
                f"{sharp['relative_rms']:.3f}",
            ]
            print("| " + " | ".join(cells) + " |", flush=True)


if __name__ == "__main__":
    main()
