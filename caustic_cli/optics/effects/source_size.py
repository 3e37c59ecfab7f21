"""The source's extent: every point of it throws the picture elsewhere, which blurs it."""

from __future__ import annotations

from dataclasses import replace

from torch import Tensor

from caustic_cli.optics.effects.base import Amount, Effect, Verdict
from caustic_cli.scene import Disc, Scene

#: Amounts that are measured where there is none: the sun's angle, degrees; a disc's size, mm.
SUN, SIZE = 0.533, 1.0


class SourceSize(Effect):
    """Left out, the source is its middle."""

    name = "source-size"

    def judge(self, scene: Scene, bounds) -> Verdict:
        """By the angle under which the lens sees a disc, or the number of points."""
        s = scene.source
        if s.kind == "disc":
            angle = s.apparent_angle(scene.lens.z_in)
            return Verdict(self.name, angle > 0, f"the lens sees the source under {angle:.3g} degrees", angle, 0.0,
                           present=angle > 0)
        if s.several:
            count = len(s.points()[0])
            return Verdict(self.name, True, f"the source is {count} points", float(count), 1.0)
        why = "a plane wave has one direction" if s.collimated else "the source is a point"
        return Verdict(self.name, False, why, 0.0, 0.0, present=False)

    def without(self, scene: Scene) -> Scene:
        """From the middle of the source."""
        return replace(scene, source=scene.source.pointlike()) if scene.source.extended else scene

    def sample(self, scene: Scene, heights: Tensor) -> Amount:
        """The sun, or a small disc."""
        s = scene.source
        if s.collimated:
            return Amount(replace(scene, source=Disc(power=s.power, angle=SUN)), None, f"{SUN} degrees")
        cone = getattr(s, "cone", None) if s.kind != "disc" else None
        return Amount(replace(scene, source=Disc(s.centre, (SIZE, SIZE), s.power, cone)), None, f"{SIZE:g} mm")
