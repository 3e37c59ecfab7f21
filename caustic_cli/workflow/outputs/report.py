"""Manufacturing figures of the lens, a JSON file beside the image."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

from caustic_cli.scene.traits import Capability
from caustic_cli.studies import manufacture
from caustic_cli.workflow.outputs.base import Output, Rendering


@dataclass(eq=False)
class ManufacturingReport(Output):
    """The figures; tool_radius: of a tool that is to fit in concave regions, mm."""

    option: ClassVar[str] = "report"
    capability: ClassVar[Capability] = Capability("manufacturing report", {})
    files: ClassVar[tuple[str, ...]] = ("report.json",)
    beyond: ClassVar[bool] = True

    tool_radius: float | None = None

    def write(self, rendering: Rendering) -> dict[str, Any]:
        """report: the figures of `studies.manufacture`."""
        lens, (path,) = rendering.designed, self.paths(rendering.place)
        found = manufacture.manufacture(lens.scene, *lens.made, self.tool_radius, rendering.seed)
        manufacture.write_json(path, found)
        rendering.say.say(f"{path}: manufacturing figures of the lens")
        return {"report": found}

    def show(self, figures: dict[str, Any], say: Any) -> None:
        say.table("making the lens", manufacture.rows(figures["report"]))
