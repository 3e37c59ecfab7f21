"""Tilted screens."""

from __future__ import annotations

from dataclasses import replace

from torch import Tensor

from caustic_cli.optics.effects.base import Decision, Effect, Probe
from caustic_cli.scene import Scene

#: Tilt for the measurement in a scene without one, degrees.
AMOUNT = 10.0


class ScreenTilt(Effect):
    """Without it the screen is perpendicular to the axis."""

    name = "screen-tilt"

    def decide(self, scene: Scene, bounds) -> Decision:
        """Needed if the screen is tilted."""
        tilt, some = scene.screen.tilt, any(scene.screen.tilt)
        return Decision(
            self.name,
            some,
            f"the screen is tilted by {' and '.join(f'{t:g}' for t in tilt)} degrees" if some else "the screen is upright",
            max(map(abs, tilt)),
            0.0,
            present=some,
        )

    def without(self, scene: Scene) -> Scene:
        """With an upright screen."""
        return replace(scene, screen=replace(scene.screen, tilt=(0.0, 0.0))) if any(scene.screen.tilt) else scene

    def probe(self, scene: Scene, heights: Tensor) -> Probe:
        """A tilt about y."""
        return Probe(replace(scene, screen=replace(scene.screen, tilt=(0.0, AMOUNT))), None, f"{AMOUNT:g} degrees")
