"""One page of figures, in the order and layout of the thesis' chapter 6, from what `run.py` noted."""

from __future__ import annotations

from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import numpy as np
from matplotlib import pyplot as plt
from PIL import Image

from caustic_cli.studies.report import COLOURS, plain_ticks


def picture(path: Path) -> np.ndarray:
    """A picture's grey values, [i, j] with i along +x and j along +y."""
    return np.asarray(Image.open(path).convert("L"), dtype=float).T[:, ::-1]


def show(axis, image: np.ndarray, title: str, cmap: str = "gray", limit: float | None = None, low: float = 0.0):
    """An image seen from +z, without ticks."""
    low = None if limit is None else low
    drawn = axis.imshow(image.T, origin="lower", cmap=cmap, vmin=low, vmax=limit, interpolation="nearest")
    axis.set(xticks=[], yticks=[])
    axis.set_title(title, fontsize=8)
    return drawn


def bright(image: np.ndarray) -> np.ndarray:
    """In units of its own 99th percentile of what is lit."""
    lit = image[image > 0.05 * image.max()]
    return image / (np.percentile(lit, 99) if lit.size else 1.0)


def figures_of(row: dict) -> str:
    return f"{row['relative_rms']:.2f} | {row['on_screen']:.0%} | {row['seconds']:.0f} s"


def losses(axis, book, names: dict[str, str], title: str, pixels: float) -> None:
    """Relative RMS of every iteration: the optimiser's own render, eq. 5.2.1 times the pixels."""
    for k, (name, label) in enumerate(names.items()):
        history = book.arrays(name)["history"]
        own, colour = name.startswith("own-"), COLOURS[k % len(COLOURS)]
        axis.semilogy(history[:, 0], history[:, 2] * pixels, lw=1.2, ls="--" if own else "-", color=colour, label=label)
    axis.set_title(title, fontsize=8)
    axis.set_xlabel("iteration", fontsize=7)
    plain_ticks(axis.yaxis)
    axis.tick_params(labelsize=6)
    axis.grid(alpha=0.3, which="both")
    axis.legend(fontsize=6.5, loc="upper center", bbox_to_anchor=(0.5, -0.16), ncols=2, frameon=False)


def draw(path: Path, book, rows: list[dict], pairs, mags, marks, pictures: Path) -> None:
    """Write the page."""
    figure = plt.figure(figsize=(13.0, 27.0), layout="constrained")
    parts = figure.subfigures(6, 1, height_ratios=[2.6, 8.4, 9.2, 3.0, 3.2, 4.6])
    headings = (
        "6.1  Derivative of a render with respect to one control height (figure 6.1.1)",
        "6.2.1  Circular top hat from a plane wave (figures 6.2.2 to 6.2.7)"
        "\n(above a render: relative RMS | light on the screen | time)",
        "6.2.2  Flame and faceted ball from a plane wave (figures 6.2.8 to 6.2.11)"
        "\n(relief: heights without their best paraboloid)",
        "6.3  B-spline intersection (figure 6.2.14)",
        "6.4  A point source, then a grid of them (figures 6.4.2 to 6.4.4)",
        "Loss, light, time",
    )
    for part, heading in zip(parts, headings, strict=True):
        part.suptitle(heading, fontsize=10, x=0.01, ha="left", weight="bold")
    _gradients(parts[0], book)
    _tophat(parts[1], book, pairs, marks, pictures)
    _pictures(parts[2], book, mags, pictures)
    _intersection(parts[3], book)
    _point(parts[4], book, pictures)
    _table(parts[5], rows)
    figure.savefig(path, dpi=130, metadata={"Software": "caustic"})
    plt.close(figure)


def lit_part(gradient: np.ndarray) -> np.ndarray:
    """What is not zero of it, with some pixels beside: the thesis' figures show no more."""
    i, j = (np.flatnonzero((gradient != 0).any(1 - axis)) for axis in (0, 1))
    return gradient[max(0, i[0] - 2) : i[-1] + 3, max(0, j[0] - 2) : j[-1] + 3]


def _gradients(part, book) -> None:
    axes = part.subplots(1, 3)
    about = {"a": "degrees (3, 3), filter (3, 3)", "b": "degrees (3, 3), filter (11, 11)", "c": "degrees (5, 3), filter (3, 3)"}
    for axis, (case, text) in zip(axes, about.items(), strict=True):
        g = lit_part(book.arrays(f"gradient-{case}")["gradient"])
        limit, total = np.abs(g).max(), book.rows[f"gradient-{case}"]["sum"]
        drawn = show(axis, np.ma.masked_equal(g, 0.0), f"({case}) {text}: sum {total:.1e}", "coolwarm", limit, -limit)
        part.colorbar(drawn, ax=axis).ax.tick_params(labelsize=6)


def _tophat(part, book, pairs, marks, pictures) -> None:
    left, right = part.subfigures(1, 2, width_ratios=[1.0, 2.3])
    names = {f"tophat-{p}": p.replace("-", " network, ") if p != "none" else "no network, zero" for p in pairs}
    top, bottom = left.subplots(2, 1)
    losses(top, book, names | {"own-tophat": "our defaults (their own loss)"}, "relative RMS over the iterations", 250.0**2)
    target = picture(pictures / "tophat.png")
    show(bottom, bright(target), "target", limit=1.0)
    grid = right.subplots(len(pairs) + 1, len(marks) + 2)
    for row, pair in zip(grid, pairs, strict=False):
        found, about = book.arrays(f"tophat-{pair}"), book.rows[f"tophat-{pair}"]
        for axis, mark in zip(row, marks, strict=False):
            title = names[f"tophat-{pair}"].replace("sparse network", "sparse").replace("dense network", "dense")
            show(axis, found[f"heights_{mark}"], f"{title}\nheights, n = {mark}", "viridis")
        _image_and_error(row[-2:], found["image"], target, about)
    found, row = book.arrays("own-tophat"), grid[-1]
    for axis in row[: len(marks) - 1]:
        axis.axis("off")
    show(row[len(marks) - 1], found["heights"], "our defaults\nheights", "viridis")
    _image_and_error(row[-2:], found["image"], target, book.rows["own-tophat"])


