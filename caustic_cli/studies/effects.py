"""What every effect costs, and what leaving it out does to the image, measured in one run.

Notation
    with, without   images of the same rays by plans that differ in one effect
    cost            least time of sampling, tracing and reconstruction with, less the least without: what else the machine does
                    only ever adds to either.  Processor time of all threads, which that disturbs least; wall time on a GPU
    error           relative RMS between the two images, each over its own mean; power, light on the screen without less with

Both plans take turns, round after round, so that a machine that slows down for a while slows both.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace

import torch
from matplotlib.figure import Figure
from torch import Tensor

from caustic_cli import __version__
from caustic_cli.config import checks
from caustic_cli.optics.effects import EFFECTS, Decision, Requests
from caustic_cli.optics.emission import rays_of
from caustic_cli.optics.image import Image
from caustic_cli.optics.plan import Plan, compile_plan
from caustic_cli.optics.sampling import stream
from caustic_cli.optics.surfaces.heightfield import HeightField
from caustic_cli.optics.trace import expose, is_lowered
from caustic_cli.optics.waves import NoWaveImage, wave_image
from caustic_cli.optics.waves.image import UNASKED
from caustic_cli.scene import Scene
from caustic_cli.studies.metrics import relative_rms
from caustic_cli.studies.report import COLOURS, MARKERS, Study

#: Rays of every image, and rounds, unless said: a few seconds for each effect on two cores.  A wave image alone takes seconds.
RAYS, REPEATS, WAVE_REPEATS = 1 << 16, 5, 2
BY_NAME = {effect.name: effect for effect in EFFECTS}
#: Whether an effect costs nothing that could be saved.
FREE = {effect.name: effect.free for effect in EFFECTS}
#: Whether it is seen in the wave image alone.
WAVES = {effect.name: effect.waves for effect in EFFECTS}
#: Least rays to a pixel of the ray image that a wave image is compared with.
RAYS_A_PIXEL = 30

COLUMNS = {
    "series": "effect",
    "on": "whether auto simulates it in this scene",
    "why": "why, in this scene",
    "bound": "the number that decides",
    "limit": "what it is compared with",
    "amount": "of the effect as measured here: the scene's own, or what was put in",
    "error": "relative RMS between the image without and with it, each over its own mean",
    "power": "light on the screen without it less with it, part of the source's power",
    "seconds": "cost: least time with it less least time without, s",
    "seconds_min": "least of the rounds' differences, s",
    "seconds_max": "most of them, s",
    "whole": "least time with it, s",
}


def measure_waves(
    plan: Plan, field: HeightField, heights: Tensor, *, rays: int = RAYS, repeats: int = WAVE_REPEATS, seed: int = 0
) -> dict:
    """The same of what is seen in the wave image alone: the rounds' times of it, for without it nothing is done, and how the ray
    image differs from it."""
    times, light, clock = [], None, _clock(heights)
    for _ in range(repeats):
        began = clock()
        try:
            light = wave_image(plan.scene, field, heights.detach(), most=UNASKED).image.cpu()
        except NoWaveImage:  # nothing to compare with, or more than a comparison is worth
            return {"error": None, "power": None} | dict.fromkeys(("seconds", "seconds_min", "seconds_max", "whole"), 0.0)
        times.append(clock() - began)
    sampler = rays_of(plan.scene, "stratified", max(rays, RAYS_A_PIXEL * light.numel()), stream(seed, "effects"), heights.device)
    drawn = expose(plan.scene, field, heights, sampler, requests=plan.requests).image.cpu()
    drawn, light = drawn.flatten(0, -2), light.flatten(0, -2)
    return {
        "error": relative_rms(drawn, light),
        "power": float(drawn.sum() - light.sum()),
        "seconds": min(times),
        "seconds_min": min(times),
        "seconds_max": max(times),
        "whole": min(times),
    }


def _clock(heights: Tensor) -> Callable[[], float]:
    """Processor time of all threads; wall time where a GPU works."""
    return time.perf_counter if heights.is_cuda else time.process_time


def measure(
    with_: Plan,
    without: Plan,
    field: HeightField,
    heights: Tensor,
    *,
    rays: int = RAYS,
    repeats: int = REPEATS,
    seed: int = 0,
    dtype: torch.dtype = torch.float64,
) -> dict:
    """Cost and error of the effect in which two plans differ: error, power, seconds, seconds_min, seconds_max, whole.

    Where only the plan without it leaves the fused kernels, both are timed by stages: the cost is that of the effect alone.
    """
    if is_lowered(with_.scene, field, with_.requests) and not is_lowered(without.scene, field, without.requests):
        with_ = replace(with_, requests=with_.requests | Requests(stages=True))

    clock = _clock(heights)

    def image(plan: Plan) -> tuple[Image, float]:
        began = clock()
        sampler = rays_of(plan.scene, "stratified", rays, stream(seed, "effects"), heights.device)
        found = expose(plan.scene, field, heights, sampler, None, dtype, requests=plan.requests)
        if heights.is_cuda:
            torch.cuda.synchronize()
        return found, clock() - began

    images = [image(plan)[0].image.flatten(0, -2).cpu() for plan in (with_, without)]  # a round that only warms up
    times = [(image(with_)[1], image(without)[1]) for _ in range(repeats)]
    costs, least = [a - b for a, b in times], [min(column) for column in zip(*times, strict=True)]
    return {
        "error": relative_rms(images[1], images[0]),
        "power": float(images[1].sum() - images[0].sum()),
        "seconds": least[0] - least[1],
        "seconds_min": min(costs),
        "seconds_max": max(costs),
        "whole": least[0],
    }


def explain(
    plan: Plan,
    scene: Scene,
    field: HeightField,
    heights: Tensor,
    *,
    rays: int = RAYS,
    seed: int = 0,
    dtype: torch.dtype = torch.float64,
) -> list[dict]:
    """A row for each effect of a plan of `scene`: name, on, why, bound, limit, cost_ms, cost_ms_range, error, power.

    error and power are those of leaving it out.  cost_ms of an effect that is off is what it would cost; cost_ms_range are the
    extremes of the rounds' differences.  What the scene has nothing of has neither cost nor error; what cannot be left out has no
    error (None).
    """
    rows = []
    for effect in plan.effects:
        row = {"name": effect.name, "on": effect.on, "why": effect.why, "bound": effect.bound, "limit": effect.limit}
        if effect.fixed or not effect.present:
            row |= (
                {"cost_ms": 0.0, "error": None, "power": None}
                if effect.fixed and effect.on
                else {"cost_ms": 0.0, "error": 0.0, "power": 0.0}
            )
        else:
            with_, without = (
                compile_plan(scene, field, heights, chosen)
                for chosen in (set(plan.simulated) | {effect.name}, set(plan.simulated) - {effect.name})
            )
            found = (
                measure_waves(with_, field, heights, rays=rays, seed=seed)
                if WAVES[effect.name]
                else measure(with_, without, field, heights, rays=rays, repeats=REPEATS, seed=seed, dtype=dtype)
            )
            scale = 0.0 if FREE[effect.name] else 1e3
            cost, *extremes = (scale * found[k] for k in ("seconds", "seconds_min", "seconds_max"))
            row |= {"cost_ms": cost, "cost_ms_range": extremes, "error": found["error"], "power": found["power"]}
        rows.append({"cost_ms_range": [0.0, 0.0]} | row)
    return rows


def table(rows: list[dict]) -> list[str]:
    """The rows of `explain` as lines of text under their titles; a cost is 0 where the rounds do not agree on its sign."""

    def number(value: float | None, form: str) -> str:
        return "-" if value is None else format(value, form)

    def cost(row: dict) -> str:
        low, high = row["cost_ms_range"]
        return "0 ms" if low <= 0.0 <= high else f"{row['cost_ms']:+.1f} ms"

    cells = [("effect", "", "cost", "error", "power", "why")]
    for r in rows:
        quiet = not r["on"] and r["cost_ms_range"] == [0.0, 0.0]
        cells.append(
            (
                r["name"],
                "on" if r["on"] else "off",
                "-" if quiet else cost(r),
                "-" if quiet else number(r["error"], ".2g"),
                "-" if quiet else number(r["power"], "+.2%"),
                r["why"],
            )
        )
    widths = [max(len(row[k]) for row in cells) for k in range(5)]
    return [
        "  ".join([*(f"{c:<{w}}" if k < 2 else f"{c:>{w}}" for k, (c, w) in enumerate(zip(row, widths, strict=False))), row[5]])
        for row in cells
    ]


def run_effects(
    scene: Scene,
    field: HeightField,
    heights: Tensor,
    *,
    rays: int | None = None,
    repeats: int | None = None,
    seed: int = 0,
    dtype: torch.dtype | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Study:
    """Cost against error of every effect at a lens; what its scene lacks is put in, one effect at a time.

    Raises:
        InputError: numbers out of range.
    """
    rays = checks.whole("⟨rays⟩", RAYS if rays is None else rays, 256, 1 << 32)
    rounds = [checks.whole("⟨repeats⟩", usual if repeats is None else repeats, 1, 1000) for usual in (REPEATS, WAVE_REPEATS)]
    heights = heights.detach().double()
    plan, rows = compile_plan(scene, field, heights), []
    for k, effect in enumerate(plan.effects):
        found = _row(effect, plan, scene, field, heights, rays, rounds[WAVES[effect.name]], seed, dtype or torch.float64)
        if found is not None:
            rows.append(found)
        if progress is not None:
            progress(k + 1, len(EFFECTS))
    told = sorted((r for r in rows if r["on"]), key=_matters, reverse=True)
    advice = (
        f"of what this scene has, {told[0]['series']} matters most ({_matters(told[0]):.2g})"
        if told
        else "this scene calls for no effect"
    )
    unfounded = max((_matters(r) for r in rows if not r["on"] and r["amount"] == "the scene's own"), default=0.0)
    advice += f"; what auto leaves out of it changes image or power by at most {unfounded:.2g}"
    about = {
        "version": __version__,
        "seed": seed,
        "repeats": rounds[0],
        "wave_repeats": rounds[1],
        "rays": rays,
        "device": str(heights.device),
        "reference_error": 0.0,
        "threads": torch.get_num_threads(),
        "dtype": str(dtype or torch.float64).removeprefix("torch."),
    }
    return Study("effects", COLUMNS, rows, {}, advice, about, "rays", PLOTS)


def _matters(row: dict) -> float:
    """What leaving an effect out changes: the larger of error and power."""
    return max(row["error"] or 0.0, abs(row["power"] or 0.0))


def _row(
    effect: Decision,
    plan: Plan,
    scene: Scene,
    field: HeightField,
    heights: Tensor,
    rays: int,
    repeats: int,
    seed: int,
    dtype: torch.dtype,
) -> dict | None:
    name, amount, bare = effect.name, "the scene's own", None
    if not effect.present:
        made = BY_NAME[name].sample(scene, heights)
        if made is None:
            return None
        scene, bare, amount = made.scene, made.bare, made.words
        plan = compile_plan(scene, field, heights)
    elif effect.fixed:
        return None
    with_ = compile_plan(scene, field, heights, set(plan.simulated) | {name})
    without = compile_plan(bare or scene, field, heights, None if bare else set(plan.simulated) - {name})
    found = (
        measure_waves(with_, field, heights, rays=rays, repeats=repeats, seed=seed)
        if WAVES[name]
        else measure(with_, without, field, heights, rays=rays, repeats=repeats, seed=seed, dtype=dtype)
    )
    if FREE[name]:
        found |= dict.fromkeys(("seconds", "seconds_min", "seconds_max"), 0.0)
    return {
        "series": name,
        "on": effect.on,
        "why": effect.why,
        "bound": effect.bound,
        "limit": effect.limit,
        "amount": amount,
    } | found


def draw_effects(study: Study, figure: Figure) -> None:
    """Cost of every effect, and the error of leaving it out; filled where auto simulates it."""
    figure.set_size_inches(8.4, 5.6)
    axes = figure.add_subplot()
    floor = 0.5 * min((_matters(r) for r in study.rows if _matters(r) > 1e-12), default=1.0)
    for k, row in enumerate(study.rows):
        colour, error = COLOURS[k % len(COLOURS)], max(_matters(row), floor)
        low, high = (1e3 * max(0.0, d) for d in (row["seconds"] - row["seconds_min"], row["seconds_max"] - row["seconds"]))
        axes.errorbar(
            [1e3 * row["seconds"]],
            [error],
            xerr=[[low], [high]],
            linestyle="",
            color=colour,
            elinewidth=0.6,
            marker=MARKERS[(k + k // len(COLOURS)) % len(MARKERS)],
            markerfacecolor=colour if row["on"] else "none",
            label=f"{row['series']}, {'on' if row['on'] else 'off'}, {row['amount']}",
        )
    axes.set(
        yscale="log",
        xlabel=f"cost (ms of processor time for {study.about['rays']:,} rays), and the rounds' range",
        ylabel=f"left out: relative RMS or change of power, the larger (least drawn: {floor:.1g})",
        title="effects: cost and error",
    )
    axes.set_xscale("symlog", linthresh=1.0)
    axes.margins(x=0.1)
    for row in study.rows:
        if _matters(row) > floor:
            axes.annotate(
                row["series"], (1e3 * row["seconds"], _matters(row)), xytext=(5, 4), textcoords="offset points", fontsize="x-small"
            )
    axes.grid(which="major", linewidth=0.4)
    figure.legend(loc="outside right upper", fontsize="x-small")


#: Endings of the pictures' names, and what draws them.
PLOTS = {"": draw_effects}
