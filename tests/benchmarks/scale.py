"""How time, memory and error of a design grow with pixels, and time with rays: pictures of 125 x 125 to 2000 x 2000 pixels.

    python tests/benchmarks/scale.py [--pixels 125,250,500,1000,2000] [--picture FILE] [--plot FILE] [OPTIONS OF caustic design]

prints three Markdown tables: designs for rays, each a whole command in a process of its own with kernels compiled before; a lens of
300 mm, thirty times the default's lengths; and seconds against rays, of an image of one of these lenses and of a whole iteration
(image, loss, gradient) at the setting of speed.py.  Standard quality takes about half an hour of processor time, the retraces half
of that.  The picture is the portrait of quality.py, 500 pixels wide: above that it is interpolated and has no finer details;
`--picture` takes one that has.  Errors are of independent retraces with 512 rays a pixel, at least 3.2e7 and at most --most-rays,
beside the standard error that their noise leaves.
"""

from __future__ import annotations

import argparse
import resource
import statistics
import tempfile
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image
from quality import caustic, pictures

#: Rays of the retrace for each pixel, and at least.
EACH, LEAST = 512, 3.2e7
RAYS = (500_000, 1_000_000, 2_000_000, 4_000_000, 8_000_000, 16_000_000, 32_000_000)
ROUNDS = 3
#: A lens of 300 mm: the default scene thirty times as large.
LARGE, LARGE_PIXELS = ("--lens-size", "300", "--throw", "9000"), 1000
GIB, MIB = 2.0**30, 2.0**20


def alone(work: Callable, *arguments) -> Any:
    """What a function returns in a fresh process, whose resources are then those of this work and of nothing before it."""
    with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
        return pool.submit(work, *arguments).result()


def measured(work: Callable, *arguments) -> dict:
    """What work in child processes takes: wall and processor seconds, and the largest resident set of one of them, bytes.

    Linux counts what the parent had resident when it started a child as the child's: this module needs less than torch, which every
    child loads.
    """
    began, before = time.monotonic(), resource.getrusage(resource.RUSAGE_CHILDREN)
    work(*arguments)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    spent = (after.ru_utime - before.ru_utime) + (after.ru_stime - before.ru_stime)
    return {"wall": time.monotonic() - began, "processor": spent, "peak": after.ru_maxrss * 1024.0}


def judged(project: Path, rays: int) -> dict:
    """Of a finished lens: the shape of its net, its error by an independent retrace and the noise of that."""
    from caustic_cli import load  # noqa: PLC0415  torch is for processes of their own

    lens = load(project)
    figures = lens.render(rays).figures
    return {"control": tuple(lens.heights.shape)} | {name: figures[name] for name in ("relative_rms", "noise", "rays")}


def designed(picture: Path, pixels: int, project: Path, most_rays: int, options: list[str]) -> dict:
    """A row: what a design takes, and what it is worth."""
    square = project.with_suffix(".png")
    Image.open(picture).convert("L").resize((pixels, pixels), Image.Resampling.BICUBIC).save(square)
    scene = ("--resolution", pixels, "--mag", 3, "--margin", 0, "--linear", "--waves", "off", *options)
    cost = alone(measured, caustic, "design", square, *scene, "-o", project)
    rays = int(min(max(EACH * pixels**2, LEAST), most_rays))
    size = sum(file.stat().st_size for file in project.iterdir())
    return {"pixels": pixels, "size": size} | cost | alone(judged, project, rays)


def times_by_rays(project: Path, counts: tuple[int, ...]) -> list[dict]:
    """Median seconds of an image and of an iteration over the number of rays, warm, the settings taking turns."""
    from speed import BASE, interleaved, objective  # noqa: PLC0415

    from caustic_cli import load  # noqa: PLC0415
    from caustic_cli.optics.trace import expose  # noqa: PLC0415
    from caustic_cli.studies.retrace import sampler_for  # noqa: PLC0415

    lens = load(project)

    def image(rays: int) -> Callable:
        sampler = sampler_for(lens.scene, rays, 0)
        return lambda: expose(lens.scene, lens.field, lens.heights, sampler)

    work = {f"image {n}": image(n) for n in counts}
    work |= {f"iteration {n}": objective("", **(BASE | {"rays": n})) for n in counts}
    times = interleaved(work, ROUNDS)
    return [{"rays": n} | {what: statistics.median(times[f"{what} {n}"]) for what in ("image", "iteration")} for n in counts]


def order(x: list[float], y: list[float]) -> float:
    """Power with which y grows with x, by regression of the logarithms."""
    return float(np.polyfit(np.log(x), np.log(y), 1)[0])


def design_table(rows: list[dict]) -> str:
    """Designs, as Markdown."""
    names = ("pixels", "control points", "seconds", "processor seconds", "of it a pixel, µs", "peak memory, GiB", "bytes a pixel")
    names += ("project, MiB", "relative RMS error", "rays of the retrace")
    lines = [f"| {' | '.join(names)} |", "|" + " --- |" * len(names)]
    for r in rows:
        count = r["pixels"] ** 2
        lines.append(
            f"| {r['pixels']} x {r['pixels']} | {r['control'][0]} x {r['control'][1]} | {r['wall']:.0f} | {r['processor']:.0f} |"
            f" {1e6 * r['processor'] / count:.0f} | {r['peak'] / GIB:.2f} | {r['peak'] / count:.0f} | {r['size'] / MIB:.1f} |"
            f" {r['relative_rms']:.4f} ± {r['noise']:.4f} | {r['rays']:.2g} |"
        )
    return "\n".join(lines)


