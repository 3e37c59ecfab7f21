#!/usr/bin/env python3
"""The pictures of chapters 5 and 6 of the guide, from the commands that it names, in about five minutes on two cores.

    python examples/pictures.py [--only price,control-point,rays,triangles,square-source] [-o DIR]

Of each sheet the panels are images that the commands write; the errors and seconds over them are those that the commands print.
"""

from __future__ import annotations

import argparse
import json
import shlex
import subprocess
import sys
import tempfile
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import numpy as np
import torch
from matplotlib import pyplot as plt
from PIL import Image

from caustic_cli import load
from caustic_cli.optics.effects import NO_REQUESTS
from caustic_cli.optics.emission import rays_of
from caustic_cli.optics.mesh import TriangleMesh
from caustic_cli.optics.rays import RayStatus
from caustic_cli.optics.surfaces.heightfield import HeightField
from caustic_cli.optics.system import EXIT
from caustic_cli.optics.trace import FEW, tracers
from caustic_cli.scene import Lens, Offset, Points, Scene, Screen
from caustic_cli.studies.report import COLOURS

HERE = Path(__file__).resolve().parent
#: What the designs of the sheet of prices have in common, and the lens whose images its last rows show.
RAYS, LIGHT = "design flame.png --quality draft --waves off", "design flame.png --waves on --resolution 64"
SAME = f"{RAYS} --resolution 64 -o same.caustic"
#: Rows of that sheet: a heading, and a panel's title, command, and image in the project.
PRICES = {
    "quality, as light": [(q, f"{LIGHT} --quality {q} -o p.caustic", "p.caustic/wave.png") for q in ("draft", "standard", "fine")],
    "pixels": [(f"{n} x {n}", f"{RAYS} --resolution {n} -o p.caustic", "p.caustic/render.png") for n in (16, 48, 144)],
    "control points": [
        (f"{n} x {n}", f"{RAYS} --resolution 128 --control {n} -o p.caustic", "p.caustic/render.png") for n in (25, 50, 100)
    ],
    "iterations, flat at first": [
        (f"{n}", f"{RAYS} --resolution 64 --control 40 --start offset --iterations {n} -o p.caustic", "p.caustic/render.png")
        for n in (10, 40, 200)
    ],
    "rays of an image": [
        (n, f"render same.caustic --rays {n} --effects none -o rays.png", "rays.png") for n in ("1e4", "1e5", "1e6")
    ],
    "wavelengths of an image": [
        (f"{n.count(',') + 1}", f"render same.caustic --wavelengths {n} --effects diffraction -o by.png", "by-wave.png")
        for n in ("550", "450,550,650", "440,470,500,530,560,590,620,650")
    ],
}
#: Height by which a control point is raised, mm.
RAISED = 0.05
#: Rays of the square source, and half the width of the parts of the lens whose light is shown, mm.
MANY, PATCH = 1 << 20, 0.1


def caustic(line: str, place: Path) -> dict:
    """What a command prints with --json."""
    command = [sys.executable, "-m", "caustic_cli", *shlex.split(line), "--json", "--quiet", "--force"]
    done = subprocess.run(command, capture_output=True, text=True, check=False, cwd=place)
    if done.returncode:
        raise SystemExit(f"{line}\n{done.stderr}")
    return json.loads(done.stdout)


def save(figure, path: Path) -> None:
    """Write a PNG of at most 128 colours."""
    figure.savefig(path, dpi=90, metadata={"Software": "caustic"})
    plt.close(figure)
    Image.open(path).convert("RGB").quantize(128, method=Image.Quantize.FASTOCTREE, dither=Image.Dither.NONE).save(
        path, optimize=True
    )
    print(path, path.stat().st_size, flush=True)


def show(axis, picture: Path, title: str = "") -> None:
    axis.imshow(np.asarray(Image.open(picture)), cmap="gray", vmin=0, vmax=255)
    axis.set(xticks=[], yticks=[])
    axis.set_title(title, fontsize=9)


