"""HTML page of a lens for its manufacturer: data and figures of the lens for the interactive page of `export.page`."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from caustic_cli import __version__
from caustic_cli.export.page import PAGE, TRACED, entrance_grid, write_page
from caustic_cli.export.surface import sample_grid
from caustic_cli.io.files import destination
from caustic_cli.optics.plan import Plan
from caustic_cli.scene import Scene
from caustic_cli.scene.traits import Capability
from caustic_cli.workflow.lens import Lens
from caustic_cli.workflow.outputs.base import Output, Place, Rendering

#: Sample points along each axis for wall thickness and slopes.
SAMPLES = 601
#: Descriptions of effects that the page does not simulate.
MISSING = {
    "polarisation": "polarised light is taken as unpolarised",
    "roughness": "the blur of a rough surface",
    "ghosts": "ghost light, reflected inside the lens",
    "secondary-intersection": "light that meets the exit a second time",
    "diffraction": "diffraction: rays show folds of light sharper and brighter than waves make them",
}


@dataclass(eq=False)
class InteractivePage(Output):
    """The page at `html`."""

    option: ClassVar[str] = "html"
    capability: ClassVar[Capability] = PAGE

    html: Path

    def __post_init__(self):
        destination(self.html)

    def paths(self, place: Place) -> tuple[Path, ...]:
        return (self.html,)

    def write(self, rendering: Rendering) -> dict[str, Any]:
        """Write the page: page, its path."""
        lens = rendering.lens
        write_page(
            self.html,
            rendering.plan.scene,
            lens.field,
            lens.heights,
            lens.target,
            title=rendering.place.lens.resolve().stem,
            rows=[*_lens_rows(lens), *_light_rows(lens.scene), *_figure_rows(rendering.figures)],
            notes=_notes(rendering.plan),
            waves=rendering.waves,
            waves_xyz=rendering.waves_xyz,
            encoding=lens.encoding,
        )
        return {"page": str(self.html)}


def _size(values: tuple[float, ...], unit: str = " mm") -> str:
    return " × ".join(f"{v:.6g}" for v in values) + unit


def _lens_rows(lens: Lens) -> list[tuple[str, str]]:
    """Material, thickness and slopes of the lens within its aperture."""
    one, grid = lens.scene.lens, sample_grid(lens.field, lens.heights, (SAMPLES, SAMPLES))
    rx, ry = one.half_size
    inside = one.opening.covers(grid.x[:, None] / rx, grid.y[None, :] / ry)
    z, slope = grid.z[inside], np.hypot(grid.zx, grid.zy)[inside]
    depth = ("Depth of the surface", f"{z.max() - z.min():.4f} mm from its lowest to its highest point")
    steepest = ("Steepest slope", f"{slope.max():.4f}, {math.degrees(math.atan(slope.max())):.2f}°")
    size = one.opening.words(_size)
    if one.mirror:
        return [("Mirror", f"{size}; the side towards the light reflects"), depth, steepest]
    flat = one.entrance is None
    wall = z - one.z_in - (0.0 if flat else entrance_grid(one, (SAMPLES, SAMPLES)).z[inside])
    return [
        ("Lens", f"{size}; {'flat where light enters, free-form where it leaves' if flat else 'free-form on both sides'}"),
        ("Refractive index", f"{one.index:.6g}" + (f" ({one.glass})" if one.glass else "")),
        ("Wall", f"{wall.min():.4f} mm where it is thinnest, {wall.max():.4f} mm where it is thickest"),
        depth,
        steepest,
    ]


def _light_rows(scene: Scene) -> list[tuple[str, str]]:
    source, screen = scene.source, scene.screen
    centre = "" if source.distant else f", its middle at {', '.join(f'{c:.6g}' for c in source.centre)} mm"
    throw = "the far field" if screen.far else f"{abs(screen.z):.6g} mm from the origin, on the {scene.lens.kind}, to the screen"
    shape = f", {screen.shape_words()}" if screen.curved else ""
    return [
        ("Light", f"{source.kind}: {source.extent_words(scene.lens.z_in)}{centre}"),
        ("Throw", throw),
        ("Screen", f"{_size(screen.size, f' {screen.unit}')}, {_size(screen.resolution, '')} pixels{shape}"),
    ]


def _figure_rows(figures: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Figures of the render."""
    rms, noise, waves, by = (figures.get(key) for key in ("relative_rms", "noise", "wave_relative_rms", "error_by"))
    rows = [("Rendered", f"{figures['rays']:,} rays; {figures['on_screen']:.2%} of the light on the screen")]
    if figures.get("of_source") is not None:
        rows.append(
            ("On the picture", f"{100.0 * figures['of_source']:.3g}% of all that the source emits {figures['source_emits']}")
        )
    errors = [] if rms is None else [("rays", f"{rms:.4f}" + ("" if noise is None else f" ± {noise:.2g}"))]
    errors += [] if waves is None else [("waves", f"{waves:.4f}")]
    errors.sort(key=lambda one: one[0] != by)  # the judged one first
    return rows + [(f"{'Error' if k else 'Relative RMS error'} by {name}", value) for k, (name, value) in enumerate(errors)]


def _notes(plan: Plan) -> list[str]:
    missing = [MISSING[name] for name in plan.simulated if name not in TRACED]
    missing += ["the edges of the mirrors behind the lens"] if plan.scene.elements else []
    notes = [f"Not traced on this page: {'; '.join(missing)}."] if missing else []
    if plan.scene.colored:
        notes.append("The picture is coloured; this page shows the light of all its colours together.")
    notes.append(
        f"Pictures show the screen {plan.scene.lens.interaction.seen_from}:"
        " x to the right, y upwards. Light that leans along x"
        f" travels towards +x. Made by caustic {__version__}."
    )
    return notes
