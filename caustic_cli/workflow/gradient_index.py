"""A complete design of a free gradient index: a flat plate by `inverse.gradient_index`, evaluated like any lens.

The control values of the index are a file of the project, which [lens] index_file names; the checkpoint holds the flat exit.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch

from caustic_cli.config.completion import build_stages
from caustic_cli.config.default_stages import transport_cells
from caustic_cli.inverse.designer import State
from caustic_cli.inverse.gradient_index import design_gradient_index
from caustic_cli.project import attachments
from caustic_cli.project.project import Project
from caustic_cli.workflow.reporter import Reporter


def is_free(project: Project) -> bool:
    """Whether the refractive index of a project is designed instead of its surface."""
    return project.settings.lens.gradient == "free"


@dataclass(frozen=True)
class IndexDesign:
    """The project with its designed index, and the final state."""

    project: Project
    state: State


def design_index(project: Project, say: Reporter, began: float, limit: float, stop: Callable[[], bool]) -> IndexDesign:
    """Design the index of the flat plate of a project.

    Args:
        began: start of the command by `time.monotonic`; limit: of the command, s; stop: called before every iteration.

    Raises:
        InputError: as of `design_gradient_index`.
    """
    full, lens, chosen = project.settings, project.settings.lens, project.settings.design
    blank = replace(project, settings=full.changed(lens=lens.without("index_file"))).scene()
    target, stage = project.target(blank), build_stages(project.settings)[-1]
    total = chosen.iterations or stage.iterations
    rows: list[tuple[int, int, float, float, float]] = []

    def late() -> bool:
        return time.monotonic() - began > limit

    say.say(
        f"index: {lens.index_control[0]} x {lens.index_control[1]} x {lens.index_layers} control values of"
        f" {lens.index_range[0]:.4g} to {lens.index_range[1]:.4g}, {stage.rays:,} rays"
    )
    with say.progress(total) as show:

        def on_iteration(k: int, loss: float, on_screen: float, _image: Any) -> None:
            rows.append((k, 0, loss, on_screen, time.monotonic() - began))
            show("index", f"loss {loss * target.size:.4f}  on screen {on_screen:.1%}", k, total)

        found = design_gradient_index(
            blank,
            target,
            lens.index_control,
            lens.index_layers,
            lens.index_range,
            cells=transport_cells(stage.rays, False),
            iterations=total,
            rays=stage.rays,
            seed=chosen.seed,
            on_iteration=on_iteration,
            stop=lambda: stop() or late(),
        )
    values = found.index.coefficients.numpy()
    lens = lens.changed(index_file=attachments.index_attached(values))
    project = replace(project, settings=full.changed(lens=lens))
    if project.path is not None:
        project.write()
    done = len(rows)
    reason = (
        "interrupted" if stop() else "time limit" if late() and done < total else "iterations" if done == total else "no progress"
    )
    flat = torch.full(lens.control, float(blank.lens.offset.thickness), dtype=torch.float64)
    seconds = rows[-1][-1] if rows else 0.0
    return IndexDesign(project, State(flat, iteration=done, total=done, history=rows, seconds=seconds, reason=reason))


def index_figures(project: Project) -> dict[str, float]:
    """Least and largest control value of a designed index."""
    values = attachments.index_of(project.settings.lens)
    return {"index_least": float(np.min(values)), "index_most": float(np.max(values))} if values is not None else {}


def limit_of(project: Project) -> float:
    """Time limit of the iterations, s: two thirds of that of the design; the rest is for its evaluation."""
    limit = project.settings.design.time_limit
    return limit if math.isinf(limit) else 2.0 * limit / 3.0
