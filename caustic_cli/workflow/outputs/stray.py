"""Stray light of an array with a source behind every lenslet."""

from __future__ import annotations

from typing import Any

from caustic_cli.loading import OnDemand
from caustic_cli.workflow.outputs.base import Output, Rendering

study = OnDemand("caustic_cli.studies.stray")


class Stray(Output):
    """Its fractions of the light on the lens and of that on the screen, as of every render of such an array."""

    def write(self, rendering: Rendering) -> dict[str, Any]:
        """stray: on_lens and on_screen, of the light there; none if no light is on the screen."""
        lens, plan, total = rendering.lens, rendering.plan, float(rendering.image.sum())
        if not plan.scene.source.behind_each or not total > 0:
            return {}
        with rendering.say.notify_if_slow("tracing the light of every source through the lenslets of others"):
            fallen, seen = study.stray_light(
                plan.scene, lens.field, lens.heights, rendering.count, rendering.seed, rendering.device, plan.requests
            )
        return {"stray": {"on_lens": fallen / (1.0 - rendering.figures["lost"]["missed_lens"]), "on_screen": seen / total}}

    def show(self, figures: dict[str, Any], say: Any) -> None:
        if "stray" in figures:
            parts = figures["stray"]
            words = f"{parts['on_lens']:.2%} of that on the lens, {parts['on_screen']:.2%} of that on the screen"
            say.table("light of sources through other lenslets than their own", [("stray light", words)])
