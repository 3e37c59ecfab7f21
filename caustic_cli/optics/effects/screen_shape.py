"""Curved screens: spherical, cylindrical, or of measured shape."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from torch import Tensor

from caustic_cli.optics.effects.base import Decision, Effect, Probe
from caustic_cli.optics.screen_shape import points_in_space
from caustic_cli.scene import Scene

#: Radius of curvature for the measurement in a scene with a plane screen, in screen widths.
AMOUNT = 1.5
#: Points along each axis of the screen at which the displacement is evaluated.
POINTS = 65


def displacement(scene: Scene) -> float:
    """Largest displacement, in pixels, of light from the centre of the lens if the screen were plane."""
    screen, lens = scene.screen, scene.lens
    x, y = (np.linspace(-h, h, POINTS) for h in screen.half_size)
    x, y = (c.ravel() for c in np.meshgrid(x, y, indexing="ij"))
    point = np.stack(points_in_space(screen, x, y))
    way = point - np.array([0.0, 0.0, lens.offset.thickness])[:, None]
    axes = np.array(screen.axes)
    back = axes[2] @ (point - np.array(screen.centre)[:, None]) / (axes[2] @ way)
    return float(np.hypot(*(back * (axis @ way) / w for axis, w in zip(axes[:2], screen.pixel, strict=True))).max())


class ScreenShape(Effect):
    """Without it the screen is plane."""

    name = "screen-shape"

    def decide(self, scene: Scene, bounds) -> Decision:
        """Needed if the screen is curved."""
        if not scene.screen.curved:
            return Decision(self.name, False, "the screen is plane", 0.0, 0.0, present=False)
        off = displacement(scene)
        why = f"the screen is {scene.screen.shape_words()}; left plane, light would land up to {off:.3g} pixels elsewhere"
        return Decision(self.name, True, why, off, 0.0)

    def without(self, scene: Scene) -> Scene:
        """With a plane screen."""
        return replace(scene, screen=scene.screen.uncurved) if scene.screen.curved else scene

    def probe(self, scene: Scene, heights: Tensor) -> Probe:
        """A spherical screen."""
        radius = AMOUNT * max(scene.screen.size)
        return Probe(replace(scene, screen=replace(scene.screen, radius=(radius, radius))), None, f"a radius of {radius:.4g} mm")
