"""How many wavelengths the verdict on a wave image needs: the error of a lens by few of them, relative to that by many.

    python tests/benchmarks/wavelengths.py flame.caustic [--spectra equal,daylight,led-4000] [--every 6]

The wave image of the lens is computed every few nanometres from 400 to 700 nm, and interpolated over the wavelength by a cubic
spline, of which the table says what it changes.  Each number of wavelengths is then judged by the rule of the program.  The columns
are the relative difference of the error from that of the whole spectrum, in per cent, and in brackets what the two halves of the
wavelengths let it be estimated as (`studies.waves`), which the program prints.
"""

from __future__ import annotations

import argparse

import numpy as np
import torch
from scipy.interpolate import CubicSpline

from caustic_cli import load
from caustic_cli.optics.system import EXIT
from caustic_cli.optics.waves.image import Imager, lines_of
from caustic_cli.optics.waves.unsupported import receiver_of
from caustic_cli.scene.spectrum import measure_of
from caustic_cli.studies.metrics import relative_rms

COUNTS = (5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 16)


@torch.no_grad()
def images(lens, wavelengths: np.ndarray) -> np.ndarray:
    """(k, n_x, n_y), power of each wavelength by itself."""
    scene, parameters = lens.scene.unfolded, {EXIT: lens.heights.double()}
    lines = lines_of(scene, lens.field, tuple(map(float, wavelengths)))
    system = lines[0].system
    imager = Imager.of(lines, parameters, receiver_of(system, scene.screen))
    (mode,) = imager.modes(system)
    front = imager.front(lines[0], mode, parameters)
    return np.stack([imager.image(line, front, 0, torch.float32)[0].numpy() for line in lines])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("project")
    parser.add_argument("--spectra", default="equal,daylight,sun,led-3000,led-4000,halogen")
    parser.add_argument("--every", type=float, default=6.0)
    asked = parser.parse_args()
    lens = load(asked.project)
    at = np.arange(400.0, 700.0 + 0.5 * asked.every, asked.every)
    seen = images(lens, at)
    every, fine = CubicSpline(at, seen, axis=0), np.arange(400.0, 700.5, 1.0)
    print("| wavelengths | " + " | ".join(asked.spectra.split(",")) + " |\n|" + " --- |" * (1 + len(asked.spectra.split(","))))
    columns, wholes = [], []
    for measure in map(measure_of, asked.spectra.split(",")):

        def error(weights: np.ndarray, pictures: np.ndarray) -> float:
            return relative_rms(np.tensordot(weights, pictures, 1), lens.target)

        whole = error(measure.density(fine), every(fine))
        wholes.append(f"{whole:.4f} ({100.0 * (error(measure.density(at), seen) / whole - 1.0):+.2f})")
        column = []
        for count in COUNTS:
            nodes, weights = measure.nodes(count)
            pictures = every(nodes)
            found = error(weights, pictures)
            halves = [error(weights[k::2], pictures[k::2]) for k in (0, 1)]
            column.append(f"{100.0 * (found / whole - 1.0):+.2f} ({100.0 * abs(np.mean(halves) / found - 1.0) / 3.0:.2f})")
        columns.append(column)
    print(f"| {len(at)}, error (by these alone, %) | " + " | ".join(wholes) + " |")
    for count, row in zip(COUNTS, zip(*columns, strict=True), strict=True):
        print(f"| {count} | " + " | ".join(row) + " |")


if __name__ == "__main__":
    main()
