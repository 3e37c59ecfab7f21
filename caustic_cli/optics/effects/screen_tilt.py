"""Tilted screens."""

from __future__ import annotations

import math
from dataclasses import replace

from torch import Tensor

from caustic_cli.optics.effects.base import Decision, Effect, Probe
from caustic_cli.scene import Scene

#: Tilt for the measurement in a scene without one, degrees.
AMOUNT = 10.0
#: Difference of two tilts that is rounding, degrees.
SAME = 1e-6


class ScreenTilt(Effect):
    """Without it the screen is square to the undeviated light, which is that of the axis unless the source is tilted."""

    name = "screen-tilt"

    def decide(self, scene: Scene, bounds) -> Decision:
        """Needed if the screen is tilted to that light."""
        tilt, square = scene.screen.tilt, _square(scene)
        off = max(abs(a - b) for a, b in zip((*tilt, 0.0), (*square, 0.0), strict=False))
        if some := off > SAME:
            how = f"tilted by {' and '.join(f'{t:g}' for t in tilt)} degrees"
        else:
            how = "square to the light" if any(square) else "upright"
        return Decision(self.name, some, f"the screen is {how}", off, 0.0, present=some)

    def without(self, scene: Scene) -> Scene:
        """With a screen square to that light."""
        needed = self.decide(scene, None).on
        return replace(scene, screen=replace(scene.screen, tilt=_square(scene))) if needed else scene

    def probe(self, scene: Scene, heights: Tensor) -> Probe:
        """A tilt about y."""
        about_x, about_y = _square(scene)
        return Probe(replace(scene, screen=replace(scene.screen, tilt=(about_x, about_y + AMOUNT))), None, f"{AMOUNT:g} degrees")


def _square(scene: Scene) -> tuple[float, float]:
    """Tilt of a screen square to the undeviated light, degrees."""
    x, y, z = (scene.lens.interaction.side * c for c in scene.undeviated)
    return math.degrees(-math.asin(y)) + 0.0, math.degrees(math.atan2(x, z)) + 0.0
