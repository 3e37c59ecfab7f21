"""Several free-form surfaces that are designed together: heights are (k, n, m), in the order of `Scene.free_surfaces`."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import torch
from torch import Tensor

from caustic_cli.inverse.mixture import Member, Mixture
from caustic_cli.inverse.objective import LossOfHeights
from caustic_cli.kinds.surface import OneSurface
from caustic_cli.optics.system import split_heights
from caustic_cli.scene import Scene


class SeveralSurfaces(OneSurface):
    """Several free-form surfaces."""

    refines_waves, has_others = False, True

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

    def objective_in(self, scene: Scene, k: int, initial: Tensor) -> LossOfHeights:
        if not self.stages[k].exit_alone:
            return self.together(scene, k, initial)
        fixed, exit = split_heights(scene, self.field(k), initial)
        return Mixture([Member(self.of_exit(fixed, k, exit), 1.0, 1.0, 1.0, where=(-1,))], 1.0)

    def together(self, scene: Scene, k: int, initial: Tensor) -> LossOfHeights:
        """The loss of stage k in a scene for heights of all surfaces near `initial`."""
        return super().objective_in(scene, k, initial)

    def of_exit(self, scene: Scene, k: int, initial: Tensor) -> LossOfHeights:
        """The same for heights of the exit (n, m) in a scene that contains the other surfaces."""
        return super().objective_in(scene, k, initial)

    def preview(self, heights: Tensor, size: int) -> Iterator[str]:
        yield from ()
