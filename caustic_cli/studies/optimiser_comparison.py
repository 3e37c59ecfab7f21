"""What a design reaches in how much time: optimisers, networks and control nets against each other.

Every contender is a design of its own for the same target.  They take turns, a slice of time each, round after round, so that a
machine that slows down for a while slows all of them.  After rounds 1, 2, 4, .. every lens is retraced with the same rays, which
no design has seen: the error is the relative RMS between that bincount image and the target, each over its own mean.

A contender's time is that of its iterations; retracing, and what is prepared once before the first iteration, are left out.
"""

from __future__ import annotations

import statistics
from collections.abc import Callable, Sequence
from typing import Protocol

import numpy as np
import torch
from matplotlib.figure import Figure
from torch import Tensor

from caustic_cli import __version__
from caustic_cli.config import checks
from caustic_cli.optics.surfaces.heightfield import HeightField
from caustic_cli.scene import Scene
from caustic_cli.studies.report import Study, draw_front, legend_beside, plain_ticks
from caustic_cli.studies.retrace import FINAL_RAYS, retrace

#: Slices that the time of every contender is cut into; a power of 2.
ROUNDS = 16
#: Seconds for each contender, unless said.
SECONDS = 4.0
#: Rays of a retrace per pixel: stratified, they leave an error of a few per cent.
RAYS_PER_PIXEL = 32
#: Lenses whose errors are this close, relatively, are called equally good.
ALIKE = 0.02

COLUMNS = {
    "series": "optimiser or network, and its control net or nets",
    "optimizer": "lbfgs or adam",
    "network": "what the heights come from: none, sparse or dense",
    "control": "control points along x and y, now",
    "iterations": "done so far",
    "seconds": "spent in iterations so far, s",
    "iteration": "wall time of one iteration so far, s; median",
    "iteration_min": "least of them, s",
    "iteration_max": "most of them, s",
    "loss": "the last iteration's own loss times the pixels, for rms a relative RMS (filtered, blurred in early stages); empty"
    " before the first iteration",
    "error": "relative RMS between the retraced image and the target, each over its own mean",
}


class Contender(Protocol):
    """A design that goes on when it is its turn.

    series, optimizer, network: see COLUMNS; heights (n, m) mm over `field`; seconds, iterations: spent so far; steps: seconds of
    every iteration so far; loss: the last iteration's, times the pixels; done: it cannot be improved further.
    """

    series: str
    optimizer: str
    network: str

    @property
    def field(self) -> HeightField: ...
    @property
    def heights(self) -> Tensor: ...
    @property
    def seconds(self) -> float: ...
    @property
    def iterations(self) -> int: ...
    @property
    def steps(self) -> list[float]: ...
    @property
    def loss(self) -> float | None: ...
    @property
    def done(self) -> bool: ...

    def advance(self, seconds: float) -> None:
        """Iterate for so long, at least once."""


def run_training(
    scene: Scene,
    target: np.ndarray,
    contenders: Sequence[Contender],
    *,
    seconds: float | None = None,
    seed: int = 0,
    rays: int | None = None,
    device: str = "cpu",
    progress: Callable[[int, int], None] | None = None,
) -> Study:
    """Let all contenders run for the same time.  Neither errors nor times repeat: a faster machine gets further.

    Args:
        target: (n_x, n_y) irradiance on the scene's screen.
        seconds: for each, None for SECONDS.
        seed: of the retrace's rays.
        rays: of every retrace, None for RAYS_PER_PIXEL a pixel.
        progress: told (slices done, in all) after each.

    Raises:
        InputError: numbers out of range.
        CausticError: no light reaches the screen.
    """
    seconds = checks.number("⟨seconds⟩", SECONDS if seconds is None else seconds, 0.0, 1e6, open_low=True)
    rays = checks.whole("⟨rays⟩", min(FINAL_RAYS, RAYS_PER_PIXEL * target.size) if rays is None else rays, 256, 1 << 32)
    tables: list[list[dict]] = [[] for _ in contenders]

    def judge() -> None:
        for table, c in zip(tables, contenders, strict=True):
            if not table or c.iterations > table[-1]["iterations"]:
                _, figures = retrace(scene, c.field, c.heights, target, rays=rays, seed=seed, device=device, noise=False)
                table.append(_row(c, figures["relative_rms"]))

    judge()
    for k in range(1, ROUNDS + 1):
        for i, c in enumerate(contenders):
            left = seconds * k / ROUNDS - c.seconds
            if left > 0 and not c.done:
                c.advance(left)
            if progress is not None:
                progress((k - 1) * len(contenders) + i + 1, ROUNDS * len(contenders))
        if k & (k - 1) == 0:
            judge()
    rows = [row for table in tables for row in table]
    made = {
        "version": __version__,
        "seed": seed,
        "seconds_each": seconds,
        "rounds": ROUNDS,
        "retrace_rays": rays,
        "device": device,
        "threads": torch.get_num_threads(),
        "resolution": list(scene.screen.resolution),
        "reference_error": 0.0,
    }
    return Study("design", COLUMNS, rows, {}, _advice(tables), made, "seconds", PLOTS)


def _row(c: Contender, error: float) -> dict:
    steps = c.steps
    return {
        "series": c.series,
        "optimizer": c.optimizer,
        "network": c.network,
        "control": "x".join(map(str, c.heights.shape)),
        "iterations": c.iterations,
        "seconds": c.seconds,
        "iteration": statistics.median(steps) if steps else None,
        "iteration_min": min(steps, default=None),
        "iteration_max": max(steps, default=None),
        "loss": c.loss,
        "error": error,
    }


def _advice(tables: list[list[dict]]) -> str:
    """Who comes furthest, and when it had passed where the next one ends, in one sentence."""
    best = min(tables, key=lambda table: table[-1]["error"])
    rest = [table[-1] for table in tables if table is not best]
    last = best[-1]
    text = f"{last['series']} has the least error, {last['error']:.3g} after {last['seconds']:.2g} s"
    if not rest:
        return text
    second = min(rest, key=lambda row: row["error"])
    if second["error"] <= (1.0 + ALIKE) * last["error"]:
        return f"{text}, and {second['series']} is as good, {second['error']:.3g} after {second['seconds']:.2g} s"
    when = next(row["seconds"] for row in best if row["error"] <= second["error"])
    return (
        f"{text}; the next, {second['series']}, ends at {second['error']:.3g} after {second['seconds']:.2g} s, which the best"
        f" had passed by {when:.2g} s"
    )


def draw_design(study: Study, figure: Figure) -> None:
    """Error against time, a curve for each contender."""
    figure.set_size_inches(8.4, 5.6)
    axes = figure.add_subplot()
    draw_front(axes, study)
    begin = max(row["error"] for row in study.rows if row["iterations"] == 0)
    axes.axhline(begin, color="grey", linewidth=0.8, linestyle="--", label=f"at the beginning, {begin:.2g}")
    axes.set(
        xlabel="time in iterations (s)", ylabel="relative RMS between retraced image and target", title="design: error and time"
    )
    plain_ticks(axes.yaxis)
    legend_beside(figure)


#: Endings of the pictures' names, and what draws them.
PLOTS = {"": draw_design}
