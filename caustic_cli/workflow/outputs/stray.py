"""Stray light of an array with a source behind every lenslet: what does not reach the screen through the source's own lenslet."""

from __future__ import annotations

import math
from typing import Any

from caustic_cli.inverse.lenslets import lenslets
from caustic_cli.workflow.outputs.base import Output, Rendering, image_alone


class Stray(Output):
    """The fraction of the light on the screen that is stray, as of every render of such an array."""

    def write(self, rendering: Rendering) -> dict[str, Any]:
        """stray: the fraction; none if no light is on the screen."""
        source, total = rendering.plan.scene.source, float(rendering.image.sum())
        if not source.by_lenslet or source.in_turn or not total > 0:
            return {}
        parts = lenslets(rendering.plan.scene, rendering.lens.field.shape)
        own = [image_alone(rendering, one.scene, one.field, one.of(rendering.lens.heights), len(parts)).sum() for one in parts]
        return {"stray": 1.0 - math.fsum(part * light for part, light in zip(source.fractions, own, strict=True)) / total}

    def show(self, figures: dict[str, Any], say: Any) -> None:
        if "stray" in figures:
            words = "of the light on the screen is that of sources behind other lenslets"
            say.table("the sources of the lenslets", [("stray light", f"{figures['stray']:.1%} {words}")])
