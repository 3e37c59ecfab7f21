"""The source's extent: every point of it throws the picture elsewhere, which blurs it."""

from __future__ import annotations

from dataclasses import replace

from torch import Tensor

from caustic_cli.optics.effects.base import Decision, Effect, Probe
from caustic_cli.scene import Disc, Scene
from caustic_cli.scene.sources.disc import SUN

#: Size of a disc, mm, that is measured where there is none nearby; of a far one it is the sun's angle.
SIZE = 1.0


class SourceSize(Effect):
    """Left out, the source is its middle."""

    name = "source-size"

    def decide(self, scene: Scene, bounds) -> Decision:
        """By the angle under which the lens sees a disc, or the number of points."""
        s, z_in = scene.source, scene.lens.z_in
        bound, limit = (float(len(s.points()[0])), 1.0) if s.several else (s.apparent_angle(z_in), 0.0)
        return Decision(self.name, s.extended, s.extent_words(z_in), bound, limit, present=s.extended)

    def without(self, scene: Scene) -> Scene:
        """From the middle of the source."""
        return replace(scene, source=scene.source.pointlike()) if scene.source.extended else scene

    def probe(self, scene: Scene, heights: Tensor) -> Probe:
        """The sun, or a small disc."""
        s = scene.source
        if s.distant:
            return Probe(replace(scene, source=Disc(power=s.power, angle=SUN)), None, f"{SUN} degrees")
        return Probe(replace(scene, source=Disc(s.centre, (SIZE, SIZE), s.power, s.cone)), None, f"{SIZE:g} mm")
