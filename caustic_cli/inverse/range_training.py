"""Training a network over ranges of the scene's values: the mean loss of the lenses for a few of them, drawn anew every iteration.

    L_t = 1/K sum over k of L(heights(v_k); scene at v_k),    v_1 .. v_K the values of iteration t (`Ranges.drawn`)

which is the stochastic gradient of the loss' mean over the ranges.  Rays are drawn anew, too, where they are random: a net finer
than the picture learns random rays by heart that stay the same, and the retraced error grows while the loss still falls.  Both
follow from seed and iteration alone, so that a resumed design draws the same.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np
import torch
from torch import Tensor

from caustic_cli.inverse.objective import Evaluation, Objective
from caustic_cli.inverse.optimisers import Adam
from caustic_cli.inverse.parametrisation import Heights
from caustic_cli.inverse.scene_parameters import Ranges
from caustic_cli.optics.emission import Rays
from caustic_cli.optics.sampling import stream
from caustic_cli.optics.system import EXIT
from caustic_cli.scene import Scene

#: Values an iteration: one in each quarter of every range.
BATCH = 4


class RangeObjective:
    """The mean loss of several lenses, each in the scene that it is for.

    Args:
        middle: the loss in the scene of the ranges' middle.
        ranges: what varies.
        rays: makes the rays of a scene by a seed.
        seed: of the values and the rays.
    """

    def __init__(self, middle: Objective, ranges: Ranges, rays: Callable[[Scene, int], Rays], seed: int):
        self.middle, self.ranges, self.rays, self.seed = middle, ranges, rays, seed
        self.loss = middle.loss

    def values(self, iteration: int) -> np.ndarray:
        """Those of an iteration, (BATCH, d) mm."""
        return self.ranges.drawn(self.seed, iteration, BATCH)

    def at(self, iteration: int) -> list[Objective]:
        """The loss at each of an iteration's values."""
        scenes = [self.ranges.scene(self.middle.scene, row) for row in self.values(iteration).tolist()]
        seeds = [stream(self.seed, f"rays {k} of iteration {iteration}") for k in range(BATCH)]
        return [self.middle.moved(scene, self.rays(scene, seed)) for scene, seed in zip(scenes, seeds, strict=True)]

    def __call__(self, heights: Tensor, iteration: int) -> Evaluation:
        """Mean loss, its gradient (k, n, m), mean light on the screen and mean image, of heights (k, n, m) mm for the values of an
        iteration."""
        found = [loss(z) for loss, z in zip(self.at(iteration), heights, strict=True)]
        loss, on_screen = (sum(getattr(e, name) for e in found) / len(found) for name in ("loss", "on_screen"))
        gradient = torch.stack([e.gradient for e in found]) / len(found)
        return Evaluation(loss, {EXIT: gradient}, on_screen, torch.stack([e.image for e in found]).mean(0))


class AdamOverRange(Adam):
    """Adam on the mean loss of the values that its iteration draws."""

    def __init__(self, objective: RangeObjective, heights: Heights, lr: float):
        super().__init__(objective.middle, heights, lr)
        self.over = objective

    def _judged(self) -> tuple[Tensor, Callable[[Tensor], Evaluation]]:
        z = self.heights(self.over.ranges.scaled(self.over.values(self.steps)))
        return z.expand(BATCH, *z.shape[-2:]), partial(self.over, iteration=self.steps)  # without inputs: one lens for all
