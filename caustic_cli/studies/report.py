"""Output of a study as a table (CSV), as data (JSON) and as plots (PNG): `<study>.csv`, `.json`, `.png`.

A study may define its own plots; the file name of each is that of the study and a suffix, "" or "-pareto".
"""

from __future__ import annotations

import csv
import io
import json
import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field, fields
from pathlib import Path

from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator, NullFormatter

from caustic_cli.errors import InputError
from caustic_cli.io.files import SOFTWARE, atomic_file, refuse_foreign, write_bytes
from caustic_cli.studies.fit import Order, pareto

#: Colours, the first of them of Okabe and Ito, distinguishable with all kinds of colour vision; and a marker for each curve.
COLOURS = (
    "#0072B2",
    "#D55E00",
    "#009E73",
    "#CC79A7",
    "#E69F00",
    "#56B4E9",
    "#8C564B",
    "#4D4D4D",
    "#6A3D9A",
    "#B3B300",
    "#E31A76",
    "#00CED1",
)
MARKERS = "osD^vP<>Xph*"

#: Most intervals between evenly spaced ticks on a short logarithmic axis.
EVEN = 4
#: Factor by which a figure is widened for a legend beside it.
BESIDE = 1.3

#: Relative reduction of the error for a slower setting to be on the Pareto front; relative difference of times that count as equal.
GAIN, ALIKE = 0.02, 0.1


@dataclass(frozen=True)
class Study:
    """Result of a study.

    Args:
        name: of the study.
        columns: meaning and unit of every column, in the order of the table.
        rows: one setting each, column name -> value (None where it does not apply); every row has `series`, `error`
            and `seconds`.
        orders: fitted order in `against` of every curve, None where it could not be fitted;
            `about["orders_of"]` names the column where the curves are the series.
        advice: one sentence.
        about: metadata: seed, repeats, device, the reference and its error, ...
        against: column that the orders are fitted in.
        plots: suffix of the file name -> function that draws the plot.
        table: for the terminal, the headings and a line for every row, of as many words each; empty for none.
    """

    name: str
    columns: dict[str, str]
    rows: list[dict]
    orders: dict[str, Order | None]
    advice: str
    about: dict
    against: str = "rays"
    plots: dict[str, Drawing] = field(default_factory=lambda: PLOTS)
    table: list[tuple[str, ...]] = field(default_factory=list)

    @property
    def lines(self) -> list[tuple[str, str]]:
        """The table as pairs of its first column and the others, in columns as wide as their longest word."""
        widths = [max(map(len, column)) for column in zip(*self.table, strict=True)]
        return [
            (line[0], "  ".join(word.ljust(width) for word, width in zip(line[1:], widths[1:], strict=True)).rstrip())
            for line in self.table
        ]


#: Draws a study on an empty figure.
Drawing = Callable[[Study, Figure], None]


def paths_of(name: str, directory: str | Path, plots: dict[str, Drawing] | None = None) -> list[Path]:
    """The files of a study: CSV, JSON and a PNG for each of its plots."""
    directory = Path(directory)
    endings = PLOTS if plots is None else plots
    return [directory / f"{name}.csv", directory / f"{name}.json", *(directory / f"{name}{end}.png" for end in endings)]


def refuse_foreign_files(paths: list[Path], force: bool = False) -> None:
    """Refuse before work begins if one of `paths_of` cannot be written or would replace a file not made by this program.

    A CSV cannot carry the mark of the program: it counts as its own if the JSON beside it does.

    Raises:
        InputError: naming the file.
    """
    table, *marked = paths
    for path in marked:
        refuse_foreign(path, force)
    refuse_foreign(table, force or marked[0].exists())


def write(study: Study, directory: str | Path) -> list[Path]:
    """Write the files into `directory`, made if missing; each is written whole.  Returns their paths.

    Raises:
        InputError: the directory cannot be made or written to.
    """
    directory = Path(directory)
    try:
        directory.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{directory}: cannot be made ({error.strerror}); a directory you may write to is needed") from error
    paths = paths_of(study.name, directory, study.plots)
    write_bytes(paths[1], as_json(study).encode())  # first, since it identifies the table as made by this program
    write_bytes(paths[0], as_csv(study).encode())
    for path, draw in zip(paths[2:], study.plots.values(), strict=True):
        plot(study, path, draw)
    return paths


def as_csv(study: Study) -> str:
    """The rows under a line of column names; None is an empty field."""
    text = io.StringIO()
    table = csv.DictWriter(text, list(study.columns), lineterminator="\n")
    table.writeheader()
    table.writerows(study.rows)
    return text.getvalue()


