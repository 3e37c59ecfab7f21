"""Several free-form surfaces that are designed together: heights are (k, n, m), in the order of `Scene.free_surfaces`.

On rays all of them are refined, on the wave image the exit alone, beside the others as they are: the field is that on the exit.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import torch
from torch import Tensor

from caustic_cli.inverse.mixture import Member, Mixture
from caustic_cli.inverse.objective import LossOfHeights
from caustic_cli.kinds.surface import OneSurface
from caustic_cli.optics.system import split_heights
from caustic_cli.scene import Scene, Screen


class SeveralSurfaces(OneSurface):
    """Several free-form surfaces."""

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

    def takes_waves(self, scene: Scene, k: int, initial: Tensor) -> bool:
        """As of one surface: stages on rays are not left out, by which alone the others are refined."""
        return False

    def objective_in(self, scene: Scene, k: int, initial: Tensor) -> LossOfHeights:
        if self.stages[k].waves:
            return self.exit_on_waves(self.lit(scene, k), k, initial)
        return super().objective_in(scene, k, initial)

    def exit_on_waves(self, scene: Scene, k: int, initial: Tensor) -> LossOfHeights:
        """The loss of the exit alone on the wave images of all pictures, beside the other surfaces as they are.

        Raises:
            Skipped, NoWaveImage: as of `on_waves`.
        """
        beside, exit = split_heights(scene, self.field(k), initial)
        seen = self.pictures(beside)
        part = 1.0 / len(seen)
        members = [
            Member(self.on_waves(beside.onto(screen), k, exit, target), part, part, float(not n), where=(-1,))
            for n, (screen, target) in enumerate(seen)
        ]
        return Mixture(members, 2.0)

    def pictures(self, scene: Scene) -> list[tuple[Screen, Tensor]]:
        """The screens of a scene and the target on each."""
        return [(scene.screen, self.target)]
