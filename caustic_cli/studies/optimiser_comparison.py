"""Comparison of optimisers, networks and control nets: error against computation time of a design.

Each run is a separate design for the same target.  The runs are interleaved in time slices, so that a temporary slowdown of the
machine affects all of them.  After rounds 1, 2, 4, .. every lens is retraced with the same independent rays: the error is the
relative RMS between that bincount image and the target, each over its own mean.

The time of a run is that of its iterations; retracing, and preparations before the first iteration, are left out.
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
from caustic_cli.effort import current_effort
from caustic_cli.optics.surfaces.heightfield import HeightField
from caustic_cli.optics.system import trace_arguments
from caustic_cli.scene import Scene
from caustic_cli.schema import checks
from caustic_cli.studies.report import Study, draw_front, legend_beside, plain_ticks
from caustic_cli.studies.retrace import retrace

#: Time slices per run; a power of 2.
ROUNDS = 16
#: Default seconds for each run.
SECONDS = 4.0
#: Rays of a retrace per pixel: stratified, with an error of a few per cent.
RAYS_PER_PIXEL = 32
#: Relative difference of errors below which lenses count as equally good.
ALIKE = 0.02

COLUMNS = {
    "series": "optimiser or network, and its control net or nets",
    "optimizer": "lbfgs or adam",
    "network": "parametrisation of the heights: none, sparse or dense",
    "control": "control points along x and y, now",
    "iterations": "done so far",
    "seconds": "spent in iterations so far, s",
    "iteration": "wall time of one iteration so far, s; median",
    "iteration_min": "shortest of them, s",
    "iteration_max": "longest of them, s",
    "loss": "the last iteration's own loss times the pixels, for rms a relative RMS (filtered, blurred in early stages); empty"
    " before the first iteration",
    "error": "relative RMS between the retraced image and the target, each over its own mean",
}


class DesignRun(Protocol):
    """A design that is advanced in time slices.

    series, optimizer, network: see COLUMNS; heights (n, m) mm over `field`, or of all surfaces (k, n, m); seconds, iterations:
    spent so far; steps: seconds of every iteration so far; loss: the last iteration's, times the pixels; done: no further
    improvement is possible.
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
        """Iterate for this number of seconds, at least once."""


def run_comparison(
    scene: Scene,
    target: np.ndarray,
    runs: Sequence[DesignRun],
    *,
    seconds: float | None = None,
    seed: int = 0,
    rays: int | None = None,
    device: str = "cpu",
    progress: Callable[[int, int], None] | None = None,
) -> Study:
    """Run all designs for the same time.  Neither errors nor times are reproducible, as they depend on the speed of the machine.

    Args:
        target: (n_x, n_y) irradiance on the scene's screen.
        seconds: for each, None for SECONDS.
        seed: of the retrace's rays.
        rays: of every retrace, None for RAYS_PER_PIXEL per pixel.
        progress: called with (slices done, in total) after each.

    Raises:
        InputError: numbers out of range.
        CausticError: no light reaches the screen.
    """
    seconds = checks.number("⟨seconds⟩", SECONDS if seconds is None else seconds, 0.0, 1e6, open_low=True)
    usual = min(current_effort().final_rays, RAYS_PER_PIXEL * target.size)
    rays = checks.whole("⟨rays⟩", usual if rays is None else rays, 256, 1 << 32)
    tables: list[list[dict]] = [[] for _ in runs]

    def evaluate() -> None:
        for table, c in zip(tables, runs, strict=True):
            if not table or c.iterations > table[-1]["iterations"]:
                lens = trace_arguments(scene, c.field, c.heights)
                _, figures = retrace(*lens, target, rays=rays, seed=seed, device=device, noise=False)
                table.append(_row(c, figures["relative_rms"]))

    evaluate()
    for k in range(1, ROUNDS + 1):
        for i, c in enumerate(runs):
            left = seconds * k / ROUNDS - c.seconds
            if left > 0 and not c.done:
                c.advance(left)
            if progress is not None:
                progress((k - 1) * len(runs) + i + 1, ROUNDS * len(runs))
        if k & (k - 1) == 0:
            evaluate()
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


def _row(c: DesignRun, error: float) -> dict:
    steps = c.steps
    return {
        "series": c.series,
        "optimizer": c.optimizer,
        "network": c.network,
        "control": "x".join(map(str, c.heights.shape[-2:])),
        "iterations": c.iterations,
        "seconds": c.seconds,
        "iteration": statistics.median(steps) if steps else None,
        "iteration_min": min(steps, default=None),
        "iteration_max": max(steps, default=None),
        "loss": c.loss,
        "error": error,
    }


def _advice(tables: list[list[dict]]) -> str:
    """The run with the least error, and the time at which it reached the final error of the next best, in one sentence."""
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
    """Error against time, a curve for each run."""
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
