"""Fresnel reflection losses at glass surfaces."""

from __future__ import annotations

from dataclasses import replace

from caustic_cli.optics.effects.base import Decision, Effect
from caustic_cli.scene import Scene


class Fresnel(Effect):
    """Without it surfaces have perfect anti-reflection coatings."""

    name = "fresnel"

    def decide(self, scene: Scene, b) -> Decision:
        """Needed unless the scene has fresnel = none."""
        if scene.lens.fresnel == "none":
            return Decision(self.name, False, "fresnel = none: perfectly coated", 0.0, 0.0)
        normal = ((b.index - 1.0) / (b.index + 1.0)) ** 2
        return Decision(
            self.name, True, f"each surface reflects {normal:.2%} of light at normal incidence; {scene.lens.fresnel}", normal, 0.0
        )

    def without(self, scene: Scene) -> Scene:
        """With perfect anti-reflection coatings."""
        return scene if scene.lens.fresnel == "none" else replace(scene, lens=replace(scene.lens, fresnel="none"))

    def including(self, scene: Scene) -> Scene:
        """With the exact Fresnel equations."""
        return replace(scene, lens=replace(scene.lens, fresnel="exact")) if scene.lens.fresnel == "none" else scene
