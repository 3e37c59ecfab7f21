"""Diffraction: a wave image, computed from the field by scalar diffraction theory (`optics.waves`).

It does not change rays: the wave image is an additional result beside the ray image, the limit of vanishing wavelength.
"""

from __future__ import annotations

from caustic_cli.optics.effects.base import Decision, Effect
from caustic_cli.optics.resolution import WIDENED
from caustic_cli.optics.waves.unsupported import WAVE_IMAGE
from caustic_cli.scene import Scene


class Diffraction(Effect):
    """Without it there is no wave image."""

    name = "diffraction"
    waves = True

    def decide(self, scene: Scene, bounds) -> Decision:
        """Needed if it increases the blur of source and pixel noticeably."""
        r = bounds.resolution
        if obstacle := WAVE_IMAGE.obstacle(scene):
            return Decision(self.name, False, WAVE_IMAGE.unsupported[obstacle], r.widened, WIDENED)
        light = f"{r.wavelength:.4g} nm" if r.said else f"{r.wavelength:.4g} nm, as the scene says no wavelength,"
        blur, source, pixel = (f"{width:.2g} {r.unit}" for width in (r.diffraction, r.source, r.pixel))
        why = f"light of {light} blurs over {blur}, the source over {source}, a pixel is {pixel}"
        return Decision(self.name, r.matters, why, r.widened, WIDENED)