def price(place: Path, out: Path) -> None:
    """Chapter 5: what is paid for, a row each."""
    figure, grid = plt.subplots(len(PRICES), 3, figsize=(6.6, 2.35 * len(PRICES)), layout="constrained")
    caustic(SAME, place)
    for row, (heading, panels) in zip(grid, PRICES.items(), strict=True):
        for axis, (name, line, image) in zip(row, panels, strict=True):
            said = caustic(line, place)
            error = said.get("wave_relative_rms") if "wave" in image else said["relative_rms"]
            show(axis, place / image, f"{name}: error {error:.3f}, {said['seconds']:.1f} s")
            print(line, error, said["seconds"], flush=True)
        row[0].set_ylabel(heading)
    save(figure, out / "price.png")


def control_point(place: Path, out: Path) -> None:
    """Figures 6.1.1 and 6.1.2: the derivative by one height, and the image of the flat lens with that height raised."""
    caustic("design tophat.png --config thesis/flat.toml -o flat.caustic", place)
    caustic("gradmap flat.caustic --control 7,7 --filter-size 3 -o gradmap.png", place)
    lens = load(place / "flat.caustic")
    figure, axes = plt.subplots(1, 2, figsize=(11.6, 4.8), layout="constrained", width_ratios=(1.3, 1.0))
    show(axes[0], place / "gradmap.png")
    axes[0].axis("off")
    lens.heights[7, 7] += RAISED
    image = lens.render(rays=1e6).image
    (rx, ry) = lens.scene.screen.half_size
    axes[1].imshow(np.asarray(image).T, origin="lower", extent=(-rx, rx, -ry, ry), cmap="gray")
    axes[1].set(xlabel="x (mm)", ylabel="y (mm)", title=f"image with this point raised by {RAISED:g} mm")
    save(figure, out / "control-point.png")


def rays(place: Path, out: Path) -> None:
    """Figure 6.2.12: 25 x 25 rays through designed lenses, and their images."""
    figure = plt.figure(figsize=(10.4, 6.8), layout="constrained")
    grid = figure.subplots(2, 2, width_ratios=(1.0, 2.1))
    for row, mag in zip(grid, (1, 5), strict=True):
        said = caustic(f"design flame.png --mag {mag} --quality draft --resolution 128 --waves off -o rays.caustic", place)
        caustic("render rays.caustic --rays 4e6 --rays-plot 625", place)
        show(row[0], place / "rays.caustic" / "render.png", f"magnification {mag}: error {said['error']:.3f}")
        show(row[1], place / "rays.caustic" / "rays.png")
        row[1].axis("off")
    save(figure, out / "rays.png")


def landed(scene: Scene, heights: torch.Tensor, count: int) -> np.ndarray:
    """Rays that arrive, (N, 10) mm: x, y on the screen, x, y where they leave the lens, and origin and direction in the glass."""
    field, found = HeightField.of(scene.lens), []
    for tracer in tracers(scene, field, rays_of(scene, "uniform", count, 0), torch.float64, FEW, NO_REQUESTS, track=True):
        with torch.no_grad():
            *before, last = (m.state.expanded() for m in tracer.interactions({EXIT: heights}))
            there = tracer.onto(last, scene.screen).expanded()
        glass = before[-1]
        columns = (
            *there.full(there.origin)[:2],
            *last.full(last.origin)[:2],
            *glass.full(glass.origin),
            *glass.full(glass.direction),
        )
        rows = torch.stack(columns, 1).double()
        rows[:, 6] += glass.datum
        found.append(rows[there.statuses() == RayStatus.OK].numpy())
    return np.concatenate(found)


