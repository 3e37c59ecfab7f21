"""The surface that a G-code program machines, traced instead of the designed one, and its form deviation."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar

from caustic_cli.workflow.machining import cut_surface, form_deviation
from caustic_cli.workflow.outputs.base import Output, Rendering, fingerprint


@dataclass(eq=False)
class MachinedSurface(Output):
    """The surface that the program `cut` leaves; tool_radius: mm, for a program that does not state it."""

    option: ClassVar[str] = "cut"

    cut: Path
    tool_radius: float | None = None
    deviation: dict[str, float] = field(default_factory=dict, init=False)

    @property
    def shows(self) -> dict[str, object]:
        return {"cut": fingerprint(self.cut)}

    def prepare(self, rendering: Rendering) -> None:
        lens = rendering.lens
        rendering.cut = cut_surface(self.cut, lens.scene, lens.field, self.tool_radius)
        self.deviation = form_deviation(rendering.cut, lens.field, lens.heights, lens.scene.lens.opening)
        rendering.steeper = self.deviation["cut_slope_most"]

    def write(self, rendering: Rendering) -> dict[str, Any]:
        """cut: program, the figures of the surface as designed, nominal_*, and the form deviation."""
        nominal = rendering.trace().figures
        if rendering.figures["error_by"] == "waves":
            nominal |= rendering.lens.render_waves(effects=rendering.plan, required=False, device=rendering.device).figures
        as_designed = {f"nominal_{name}": nominal[name] for name in ("error", "error_by", "relative_rms", "noise")}
        return {"cut": {"program": str(self.cut)} | as_designed | self.deviation}

    def show(self, figures: dict[str, Any], say: Any) -> None:
        f, nominal = figures["cut"], []
        if f["nominal_error_by"] is not None:
            designed = f"of the surface as designed {f['nominal_error']:.4f} by {f['nominal_error_by']}"
            nominal = [("relative RMS error", f"{figures['error']:.4f} by {figures['error_by']}; {designed}")]
        rows = [
            *nominal,
            ("left on the surface", f"up to {1e3 * f['cut_left_mm']:.3g} µm, RMS {1e3 * f['cut_rms_mm']:.3g} µm"),
            ("cut too deep", f"up to {1e3 * f['cut_gouge_mm']:.3g} µm"),
            ("slopes off by", f"RMS {f['cut_slope_rms']:.3g}, up to {f['cut_slope_most']:.3g}"),
        ]
        say.table(f"as {f['program']} cuts it", rows)
