"""Dispersion: the refractive index depends on the wavelength."""

from __future__ import annotations

from dataclasses import replace

from torch import Tensor

from caustic_cli.optics.effects.base import Decision, Effect, Probe
from caustic_cli.scene import Light, Scene
from caustic_cli.scene.materials import D_LINE, nearest_index, refractive_index

#: Glass and wavelengths, nm, for the measurement in a scene without dispersion.
GLASS, LINES = "N-BK7", (486.1, D_LINE, 656.3)


class Dispersion(Effect):
    """Without it the index is the same at all wavelengths."""

    name = "dispersion"
    of_glass = True

    def decide(self, scene: Scene, bounds) -> Decision:
        """Needed if several wavelengths pass a glass."""
        if scene.dispersive:
            spans = {glass: [nearest_index(glass, w) for w in scene.light.wavelengths] for glass in scene.glasses}
            glass, indices = max(spans.items(), key=lambda item: max(item[1]) - min(item[1]))
            why = (
                f"{len(scene.light.wavelengths)} wavelengths in {glass}, whose index goes from {min(indices):.5f} to"
                f" {max(indices):.5f}"
            )
            return Decision(self.name, True, why, max(indices) - min(indices), 0.0)
        why = scene.lens.interaction.achromatic if scene.light.wavelengths else "one wavelength"
        return Decision(self.name, False, why, 0.0, 0.0, present=False)

    def without(self, scene: Scene) -> Scene:
        """With indices independent of the wavelength."""
        if not scene.dispersive:
            return scene
        light = scene.light if scene.light.color else replace(scene.light, wavelengths=(), weights=())
        elements = tuple(replace(e, glass=None) for e in scene.elements)
        return replace(scene, lens=replace(scene.lens, glass=None), light=light, elements=elements)

    def probe(self, scene: Scene, heights: Tensor) -> Probe | None:
        """Three spectral lines in the lens' glass, or in a common one."""
        glass = scene.lens.glass or GLASS
        lens = replace(scene.lens, glass=glass, index=refractive_index(glass))
        dispersed = replace(scene, lens=lens, light=Light(scene.light.polarisation, LINES))
        return Probe(dispersed, None, f"{len(LINES)} wavelengths in {glass}")
