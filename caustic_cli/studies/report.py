"""A study's result as a table (CSV), as data (JSON) and as a plot (PNG): `<study>.csv`, `.json`, `.png`."""

from __future__ import annotations

import csv
import io
import json
from dataclasses import asdict, dataclass
from pathlib import Path

from matplotlib.figure import Figure

from caustic_cli.errors import InputError
from caustic_cli.files import SOFTWARE, atomic_path, write_bytes
from caustic_cli.studies.fit import Order, pareto

#: Colours of Okabe and Ito, told apart by every kind of colour vision, and a marker of its own for each curve.
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#8C564B", "#4D4D4D")
MARKERS = "osD^vP<>"


@dataclass(frozen=True)
class Study:
    """What a study found.

    Args:
        name: of the study.
        columns: meaning and unit of every column, in the order of the table.
        rows: one setting each, column name -> value (None where it does not apply); every row has `series`, `error`
            and `seconds`.
        orders: fitted order in the number of rays of every series, None where it could not be fitted;
            `about["orders_of"]` names the column.
        advice: one sentence.
        about: how it was made: seed, repeats, device, the reference and its own error, ...
    """

    name: str
    columns: dict[str, str]
    rows: list[dict]
    orders: dict[str, Order | None]
    advice: str
    about: dict


def write(study: Study, directory: str | Path) -> list[Path]:
    """Write the three files into `directory`, made if missing; each is written whole.  Returns their paths.

    Raises:
        InputError: the directory cannot be made or written to.
    """
    directory = Path(directory)
    try:
        directory.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{directory}: cannot be made ({error.strerror}); a directory you may write to is needed") \
            from error
    paths = [directory / f"{study.name}.{kind}" for kind in ("csv", "json", "png")]
    write_bytes(paths[0], as_csv(study).encode())
    write_bytes(paths[1], as_json(study).encode())
    plot(study, paths[2])
    return paths


def as_csv(study: Study) -> str:
    """The rows under a line of column names; None is an empty field."""
    text = io.StringIO()
    table = csv.DictWriter(text, list(study.columns), lineterminator="\n")
    table.writeheader()
    table.writerows(study.rows)
    return text.getvalue()


def as_json(study: Study) -> str:
    """Everything, one object that begins with who made it; there is neither infinity nor NaN in it."""
    return json.dumps({"created_by": SOFTWARE} | asdict(study), indent=2, allow_nan=False) + "\n"


def plot(study: Study, path: str | Path) -> None:
    """Error against time on logarithmic axes, one curve a series, the Pareto front ringed and joined.

    An error of exactly 0 has no place on such an axis and is left out.
    """
    figure = Figure(figsize=(7.2, 5.2), dpi=150, layout="constrained")
    axes = figure.add_subplot(xscale="log", yscale="log")
    rows = [row for row in study.rows if row["error"] > 0]
    for k, series in enumerate(dict.fromkeys(row["series"] for row in rows)):
        mine = [row for row in rows if row["series"] == series]
        spread = [[row["seconds"] - row["seconds_min"] for row in mine],
                  [row["seconds_max"] - row["seconds"] for row in mine]]
        order, label = study.orders.get(series), series
        if order is not None:
            label += f", {study.about['orders_of']} of order {order.exponent:.2f}"
        axes.errorbar([row["seconds"] for row in mine], [row["error"] for row in mine], xerr=spread, linewidth=1,
                      elinewidth=0.6, markersize=5, color=COLOURS[k % len(COLOURS)], marker=MARKERS[k % len(MARKERS)],
                      label=label)
    best = pareto([row["seconds"] for row in rows], [row["error"] for row in rows])
    front = sorted((row["seconds"], row["error"]) for row, on in zip(rows, best, strict=True) if on)
    axes.plot([seconds for seconds, _ in front], [error for _, error in front], linestyle=":", color="black",
              marker="o", markersize=11, markerfacecolor="none", label="Pareto front")
    if study.about["reference_error"] > 0:
        axes.axhline(study.about["reference_error"], color="grey", linewidth=0.8, linestyle="--",
                     label="error of the reference")
    axes.set(xlabel="time (s): median, least and most", ylabel="error: relative RMS against the reference",
             title=f"{study.name}: error and time")
    axes.grid(which="major", linewidth=0.4)
    axes.legend(fontsize="small")
    with atomic_path(path) as temporary:
        figure.savefig(temporary, format="png", metadata={"Software": SOFTWARE})
