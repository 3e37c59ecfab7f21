"""Decentred screens."""

from __future__ import annotations

from dataclasses import replace

from torch import Tensor

from caustic_cli.optics.effects.base import Decision, Effect, Probe
from caustic_cli.scene import Scene

#: Decentre for the measurement in a scene without one, mm.
AMOUNT = 1.0
#: Distance that is rounding, mm.
SAME = 1e-6


class ScreenShift(Effect):
    """Without it the screen is centred on the undeviated light, which is the axis unless the source is tilted."""

    name = "screen-shift"
    free = True

    def decide(self, scene: Scene, bounds) -> Decision:
        """Needed if the screen is decentred."""
        (a, b), (x, y) = scene.screen.shift, _centre(scene)
        off = max(abs(a - x), abs(b - y))
        some, centred = off > SAME, "centred on the light" if x or y else "on the axis"
        how = f"shifted by {a:g} and {b:g} mm" if some else centred
        return Decision(self.name, some, f"the screen is {how}", off, 0.0, present=some)

    def without(self, scene: Scene) -> Scene:
        """With a screen centred on that light."""
        needed = self.decide(scene, None).on
        return replace(scene, screen=replace(scene.screen, shift=_centre(scene))) if needed else scene

    def probe(self, scene: Scene, heights: Tensor) -> Probe:
        """A decentre along x."""
        x, y = _centre(scene)
        return Probe(replace(scene, screen=replace(scene.screen, shift=(x + AMOUNT, y))), None, f"{AMOUNT:g} mm")


def _centre(scene: Scene) -> tuple[float, float]:
    """Where the undeviated light meets the screen's plane, mm."""
    x, y, z = scene.undeviated
    return scene.screen.z * x / z + 0.0, scene.screen.z * y / z + 0.0
