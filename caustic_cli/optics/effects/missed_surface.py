"""Vignetting: rays that leave the aperture before they reach the exit, or miss an aperture."""

from __future__ import annotations

import math

from caustic_cli.optics.effects.base import Decision, Effect
from caustic_cli.scene import Scene


class MissedSurface(Effect):
    """It is always evaluated, as a mask."""

    name = "missed-surface"
    free = True

    def decide(self, scene: Scene, b) -> Decision:
        """By the bound of the rays' distance from the axis at the surface's greatest height."""
        reach = b.exit.reach
        if scene.elements:
            return Decision(self.name, True, "the apertures of other elements may stop light", fixed=True)
        if scene.axial:
            return Decision(self.name, False, "every ray of a plane wave is on the surface", reach, 1.0)
        if reach <= 1.0:
            return Decision(self.name, False, f"no ray gets beyond {reach:.4g} of the aperture's half width", reach, 1.0)
        if math.isinf(reach):
            return Decision(self.name, True, "the surface may dip below the entrance", None, 1.0, fixed=True)
        why = f"rays may get to {reach:.4g} of the aperture's half width, where its edge absorbs them"
        return Decision(self.name, True, why, reach, 1.0, fixed=True)
