"""Reflection by a free-form mirror."""

from __future__ import annotations

from dataclasses import replace

from torch import Tensor

from caustic_cli.optics.effects.base import Decision, Effect, Probe
from caustic_cli.scene import Scene


class Mirror(Effect):
    """It cannot be omitted."""

    name = "mirror"

    def decide(self, scene: Scene, bounds) -> Decision:
        """Given by the scene."""
        if scene.lens.mirror:
            return Decision(self.name, True, "the surface is a mirror", fixed=True)
        return Decision(self.name, False, "the surface is glass", fixed=True, present=False)

    def probe(self, scene: Scene, heights: Tensor) -> Probe | None:
        """The same surface as a mirror, with the screen where it is seen in it; None for a gradient-index lens, or among others."""
        if scene.lens.gradient is not None or scene.elements:
            return None
        z, tilt = 2.0 * float(heights.mean()) - scene.screen.z, scene.screen.tilt
        tilt = (-tilt[0], -tilt[1], *tilt[2:])  # seen in it, the normal points the other way, too
        lens, screen = replace(scene.lens, mirror=True), replace(scene.screen, z=z, tilt=tilt)
        return Probe(Scene(scene.source, lens, screen, scene.light), scene, f"the screen at {z:.4g} mm")
