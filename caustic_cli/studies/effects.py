"""Cost and influence of every simulated effect: computation time, and the change of the image without it.

Notation
    with, without   images of the same rays by plans that differ in one effect
    cost            least time of sampling, tracing and reconstruction with, minus the least without, since interference only ever
                    adds time.  Processor time of all threads, which is disturbed least; wall time on a GPU
    error           relative RMS between the two images, each over its own mean; power, light on the screen without less with

Both plans are timed alternately, so that a temporary slowdown of the machine affects both.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial

import torch
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from torch import Tensor

from caustic_cli import __version__
from caustic_cli.effort import STANDARD, Effort, current_effort
from caustic_cli.errors import InputError
from caustic_cli.optics import ranks
from caustic_cli.optics.effects import EFFECTS, Requests
from caustic_cli.optics.emission import rays_of
from caustic_cli.optics.image import Image
from caustic_cli.optics.plan import Plan, compile_plan
from caustic_cli.optics.sampling import stream
from caustic_cli.optics.surfaces.heightfield import HeightField
from caustic_cli.optics.trace import expose, is_lowered
from caustic_cli.optics.waves.image import UNASKED, wave_image
from caustic_cli.optics.waves.unsupported import NoWaveImage
from caustic_cli.scene import Scene
from caustic_cli.schema import checks
from caustic_cli.studies.metrics import relative_rms
from caustic_cli.studies.report import COLOURS, Study

BY_NAME = {effect.name: effect for effect in EFFECTS}
#: Whether leaving out an effect saves no time.
FREE = {effect.name: effect.free for effect in EFFECTS}
#: Whether an effect appears in the wave image alone.
WAVES = {effect.name: effect.waves for effect in EFFECTS}
#: Amount of an effect that the scene itself has; changes below this are rounding.
OWN, ROUNDING = "the scene's own", 1e-12
#: Least rays to a pixel of the ray image that a wave image is compared with.
RAYS_A_PIXEL = 30

COLUMNS = {
    "series": "effect",
    "on": "whether auto simulates it in this scene",
    "why": "reason, in this scene",
    "bound": "the number on which the decision is based",
    "limit": "the value with which it is compared",
    "amount": "of the effect in this measurement: that of the scene, or of the example added for the study",
    "error": "relative RMS between the images without and with the effect, each over its own mean",
    "power": "light on the screen without the effect minus with it, as a fraction of the source's power",
    "seconds": "cost: shortest time with it minus shortest time without, s",
    "seconds_min": "least difference over the rounds, s",
    "seconds_max": "largest of them, s",
    "whole": "shortest time with it, s",
}


def measure_waves(plan: Plan, field: HeightField, heights: Tensor, *, rays: int, repeats: int, seed: int = 0) -> dict:
    """`measure` for an effect of the wave image alone: its whole time is the cost, and the error is that of the ray image."""
    times, light, clock = [], None, _clock(heights)
    for _ in range(repeats):
        began = clock()
        try:
            light = wave_image(plan.scene, field, heights.detach(), most=UNASKED).image.cpu()
        except NoWaveImage:  # no wave image, or one that is too expensive for a comparison
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
    rays: int,
    repeats: int,
    seed: int = 0,
    dtype: torch.dtype = torch.float64,
) -> dict:
    """Cost and error of the effect in which two plans differ: error, power, seconds, seconds_min, seconds_max, whole.

    Where only the plan with it uses the fused kernels, both are timed by stages: the cost is that of the effect alone.
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
    rays: int,
    effort: Effort = STANDARD,
    seed: int = 0,
    dtype: torch.dtype = torch.float64,
) -> list[dict]:
    """A row for each effect of a plan of `scene`: name, on, why, bound, limit, cost_ms, cost_ms_range, error, power.

    error and power are those of leaving it out.  cost_ms of an effect that is off is what it would cost; cost_ms_range are the
    extremes of the differences over the rounds.  An effect absent from the scene has neither cost nor error; one that cannot be
    left out has no error (None).
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
                measure_waves(with_, field, heights, rays=rays, repeats=effort.wave_rounds, seed=seed)
                if WAVES[effect.name]
                else measure(with_, without, field, heights, rays=rays, repeats=effort.effect_rounds, seed=seed, dtype=dtype)
            )
            scale = 0.0 if FREE[effect.name] else 1e3
            cost, *extremes = (scale * found[k] for k in ("seconds", "seconds_min", "seconds_max"))
            row |= {"cost_ms": cost, "cost_ms_range": extremes, "error": found["error"], "power": found["power"]}
        rows.append({"cost_ms_range": [0.0, 0.0]} | row)
    return rows


def table(rows: list[dict]) -> list[str]:
    """The rows of `explain` as lines of text with a header; a cost is 0 where the rounds disagree on its sign."""

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
    """Cost and error of every effect for a lens; effects absent from its scene are added one at a time.

    Raises:
        InputError: numbers out of range.
    """
    effort = current_effort()
    rays = checks.whole("⟨rays⟩", effort.effect_rays if rays is None else rays, 256, 1 << 32)
    rounds = [
        checks.whole("⟨repeats⟩", usual if repeats is None else repeats, 1, 1000)
        for usual in (effort.effect_rounds, effort.wave_rounds)
    ]
    heights = heights.detach().double()
    plan = compile_plan(scene, field, heights)
    measured = partial(_row, plan, scene, field, heights, rays, rounds, seed, dtype or torch.float64)
    told = (lambda done: None) if progress is None else lambda done: progress(done, len(EFFECTS))
    rows = [row for row in ranks.mapped(measured, range(len(plan.effects)), told) if row is not None]
    told = sorted((r for r in rows if r["on"]), key=_influence, reverse=True)
    advice = (
        f"of what this scene has, {told[0]['series']} matters most ({_influence(told[0]):.2g})"
        if told
        else "this scene calls for no effect"
    )
    unfounded = max((_influence(r) for r in rows if not r["on"] and r["amount"] == OWN), default=0.0)
    advice += f"; effects of it that auto leaves out change image or power by at most {unfounded:.2g}"
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


def _influence(row: dict) -> float:
    """Influence of an effect: the larger of error and change of power without it."""
    return max(row["error"] or 0.0, abs(row["power"] or 0.0))


def _row(
    plan: Plan,
    scene: Scene,
    field: HeightField,
    heights: Tensor,
    rays: int,
    rounds: list[int],
    seed: int,
    dtype: torch.dtype,
    number: int,
) -> dict | None:
    """The row of an effect of the plan by its number, None for one that this scene cannot have; rounds: of effects in the ray image
    and in the wave image."""
    effect = plan.effects[number]
    name, amount, bare, repeats = effect.name, OWN, None, rounds[WAVES[effect.name]]
    if not effect.present:
        try:
            made = None if BY_NAME[name].of_glass and scene.lens.mirror else BY_NAME[name].probe(scene, heights)
        except InputError:  # which this scene cannot have, such as a gradient index beside other elements
            return None
        if made is None:
            return None
        scene, bare, amount = made.scene, made.baseline, made.words
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
    """A row for each effect, in the order of influence: the error of leaving it out, and its cost with the range over the
    rounds."""
    rows = sorted(study.rows, key=_influence)
    figure.set_size_inches(10.4, 1.6 + 0.27 * len(rows))
    errors, costs = figure.subplots(1, 2, sharey=True)
    floor = 0.3 * min((_influence(r) for r in rows if _influence(r) > ROUNDING), default=1.0)
    words = {"va": "center", "fontsize": "small", "bbox": {"facecolor": "white", "edgecolor": "none", "pad": 1.0}}
    for k, row in enumerate(rows):
        colour = COLOURS[row["amount"] != OWN]
        style = {"color": colour, "marker": "o", "markersize": 6, "markerfacecolor": colour if row["on"] else "white"}
        if _influence(row) > ROUNDING:
            errors.plot([_influence(row)], [k], linestyle="", **style)
        else:
            errors.annotate("nothing", (floor, k), color=colour, **words)
        cost, *ends = (1e3 * row[key] for key in ("seconds", "seconds_min", "seconds_max"))
        if any((cost, *ends)):
            costs.plot(ends, [k, k], color=colour, linewidth=1)  # a range that contains 0 is noise
            costs.plot([cost], [k], linestyle="", **style)
        else:
            costs.annotate("none", (0.0, k), color=colour, **words)
    names = [row["series"] if row["amount"] == OWN else f"{row['series']}: {row['amount']}" for row in rows]
    errors.set_yticks(range(len(rows)), names, fontsize="small")
    errors.set(xscale="log", title="error of leaving it out", xlabel="relative RMS or change of power, the larger")
    errors.set_xlim(left=0.8 * floor)
    errors.set_ylim(-0.7, len(rows) - 0.3)
    costs.set_xscale("symlog", linthresh=1.0)
    costs.margins(x=0.08)
    costs.set(title="cost, and range of the rounds", xlabel=f"ms of processor time for {study.about['rays']:,} rays")
    for axes in (errors, costs):
        axes.grid(linewidth=0.4)
        axes.set_axisbelow(True)
    kinds = {
        "as this scene has it": {"color": COLOURS[0]},
        "put in for this study": {"color": COLOURS[1]},
        "simulated by auto": {"color": "black"},
        "not simulated": {"color": "black", "markerfacecolor": "white"},
    }
    marks = [Line2D([], [], linestyle="", marker="o", markersize=6, label=name, **style) for name, style in kinds.items()]
    figure.legend(handles=marks, loc="outside lower center", ncols=4, fontsize="small")


#: Endings of the pictures' names, and what draws them.
PLOTS = {"": draw_effects}