def _image_and_error(axes, image, target, about) -> None:
    show(axes[0], bright(image), figures_of(about), limit=1.0)
    from_, to = (np.linspace(0, n, m + 1) for n, m in zip(target.shape, image.shape, strict=True))
    index = [np.clip((0.5 * (e[1:] + e[:-1])).astype(int), 0, n - 1) for e, n in zip((from_, to), target.shape, strict=True)]
    aim = target[np.ix_(*index)]
    error = image / max(image.sum(), 1e-300) - aim / aim.sum()
    show(axes[1], error * error.size, "error", "coolwarm", 2.0, -2.0)


def _pictures(part, book, mags, pictures) -> None:
    left, right = part.subfigures(1, 2, width_ratios=[1.0, 2.3])
    axes = left.subplots(3, 1)
    losses(
        axes[0],
        book,
        {f"{p}-mag{m}": f"{p}, magnification {m}" for p in ("flame", "ball") for m in mags},
        "the thesis' loop: relative RMS over the iterations",
        250.0**2,
    )
    for axis, name in zip(axes[1:], ("flame", "ball"), strict=True):
        show(axis, bright(picture(pictures / f"{name}.png")), f"{name}: target", limit=1.0)
    grid = right.subplots(4, 2 * len(mags))
    for k, name in enumerate(("flame", "ball")):
        for m, mag in enumerate(mags):
            for half, (kind, label) in enumerate((("", "thesis"), ("own-", "our defaults"))):
                key = f"{kind}{name}-mag{mag}"
                found = book.arrays(key)
                column = 2 * m + half
                show(grid[2 * k, column], bright(found["image"]), f"{label}, mag {mag}\n{figures_of(book.rows[key])}", limit=1.0)
                show(grid[2 * k + 1, column], _relief(found["heights"]), "relief", "viridis")


def _relief(heights: np.ndarray) -> np.ndarray:
    """Less its best fit by 1, x, y, x^2 + y^2, on an even net."""
    x, y = np.meshgrid(*(np.linspace(-1.0, 1.0, n) for n in heights.shape), indexing="ij")
    terms = np.stack([np.ones_like(x), x, y, x * x + y * y], -1).reshape(-1, 4)
    return heights - (terms @ np.linalg.lstsq(terms, heights.ravel(), rcond=None)[0]).reshape(heights.shape)


def _intersection(part, book) -> None:
    axes = part.subplots(1, 2)
    rows = book.rows["intersection"]["rows"]
    mesh = [r for r in rows if r["series"] == "mesh"]
    newton = [r for r in rows if r["series"].startswith("newton")]
    n = [r["n_u"] for r in mesh]
    for key, label, line, colour in (("z_mean", "mean z-error", "o-", COLOURS[0]), ("error", "mean t-error", "s--", COLOURS[1])):
        axes[0].loglog(n, [r[key] for r in mesh], line, ms=4, label=label, color=colour)
    axes[1].loglog(n, [r["seconds"] for r in mesh], "o-", ms=3, label="mesh")
    for r in newton[:1]:
        axes[0].axhline(max(r["error"], 1e-17), color="grey", ls="--", label="Newton's method, t-error")
        axes[1].axhline(r["seconds"], color="grey", ls="--", label="Newton's method")
    plain_ticks(axes[1].yaxis)
    for axis, text in zip(axes, ("error (mm)", "time (s)"), strict=True):
        axis.set_xlabel("knot span subdivisions $n_u = n_v$", fontsize=7)
        axis.set_ylabel(text, fontsize=7)
        axis.tick_params(labelsize=6)
        axis.grid(alpha=0.3, which="both")
        axis.legend(fontsize=6)


def _point(part, book, pictures) -> None:
    axes = part.subplots(1, 6)
    show(axes[0], bright(picture(pictures / "flame.png")), "target (32 mm of 40)", limit=1.0)
    for axis, key, label in zip(
        axes[1:4],
        ("point-grid", "own-point", "own-point-grid"),
        ("thesis: point, then grid", "our defaults: point", "our defaults: grid"),
        strict=True,
    ):
        show(axis, bright(book.arrays(key)["image"]), f"{label}\n{figures_of(book.rows[key])}", limit=1.0)
    show(axes[4], _relief(book.arrays("point-grid")["heights"]), "thesis: relief", "viridis")
    losses(axes[5], book, {"point-grid": "thesis", "own-point-grid": "our defaults"}, "relative RMS", 100.0**2)


def _table(part, rows) -> None:
    axis = part.subplots()
    axis.axis("off")
    head = ["experiment", "by", "loss (5.2.1)", "relative RMS", "on the screen", "lost to Fresnel", "iterations", "time (s)"]
    cells = [
        [
            r["experiment"],
            r["by"],
            f"{r['loss']:.2e}",
            f"{r['relative_rms']:.3f}",
            f"{r['on_screen']:.1%}",
            f"{r['fresnel']:.1%}",
            str(r["iterations"]),
            f"{r['seconds']:.0f}",
        ]
        for r in rows
    ]
    found = axis.table(cells, colLabels=head, loc="upper left", cellLoc="left")
    found.auto_set_font_size(False)
    found.set_fontsize(7)