def triangles(place: Path, out: Path) -> None:
    """Figure 6.2.13: a point source through a flat lens, by the lower left triangles of its mesh; triangles tested for each ray."""
    spans, half = 10, 5.0
    lens = Lens((2 * half, 2 * half), control=(spans + 3, spans + 3), index=1.5, offset=Offset(6.0))
    scene = Scene(Points(((0.0, 0.0, -2.0),)), lens, Screen((60.0, 60.0), 20.0, (300, 300)))
    field, heights = HeightField.of(lens), torch.full((spans + 3, spans + 3), 6.0, dtype=torch.float64)
    xy, left, *inside = np.split(landed(scene, heights, 2_000_000), (2, 4), axis=1)
    _, _, tested = TriangleMesh(field, heights, 1, 1).intersect(*torch.from_numpy(inside[0]).T)
    cell = (left + half) / (2 * half) * spans
    lower = (cell - np.floor(cell)).sum(1) < 1.0
    figure, axes = plt.subplots(1, 2, figsize=(10.0, 4.6), layout="constrained")
    box = {"bins": 300, "range": [(-s, s) for s in scene.screen.half_size]}
    extent = [v for s in scene.screen.half_size for v in (-s, s)]
    light = np.histogram2d(*xy[lower].T, **box)[0]
    axes[0].imshow(light.T, origin="lower", extent=extent, cmap="gray", vmax=np.percentile(light, 99.5))
    axes[0].set(title="light through the lower left triangles")
    hits, sums = (np.histogram2d(*xy.T, weights=w, **box)[0] for w in (None, tested.numpy().astype(float)))
    mean = np.divide(sums, hits, out=np.full_like(sums, np.nan), where=hits > 0)
    drawn = axes[1].imshow(mean.T, origin="lower", extent=extent, cmap="viridis")
    axes[1].set(title=f"triangles tested for a ray, of {2 * spans**2}")
    figure.colorbar(drawn, ticks=range(int(tested.min()), int(tested.max()) + 1))
    for axis in axes:
        axis.set(xlabel="x (mm)", ylabel="y (mm)")
    save(figure, out / "triangles.png")


def square_source(place: Path, out: Path) -> None:
    """Figure 6.4.1: images by one point of a square source and by all, and those of the square by small parts of the lens."""
    source = "--source grid --source-size 0.6 --source-position 0,0,-50"
    said = caustic(f"design flame.png {source} --quality draft --resolution 64 --waves off -o square.caustic", place)
    point = "render square.caustic --source point --source-position"
    caustic(f"{point} 0,0,-50 --rays 4e6 -o middle.png", place)
    caustic(f"{point} 0.3,0.3,-50 --rays 4e6 -o corner.png", place)
    lens = load(place / "square.caustic")
    figure, axes = plt.subplots(1, 4, figsize=(12.4, 3.5), layout="constrained")
    show(axes[0], place / "middle.png", "the middle of the square alone")
    show(axes[1], place / "corner.png", "its +x +y corner alone")
    show(axes[2], place / "square.caustic" / "render.png", f"the whole square: error {said['error']:.3f}")
    xy, left, _ = np.split(landed(lens.scene, lens.heights, MANY), (2, 4), axis=1)
    centres = np.linspace(-0.9, 0.9, 3) * lens.scene.lens.half_size[0]
    for k, (x, y) in enumerate((x, y) for x in centres for y in centres):
        through = (np.abs(left - (x, y)) < PATCH).all(1)
        axes[3].plot(*xy[through].T, ".", markersize=1.5, color=COLOURS[k % len(COLOURS)])
    (rx, ry) = lens.scene.screen.half_size
    axes[3].set(xlim=(-rx, rx), ylim=(-ry, ry), aspect="equal", xticks=[], yticks=[])
    axes[3].set_title(f"by nine parts of the lens, {2 * PATCH:g} mm wide", fontsize=9)
    save(figure, out / "square-source.png")


SHEETS = {"price": price, "control-point": control_point, "rays": rays, "triangles": triangles, "square-source": square_source}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("--only", default=",".join(SHEETS), help="names of pictures, separated by commas")
    parser.add_argument("-o", "--out", type=Path, default=HERE, metavar="DIR", help="default: examples")
    given = parser.parse_args()
    given.out.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as folder:
        place = Path(folder)
        for name in ("flame.png", "tophat.png", "thesis"):
            (place / name).symlink_to(HERE / name)
        for name in given.only.split(","):
            SHEETS[name](place, given.out)


if __name__ == "__main__":
    main()
