"""The least error that any light can reach behind an extended source's blur, and what designs reach.

    python tests/benchmarks/extended.py            bounds, a minute; prints a Markdown table
    python tests/benchmarks/extended.py --project LENS.caustic
    python tests/benchmarks/extended.py --designs  with designs at standard quality, judged without their rays' noise; five minutes

Every point of the exit spreads its light over the same disc on the screen, as wide as the throw from there times the angle under
which it sees the source through the glass.  So an
image is light that is nowhere negative, convolved with that disc, and the least error is that of a constrained deconvolution
(`caustic_cli.inverse.deconvolution`).  The interval is proven: the upper end by the light found, the lower by its dual.  Light is
told apart by pixels, as the lens is judged; by halves of pixels a little less can be reached behind blurs of a few pixels.  A
point's lens throws the picture itself, convolved with the disc.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
import torch
from scipy.spatial import cKDTree

from caustic_cli import load
from caustic_cli.inverse.deconvolution import Deconvolved, deconvolved
from caustic_cli.inverse.source_limits import performance_limits
from caustic_cli.inverse.target import target_on_screen
from caustic_cli.io.picture import read_picture
from caustic_cli.optics.emission.coherent import central_mode
from caustic_cli.optics.spread import Convolution
from caustic_cli.optics.system import EXIT, System
from caustic_cli.optics.trace import Tracer
from caustic_cli.scene import Screen

PICTURES = Path(__file__).resolve().parents[2] / "examples"
WIDTH, PIXELS, THROW, DISC = 30.0, 250, 300.0, 5.0  # mm; the default lens at magnification 3 without margin
THICKNESS, INDEX = 5.0, 1.5443
DISTANCES = (5000.0, 2500.0, 1000.0, 500.0)
STEPS = 3000
POINTS = 33  # along each axis of a lens' pupil, from which it is known where its light lands
FINER = 4  # points to a pixel, along each axis, of the disc


def disc(pixels: float) -> Convolution:
    """An even disc so many pixels wide, of sum 1, of light in the middle of a pixel."""
    reach = int(pixels / 2 + 1.5)
    x = (np.arange((2 * reach + 1) * FINER) + 0.5) / FINER - reach - 0.5
    inside = (x[:, None] ** 2 + x**2 <= (pixels / 2) ** 2).astype(float)
    kernel = inside.reshape(2 * reach + 1, FINER, 2 * reach + 1, FINER).mean((1, 3))
    return Convolution(torch.from_numpy(kernel / kernel.sum()), 1)


def errors(name: str, blur: float) -> tuple[float, Deconvolved]:
    """Relative RMS of a point's lens and the best there can be, under a disc that blurs over `blur` mm."""
    picture = read_picture(PICTURES / f"{name}.png", linear=True)
    target = target_on_screen(picture.irradiance(), (WIDTH, WIDTH), Screen((WIDTH, WIDTH), THROW, (PIXELS, PIXELS)))
    spread = disc(blur / WIDTH * PIXELS)
    b = torch.from_numpy(target / target.mean())
    seen = spread.whole(b)
    return float((seen / seen.mean() - b).square().mean().sqrt()), deconvolved(target, spread, STEPS)


def designed(name: str, distance: float) -> dict:
    """Figures of `caustic design` under the disc."""
    with tempfile.TemporaryDirectory() as directory:
        found = subprocess.run(
            [
                sys.executable,
                "-m",
                "caustic_cli",
                "design",
                str(PICTURES / f"{name}.png"),
                "--source",
                "disc",
                "--source-position",
                f"0,0,{-distance}",
                "--source-size",
                str(DISC),
                "--mag",
                "3",
                "--margin",
                "0",
                "--linear",
                "--quiet",
                "--json",
                "--out",
                f"{directory}/lens",
            ],
            check=True,
            capture_output=True,
        )
    return json.loads(found.stdout)


def of_project(path: Path) -> str:
    """Bounds of the error for a project's scene, of any lens and of those that send their light about where this one does."""
    lens = load(path)
    (x, y), (u, v) = landing(lens)
    known = cKDTree(np.stack([x, y], 1))

    def sent(at: np.ndarray) -> np.ndarray:
        nearest = known.query(at.T)[1]
        return np.stack([u[nearest], v[nearest]])

    target = np.asarray(lens.target)
    # None where the source does not limit it
    whole, alike = (performance_limits(lens.scene, target, sent=how).error or 0.0 for how in (None, sent))
    return f"{path}: at least {whole:.4f} for any lens, {alike:.4f} for those that send their light about where it does"


def landing(lens) -> tuple[np.ndarray, np.ndarray]:
    """Points (2, N) where light of the source's centre leaves a lens, and where it lands, from the middle of the screen, mm."""
    scene, heights = lens.scene, {EXIT: torch.as_tensor(lens.heights).double()}
    system, line = System.of(scene, lens.field), torch.linspace(0.0, 1.0, POINTS, dtype=torch.float64)
    u, v = (c.reshape(-1) for c in torch.meshgrid(line, line, indexing="ij"))
    tracer = Tracer(system, central_mode(scene).through(u, v, system.object_space.index_at(None)))
    landed, left = tracer.land(heights, scene.screen)[0].expanded(), tracer.last(heights).state.expanded()
    found = [torch.stack(state.full(state.origin)[:2]).numpy() for state in (left, landed)]
    return found[0], found[1] - np.array(scene.screen.shift)[:, None]


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("--designs", action="store_true", help="also design each lens, five minutes")
    parser.add_argument("--project", type=Path, action="append", default=[], help="bounds for the scene of a project instead")
    designs, projects = (given := parser.parse_args()).designs, given.project
    for path in projects:
        print(of_project(path), flush=True)
    if projects:
        sys.exit()
    print("| picture | distance, mm | blur, mm | a point's lens | the least possible |" + (" designed | time |" if designs else ""))
    print("| --- | --- | --- | --- | --- |" + (" --- | --- |" if designs else ""))
    for name in ("ball", "flame"):
        for distance in DISTANCES:
            blur = (THROW - THICKNESS) * DISC / (distance + THICKNESS / INDEX)
            first, best = errors(name, blur)
            row = f"| {name} | {distance:g} | {blur:.3f} | {first:.3f} | {best.bound:.4f} to {best.error:.4f} |"
            if designs:
                figures = designed(name, distance)
                row += f" {figures['relative_rms']:.4f} ± {figures['noise']:.4f} | {figures['seconds']:.0f} s |"
            print(row, flush=True)
