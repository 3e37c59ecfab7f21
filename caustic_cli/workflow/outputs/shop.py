"""The page for the shop that makes the part, HTML, with the test card beside it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

from caustic_cli.io.files import destination
from caustic_cli.scene.traits import Capability
from caustic_cli.studies import manufacture, shop_page
from caustic_cli.studies.photograph.card import write_card
from caustic_cli.workflow.outputs.base import Output, Place, Rendering
from caustic_cli.workflow.outputs.test_card import TestCard


@dataclass(eq=False)
class ShopPage(Output):
    """The page at `shop`; beside it NAME-card.png and NAME-card.csv, where a card fits the screen."""

    option: ClassVar[str] = "shop"
    capability: ClassVar[Capability] = Capability("page for the shop", {})
    beyond: ClassVar[bool] = True

    shop: Path

    def __post_init__(self):
        destination(self.shop)

    def paths(self, place: Place) -> tuple[Path, ...]:
        return (self.shop, *(self.shop.with_name(f"{self.shop.stem}-card{suffix}") for suffix in (".png", ".csv")))

    def write(self, rendering: Rendering) -> dict[str, Any]:
        """shop: page and card, and the limits of `studies.shop_limits`."""
        lens, (page, sheet, table) = rendering.designed, self.paths(rendering.place)
        fits = TestCard.capability.supports(lens.scene)
        report = manufacture.manufacture(lens.scene, *lens.made, seed=rendering.seed)
        size = write_card(sheet, table, lens.scene.screen) if fits else None
        title, finish = rendering.place.lens.resolve().stem, lens.project.settings.lens.finish if lens.project else ""
        limits = shop_page.write_page(page, title, lens.scene, *lens.made, report, finish, size, rendering.seed)
        return {"shop": {"page": str(page), "card": str(sheet) if fits else None} | limits}

    def show(self, figures: dict[str, Any], say: Any) -> None:
        f = figures["shop"]
        bumps = "; ".join(f"{height:.2g} µm over {width:g} mm" for width, height in f["bumps_um"].items())
        card = f["card"] or "none: no flat sheet fits the screen"
        say.table("for the shop", [("page", f["page"]), ("test card", card), ("bumps lower than", bumps)])
