"""Decentred screens."""

from __future__ import annotations

from dataclasses import replace

from torch import Tensor

from caustic_cli.optics.effects.base import Decision, Effect, Probe
from caustic_cli.scene import Scene

#: Decentre for the measurement in a scene without one, mm.
AMOUNT = 1.0


class ScreenShift(Effect):
    """Without it the screen is centred on the axis."""

    name = "screen-shift"
    free = True

    def decide(self, scene: Scene, bounds) -> Decision:
        """Needed if the screen is decentred."""
        (a, b), some = scene.screen.shift, any(scene.screen.shift)
        return Decision(
            self.name,
            some,
            f"the screen is shifted by {a:g} and {b:g} mm" if some else "the screen is on the axis",
            max(abs(a), abs(b)),
            0.0,
            present=some,
        )

    def without(self, scene: Scene) -> Scene:
        """With a centred screen."""
        return replace(scene, screen=replace(scene.screen, shift=(0.0, 0.0))) if any(scene.screen.shift) else scene

    def probe(self, scene: Scene, heights: Tensor) -> Probe:
        """A decentre along x."""
        return Probe(replace(scene, screen=replace(scene.screen, shift=(AMOUNT, 0.0))), None, f"{AMOUNT:g} mm")