def as_json(study: Study) -> str:
    """The whole study as one JSON object that begins with the program's mark, without infinity or NaN."""
    data = {f.name: getattr(study, f.name) for f in fields(study) if f.name != "plots"}
    data["orders"] = {name: None if found is None else vars(found) for name, found in study.orders.items()}
    return json.dumps({"created_by": SOFTWARE} | data, indent=2, allow_nan=False) + "\n"


def plot(study: Study, path: str | Path, draw: Drawing | None = None) -> None:
    """Write one plot of a study, by default error against time."""
    figure = Figure(figsize=(7.2, 5.2), dpi=150, layout="constrained")
    (draw or draw_error_and_time)(study, figure)
    with atomic_file(path) as file:
        figure.savefig(file, format="png", metadata={"Software": SOFTWARE})


def draw_error_and_time(study: Study, figure: Figure) -> None:
    """Error against time, one curve per series, and the Pareto front."""
    axes = figure.add_subplot()
    draw_front(axes, study)
    if study.about["reference_error"] > 0:
        axes.axhline(study.about["reference_error"], color="grey", linewidth=0.8, linestyle="--", label="error of the reference")
    axes.set(
        xlabel="time (s): median, least and most",
        ylabel="error: relative RMS against the reference",
        title=f"{study.name}: error and time",
    )
    legend_beside(figure)


def legend_beside(figure: Figure) -> None:
    """Place the legend to the right of the axes."""
    figure.set_size_inches(BESIDE * figure.get_figwidth(), figure.get_figheight())
    figure.legend(loc="outside right upper", fontsize="small")


def draw_front(axes: Axes, study: Study) -> None:
    """The curves of error against time on logarithmic axes, with bars where a row knows its spread, and the Pareto front.

    Errors and times of exactly 0 are left out.
    """
    axes.set(xscale="log", yscale="log")
    rows = [row for row in study.rows if row["error"] > 0 and row["seconds"] > 0]
    for series, style in styles(row["series"] for row in study.rows).items():
        mine = [row for row in rows if row["series"] == series]
        if not mine:
            continue
        order, label = study.orders.get(series), series
        if order is not None:
            label += f", {study.about['orders_of']} of order {order.exponent:.2f}"
        axes.errorbar([row["seconds"] for row in mine], [row["error"] for row in mine], xerr=spread(mine), label=label, **style)
    best = pareto([row["seconds"] for row in rows], [row["error"] for row in rows], GAIN, ALIKE)
    front = sorted((row["seconds"], row["error"]) for row, on in zip(rows, best, strict=True) if on)
    axes.plot(
        [seconds for seconds, _ in front],
        [error for _, error in front],
        linestyle=":",
        color="black",
        marker="o",
        markersize=11,
        markerfacecolor="none",
        label="Pareto front",
    )
    axes.grid(which="major", linewidth=0.4)
    plain_ticks(axes.xaxis)


def plain_ticks(axis: Axis) -> None:
    """Decimal tick labels at 1, 2 and 5 on a logarithmic axis of less than three decades, evenly spaced ones on an axis between
    two of those; to be called after plotting."""
    low, high = axis.get_view_interval()
    subs = (1.0, 2.0, 5.0) if high < 1000.0 * low else (1.0,)
    decades = range(math.floor(math.log10(low)), math.ceil(math.log10(high)) + 1) if 0 < low < high else range(0)
    shown = sum(low <= sub * 10.0**decade <= high for decade in decades for sub in subs)
    axis.set_major_locator(LogLocator(subs=subs) if shown > 1 else MaxNLocator(EVEN))
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axis.set_minor_formatter(NullFormatter())


def styles(series: Iterable[str]) -> dict[str, dict]:
    """Line style of each series, as options of `Axes.errorbar`."""
    return {
        name: {
            "linewidth": 1,
            "elinewidth": 0.6,
            "markersize": 5,
            "color": COLOURS[k % len(COLOURS)],
            "marker": MARKERS[k % len(MARKERS)],
        }
        for k, name in enumerate(dict.fromkeys(series))
    }


def spread(rows: list[dict]) -> list[list[float]] | None:
    """Distances of the shortest and longest time of every row from the median, s, for error bars; None without such columns."""
    if not rows or "seconds_min" not in rows[0]:
        return None
    return [[row["seconds"] - row["seconds_min"] for row in rows], [row["seconds_max"] - row["seconds"] for row in rows]]


#: Plot of a study that defines none.
PLOTS: dict[str, Drawing] = {"": draw_error_and_time}
