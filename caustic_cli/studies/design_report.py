"""report.png of a design: target, caustic, error, lens height and relief, loss against time, and energy balance."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.image import AxesImage
from matplotlib.ticker import MaxNLocator
from mpl_toolkits.mplot3d import Axes3D

from caustic_cli.io.files import atomic_path
from caustic_cli.io.picture import SOFTWARE, to_linear, to_srgb
from caustic_cli.scene import Lens, Screen
from caustic_cli.studies.report import COLOURS, plain_ticks

#: Upper end of an irradiance scale below which ticks cannot be placed, as for a black image.
DARK = 1e-250
#: Quantile of the absolute errors at which the error scale ends.
NEARLY = 0.995
#: Most points along an axis of the relief; fraction of the light below which a loss is not listed.
RELIEF, LITTLE = 130, 5e-5
#: Position of a colour bar relative to its panel: left, bottom, width, height.
BAR = (1.03, 0.0, 0.046, 1.0)
#: Positions of the panels.  An automatic layout took as long as drawing.
PLACES = {"left": 0.035, "right": 0.95, "bottom": 0.065, "top": 0.925, "wspace": 0.62, "hspace": 0.42}
#: Height of the panel of blurred losses relative to that of the error.
BLURRED = 0.6


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
) -> None:
    """Write the panels.

    Args:
        target, image: (n_x, n_y) irradiance; drawn at the same exposure and in the encoding of the picture, images with a colour
            bar of absolute irradiance.
        heights: (a, b) surface heights on a regular grid over the aperture, mm; the best-fit paraboloid is subtracted, because it
            hides the relief; for a gradient index the index is drawn instead.
        history: (k, 5) rows iteration, stage, loss, on_screen, seconds.
        waves: (n_x, n_y), the wave image, or None; if given, the error is that of the wave image.
        stages: of each, the blur in its loss, pixels, and whether it uses the wave image.
    """
    import matplotlib  # noqa: PLC0415

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt  # noqa: PLC0415
    from matplotlib.colors import FuncNorm, Normalize  # noqa: PLC0415

    figure = plt.figure(figsize=(22.0, 9.8))
    axes = figure.subplots(2, 4, gridspec_kw=PLACES)
    extent = [-screen.half_size[0], screen.half_size[0], -screen.half_size[1], screen.half_size[1]]
    scale = target.sum() / target.max()

    def titled(name: str, relative: float | None) -> str:
        return name if relative is None else f"{name}\nrelative RMS error {relative:.3f}"

    if waves is None:
        title = titled("caustic", figures["relative_rms"])
        if "least_relative_rms" in figures:
            title += f", at least {figures['least_relative_rms']:.3f}"
        shown = [(target, "target"), (image, title)]
    else:
        shown = [
            (target, "target"),
            (image, titled("ray image", figures["relative_rms"])),
            (waves, titled("wave image", figures["wave_relative_rms"])),
        ]
        image = waves
    for axis, (picture, title) in zip(axes[0], shown, strict=False):
        part = picture / max(picture.sum(), 1e-300)
        peak, brightest = figures["wave_peak_irradiance" if picture is waves else "peak_irradiance"], picture
        if picture is target:
            brightest = shown[1][0]
        white = peak / (brightest.max() or 1.0) * brightest.sum() / scale
        white = white if white > DARK else 1.0
        norm = (
            FuncNorm((lambda e, w=white: to_srgb(e / w), lambda v, w=white: w * to_linear(v)), 0.0, white, clip=True)
            if encoding == "srgb"
            else Normalize(0.0, white, clip=True)
        )
        drawn = axis.imshow((part * scale * white).T, origin="lower", extent=extent, cmap="gray", norm=norm)
        if picture is not target:
            _bar(drawn, axis, _irradiance_words(figures, "wave_" if picture is waves else ""))
        axis.set(title=title, xlabel="x on the screen (mm)", ylabel="y (mm)")
    error = (image / max(image.sum(), 1e-300) - target / target.sum()) * target.size
    most = _scale_of(error, (image > 0) | (target > 0))
    axis = axes[0, len(shown)]
    drawn = axis.imshow(error.T, origin="lower", extent=extent, cmap="coolwarm", vmin=-most, vmax=most)
    _bar(drawn, axis, "of the mean irradiance", extend="both")
    axis.set(title="error: too dark (blue), too bright (red)", xlabel="x on the screen (mm)", ylabel="y (mm)")
    if waves is None:
        _draw_section(axes[0, 3], target, image, screen)
    rx, ry = lens.half_size
    volume = None if lens.gradient is None else lens.gradient.volume
    relief, unit, name = (
        (_without_paraboloid(heights, rx, ry) * 1e3, "µm", "lens height, best paraboloid removed")
        if volume is None
        else (volume.mean(-1), "index", "index, mean along z")
    )
    drawn = axes[1, 0].imshow(relief.T, origin="lower", extent=[-rx, rx, -ry, ry], cmap="viridis")
    _bar(drawn, axes[1, 0], unit)
    axes[1, 0].set(title=name, xlabel="x on the lens (mm)", ylabel="y (mm)")
    place = axes[1, 1].get_subplotspec()
    axes[1, 1].remove()
    solid = figure.add_subplot(place, projection="3d")
    _draw_losses(axes[1, 2], history, target.size, figures, stages)
    _draw_energy_balance(axes[1, 3], figures)
    _draw_relief(solid, relief, (rx, ry), unit)
    with atomic_path(path) as temporary:
        figure.savefig(temporary, format="png", dpi=100, metadata={"Software": SOFTWARE})
    plt.close(figure)


def _bar(drawn: AxesImage, axis: Axes, label: str, extend: str = "neither") -> None:
    """Add a colour bar as high as the panel."""
    axis.get_figure().colorbar(drawn, cax=axis.inset_axes(BAR), label=label, extend=extend)


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
    axis.set(title=f"along y = {y:.3g} mm", xlabel="x on the screen (mm)", ylabel="of the mean irradiance")
    axis.set_ylim(0.0, 1.25 * axis.get_ylim()[1])  # room for the legend above all data
    axis.legend(loc="upper right", ncols=2, frameon=False)


def _draw_relief(axis: Axes3D, relief: np.ndarray, half: tuple[float, float], unit: str) -> None:
    """The relief in three dimensions, lit from the side."""
    every = max(1, max(relief.shape) // RELIEF)
    z = relief[::every, ::every]
    x, y = (np.linspace(-h, h, n) for h, n in zip(half, z.shape, strict=True))
    axis.plot_surface(*np.meshgrid(x, y, indexing="ij"), z, cmap="viridis", rcount=len(x), ccount=len(y), lw=0, antialiased=False)
    axis.set_box_aspect((half[0] / max(half), half[1] / max(half), 0.35), zoom=1.15)
    axis.set(xlabel="x (mm)", ylabel="y (mm)", zlabel=unit, title="the same in relief")
    axis.zaxis.set_major_locator(MaxNLocator(3))
    axis.view_init(elev=38, azim=-65)


def _draw_losses(axis: Axes, history: np.ndarray, pixels: int, figures: dict, stages: Sequence[tuple[float, bool]]) -> None:
    """Loss of each stage against time, and the retraced errors of the initial and the final lens.

    Stages with a blur have a panel of their own below: their losses decrease with the width of the blur and cannot be compared with
    each other.
    """
    found = [int(k) for k in np.unique(history[:, 1])]
    how = {k: stages[k] if k < len(stages) else (0.0, False) for k in found}
    mixed = len({waves for _, waves in how.values()}) > 1  # two different losses
    last, least = (history[-1, 4], history[-1, 2] * pixels) if len(history) else (0.0, 0.0)
    below = None
    if any(blur > 0 for blur, _ in how.values()):
        grid = axis.get_subplotspec().subgridspec(2, 1, height_ratios=(1.0, BLURRED))
        axis.set_subplotspec(grid[0])
        below = axis.get_figure().add_subplot(grid[1], sharex=axis)
        below.set_title("loss of each stage, with blur", fontsize="medium")
    for k, (blur, waves) in how.items():
        rows, colour = history[history[:, 1] == k], COLOURS[k % len(COLOURS)]
        own = axis if blur == 0 or below is None else below
        own.semilogy(rows[:, 4], rows[:, 2] * pixels, color=colour, marker="." if len(rows) == 1 else None, lw=1.6)
        kind = ", waves" if waves else ", rays" if mixed else ""
        at, up = (rows[0], 4) if own is axis or k % 2 == 0 else (rows[-1], -11)  # above one line and below the next: many are short
        late = at[4] > 0.7 * last
        own.annotate(
            f"{blur:.2g} px" if blur > 0 else f"stage {k + 1}{kind}",
            (at[4], at[2] * pixels),
            xytext=(-3 if late else 3, up),
            textcoords="offset points",
            ha="right" if late else "left",
            color=colour,
            fontsize="small",
        )
    likeness = "wave_relative_rms" if figures.get("wave_relative_rms") is not None else "relative_rms"
    for key, at, words in ((f"start_{likeness}", 0.0, "start"), (likeness, last, "finished")):
        if figures.get(key):
            axis.semilogy([at], [figures[key]], "o", color="black", ms=5, mfc="none" if at == 0.0 else "black")
            away = 10 if least < figures[key] else -10
            side = {"xytext": (6, 0), "ha": "left"} if at == 0.0 else {"xytext": (0, away), "ha": "right"}
            axis.annotate(
                f"{words} {figures[key]:.3f}",
                (at, figures[key]),
                textcoords="offset points",
                va="center",
                fontsize="small",
                bbox={"facecolor": "white", "edgecolor": "none", "pad": 1.0, "alpha": 0.8},
                **side,
            )
    axis.set(title="error: loss of the design (lines),\nretraced with independent rays (points)")
    for own in (axis,) if below is None else (axis, below):
        own.margins(x=0.08, y=0.12 if own is axis else 0.25)
        own.set_ylabel("relative RMS")
        own.grid(alpha=0.3, which="both")
        plain_ticks(own.yaxis)
    (below or axis).set_xlabel("s")
    if below is not None:
        axis.tick_params(labelbottom=False)


def _draw_energy_balance(axis: Axes, figures: dict) -> None:
    """Energy balance: where the light of the source goes."""
    parts = [("on the picture", figures["on_target"] or 0.0, COLOURS[2])]
    parts += [("beside it, on the screen", figures["on_screen"] - (figures["on_target"] or 0.0), COLOURS[0])]
    parts += [(name.replace("_", " "), value, COLOURS[1]) for name, value in figures["lost"].items() if value > LITTLE]
    axis.barh(range(len(parts)), [100.0 * value for _, value, _ in parts], 0.35, color=[colour for _, _, colour in parts])
    for k, (name, value, _) in enumerate(parts):
        axis.annotate(f"{name} {value:.2%}", (1.0, k - 0.22), va="bottom")
    axis.set(title=_balance_words(figures), xlabel="% of the source's light", xlim=(0.0, 100.0), yticks=[])
    axis.set_ylim(len(parts) - 0.5, -0.6)


def _balance_words(figures: dict) -> str:
    """Title of the energy balance: light in black regions of the picture, and what a least radius adds to that."""
    words, radius = "where the light goes", figures.get("min_radius")
    if figures.get("in_black") is not None:
        words += f"\nof that on the screen, in black {figures['in_black']:.2%}"
    if radius is not None and radius["in_black_per_mm"] is not None:
        words += f"\na radius of {radius['radius_mm']:g} mm: {radius['in_black_per_mm']:.2%} more a mm, on the first surface"
    return words


def _irradiance_words(figures: dict, prefix: str) -> str:
    """Label of an irradiance colour bar: quantity, unit, and peak and mean of the image."""
    unit = figures["irradiance_unit"].replace("^2", "²")
    peak, mean = (figures[f"{prefix}{k}_irradiance"] for k in ("peak", "mean"))
    return f"{'illuminance' if unit == 'lux' else 'irradiance'} ({unit})\npeak {peak:.3g}, mean {mean:.3g}"


def _without_paraboloid(heights: np.ndarray, rx: float, ry: float) -> np.ndarray:
    """`heights` less its least-squares fit by 1, x, y, x^2 + y^2."""
    x = np.linspace(-rx, rx, heights.shape[0])[:, None] + np.zeros(heights.shape[1])
    y = np.linspace(-ry, ry, heights.shape[1]) + np.zeros(heights.shape)
    terms = np.stack([np.ones_like(x), x, y, x * x + y * y], -1).reshape(-1, 4)
    fit, *_ = np.linalg.lstsq(terms, heights.reshape(-1), rcond=None)
    return heights - (terms @ fit).reshape(heights.shape)
