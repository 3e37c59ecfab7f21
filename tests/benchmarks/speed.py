"""What an iteration costs: the fused kernels beside plain torch, and how time and memory grow.

    python tests/benchmarks/speed.py [DIRECTORY]      about two minutes on two cores; writes speed.md, speed.json, speed.png

Every figure is a median over rounds in which the settings take turns, so that a change in the machine's speed meets all of them;
ratios are medians of the ratios within a round.  The setting is table D.2's: 562,500 rays, 50 x 50 control net of degree 10,
250 x 250 pixels, a Gaussian filter of 3 x 3 with alpha = 1 / cm^2; the kernels in float64, plain torch in
float32.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import statistics
import subprocess
import sys
import time
from dataclasses import replace
from functools import partial
from pathlib import Path

import torch

from caustic_cli.inverse.objective import Objective
from caustic_cli.inverse.schedule import LossImage
from caustic_cli.optics.emission import rays_of
from caustic_cli.optics.reconstruction import Filter
from caustic_cli.optics.sampling import Sampler
from caustic_cli.optics.surfaces.heightfield import HeightField
from caustic_cli.optics.system import EXIT, System
from caustic_cli.optics.trace import Tracer
from caustic_cli.scene import Lens, Offset, PlaneWave, Scene, Screen
from caustic_cli.scene.sources.points import Points

SCREEN = Screen((38.4, 38.4), 300.0, (250, 250))
ALPHA = 0.01 * SCREEN.pixel[0] ** 2  # 1 / cm^2 = 0.01 / mm^2, per pixel
BASE = {"rays": 562_500, "control": 50, "degree": 10, "pixels": 250, "filter": 3, "kind": "gaussian", "alpha": ALPHA}
ROUNDS = 7


def scene(control: int, degree: int, pixels: int) -> tuple[Scene, HeightField, torch.Tensor]:
    """The flame's lens before any design, roughened, so that rays fall everywhere."""
    lens = Lens(control=(control, control), degree=(degree, degree), index=1.544333973, offset=Offset(5.0, (80.0, 80.0)))
    field = HeightField.of(lens)
    x, y = (c.numpy() for c in field.control_xy())
    noise = torch.randn(control, control, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    heights = torch.from_numpy(5.0 + lens.offset.sag(x[:, None], y[None, :])) + noise * (0.05 / control)
    return Scene(PlaneWave(), lens, replace(SCREEN, resolution=(pixels, pixels))), field, heights


def objective(kernels: str, rays: int, control: int, degree: int, pixels: int, filter: int, kind: str, alpha: float):
    """A whole iteration's work: image, loss, gradient.  Returns a function without arguments."""
    s, field, heights = scene(control, degree, pixels)
    f = Filter(kind, (filter, filter), (alpha, alpha)) if filter > 1 else Filter()
    target = torch.rand((pixels, pixels), generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    os.environ["CAUSTIC_KERNELS"] = kernels
    made = Objective(s, field, Sampler.of_size("grid", rays), target, "rms-light", LossImage(f))
    os.environ["CAUSTIC_KERNELS"] = ""
    return lambda: made(heights)


def forward(kernels: str, **setting):
    """The image alone."""
    s, field, heights = scene(setting["control"], setting["degree"], setting["pixels"])
    f = Filter(setting["kind"], (setting["filter"],) * 2, (setting["alpha"],) * 2)
    os.environ["CAUSTIC_KERNELS"] = kernels
    (sample,) = Sampler.of_size("grid", setting["rays"]).chunks()
    tracer = Tracer(System.of(s, field), sample, torch.float32)
    os.environ["CAUSTIC_KERNELS"] = ""

    def run():
        with torch.no_grad():
            tracer.expose({EXIT: heights}, s.screen, f)

    return run


def interleaved(work: dict, rounds: int = ROUNDS) -> dict[str, list[float]]:
    """Seconds of each piece of work, taking turns; the first round warms up."""
    times: dict[str, list[float]] = {name: [] for name in work}
    for k in range(rounds + 1):
        for name, run in work.items():
            began = time.perf_counter()
            run()
            if k:
                times[name].append(time.perf_counter() - began)
    return times


def against_torch() -> list[dict]:
    """Fused against plain torch, forward, whole, and by difference backward."""
    rows = []
    for filter, kind, alpha in ((3, "gaussian", ALPHA), (11, "gaussian", ALPHA), (11, "gaussian", 0.03), (3, "cosine", 0.0)):
        setting = {**BASE, "filter": filter, "kind": kind, "alpha": alpha}
        work = {
            f"{part} {name}": make(kernels, **setting)
            for name, kernels in (("fused", ""), ("torch", "torch"))
            for part, make in (("forward", forward), ("whole", objective))
        }
        times = interleaved(work)
        ratio = {
            part: [t / f for t, f in zip(times[f"{part} torch"], times[f"{part} fused"], strict=True)]
            for part in ("forward", "whole")
        }
        row = {"filter": f"{kind} {filter}", "alpha_per_pixel2": alpha}
        for name in ("fused", "torch"):
            f, w = (statistics.median(times[f"{part} {name}"]) * 1e3 for part in ("forward", "whole"))
            row |= {f"{name}_forward_ms": f, f"{name}_backward_ms": w - f, f"{name}_whole_ms": w}
        row |= {
            "ratio_forward": statistics.median(ratio["forward"]),
            "ratio_whole": statistics.median(ratio["whole"]),
            "ratio_whole_least": min(ratio["whole"]),
            "ratio_whole_most": max(ratio["whole"]),
        }
        rows.append(row)
        print(row, flush=True)
    return rows


def scaling(name: str, values) -> list[dict]:
    """Whole iterations, fused, over one parameter; time per ray as a ratio to the base setting in the same run."""
    work = {"base": objective("", **BASE)}
    work |= {str(v): objective("", **{**BASE, name: v}) for v in values}
    times = interleaved(work, 5)
    base = times.pop("base")
    rows = [
        {name: v, "ms": statistics.median(t) * 1e3, "ratio": statistics.median(a / b for a, b in zip(t, base, strict=True))}
        for v, t in zip(values, times.values(), strict=True)
    ]
    print(name, rows, flush=True)
    return rows


def sources() -> list[dict]:
    """The regular grid of a plane wave, the pencil of a point source, and random rays of the latter, intersected one by one."""
    s, field, heights = scene(BASE["control"], 3, BASE["pixels"])
    near = replace(s, source=Points(((0.0, 0.0, -500.0),), (1.0,)))
    how, target = LossImage(Filter("cosine", (3, 3))), torch.ones(SCREEN.resolution, dtype=torch.float64)
    cases = {"plane wave": (s, "grid"), "point": (near, "grid"), "point, scattered": (near, "stratified")}
    made = {
        name: Objective(lit, field, rays_of(lit, kind, BASE["rays"]), target, "rms-light", how)
        for name, (lit, kind) in cases.items()
    }
    times = interleaved({name: partial(one, heights) for name, one in made.items()})
    rows = [{"source": name, "ms": statistics.median(t) * 1e3} for name, t in times.items()]
    print(rows, flush=True)
    return rows


def threads() -> list[dict]:
    """One thread and two."""
    before, rows = torch.get_num_threads(), []
    run = objective("", **BASE)
    for count in (1, 2):
        torch.set_num_threads(count)
        rows.append({"threads": count, "ms": statistics.median(interleaved({"x": run})["x"]) * 1e3})
    torch.set_num_threads(before)
    print(rows, flush=True)
    return rows


_MEMORY = """
import sys, time
sys.path.insert(0, {here!r})
import speed, torch
from caustic_cli.inverse.objective import Objective
from caustic_cli.inverse.schedule import LossImage
from caustic_cli.optics.sampling import Sampler
from caustic_cli.optics.trace import expose
from caustic_cli.optics.reconstruction import Filter
s, field, heights = speed.scene(50, 3, 250)
began = time.perf_counter()
if {what!r} == "render":
    expose(s, field, heights, Sampler.of_size("stratified", {rays}))
else:
    rays, target = Sampler.of_size("lines", {rays}), torch.ones(250, 250).double()
    Objective(s, field, rays, target, "rms-light", LossImage(Filter("cosine", (3, 3))))(heights)
peak = next(line for line in open("/proc/self/status") if line.startswith("VmHWM"))  # this process alone, from its start
print(int(peak.split()[1]) / 1024, time.perf_counter() - began)
"""


def memory() -> list[dict]:
    """Peak memory of a fresh process: a render, and a loss with its gradient, over the number of rays."""
    rows = []
    for what in ("render", "gradient"):
        for rays in (10**6, 10**7, 10**8):
            code = _MEMORY.format(here=str(Path(__file__).parent), what=what, rays=rays)
            out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.split()
            rows.append({"what": what, "rays": rays, "peak_MiB": float(out[0]), "seconds": float(out[1])})
            print(rows[-1], flush=True)
    return rows


def table(rows: list[dict]) -> str:
    """Rows as a Markdown table."""

    def cell(value) -> str:
        return f"{value:.3g}" if isinstance(value, float) else f"{value:,}" if isinstance(value, int) else str(value)

    keys = list(rows[0])
    lines = ["| " + " | ".join(keys) + " |", "|" + " --- |" * len(keys)]
    return "\n".join(lines + ["| " + " | ".join(cell(row[k]) for k in keys) + " |" for row in rows])


def plot(results: dict, path: Path) -> None:
    """Each scaling on logarithmic axes."""
    from matplotlib.figure import Figure  # noqa: PLC0415

    figure = Figure(figsize=(15, 6.5), layout="constrained")
    panels = dict(
        zip(
            ("against_torch", "rays", "control", "degree", "pixels", "filter", "threads", "memory"),
            figure.subplots(2, 4).flat,
            strict=True,
        )
    )
    for name, axes in panels.items():
        rows = results[name]
        if name == "against_torch":
            places = range(len(rows))
            axes.bar([p - 0.2 for p in places], [r["torch_whole_ms"] for r in rows], 0.4, label="plain torch")
            axes.bar([p + 0.2 for p in places], [r["fused_whole_ms"] for r in rows], 0.4, label="fused")
            axes.set(yscale="log", ylabel="ms per iteration")
            axes.set_xticks(list(places), [f"{r['filter']}\nalpha {r['alpha_per_pixel2']:.1g}" for r in rows], fontsize=7)
            axes.legend()
        elif name == "memory":
            for what in ("render", "gradient"):
                mine = [r for r in rows if r["what"] == what]
                axes.semilogx([r["rays"] for r in mine], [r["peak_MiB"] for r in mine], "o-", label=what)
            axes.set(xlabel="rays", ylabel="peak memory (MiB)", ylim=(0, None))
            axes.legend()
        else:
            axes.plot([r[name] for r in rows], [r["ms"] for r in rows], "o-")
            if name == "rays":
                axes.set(xscale="log", yscale="log")
            else:
                axes.set_ylim(0, None)
            axes.set(xlabel=name, ylabel="ms per iteration")
        axes.grid(alpha=0.3)
    figure.savefig(path, dpi=90, metadata={"Software": None})


def main() -> None:
    """Measure everything and write it down."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("directory", type=Path, nargs="?", default=Path("speed"), help="where tables and plots go")
    directory = parser.parse_args().directory
    directory.mkdir(parents=True, exist_ok=True)
    results = {
        "against_torch": against_torch(),
        "rays": scaling("rays", (100_000, 1_000_000, 10_000_000, 100_000_000)),
        "control": scaling("control", (25, 50, 100, 200, 400)),
        "degree": scaling("degree", (3, 5, 8, 12)),
        "pixels": scaling("pixels", (100, 250, 500, 1000)),
        "filter": scaling("filter", (1, 3, 5, 7, 11, 15)),
        "sources": sources(),
        "threads": threads(),
        "memory": memory(),
    }
    with open("/proc/cpuinfo") as f:
        model = next((line.split(":")[1].strip() for line in f if line.startswith("model name")), platform.processor())
    machine = f"{model}, {os.cpu_count()} cores, Python {platform.python_version()}, torch {torch.__version__}"
    (directory / "speed.json").write_text(json.dumps({"machine": machine, **results}, indent=1) + "\n")
    parts = [f"Machine: {machine}", *(f"### {name}\n\n{table(rows)}" for name, rows in results.items())]
    (directory / "speed.md").write_text("\n\n".join(parts) + "\n")
    plot(results, directory / "speed.png")


if __name__ == "__main__":
    main()
