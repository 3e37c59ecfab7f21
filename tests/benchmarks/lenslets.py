"""How even is a top hat by one lens and by an array of lenslets, under beams that neither was designed for?

    python tests/benchmarks/lenslets.py [--quality standard] [--resolution 100] [--rays 2e7]

Beams fall by 20 % over the aperture: towards the corners (gauss), along x (ramp), or three times (sine); shifted ones by half a
lenslet's width along x.  Uniformity is the standard deviation over the mean of the irradiance on the pixels that are wholly within
the bright disc, by rays that no design used; noise is that of these rays, on the whole image and over its mean.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import replace
from pathlib import Path

import numpy as np

import caustic_cli as caustic
from caustic_cli.scene import PlaneWave
from caustic_cli.studies.retrace import retrace

PICTURE = Path(__file__).resolve().parents[2] / "examples" / "tophat.png"
#: Cells of the beams along each axis.
CELLS = 1000


def beams(lenslets: int) -> dict[str, np.ndarray | None]:
    """Irradiance over the aperture by name."""
    u = (np.arange(CELLS) + 0.5) / CELLS - 0.5
    found: dict[str, np.ndarray | None] = {"even": None}
    for name, moved in (("", 0.0), (" shifted", 0.5 / lenslets)):
        x, y = u[:, None] - moved, u[None, :]
        found["gauss" + name] = 0.8 ** (2.0 * (x * x + y * y))
        found["ramp" + name] = 0.9 + 0.2 * x + 0.0 * y
        found["sine" + name] = 0.9 + 0.1 * np.cos(6.0 * np.pi * x) + 0.0 * y
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quality", default="standard")
    parser.add_argument("--resolution", type=int, default=100)
    parser.add_argument("--rays", type=float, default=2e7)
    parser.add_argument("--array", type=int, default=5)
    asked = parser.parse_args()
    columns = {}
    for name, lenslets in (("one lens", 1), (f"{asked.array} x {asked.array} lenslets", asked.array)):
        began = time.monotonic()
        sections = {"lens": {"array": [lenslets] * 2}, "screen": {"resolution": [asked.resolution] * 2}}
        lens = caustic.design(PICTURE, settings=sections, quality=asked.quality, waves="off", linear=True)
        print(f"{name}: designed in {time.monotonic() - began:.0f} s")
        bright = lens.target > 0.999 * lens.target.max()
        columns[name] = []
        for profile in beams(asked.array).values():
            scene = replace(lens.scene, source=PlaneWave(1.0, profile))
            seen, figures = retrace(scene, lens.field, lens.heights, lens.target, rays=int(asked.rays), seed=1)
            disc = seen.image.cpu().numpy()[bright]
            columns[name].append(f"{disc.std() / disc.mean():.2%} (noise {figures['error_estimate']:.2%})")
    print("| beam |", " | ".join(columns), "|\n| --- |", " | ".join(["---"] * len(columns)), "|")
    for k, name in enumerate(beams(asked.array)):
        print(f"| {name} |", " | ".join(values[k] for values in columns.values()), "|")


if __name__ == "__main__":
    main()
