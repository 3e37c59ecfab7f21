"""What the radius of a tool costs: light in a picture's black against --min-radius, for the README's table.

    python tests/benchmarks/radius.py [--picture lines] [--quality draft] [--radii 0,1,2,5,10] [-o DIR]

A picture of thin lines, designed for rays (`--mag 3 --margin 0 --linear --waves off`), once for each radius, mm; in black is what
`caustic render --rays 3.2e7` says.  The estimate is from the first surface without the radius: its strips of largest curvature
k > 1 / R, seen as creases, become cylinders of radius R that turn the slope as far, so their area is R times the integral of k over
them; all of their light is taken to land in the black.  Prints a Markdown table.
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
    parser.add_argument("--radii", default="0,1,2,5,10", help="mm, ascending from 0")
    parser.add_argument("-o", "--out", type=Path, help="keep the projects here")
    options, more = parser.parse_known_args()  # what is left goes to `caustic design`
    with tempfile.TemporaryDirectory() as scratch:
        folder = options.out or Path(scratch)
        folder.mkdir(parents=True, exist_ok=True)
        picture = pictures(folder)[options.picture]
        print(
            "| radius | concave radius at 2e6 points | estimate | its first surface in black | designed | relative RMS error |\n"
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
                strips = radius * float(k[k > 1.0 / radius].sum()) / POINTS
                estimate, start = f"{strips:.1%}", f"{said['min_radius']['start_in_black']:.1%}"
                start += f", {said['min_radius']['start_in_black_without']:.1%} without"
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
