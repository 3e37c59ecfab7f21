"""Gradient index: curved rays inside the lens (thesis 7.2.1)."""

from __future__ import annotations

import math
from dataclasses import replace

from torch import Tensor

from caustic_cli.optics.effects.base import Decision, Effect, Probe
from caustic_cli.optics.gradient.fields import index_field_of
from caustic_cli.scene import Scene
from caustic_cli.scene.gradient import Gradient

#: Displacement on the screen, in pixels, below which the curvature of rays is neglected.
UNSEEN = 0.05
#: Deflection of a marginal ray, rad, for the measurement in a scene without a gradient.
TURN = 0.01


class GradientIndex(Effect):
    """Without it the lens is homogeneous."""

    name = "gradient-index"
    of_glass = True

    def decide(self, scene: Scene, bounds) -> Decision:
        """By a bound of the displacement on the screen due to the curvature of rays and to the deviation of the index.

        Over t mm a ray is deflected by at most t |grad n| / n inside, and by n times that behind the exit.
        """
        lens, field = scene.lens, index_field_of(scene.lens)
        if field is None:
            return Decision(self.name, False, "the lens has a homogeneous index", 0.0, UNSEEN, present=False)
        least, most, steepest = field.extremes(lens.half_size, bounds.depth)
        turn = min(steepest * bounds.depth * most / least, 0.5 * math.pi)
        moved = turn * (bounds.depth / (2.0 * least) + scene.screen.z - lens.offset.thickness) / min(scene.screen.pixel)
        step = (max(most - lens.index, lens.index - least) / lens.index) * bounds.exit.slope
        moved += step * (scene.screen.z - lens.offset.thickness) / min(scene.screen.pixel)
        why = (
            f"the index goes from {least:.5g} to {most:.5g}, by up to {steepest:.3g} per mm, which moves light by up to"
            f" {moved:.3g} pixels"
        )
        return Decision(self.name, moved > UNSEEN, why, moved, UNSEEN)

    def without(self, scene: Scene) -> Scene:
        """With a homogeneous lens."""
        return scene if scene.lens.gradient is None else replace(scene, lens=replace(scene.lens, gradient=None))

    def probe(self, scene: Scene, heights: Tensor) -> Probe | None:
        """A weak radial gradient with the index decreasing towards the edge."""
        lens = scene.lens
        depth, edge = lens.offset.thickness - lens.z_in, min(lens.half_size)
        if not depth > 0:
            return None
        gradient = Gradient("radial", (-TURN / (2.0 * depth * edge),))
        return Probe(replace(scene, lens=replace(lens, gradient=gradient)), None, f"{TURN:g} rad at the edge")
