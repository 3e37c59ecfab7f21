"""What all rays have in common that are drawn inside the lens' flat entrance (thesis 4.2, 4.3.1).

Nothing here depends on the heights, so a design does it once.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from typing import ClassVar

import torch
from torch import Tensor

from caustic_cli.errors import InputError
from caustic_cli.optics.bundle import Bundle
from caustic_cli.optics.sampling import SAMPLERS, numbers
from caustic_cli.scene import Scene


@dataclass(frozen=True, eq=False)
class Emission:
    """All rays of a source that is not collimated; a class of its own says how they are drawn.

    Args:
        scene: its source is of the kind that the class draws.
        kind: sampler, one of `sampling.SAMPLERS`.
        shape: cells (nu, nv) for each of its points, or for a distant source; every one sends out as many rays.
        seed, device: as of a `Sampler`.

    dimensions: numbers in [0, 1] that a ray is drawn from; the first two fill the cells.
    """

    scene: Scene
    kind: str
    shape: tuple[int, int]
    seed: int = 0
    device: str | torch.device = "cpu"

    dimensions: ClassVar[int] = 2

    def __post_init__(self):
        if self.kind not in SAMPLERS:
            raise InputError(f"sampler must be one of {', '.join(SAMPLERS)}, got {self.kind!r}")

    @classmethod
    def of_size(cls, scene: Scene, kind: str, rays: int, seed: int = 0, device: str | torch.device = "cpu") -> Emission:
        """About `rays` rays in cells as nearly square as whole numbers allow, at least one for each of its points."""
        aspect, each = scene.lens.size[0] / scene.lens.size[1], max(1, round(rays / _starts(scene)))
        nu = max(1, min(each, round(math.sqrt(each * aspect))))
        return cls(scene, kind, (nu, max(1, round(each / nu))), seed, device)

    @cached_property
    def count(self) -> int:
        """Number of rays."""
        return self.shape[0] * self.shape[1] * _starts(self.scene)

    def through(self, scene: Scene) -> Emission:
        """The same rays as another scene refracts them: of its own index and polarisation."""
        return self if scene is self.scene else replace(self, scene=scene)

    def chunks(self, size: int = 1 << 20, first: int = 0, step: int = 1) -> Iterator[Bundle]:
        """The rays in order, at most `size` at a time; their shares and what they lost sum to 1 over all chunks.

        With `step`, only every step-th chunk from number `first` on: the part of one of several processes.
        """
        for start in range(first * size, self.count, step * size):
            stop = min(start + size, self.count)
            yield self._bundle(start, *numbers(self.kind, self.shape, self.seed, self.dimensions, start, stop, self.device))

    def _bundle(self, start: int, *draws: Tensor) -> Bundle:
        """Rays from number `start` on, one for each of the draws: `dimensions` tensors (N,)."""
        raise NotImplementedError


def _starts(scene: Scene) -> int:
    """Positions of the source; a distant one counts as one."""
    return max(1, len(scene.source.points()[0]))
