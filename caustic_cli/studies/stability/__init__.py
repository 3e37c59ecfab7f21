"""The study of numerically difficult cases: what a naive formula gives, the error of this program, and its bound.

The truth of every case is a closed form, evaluated without cancellation or in 60 digits.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable

from matplotlib.figure import Figure

from caustic_cli.optics import ranks
from caustic_cli.studies.report import COLOURS, Drawing, Study
from caustic_cli.studies.stability import elements, images, light, refraction, splines, surfaces, systems, waves
from caustic_cli.studies.stability.case import Case

#: Every case, in the order of the table.
CASES: tuple[Case, ...] = tuple(
    case for home in (light, refraction, surfaces, images, splines, elements, systems, waves) for case in home.CASES
)
#: Errors below this are drawn at it.
LEAST = 1e-17
#: Columns of the table.
COLUMNS = {
    "series": "case",
    "error_of": "what the errors are those of, and their unit",
    "naively": "what the naive formula does",
    "naive": "its error, empty where it is not finite",
    "naive_words": "the same in words",
    "error": "error of this program",
    "bound": "largest error that counts as right",
    "holds": "whether the error is within the bound",
    "seconds": "time of the case, s",
}

#: Those of the table on the terminal.
HEADINGS = ("case", "naively", "here", "bound", "seconds", "error of: what goes wrong naively")


def words(value: float) -> str:
    """An error for people."""
    return "NaN" if math.isnan(value) else "infinite" if math.isinf(value) else "0" if value == 0 else f"{value:.1e}"


def run_stability(progress: Callable[[int, int], None]) -> Study:
    """Measure every case, the worst of its settings."""
    rows = ranks.mapped(_measured, range(len(CASES)), lambda done: progress(done, len(CASES)))
    broken = [row["series"] for row in rows if not row["holds"]]
    advice = f"beyond their bounds: {', '.join(broken)}" if broken else f"all {len(rows)} cases are within their bounds"
    return Study("stability", COLUMNS, rows, {}, advice, {}, plots=PLOTS, table=[HEADINGS, *map(in_words, rows)])


def _measured(number: int) -> dict:
    """The row of a case."""
    case, began = CASES[number], time.perf_counter()
    naive, ours = case.worst()
    return {
        "series": case.family,
        "error_of": case.error_of,
        "naively": case.naively,
        "naive": naive if math.isfinite(naive) else None,
        "naive_words": words(naive),
        "error": ours if math.isfinite(ours) else None,
        "bound": case.bound,
        "holds": bool(ours <= case.bound),
        "seconds": time.perf_counter() - began,
    }


def in_words(row: dict) -> tuple[str, ...]:
    """The row as it is printed."""
    ours = words(math.nan if row["error"] is None else row["error"])
    return (
        row["series"],
        row["naive_words"],
        ours,
        words(row["bound"]),
        f"{row['seconds']:.2f}",
        f"{row['error_of']}: {row['naively']}",
    )


def draw(study: Study, figure: Figure) -> None:
    """A line for every case from the naive error to that of this program, and its bound."""
    figure.set_size_inches(10.0, 1.5 + 0.5 * len(study.rows))
    axes = figure.add_subplot()
    finite = [row[name] for row in study.rows for name in ("naive", "error", "bound") if row[name] is not None]
    edge = 100.0 * max(finite)
    for k, row in enumerate(study.rows):
        ends = [edge if row[name] is None else max(row[name], LEAST) for name in ("error", "naive")]
        axes.plot(ends, [k, k], color="grey", linewidth=1, zorder=1)
        for end, colour, name in zip(ends, COLOURS, ("this program", "naive formula"), strict=False):
            axes.scatter(end, k, color=colour, label=name if k == 0 else None)
        axes.scatter(row["bound"], k, color="black", marker="|", s=150, label="bound" if k == 0 else None)
        if row["naive"] is None:
            axes.annotate(row["naive_words"], (edge, k), xytext=(6, -3), textcoords="offset points")
    axes.set(xscale="log", xlabel="error", title="Numerically difficult cases", xlim=(0.3 * LEAST, 1e3 * edge))
    axes.set_yticks(range(len(study.rows)), [f"{row['series']}\n{row['error_of']}" for row in study.rows], fontsize="small")
    axes.invert_yaxis()
    figure.legend(loc="outside lower center", ncols=3)


PLOTS: dict[str, Drawing] = {"": draw}
