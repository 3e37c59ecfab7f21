"""report.png of a design: target, caustic, error, lens height and relief, loss against time, and energy balance."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from pathlib import Path
from textwrap import fill
from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import FuncNorm, Normalize
from matplotlib.figure import Figure
from matplotlib.image import AxesImage
from matplotlib.ticker import FuncFormatter, MaxNLocator
from mpl_toolkits.mplot3d import Axes3D

from caustic_cli.io.files import atomic_file
from caustic_cli.io.picture import SOFTWARE, codes_of, to_linear, to_srgb
from caustic_cli.scene import Lens, Screen
from caustic_cli.studies.irradiance import in_units
from caustic_cli.studies.judge import JUDGES, Judge, judge_of
from caustic_cli.studies.radius import cost_of_radius, known_radius
from caustic_cli.studies.report import COLOURS, plain_ticks

#: Upper end of an irradiance scale below which ticks cannot be placed, as for a black image.
DARK = 1e-250
#: Quantile of the absolute errors at which the error scale ends.
NEARLY = 0.995
#: Most points along an axis of the relief; fraction of the light below which a loss is not listed.
RELIEF, LITTLE = 130, 5e-5
#: Width of a colour bar and its distance from the right or, below the labels of the x axis, from the lower edge of its panel, inch.
BAR, BESIDE, BELOW = 0.16, 0.1, 0.56
#: Ratio of width and height from which the colour bar of a panel lies below it.
WIDE = 1.3
#: Largest number of ticks; width of a character of a label, its height, and the space between two labels, inch.
MOST_TICKS, CHARACTER, HEIGHT, GAP = 9, 0.085, 0.14, 0.12
#: Ticks of a scale of encoded irradiance.
TICKS = 6
#: Distance of a title from its panel, points: clear of the tick label at the upper end of the y axis.
PAD = 9
#: Characters of a line of a title.
LINE = 50
#: Positions of the panels.  An automatic layout took as long as drawing.
PLACES = {"left": 0.035, "right": 0.95, "bottom": 0.065, "top": 0.925, "wspace": 0.62, "hspace": 0.42}
#: Height of a panel of losses relative to that of the error, if that is another panel, and the space between panels relative to
#: their mean height.
LESS, BETWEEN = 0.5, 0.6


#: The value shown as white -> linear R, G, B (3, n_x, n_y) of an image, see `studies.viewing.in_colour`.
Colours = Callable[[float], np.ndarray]


class Shown(NamedTuple):
    """An image of the report: absolute irradiance, (n_x, n_y); title; prefix of its figures, None for the target; and, for one in
    colour, linear R, G, B (3, n_x, n_y) from 0 to 1 by the irradiance shown as white."""

    picture: np.ndarray
    title: str
    prefix: str | None
    colours: Colours | None = None


def write_report(
    path: Path,
    target: np.ndarray,
    image: np.ndarray,
    heights: np.ndarray,
    history: np.ndarray,
    lens: Lens,
    screen: Screen,
    figures: dict,
    encoding: str,
    waves: np.ndarray | None = None,
    stages: Sequence[tuple[float, bool]] = (),
    costs: Sequence[tuple[float, float]] = (),
    price: str = "",
    colours: Sequence[Colours | None] = (None, None),
) -> None:
    """Write the panels.

    Args:
        target, image: (n_x, n_y) irradiance; images are drawn in the encoding of the picture over their whole range, the target and
            the image that the lens is judged by at the same exposure, with colour bars of absolute irradiance.
        heights: (a, b) surface heights on a regular grid over the aperture, mm; the best-fit paraboloid is subtracted, because it
            hides the relief; for a gradient index the index is drawn instead.
        history: (k, 5) rows iteration, stage, loss, on_screen, seconds.
        waves: (n_x, n_y), the wave image, or None; if given, the error is that of the wave image.
        stages: of each, the blur in its loss, pixels, and whether it uses the wave image.
        costs: (seconds, error by independent light) during the design, of the image that the lens is judged by.
        price: what a smaller error would cost, in words.
        colours: of the image by rays and by waves, where they are shown in colour.
    """
    figure = Figure(figsize=(22.0, 9.8))
    axes = figure.subplots(2, 4, gridspec_kw=PLACES)
    extent = [-screen.half_size[0], screen.half_size[0], -screen.half_size[1], screen.half_size[1]]
    judged = image if waves is None else waves
    _draw_images(axes[0], target, _judged(judged, waves is not None, figures, colours), figures, extent, screen.unit, encoding)
    _draw_error(axes[0, 2], target, judged, extent, screen.unit)
    _draw_section(axes[0, 3], target, judged, screen)
    rx, ry = lens.half_size
    volume = None if lens.gradient is None else lens.gradient.volume
    relief, unit, name = (
        (_without_paraboloid(heights, rx, ry) * 1e3, "µm", "lens height, best paraboloid removed")
        if volume is None
        else (volume.mean(-1), "index", "index, mean along z")
    )
    drawn = _draw_image(axes[1, 0], relief, [-rx, rx, -ry, ry], name, "mm", "lens", cmap="viridis")
    _bar(drawn, axes[1, 0], unit)
    place = axes[1, 1].get_subplotspec()
    axes[1, 1].remove()
    solid = figure.add_subplot(place, projection="3d")
    _draw_losses(axes[1, 2], history, target.size, figures, stages, costs, price)
    _draw_energy_balance(axes[1, 3], figures)
    _draw_relief(solid, relief, (rx, ry), unit)
    with atomic_file(path) as file:
        figure.savefig(file, format="png", dpi=100, metadata={"Software": SOFTWARE})


def _judged(picture: np.ndarray, by_waves: bool, figures: dict, colours: Sequence[Colours | None]) -> Shown:
    """The image that judges the lens.  That of a lens refined on its wave image by rays is none that light will show."""
    prefix, own = JUDGES[by_waves].prefix, colours[by_waves]
    error, scale = figures[f"{prefix}relative_rms"], figures[f"{prefix}peak_irradiance"] / (picture.max() or 1.0)
    title = "wave image" if by_waves else "caustic"
    words = title if error is None else f"{title}\nrelative RMS error {error:.3f}"
    if figures.get(f"{prefix}ciede2000") is not None:
        words += f", CIEDE2000 {figures[f'{prefix}ciede2000']:.1f}"
    if "least_relative_rms" in figures and not by_waves:
        words += f", at least {figures['least_relative_rms']:.3f}"
    if own is None or not scale > 0:
        return Shown(picture * scale, words, prefix)
    return Shown(picture * scale, words, prefix, lambda white: own(white / scale) / (white / scale))


def _draw_images(
    axes: Sequence[Axes],
    target: np.ndarray,
    shown: Shown,
    figures: dict,
    extent: Sequence[float],
    length: str,
    encoding: str,
) -> None:
    """The target and the image that judges the lens at the same exposure."""
    goal = target * (shown.picture.sum() / target.sum())
    white = max(float(goal.max()), float(shown.picture.max()))  # of both
    top = white if white > DARK else 1.0
    for axis, (picture, title, prefix, colours) in zip(axes, (Shown(goal, "target", None), shown), strict=False):
        norm = (
            FuncNorm((lambda e, w=top: to_srgb(e / w), lambda v, w=top: w * to_linear(v)), 0.0, top, clip=True)
            if encoding == "srgb"
            else Normalize(0.0, top, clip=True)
        )
        drawn = _draw_image(axis, picture, extent, title, length, cmap="gray", norm=norm)
        if colours is not None:
            axis.imshow(codes_of(colours(top), 1.0, encoding), extent=tuple(extent))
        if prefix is not None:
            _bar(drawn, axis, _irradiance_words(figures, prefix))


def _draw_error(axis: Axes, target: np.ndarray, image: np.ndarray, extent: Sequence[float], length: str) -> None:
    """The difference of image and target, each over its own mean."""
    error = (image / max(image.sum(), 1e-300) - target / target.sum()) * target.size
    most = _scale_of(error, (image > 0) | (target > 0))
    title = "error: too dark (blue), too bright (red)"
    drawn = _draw_image(axis, error, extent, title, length, cmap="coolwarm", vmin=-most, vmax=most)
    _bar(drawn, axis, "of the mean irradiance", extend="both")


def _draw_image(
    axis: Axes, picture: np.ndarray, extent: Sequence[float], title: str, length: str, place: str = "screen", **style
) -> AxesImage:
    """An image with its axes in a unit of length, or mrad, with as many ticks as fit."""
    drawn = axis.imshow(picture.T, origin="lower", extent=tuple(extent), **style)
    axis.set(xlabel=f"x on the {place} ({length})", ylabel=f"y ({length})")
    axis.set_title(title, pad=PAD)
    width, height = _size(axis)
    axis.xaxis.set_major_locator(_ticks(extent[0], extent[1], width, True))
    axis.yaxis.set_major_locator(_ticks(extent[2], extent[3], height, False))
    return drawn


def _ticks(low: float, high: float, length: float, across: bool) -> MaxNLocator:
    """As many ticks as have room for their labels, side by side (`across`) or one above the other, on an axis of this length,
    inch."""
    for most in range(MOST_TICKS, 0, -1):
        found = MaxNLocator(most, steps=[1, 2, 2.5, 5, 10], min_n_ticks=1)
        values = found.tick_values(low, high)
        label = max(len(f"{value:.6g}") for value in values) * CHARACTER if across else HEIGHT
        if len(values) < 2 or (values[1] - values[0]) * length >= (label + GAP) * (high - low):
            break
    return found


def _size(axis: Axes) -> tuple[float, float]:
    """Width and height, inch, of an image with square pixels in its panel."""
    place, (width, height) = axis.get_position(), axis.get_figure().get_size_inches()
    (left, right), (bottom, top) = axis.get_xlim(), axis.get_ylim()
    inch = min(place.width * width / (right - left), place.height * height / (top - bottom))
    return inch * (right - left), inch * (top - bottom)


def _bar(drawn: AxesImage, axis: Axes, label: str, extend: str = "neither") -> None:
    """Add a colour bar along the longer side of an image."""
    width, height = _size(axis)
    wide = width > WIDE * height
    place = (0.0, -(BELOW + BAR) / height, 1.0, BAR / height) if wide else (1.0 + BESIDE / width, 0.0, BAR / width, 1.0)
    bar = axis.get_figure().colorbar(
        drawn,
        cax=axis.inset_axes(place),
        orientation="horizontal" if wide else "vertical",
        label=label.replace("\n", ", ") if wide else label,
        extend=extend,
        ticks=_even_ticks(drawn.norm)
        if isinstance(drawn.norm, FuncNorm)
        else _ticks(*drawn.get_clim(), width if wide else height, wide),
        format=FuncFormatter(lambda value, _: f"{value:.6g}".replace("-", "\N{MINUS SIGN}")),
    )
    bar.minorticks_off()


def _even_ticks(norm: FuncNorm) -> list[float]:
    """Values of two digits at nearly even distances on a scale from 0."""
    return [float(f"{value:.1e}") for value in norm.inverse(np.linspace(0.0, 0.97, TICKS))]


def _scale_of(error: np.ndarray, seen: np.ndarray) -> float:
    """End of the error scale: a quantile over the pixels that are `seen`, not dark in both images."""
    sizes = np.abs(error[seen]) if seen.any() else np.abs(error)
    return float(np.quantile(sizes, NEARLY)) or 1.0


def _draw_section(axis: Axes, target: np.ndarray, image: np.ndarray, screen: Screen) -> None:
    """Sections of both along x through the brightest row of the target, over their means."""
    row = int(target.sum(0).argmax())
    n, half = target.shape[0], screen.half_size
    x = ((np.arange(n) + 0.5) * (2.0 / n) - 1.0) * half[0]
    y = ((row + 0.5) * (2.0 / target.shape[1]) - 1.0) * half[1]
    axis.step(x, image[:, row] / max(image.mean(), 1e-300), where="mid", color=COLOURS[1], lw=1.0, label="caustic")
    axis.step(x, target[:, row] / target.mean(), where="mid", color="black", lw=1.2, label="target")
    axis.set(xlabel=f"x on the screen ({screen.unit})", ylabel="of the mean irradiance")
    axis.set_title(f"along y = {y:.3g} {screen.unit}", pad=PAD)
    axis.set_ylim(0.0, 1.25 * axis.get_ylim()[1])  # room for the legend above all data
    axis.legend(loc="upper right", ncols=2, frameon=False)


def _draw_relief(axis: Axes3D, relief: np.ndarray, half: tuple[float, float], unit: str) -> None:
    """The relief in three dimensions, lit from the side."""
    every = max(1, max(relief.shape) // RELIEF)
    z = relief[::every, ::every]
    x, y = (np.linspace(-h, h, n) for h, n in zip(half, z.shape, strict=True))
    axis.plot_surface(*np.meshgrid(x, y, indexing="ij"), z, cmap="viridis", rcount=len(x), ccount=len(y), lw=0, antialiased=False)
    across, along = (h / max(half) for h in half)
    axis.set_box_aspect((across, along, 0.35), zoom=1.15 * min(across, along) ** 0.1)
    axis.set(zlabel=unit, title="the same in relief")
    axis.set_xlabel("x (mm)", labelpad=9 * across)  # a long axis is seen end on: its label must clear those of its ticks
    axis.set_ylabel("y (mm)", labelpad=34 - 25 * across)
    for direction, length in ((axis.xaxis, across), (axis.yaxis, along), (axis.zaxis, 0.5)):
        direction.set_major_locator(MaxNLocator(max(1, round(6 * length)), min_n_ticks=1))
    axis.view_init(elev=38, azim=-65)


def _draw_losses(
    axis: Axes,
    history: np.ndarray,
    pixels: int,
    figures: dict,
    stages: Sequence[tuple[float, bool]],
    costs: Sequence[tuple[float, float]],
    price: str,
) -> None:
    """Loss of each stage against time, the independent errors by the image that the lens is judged by, and what less would cost.

    Losses by rays and by waves, and with a blur and without, have panels of their own: they cannot be compared with each other.
    """
    found = [int(k) for k in np.unique(history[:, 1])]
    stage = {k: stages[k] if k < len(stages) else (0.0, False) for k in found}
    how = {k: (blur, JUDGES[waves]) for k, (blur, waves) in stage.items()}
    judging = judge_of(figures)
    kinds = list(dict.fromkeys((judge, blur > 0) for blur, judge in how.values()))  # in the order of the stages
    if (judging, False) not in kinds:
        kinds.append((judging, False))
    grid = axis.get_subplotspec().subgridspec(
        len(kinds), 1, height_ratios=[1.0 if kind == (judging, False) else LESS for kind in kinds], hspace=BETWEEN
    )
    axis.set_subplotspec(grid[0])
    panels = {kinds[0]: axis}
    panels |= {kind: axis.get_figure().add_subplot(grid[k], sharex=axis) for k, kind in enumerate(kinds) if k > 0}
    begin = costs[0][0] if costs else 0.0  # of the iterations
    last = begin + history[-1, 4] if len(history) else begin
    history = history + np.array([0.0, 0.0, 0.0, 0.0, begin])
    for k, (blur, judge) in how.items():
        _draw_stage(panels[judge, blur > 0], k, blur, history[history[:, 1] == k], pixels, last)
    _draw_errors(panels[judging, False], figures, judging.prefix, costs, begin, last)
    for kind, own in panels.items():
        own.set_title(_loss_words(*kind, points=own is panels[judging, False]), fontsize="medium")
        own.margins(x=0.08, y=0.12 if own is panels[judging, False] else 0.8)  # room for the names of the stages
        own.set_ylabel("relative RMS")
        own.grid(alpha=0.3, which="both")
        plain_ticks(own.yaxis)
        own.tick_params(labelbottom=own is panels[kinds[-1]])
    panels[kinds[-1]].set_xlabel("\n".join(["s from the beginning of the design", *filter(None, [price])]))


def _draw_stage(axis: Axes, k: int, blur: float, rows: np.ndarray, pixels: int, last: float) -> None:
    """The losses of stage k, `rows` of the history, which ends after `last` seconds."""
    colour = COLOURS[k % len(COLOURS)]
    axis.semilogy(rows[:, 4], rows[:, 2] * pixels, color=colour, marker="." if len(rows) == 1 else None, lw=1.6)
    at, up = (rows[0], 4) if blur == 0 or k % 2 == 0 else (rows[-1], -11)  # above one line and below the next: many are short
    late = at[4] > 0.7 * last
    axis.annotate(
        f"{blur:.2g} px" if blur > 0 else f"stage {k + 1}",
        (at[4], at[2] * pixels),
        xytext=(-3 if late else 3, up),
        textcoords="offset points",
        ha="right" if late else "left",
        color=colour,
        fontsize="small",
    )


def _draw_errors(axis: Axes, figures: dict, prefix: str, costs: Sequence[tuple[float, float]], begin: float, last: float) -> None:
    """The independent errors as points: of the initial lens after `begin` seconds, during the design, and of the final lens after
    `last`; prefix: of the figures of the image."""
    between = [row for row in costs if begin < row[0] < last]
    least = min((float(line.get_ydata()[-1]) for line in axis.get_lines()), default=0.0)
    if between:
        axis.semilogy(*zip(*between, strict=True), "o", color="black", ms=4)
    for key, at, words in ((f"start_{prefix}relative_rms", begin, "start"), (f"{prefix}relative_rms", last, "finished")):
        if figures.get(key):
            axis.semilogy([at], [figures[key]], "o", color="black", ms=5, mfc="none" if at == begin else "black")
            away = 10 if least < figures[key] else -10
            side = {"xytext": (6, 0), "ha": "left"} if at == begin else {"xytext": (0, away), "ha": "right"}
            axis.annotate(
                f"{words} {figures[key]:.3f}",
                (at, figures[key]),
                textcoords="offset points",
                va="center",
                fontsize="small",
                bbox={"facecolor": "white", "edgecolor": "none", "pad": 1.0, "alpha": 0.8},
                **side,
            )


def _loss_words(judge: Judge, blurred: bool, points: bool) -> str:
    """Title of a panel of losses."""
    if blurred:
        return f"loss by {judge.by} of each stage, with blur"
    if not points:
        return f"loss by {judge.by}"
    return f"error by {judge.by}: loss of the design (lines),\n{judge.points} (points)"


def _draw_energy_balance(axis: Axes, figures: dict) -> None:
    """Energy balance: where the light of the source goes."""
    parts = [("on the picture", figures["on_target"] or 0.0, COLOURS[2])]
    parts += [("beside it, on the screen", figures["on_screen"] - (figures["on_target"] or 0.0), COLOURS[0])]
    parts += [(name.replace("_", " "), value, COLOURS[1]) for name, value in figures["lost"].items() if value > LITTLE]
    axis.barh(range(len(parts)), [100.0 * value for _, value, _ in parts], 0.35, color=[colour for _, _, colour in parts])
    for k, (name, value, _) in enumerate(parts):
        axis.annotate(f"{name} {value:.2%}", (1.0, k - 0.22), va="bottom")
    axis.set(xlabel="% of the source's light", xlim=(0.0, 100.0), yticks=[])
    axis.set_title("\n".join(fill(line, LINE) for line in _balance_words(figures).splitlines()), pad=PAD)
    axis.set_ylim(len(parts) - 0.5, -0.6)


def _balance_words(figures: dict) -> str:
    """Title of the energy balance: the fraction of all that the source emits, light in black regions of the image that the lens is
    judged by, and what a least radius adds to that."""
    judge, radius = judge_of(figures), known_radius(figures)
    words, black = judge.balance, judge.figure(figures, "in_black")
    emitted = figures.get("of_source")
    if emitted is not None and not math.isclose(emitted, judge.figure(figures, "on_target")):  # it emits beside the lens, too
        words += f"\non the picture {100.0 * emitted:.3g} % of all that the source emits"
    if black is not None:
        words += f"\nof that on the screen, in black {black:.2%}{judge.beside_rays}"
    if radius:
        words += f"\na radius of {radius['radius_mm']:g} mm on the first surface, in black: {cost_of_radius(radius)}"
    return words


def _irradiance_words(figures: dict, prefix: str) -> str:
    """Label of an irradiance colour bar: quantity, unit, and peak and mean of the image."""
    (name, unit, peak, mean), *others = in_units(figures, prefix)
    words = f"{name} ({unit})\npeak {peak:.3g}, mean {mean:.3g}"
    return "".join([words, *(f"; {peak:.3g}, {mean:.3g} {unit}" for _, unit, peak, mean in others)]).replace("^2", "²")


def _without_paraboloid(heights: np.ndarray, rx: float, ry: float) -> np.ndarray:
    """`heights` less its least-squares fit by 1, x, y, x^2 + y^2."""
    x = np.linspace(-rx, rx, heights.shape[0])[:, None] + np.zeros(heights.shape[1])
    y = np.linspace(-ry, ry, heights.shape[1]) + np.zeros(heights.shape)
    terms = np.stack([np.ones_like(x), x, y, x * x + y * y], -1).reshape(-1, 4)
    fit, *_ = np.linalg.lstsq(terms, heights.reshape(-1), rcond=None)
    return heights - (terms @ fit).reshape(heights.shape)
