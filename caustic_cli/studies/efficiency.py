"""Trade-off between optical efficiency and picture error: the Pareto front over thickness and weight of the light in the loss.

For a near source a thinner lens collects more light, up to a point, and has a larger blur.  So lenses of several thicknesses are
designed, each with the loss `rms + w light` for several weights w, and all are evaluated with independent rays.  A lens is on the
Pareto front if no other has both a higher efficiency and a smaller error.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np
import torch
from matplotlib.figure import Figure
from torch import Tensor

from caustic_cli import __version__
from caustic_cli.effort import current_effort
from caustic_cli.errors import CausticError
from caustic_cli.optics.surfaces.heightfield import HeightField
from caustic_cli.optics.system import trace_arguments
from caustic_cli.scene import Scene
from caustic_cli.schema import checks
from caustic_cli.studies.fit import pareto
from caustic_cli.studies.report import Study, legend_beside, styles
from caustic_cli.studies.retrace import retrace

#: Least range of the efficiency axis, percentage points.
LEAST_SPAN = 0.1
#: Default seconds of iterations for each lens.
SECONDS = 10.0
#: Rays of a retrace per pixel.
RAYS_PER_PIXEL = 64

COLUMNS = {
    "series": "thickness of the design, mm",
    "thickness": "the same, mm",
    "weight": "of the term `light` of the loss, relative to `rms`; of log-rms the efficiency that is asked for",
    "loss": "loss of the design",
    "error": "relative RMS between the retraced image and the target, each over its own mean; of log-rms the relative error in the"
    " mask, by waves",
    "noise": "standard error of `error`",
    "on_screen": "fraction of the source's power on the screen; of log-rms, of the light behind the lens in the region",
    "of_source": "fraction of all that the source emits which lands on the picture; of log-rms as on_screen",
    "front": "whether the lens is on the Pareto front: none other is both brighter and has a smaller error",
    "seconds": "of the design's iterations",
}


@dataclass(frozen=True, eq=False)
class DesignedLens:
    """A designed lens: its thickness, mm, the weight of the light, the loss, the scene, the spline spaces and heights (n, m) mm, or
    those of all surfaces (k, n, m), the target (n_x, n_y), and the seconds its iterations took; of a shaped laser beam the wanted
    efficiency in place of the weight, and figures by its wave image, as of `beam.beam_figures`."""

    thickness: float
    weight: float
    loss: str
    scene: Scene
    field: HeightField
    heights: Tensor
    target: np.ndarray
    seconds: float
    shaped: dict[str, float] | None = None


def run_efficiency(
    lenses: Iterable[DesignedLens],
    count: int,
    *,
    rays: int | None = None,
    seed: int = 0,
    device: str = "cpu",
    progress: Callable[[int, int], None] | None = None,
) -> Study:
    """Evaluate lenses one by one.

    Args:
        count: largest number of lenses, for the progress.
        rays: of every retrace, None for RAYS_PER_PIXEL per pixel.
        progress: called with (lenses done, in total) after each.

    Raises:
        CausticError: there are no lenses.
    """
    rows: list[dict] = []
    for k, lens in enumerate(lenses):
        usual = min(current_effort().final_rays, RAYS_PER_PIXEL * lens.target.size)
        traced = checks.whole("⟨rays⟩", usual if rays is None else rays, 256, 1 << 32)
        if lens.shaped is None:
            made = trace_arguments(lens.scene, lens.field, lens.heights)
            _, figures = retrace(*made, lens.target, rays=traced, seed=seed, device=device)
        else:
            part = lens.shaped["in_region"]
            figures = {"relative_rms": lens.shaped["error"], "noise": 0.0, "on_screen": part, "of_source": part}
        rows.append(
            {
                "series": f"{lens.thickness:g} mm",
                "thickness": lens.thickness,
                "weight": lens.weight,
                "loss": lens.loss,
                "error": figures["relative_rms"],
                "noise": figures["noise"],
                "on_screen": figures["on_screen"],
                "of_source": figures["of_source"],
                "seconds": lens.seconds,
            }
        )
        if progress is not None:
            progress(k + 1, count)
    if not rows:
        raise CausticError("no lens of this scene sends any light to the picture")
    gain = min(0.5, max(((r["noise"] or 0.0) / r["error"] for r in rows if r["error"] > 0), default=0.0))
    for row, front in zip(rows, pareto([1.0 - r["on_screen"] for r in rows], [r["error"] for r in rows], gain), strict=True):
        row["front"] = bool(front)
    about = {
        "version": __version__,
        "seed": seed,
        "device": device,
        "threads": torch.get_num_threads(),
        "retrace_rays": traced,
        "resolution": list(lens.scene.screen.resolution),
        "reference_error": max(r["noise"] or 0.0 for r in rows),
    }
    return Study("light", COLUMNS, rows, {}, _advice(rows), about, "on_screen", PLOTS)


def _advice(rows: list[dict]) -> str:
    """The ends of the Pareto front in one sentence."""
    front = sorted((r for r in rows if r["front"]), key=lambda r: r["error"])
    sharp, bright = front[0], front[-1]
    if sharp is bright:
        return f"one lens has both the least error and the highest efficiency: {_words(sharp)}"
    return f"{len(front)} lenses are on the Pareto front, from {_words(sharp)} to {_words(bright)}"


def _words(row: dict) -> str:
    made = f'thickness {row["thickness"]:g} mm, loss "{row["loss"]}"'
    return f"error {row['error']:.3g} with {row['on_screen']:.1%} of the light ({made})"


def draw_efficiency(study: Study, figure: Figure) -> None:
    """Error against efficiency, a curve for each thickness, and the Pareto front."""
    axes = figure.add_subplot()
    for series, style in styles(row["series"] for row in study.rows).items():
        mine = [row for row in study.rows if row["series"] == series]
        axes.errorbar(
            [100.0 * r["on_screen"] for r in mine],
            [r["error"] for r in mine],
            yerr=[r["noise"] or 0.0 for r in mine],
            label=f"thickness {series}",
            **style,
        )
    front = sorted((100.0 * r["on_screen"], r["error"]) for r in study.rows if r["front"])
    axes.plot(
        *zip(*front, strict=True),
        linestyle=":",
        color="black",
        marker="o",
        markersize=11,
        markerfacecolor="none",
        label="Pareto front",
    )
    axes.set(
        xlabel="light on the screen (% of the source's)",
        ylabel="relative RMS error of the picture",
        title="light: error against efficiency, weights {:g} to {:g} of the light in the loss".format(
            *(pick(r["weight"] for r in study.rows) for pick in (min, max))
        ),
    )
    axes.set_ylim(0.0, 1.15 * max(r["error"] for r in study.rows))
    low, high = axes.get_xlim()
    short = max(0.0, LEAST_SPAN - (high - low))
    axes.set_xlim(low - 0.5 * short, high + 0.5 * short)  # a range within rounding is widened
    axes.ticklabel_format(useOffset=False)
    axes.grid(which="major", linewidth=0.4)
    legend_beside(figure)


#: Endings of the pictures' names, and what draws them.
PLOTS = {"": draw_efficiency}
