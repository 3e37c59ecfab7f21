"""The test card: a sheet with marks around the place of the picture, to be printed in its true size and fixed on the screen."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

from caustic_cli.scene.traits import Capability
from caustic_cli.studies.photograph.card import write_card
from caustic_cli.workflow.outputs.base import Output, Rendering


@dataclass(eq=False)
class TestCard(Output):
    """The sheet, and a table of its marks."""

    option: ClassVar[str] = "test_card"
    capability: ClassVar[Capability] = Capability.because(
        "test cards",
        {"a sheet of paper does not lie there": ("unrollable screen", "far field")},
        "a test card is a sheet of paper, which does not lie on {{}}",
    )
    files: ClassVar[tuple[str, ...]] = ("card.png", "card.csv")
    beyond: ClassVar[bool] = True

    def write(self, rendering: Rendering) -> dict[str, Any]:
        """test_card: the sheet, its width and height, mm, and the table of its marks."""
        sheet, table = self.paths(rendering.place)
        screen = rendering.lens.scene.screen
        size = write_card(sheet, table, screen)
        return {"test_card": {"sheet": str(sheet), "marks": str(table), "size_mm": list(size)}}

    def show(self, figures: dict[str, Any], say: Any) -> None:
        f = figures["test_card"]
        width, height = f["size_mm"]
        say.table("test card", [("sheet", f"{f['sheet']}, {width:.4g} x {height:.4g} mm"), ("marks", f["marks"])])