def ray_table(rows: list[dict]) -> str:
    """Seconds against rays, as Markdown."""
    lines = ["| rays | image, s | of it a ray, ns | iteration, s | of it a ray, ns |\n" + "|" + " --- |" * 5]
    for r in rows:
        cells = (f"{r[what]:.3g} | {1e9 * r[what] / r['rays']:.0f}" for what in ("image", "iteration"))
        lines.append(f"| {r['rays']:,} | {' | '.join(cells)} |")
    return "\n".join(lines)


def plot(designs: list[dict], by_rays: list[dict], path: Path) -> None:
    """Time, memory and error against pixels, and time against rays, on logarithmic axes beside lines of slope 1."""
    from matplotlib.figure import Figure  # noqa: PLC0415

    from caustic_cli.studies.report import COLOURS, MARKERS, SOFTWARE  # noqa: PLC0415

    figure = Figure(figsize=(10, 8), layout="constrained")
    time_, memory, error, rays = figure.subplots(2, 2).flat

    def draw(axes, x: list[int], lines: dict[str, list[float]], name: str, what: str) -> None:
        for k, (label, y) in enumerate(lines.items()):
            axes.loglog(x, y, MARKERS[k] + "-", color=COLOURS[k], label=label)
        axes.loglog(x, [y[-1] * n / x[-1] for n in x], "--", color="grey", lw=1, label="slope 1")
        axes.set(xlabel=name, ylabel=what)
        axes.legend(frameon=False)

    pixels, counts = [r["pixels"] ** 2 for r in designs], [r["rays"] for r in by_rays]
    times = {name: [r[key] for r in designs] for name, key in (("elapsed", "wall"), ("processor", "processor"))}
    draw(time_, pixels, times, "pixels", "time of a design (s)")
    draw(memory, pixels, {"peak resident": [r["peak"] / GIB for r in designs]}, "pixels", "memory of a design (GiB)")
    draw(rays, counts, {name: [r[name] for r in by_rays] for name in ("image", "iteration")}, "rays", "time, kernels warm (s)")
    error.errorbar(
        pixels, [r["relative_rms"] for r in designs], [r["noise"] for r in designs], fmt=MARKERS[0] + "-", color=COLOURS[0]
    )
    error.set(
        xscale="log",
        xlabel="pixels",
        ylabel="relative RMS error, retraced",
        ylim=(0, 1.1 * max(r["relative_rms"] for r in designs)),
    )
    for axes in (time_, memory, error, rays):
        axes.grid(alpha=0.3)
    figure.savefig(path, dpi=100, metadata={"Software": SOFTWARE})


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter, allow_abbrev=False)
    parser.add_argument("--pixels", default="125,250,500,1000,2000", help="along a side, separated by commas")
    parser.add_argument("--picture", type=Path, help="instead of the portrait; it is made square")
    parser.add_argument("--most-rays", type=float, default=5.12e8, help="of a retrace")
    parser.add_argument("--large", action=argparse.BooleanOptionalAction, default=True, help="design the lens of 300 mm too")
    parser.add_argument("--plot", type=Path, metavar="FILE")
    parser.add_argument("-o", "--out", type=Path, help="keep the projects here")
    options, more = parser.parse_known_args()  # what is left goes to `caustic design`
    sides = sorted(int(n) for n in options.pixels.split(","))
    with tempfile.TemporaryDirectory() as scratch:
        folder = options.out or Path(scratch)
        folder.mkdir(parents=True, exist_ok=True)
        picture = options.picture or pictures(folder)["portrait"]
        caustic("design", picture, "--quality", "draft", "--time-limit", 1, "--waves", "off", "-o", folder / "warm.caustic")
        designs = []
        for pixels in sides:
            project = folder / f"scale-{pixels}.caustic"
            designs.append(designed(picture, pixels, project, int(options.most_rays), more))
            print(design_table(designs[-1:]) if len(designs) == 1 else design_table(designs[-1:]).splitlines()[-1], flush=True)
        if len(designs) > 1:
            count = [float(n * n) for n in sides]
            time_, memory = (order(count, [r[key] for r in designs]) for key in ("processor", "peak"))
            print(f"\nWith the pixels, processor time grows by the power {time_:.2f} and memory by {memory:.2f}.")
        if options.large:
            project = folder / "scale-300mm.caustic"
            row = designed(picture, LARGE_PIXELS, project, int(options.most_rays), [*LARGE, *more])
            print(f"\nA lens of 300 mm ({' '.join(LARGE)}):\n\n{design_table([row])}", flush=True)
        by_rays = alone(times_by_rays, folder / f"scale-{sides[0]}.caustic", RAYS)
    counts = [float(r["rays"]) for r in by_rays]
    image, iteration = (order(counts, [r[what] for r in by_rays]) for what in ("image", "iteration"))
    print(f"\n{ray_table(by_rays)}\n")
    print(f"With the rays, time grows by the power {image:.2f} for an image and {iteration:.2f} for an iteration.")
    if options.plot:
        plot(designs, by_rays, options.plot)


if __name__ == "__main__":
    main()
