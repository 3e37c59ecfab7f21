"""Comparison of network architectures by a grid search (outlook of the thesis, 7.2).

All candidates are trained for the same numbers of iterations, in rounds, on the same picture from the same initial lens, and their
lenses are retraced with the same independent rays.  So errors are reproducible, and times are not; a time limit ends the study
after a complete round.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Protocol

import torch
from matplotlib.figure import Figure

from caustic_cli import __version__
from caustic_cli.effort import current_effort
from caustic_cli.errors import CausticError
from caustic_cli.schema import checks
from caustic_cli.studies.report import Study, plain_ticks, styles

#: Seconds for each candidate, unless said.
SECONDS = 4.0

COLUMNS = {
    "series": "name of the candidate",
    "network": "dense, or none for the heights themselves",
    "inputs": "range: a network trained over a range, with the parameters as inputs; none: over a range, without inputs, one lens"
    " for all of it; alone: one network for each value evaluated; empty without a range",
    "layers": "hidden layers",
    "width": "neurons in each",
    "activation": "of the hidden layers",
    "preconditioner": "laplacian: outputs are coordinates in which the response of the caustic is well conditioned; none: heights",
    "lr": "learning rate of Adam",
    "parameters": "weights and biases, or heights",
    "iterations": "of Adam",
    "seconds": "spent in iterations, s",
    "loss": "the last iteration's own loss times the pixels",
    "error": "relative RMS between the retraced image and the target; over a range, the root mean square over the values evaluated",
    "worst": "over a range, the largest of these",
    "noise": "standard error of `error`, by the rays of the retrace",
}


class Candidate(Protocol):
    """A network in training.

    about: its constant columns; seconds: spent; loss: of the last iteration, times the pixels.
    """

    about: dict[str, Any]
    seconds: float
    loss: float | None

    def reach(self, iterations: int) -> None:
        """Continue to this total number of iterations.

        Raises:
            CausticError: the loss is not finite, or no light reaches the screen.
        """

    def judged(self) -> dict[str, float]:
        """Figures error, worst and noise, see COLUMNS."""


def run_architectures(
    candidates: Sequence[Candidate],
    *,
    seconds: float | None = None,
    about: dict | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Study:
    """Train all candidates.

    Args:
        seconds: per candidate on average, None for SECONDS: no further round begins when the total is spent.
        about: further metadata of the study.
        progress: called with (evaluations done, in total) after each.

    Raises:
        InputError: numbers out of range.
        CausticError: none of them can be trained.
    """
    seconds = checks.number("⟨seconds⟩", SECONDS if seconds is None else seconds, 0.0, 1e6, open_low=True)
    began, rows, left, failed, rounds = time.monotonic(), [], list(candidates), {}, current_effort().training_rounds
    for k, iterations in enumerate(rounds):
        for i, c in enumerate(list(left)):
            try:
                c.reach(iterations)
                rows.append({**c.about, "iterations": iterations, "seconds": c.seconds, "loss": c.loss, **c.judged()})
            except CausticError as error:
                failed[c.about["series"]] = str(error)
                left.remove(c)
            if progress is not None:
                progress(k * len(candidates) + i + 1, len(rounds) * len(candidates))
        if not left or time.monotonic() - began > seconds * len(candidates):
            break
    if not any(_in_grid(c.about) for c in left):
        raise CausticError(f"none of the networks could be trained: {next(iter(failed.values()))}")
    rows.sort(key=lambda row: [c.about["series"] for c in candidates].index(row["series"]))
    made = {
        "version": __version__,
        "seconds_each": seconds,
        "rounds": list(rounds),
        "failed": failed,
        "threads": torch.get_num_threads(),
        "reference_error": 0.0,
    }
    advice = _advice(rows) + (f"; {len(failed)} of {len(candidates)} could not be trained" if failed else "")
    return Study("networks", COLUMNS, rows, {}, advice, made | (about or {}), "seconds", PLOTS)


def _in_grid(about: Mapping[str, Any]) -> bool:
    """Whether these columns are of a network of the grid."""
    return about["network"] == "dense" and about["inputs"] in ("", "range")


def last_round(rows: Sequence[dict]) -> list[dict]:
    """The rows of the most iterations."""
    most = max(row["iterations"] for row in rows)
    return [row for row in rows if row["iterations"] == most]


def _advice(rows: Sequence[dict]) -> str:
    """The best network, and the least error for every choice of each hyperparameter, in one sentence."""
    rows = last_round(rows)
    grid = [row for row in rows if _in_grid(row)]
    best = min(grid, key=lambda row: row["error"])
    parts = [f"after {best['iterations']} iterations {best['series']} has the least error of the networks, {best['error']:.3g}"]
    for key in ("preconditioner", "lr", "activation", "layers", "width"):
        of = {value: min(row["error"] for row in grid if row[key] == value) for value in {row[key] for row in grid}}
        if len(of) > 1:
            listed = ", ".join(f"{value} {of[value]:.3g}" for value in sorted(of, key=lambda value: of[value]))
            parts.append(f"by {key} at best {listed}")
    free = [row["error"] for row in rows if row["network"] == "none"]
    if free:
        parts.append(f"no network {min(free):.3g}")
    for name, words in (("none", "one lens for the whole range"), ("alone", "networks for each value alone")):
        of_range = [row["error"] for row in rows if row["inputs"] == name]
        if of_range:
            parts.append(f"{words} {min(of_range):.3g}")
    return "; ".join(parts)


def draw_architectures(study: Study, figure: Figure) -> None:
    """Error of the last round against width; panels by preconditioner and learning rate, curves by layers and activation."""
    rows = last_round(study.rows)
    grid = [row for row in rows if _in_grid(row)]
    down, across = (sorted({row[key] for row in grid}) for key in ("preconditioner", "lr"))
    figure.set_size_inches(2.2 + 3.4 * len(across), 1.4 + 2.8 * len(down))
    panels = figure.subplots(len(down), len(across), sharex=True, sharey=True, squeeze=False)
    of = styles(f"{row['activation']}, {_layers(row['layers'])}" for row in grid)
    for line, preconditioner in zip(panels, down, strict=True):
        for axes, lr in zip(line, across, strict=True):
            for name, style in of.items():
                mine = [
                    row
                    for row in grid
                    if (row["preconditioner"], row["lr"]) == (preconditioner, lr)
                    and f"{row['activation']}, {_layers(row['layers'])}" == name
                ]
                mine.sort(key=lambda row: row["width"])
                axes.errorbar([row["width"] for row in mine], [row["error"] for row in mine], label=name, **style)
            for row, dashes in zip(_beside(rows, preconditioner), ("--", ":"), strict=False):
                axes.axhline(row["error"], color="black", linewidth=0.9, linestyle=dashes, label=row["series"].split(",")[0])
            axes.set(xscale="log", yscale="log", title=f"preconditioner {preconditioner}, lr {lr:g}")
            axes.title.set_fontsize("medium")
            axes.set_xticks(sorted({row["width"] for row in grid}), labels=[f"{n}" for n in sorted({row["width"] for row in grid})])
            axes.minorticks_off()
            axes.grid(which="major", linewidth=0.4)
            plain_ticks(axes.yaxis)
    handles, labels = panels[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=3, fontsize="small")
    for axes in panels[-1]:
        axes.set_xlabel("neurons in each hidden layer")
    figure.supylabel(f"relative RMS of the retraced image, {rows[0]['iterations']} iterations", fontsize="medium")


def _layers(n: int) -> str:
    return f"{n} layer{'s' if n > 1 else ''}"


def _beside(rows: Sequence[dict], preconditioner: str) -> list[dict]:
    """Baselines: free heights at their best learning rate, and the other ways of training over a range."""
    free = [row for row in rows if row["network"] == "none" and row["preconditioner"] == preconditioner]
    best = [min(free, key=lambda row: row["error"])] if free else []
    return best + [row for row in rows if row["inputs"] in ("none", "alone")]


#: Endings of the pictures' names, and what draws them.
PLOTS = {"": draw_architectures}
