"""Source extent: every source point forms a shifted picture, which blurs the image."""

from __future__ import annotations

from dataclasses import replace

from torch import Tensor

from caustic_cli.optics.effects.base import Decision, Effect, Probe
from caustic_cli.scene import Disc, Scene
from caustic_cli.scene.sources.section import SUN

#: Diameter of a near source for the measurement in a scene with a point source, mm; for a distant one it is the sun's angle.
SIZE = 1.0


class SourceSize(Effect):
    """Without it the source is a point at its centre."""

    name = "source-size"

    def decide(self, scene: Scene, bounds) -> Decision:
        """By the angle that the source subtends, or its number of points."""
        s, z_in = scene.source, scene.lens.z_in
        bound, limit = (float(len(s.points()[0])), 1.0) if s.several else (s.apparent_angle(z_in), 0.0)
        return Decision(self.name, s.extended, s.extent_words(z_in), bound, limit, present=s.extended)

    def without(self, scene: Scene) -> Scene:
        """With a point source or plane wave."""
        return replace(scene, source=scene.source.pointlike()) if scene.source.extended else scene

    def probe(self, scene: Scene, heights: Tensor) -> Probe:
        """The sun, or a small disc."""
        s = scene.source
        if s.distant:
            return Probe(replace(scene, source=Disc(power=s.power, angle=SUN, tilt=s.tilt)), None, f"{SUN} degrees")
        return Probe(replace(scene, source=Disc(s.centre, (SIZE, SIZE), s.power, s.cone)), None, f"{SIZE:g} mm")
