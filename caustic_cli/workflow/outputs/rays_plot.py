"""A plot of some rays through the lens to the screen, beside the image."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar, Self

from caustic_cli.studies.rays_plot import check_count, trace_paths, write_plot
from caustic_cli.workflow.outputs.base import Output, Rendering


@dataclass(eq=False)
class RaysPlot(Output):
    """The plot.  rays_plot: number of rays."""

    option: ClassVar[str] = "rays_plot"
    files: ClassVar[tuple[str, ...]] = ("rays.png",)
    beyond: ClassVar[bool] = True

    rays_plot: int

    @classmethod
    def of(cls, options: Any) -> Self | None:
        return None if options.rays_plot is None else cls(options.rays_plot)

    def prepare(self, rendering: Rendering) -> None:
        check_count(self.rays_plot)

    def write(self, rendering: Rendering) -> dict[str, Any]:
        """rays_plot: the figures of `studies.rays_plot`, and image."""
        lens, plan, (path,) = rendering.lens, rendering.plan, self.paths(rendering.place)
        paths = trace_paths(plan.scene, lens.field, lens.heights, self.rays_plot, rendering.seed, plan.requests)
        write_plot(path, paths)
        return {"rays_plot": paths.figures | {"image": str(path)}}

    def show(self, figures: dict[str, Any], say: Any) -> None:
        f = figures["rays_plot"]
        ways = ", ".join(f"{name.replace('_', ' ')} {n}" for name, n in f["lost_by"].items())
        say.table(
            "rays drawn", [("rays", str(f["rays"])), ("lost", f"{f['lost']}{f' ({ways})' if ways else ''}"), ("image", f["image"])]
        )
