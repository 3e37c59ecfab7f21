"""Several free-form surfaces that are designed together: heights are (k, n, m), in the order of `Scene.free_surfaces`."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import torch
from torch import Tensor

from caustic_cli.kinds.surface import OneSurface


class SeveralSurfaces(OneSurface):
    """Several free-form surfaces."""

    refines_waves = False

    @property
    def half_sizes(self) -> list[tuple[float, float]]:
        """Half sizes of the surfaces, mm."""
        raise NotImplementedError

    def feasible(self, k: int, heights: Tensor, rounded: bool = True) -> Tensor:
        field, sides = self.field(k), [1] * len(heights)
        for n, name in enumerate(self.scene.free_surfaces[:-1]):
            sides[n] = -1 if name.endswith(("entrance", "front")) else 1  # from outside the glass
        sides[-1] = self.scene.lens.cut_from
        return torch.stack(
            [
                self.options.limits.feasible(replace(field, half_size=half), net, (low, high), side, rounded)
                for half, net, low, high, side in zip(self.half_sizes, heights, *self.bounds(k), sides, strict=True)
            ]
        )

    def preview(self, heights: Tensor, size: int) -> Iterator[str]:
        yield from ()
