"""Manufacturing figures of the lens, a JSON file beside the image."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, Self

from caustic_cli.studies import manufacture
from caustic_cli.workflow.lens import Lens
from caustic_cli.workflow.outputs.base import Output, Place, Rendering, not_single


@dataclass(eq=False)
class ManufacturingReport(Output):
    """The figures; tool_radius: of a tool that is to fit in concave regions, mm."""

    beyond: ClassVar[bool] = True

    tool_radius: float | None = None

    @classmethod
    def of(cls, options: Any) -> Self | None:
        """By the option `report`."""
        return cls(options.tool_radius) if options.report else None

    @property
    def asks(self) -> dict[str, object]:
        """The report and the tool."""
        return {"report": True, "tool_radius": self.tool_radius}

    def paths(self, place: Place) -> tuple[Path, ...]:
        """report.json."""
        return (place.beside("report.json"),)

    def unsupported(self, lens: Lens) -> str | None:
        """Of single lenses."""
        return not_single("report", lens)

    def write(self, rendering: Rendering) -> dict[str, Any]:
        """report: the figures of `studies.manufacture`."""
        lens, (path,) = rendering.lens, self.paths(rendering.place)
        found = manufacture.manufacture(lens.scene, lens.field, lens.heights, self.tool_radius, rendering.seed)
        manufacture.write_json(path, found)
        rendering.say.say(f"{path}: manufacturing figures of the lens")
        return {"report": found}

    def show(self, figures: dict[str, Any], say: Any) -> None:
        """Print the figures."""
        say.table("making the lens", manufacture.rows(figures["report"]))
