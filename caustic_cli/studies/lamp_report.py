"""report.png of a lamp: the light on its target with lines of equal illuminance or intensity, its error, the polar diagram of its
intensity, the section of the lens, and where the light goes.

Illuminances and intensities are those of a chip of FLUX lumens.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from textwrap import fill
from typing import Any

import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.projections.polar import PolarAxes
from matplotlib.ticker import MaxNLocator
from scipy.ndimage import uniform_filter
from torch import Tensor

from caustic_cli.io.files import SOFTWARE, atomic_file
from caustic_cli.optics.lamp import surfaces_of
from caustic_cli.optics.surfaces.polarfield import PolarField
from caustic_cli.scene.lamp import Goal, Lamp
from caustic_cli.studies.photometry import FLUX, IntensityTable
from caustic_cli.studies.report import COLOURS

#: Fractions of the greatest value at which lines are drawn, and range of the relative error that is shown.
LINES, ERROR = (0.1, 0.25, 0.5, 0.75, 0.9), 0.1
#: Least part of the light whose loss is shown.
LEAST = 5e-4
#: Points of a section; pixels over which the light is averaged along either axis.
POINTS, SMOOTH = 181, 5


def write_lamp_report(
    path: Path,
    lamp: Lamp,
    goal: Goal,
    field: PolarField,
    values: Tensor,
    image: np.ndarray,
    wanted: np.ndarray,
    table: IntensityTable,
    figures: Mapping[str, Any],
) -> None:
    """Write the report.

    Args:
        image, wanted: part of the light on each pixel, (n_x, n_y), and as it should be; figures: as of `studies.lamp`.
    """
    figure = Figure(figsize=(15.0, 8.0), dpi=100)
    grid = figure.add_gridspec(2, 6, left=0.05, right=0.95, top=0.95, bottom=0.12, wspace=1.0, hspace=0.35)
    _draw_light(figure, figure.add_subplot(grid[0, :3]), goal, image)
    _draw_error(figure, figure.add_subplot(grid[0, 3:]), goal, image, wanted)
    polar = figure.add_subplot(grid[1, :2], projection="polar")
    assert isinstance(polar, PolarAxes)
    _draw_polar(polar, table)
    _draw_section(figure.add_subplot(grid[1, 2:4]), lamp, field, values)
    _draw_losses(figure.add_subplot(grid[1, 4:]), figures)
    with atomic_file(path) as file:
        figure.savefig(file, format="png", metadata={"Software": SOFTWARE})


def density(goal: Goal, image: np.ndarray) -> np.ndarray:
    """Illuminance, lx, or intensity, cd, of a chip of FLUX lumens, from the part of its light on each pixel (n_x, n_y)."""
    shares = goal.shares((image.shape[0], image.shape[1]))
    if goal.far:
        return FLUX * image / (shares * goal.solid_angle)
    return FLUX * image / (shares * goal.size[0] * goal.size[1] / 1e6)


def _extent(goal: Goal) -> tuple[float, float, float, float]:
    """Of a target, in degrees or metres."""
    unit = 1.0 if goal.far else 1e-3
    (left, right), (low, high) = ((unit * (m - 0.5 * s), unit * (m + 0.5 * s)) for m, s in zip(goal.shift, goal.size, strict=True))
    return left, right, low, high


def _labelled(axis: Axes, goal: Goal, title: str) -> None:
    names = ("x (m)", "y (m)")
    if goal.far:
        kind = goal.projection
        names = ("longitude (degrees)", "latitude (degrees)") if kind == "latitude" else (f"x ({kind}, degrees)", "y (degrees)")
    axis.set(title=title, xlabel=names[0], ylabel=names[1])


def _draw_light(figure: Figure, axis: Axes, goal: Goal, image: np.ndarray) -> None:
    """The light, with lines of equal illuminance or intensity."""
    light, extent = uniform_filter(density(goal, image), SMOOTH, mode="nearest"), _extent(goal)
    top = float(np.quantile(light, 0.999)) or 1.0
    drawn = axis.imshow(light.T, cmap="gray", vmin=0.0, vmax=top, extent=extent, origin="lower", interpolation="nearest")
    x, y = (np.linspace(a, b, 2 * n + 1)[1::2] for a, b, n in zip(extent[::2], extent[1::2], light.shape, strict=True))
    if min(light.shape) > 1 and light.max() > 0:
        lines = axis.contour(x, y, light.T, [part * top for part in LINES], colors=COLOURS[0], linewidths=0.8)
        axis.clabel(lines, fontsize=7, fmt="%.3g")
    name, unit = ("isocandela", "cd") if goal.far else ("isolux", "lx")
    figure.colorbar(drawn, ax=axis, label=f"{unit} per {FLUX:.0f} lm of the chip", shrink=0.6)
    _labelled(axis, goal, f"light on the target, {name} lines")


def _draw_error(figure: Figure, axis: Axes, goal: Goal, image: np.ndarray, wanted: np.ndarray) -> None:
    """The error over the mean of the target."""
    seen, asked = (uniform_filter(density(goal, part), SMOOTH, mode="nearest") for part in (image, wanted))
    lit = asked > 0
    error = np.where(lit, seen / seen[lit].mean() - asked / asked[lit].mean(), np.nan)
    drawn = axis.imshow(
        error.T, cmap="coolwarm", vmin=-ERROR, vmax=ERROR, extent=_extent(goal), origin="lower", interpolation="nearest"
    )
    figure.colorbar(drawn, ax=axis, label="over the mean of the target", shrink=0.6, extend="both")
    _labelled(axis, goal, "deviation from the target")


def _draw_polar(axis: PolarAxes, table: IntensityTable) -> None:
    """The intensity in the planes C 0 - 180 and C 90 - 270, gamma = 0 below."""
    axis.set_theta_zero_location("S")
    axis.yaxis.set_major_locator(MaxNLocator(3))
    axis.set_thetalim(-0.5 * math.pi, 0.5 * math.pi)
    ahead, half = table.angles <= 90.0, len(table.planes) // 2
    gamma, values = np.radians(table.angles[ahead]), table.values[:, ahead]
    for first, colour in ((0, COLOURS[0]), (half // 2, COLOURS[1])):
        both = np.concatenate([values[(first + half) % len(values)][:0:-1], values[first]])
        name = f"C {table.planes[first]:.0f} - {table.planes[first] + 180.0:.0f}"
        axis.plot(np.concatenate([-gamma[:0:-1], gamma]), both, color=colour, label=name)
    axis.set_title(f"intensity (cd per {FLUX:.0f} lm of the chip)")
    axis.legend(loc="lower left", bbox_to_anchor=(-0.1, 0.0), fontsize=8)


def _draw_section(axis: Axes, lamp: Lamp, field: PolarField, values: Tensor) -> None:
    """Sections of the lens along x and along y."""
    rho = torch.linspace(-1.0, 1.0, POINTS, dtype=torch.float64)
    zero = torch.zeros_like(rho)
    for surface, side in zip(("outer", "inner"), surfaces_of(lamp, field, values), strict=True):
        for name, at, colour in (("x", (rho, zero), COLOURS[0]), ("y", (zero, rho), COLOURS[1])):
            x, y, z = side.points(*at)
            label = f"along {name}" if surface == "outer" else None
            axis.plot((x if name == "x" else y).numpy(), z.numpy(), color=colour, label=label)
    axis.plot([-0.5 * lamp.chip.size[0], 0.5 * lamp.chip.size[0]], [0.0, 0.0], color="black", linewidth=4.0)
    axis.plot(0.0, 0.0, "k.")
    axis.set(title="sections of the lens", xlabel="x or y (mm)", ylabel="z (mm)", aspect="equal")
    axis.legend(loc="upper center", bbox_to_anchor=(0.5, 0.0), borderaxespad=4.5, ncols=2, fontsize=8)  # below the name of the axis


def _draw_losses(axis: Axes, figures: Mapping[str, Any]) -> None:
    """Where the light of the chip goes."""
    parts = {
        "on the target": figures["of_source"],
        **{fill(name.replace("_", " "), 14): part for name, part in figures["lost"].items() if part > LEAST},
    }
    names = list(parts)
    bars = axis.barh(names, [100.0 * part for part in parts.values()], color=[COLOURS[2], *[COLOURS[1]] * (len(names) - 1)])
    axis.bar_label(bars, fmt="%.1f %%", padding=3)
    axis.invert_yaxis()
    axis.set(title="light of the chip (%)", xlim=(0.0, 115.0))
