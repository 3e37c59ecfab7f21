"""Stochastic training of a network over ranges of scene parameters: a mini-batch of parameter values is drawn at every iteration.

    L_t = 1/K sum over k of L(heights(v_k); scene at v_k),    v_1 .. v_K the values of iteration t (`Ranges.sampled`)

whose gradient is an unbiased estimate of that of the mean loss over the ranges.  Random rays are also drawn anew: a control net
finer than the picture overfits a fixed set of random rays, so that the retraced error grows while the loss still falls.  Both draws
are a function of the seed and the iteration, so that a resumed design repeats them.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np
from torch import Tensor

from caustic_cli.inverse.mixture import Member, Mixture
from caustic_cli.inverse.objective import Evaluation, Objective
from caustic_cli.inverse.optimisers import Adam
from caustic_cli.inverse.parametrisation import Heights
from caustic_cli.inverse.scene_parameters import Ranges
from caustic_cli.optics.emission import Rays
from caustic_cli.optics.sampling import stream
from caustic_cli.scene import Scene

#: Size of the mini-batch: one value in each quarter of every range.
BATCH = 4


class RangeObjective:
    """The mean loss over a mini-batch of lenses, each in the scene with its own parameter values.

    Args:
        middle: the loss in the scene at the middle of the ranges.
        ranges: of the scene parameters.
        rays: samples the rays of a scene from a seed.
        seed: of the parameter values and the rays.
    """

    def __init__(self, middle: Objective, ranges: Ranges, rays: Callable[[Scene, int], Rays], seed: int):
        self.middle, self.ranges, self.rays, self.seed = middle, ranges, rays, seed
        self.loss = middle.loss

    def values(self, iteration: int) -> np.ndarray:
        """Parameter values of an iteration, (BATCH, d) mm."""
        return self.ranges.sampled(self.seed, iteration, BATCH)

    def at(self, iteration: int) -> list[Objective]:
        """The losses at the parameter values of an iteration."""
        scenes = [self.ranges.scene(self.middle.scene, row) for row in self.values(iteration).tolist()]
        seeds = [stream(self.seed, f"rays {k} of iteration {iteration}") for k in range(BATCH)]
        return [self.middle.moved(scene, self.rays(scene, seed)) for scene, seed in zip(scenes, seeds, strict=True)]

    def __call__(self, heights: Tensor, iteration: int = 0) -> Evaluation:
        """Mean loss, its gradient (k, n, m), mean fraction of the light on the screen and mean image, of heights (k, n, m) mm at
        the parameter values of an iteration."""
        part = 1.0 / BATCH
        return Mixture([Member(one, part, part, part, (k,)) for k, one in enumerate(self.at(iteration))], 1.0)(heights)


class RangeAdam(Adam):
    """Adam on the mean loss over the mini-batch of its iteration."""

    def __init__(self, objective: RangeObjective, heights: Heights, lr: float):
        super().__init__(objective.middle, heights, lr)
        self.over = objective

    def _objective_here(self) -> tuple[Tensor, Callable[[Tensor], Evaluation]]:
        z = self.heights(self.over.ranges.scaled(self.over.values(self.steps)))
        return z.expand(BATCH, *z.shape[-2:]), partial(self.over, iteration=self.steps)  # without inputs: one lens for all
