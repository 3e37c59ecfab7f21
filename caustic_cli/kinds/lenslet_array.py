"""An array of lenslets, which all throw the picture, or one of a sheet each, onto the same screen."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from caustic_cli.config.default_stages import Table, each_lenslet, more_by_lenslets
from caustic_cli.config.exclusions import refuse_excluded
from caustic_cli.config.settings import Settings
from caustic_cli.errors import InputError
from caustic_cli.inverse.initial_surface import COARSE, InitialSurface
from caustic_cli.inverse.lenslets import array_objective, initial_array, lenslets
from caustic_cli.inverse.objective import LossOfHeights
from caustic_cli.inverse.target import grey
from caustic_cli.kinds.defaults import Defaults
from caustic_cli.kinds.surface import Described, OneSurface
from caustic_cli.scene import Scene
from caustic_cli.scene.lens import array_control
from caustic_cli.scene.packing import cells_of


class LensletArray(OneSurface):
    """An array of lenslets.

    Args:
        targets: (n_x, n_y) targets of the lenslets, j fastest; one for all is `target`.
    """

    def __init__(self, *args: Any, targets: Sequence[Tensor] = (), **more: Any):
        self.targets = list(targets)
        super().__init__(*args, **more)

    @classmethod
    def applies(cls, s: Settings) -> bool:
        return max(s.lens.array) > 1

    @classmethod
    def further(cls, described: Described, scene: Scene) -> dict[str, Any]:
        targets = [torch.from_numpy(target) for target in described.targets(scene)]
        return {"targets": targets if len(targets) > 1 else []} | super().further(described, scene)

    @classmethod
    def refuse_settings(cls, d: Defaults) -> None:
        super().refuse_settings(d)
        refuse_excluded("lens.array", d.s)

    @classmethod
    def fine_net(cls, d: Defaults) -> bool:
        return True  # lenslets need a transport start

    @classmethod
    def exact_start(cls, d: Defaults) -> bool:
        return d.plain and d.design.start != "offset"

    @classmethod
    def complete_control(cls, d: Defaults) -> None:
        super().complete_control(d)
        control, fits = d.lens.control, cls.fitting(d)
        if d.own_control and fits != list(control):
            raise InputError(
                "⟨lens.control⟩ of an array must be lenslets times (spans + degree - 1) and one more along each axis, such as"
                f" {fits[0]} x {fits[1]}, got {control[0]} x {control[1]}"
            )
        d.set_control(fits)

    @classmethod
    def default_control(cls, d: Defaults) -> list[int]:
        """For each lenslet that of one lens; with a source each the noise of its few rays would be fitted by so many points."""
        found = super().default_control(d)
        return found if cls.by_lenslets(d) else [k * (n - 1) + 1 for n, k in zip(found, d.lens.array, strict=True)]

    @classmethod
    def fitting(cls, d: Defaults) -> list[int]:
        """The control net next to that set so far that lenslets share."""
        pieces = cls.pieces(d)
        return [array_control(n, p, k) if k > 1 else n for n, p, k in zip(d.lens.control, d.lens.degree, pieces, strict=True)]

    @staticmethod
    def pieces(d: Defaults) -> tuple[int, int]:
        """Pieces of the spline along x and y between which the borders of lenslets are."""
        return cells_of(d.lens.packing, d.lens.array, d.lens.size).pieces

    @classmethod
    def known_to_transport(cls, d: Defaults) -> bool:
        """Not the borders of hexagonal lenslets, which cross knot spans, nor what smooth pictures lack on few cells."""
        return super().known_to_transport(d) and super().has_creases(d) and d.lens.packing == "square"

    @classmethod
    def has_creases(cls, d: Defaults) -> bool:
        return True  # at the borders of lenslets, and each of them has few knot spans

    @classmethod
    def least_rays(cls, d: Defaults) -> int:
        """One for each knot span, so that nothing hides between rays; stages by lenslets have more of them than others."""
        return math.prod(d.lens.control) // (more_by_lenslets(d.lens.array) if cls.by_lenslets(d) else 1)

    @classmethod
    def creased(cls, d: Defaults, waves: list[Table]) -> bool:
        blurred = d.source.by_lenslet and max(d.source.extent) > 0  # so near that creases are smooth whatever the net
        return not blurred and super().creased(d, waves)

    @classmethod
    def by_lenslets(cls, d: Defaults) -> bool:
        """Whether stages compare every lenslet with its own picture, or in the light of its own source: few of that source's rays
        over the whole array would meet it."""
        return d.s.target.sheet or d.s.source.each

    @classmethod
    def spread(cls, d: Defaults) -> bool:
        return super().spread(d) and not cls.by_lenslets(d)

    @classmethod
    def default_stages(cls, d: Defaults, waves: list[Table]) -> list[Table]:
        stages = cls.refinement(d, cls.creased(d, waves))
        if cls.by_lenslets(d):
            stages = each_lenslet(stages, d.lens.array, d.resolution)
        return stages

    def notes(self, size: tuple[float, float], timed: bool, without_waves: str) -> Iterator[str]:
        yield from super().notes(size, timed, without_waves)
        lens, screen, source = self.scene.lens, self.scene.screen, self.scene.source
        if source.beam is not None and not source.extended:
            distance, pitch = abs(screen.z - lens.offset.thickness), min(lens.cells.pitch)
            fringes = 1e-6 * self.scene.light.mean * distance / pitch
            yield (
                f"the light of lenslets side by side interferes, in fringes of {fringes:.2g} {screen.unit}, pixels being"
                f" {max(screen.pixel):.2g}: a design by rays is that of their mean, which light of a shorter coherence shows"
            )

    def takes_lenslets(self, k: int) -> bool:
        return not (self.stages[k].waves or self.stages[k].spread)

    def objective_in(self, scene: Scene, k: int, initial: Tensor) -> LossOfHeights:
        stage = self.stages[k]
        if not stage.lenslets:
            return super().objective_in(scene, k, initial)
        parts = lenslets(self.lit(scene, k), stage.control)
        targets, rays = self.targets or [self.target] * len(parts), max(1, stage.rays // len(parts))
        return array_objective(parts, lambda n, lenslet: self.on_rays(lenslet.scene, k, lenslet.field, targets[n], rays))

    def solved(self, scene: Scene, goal: np.ndarray, cells: int, fixed: bool, seconds: float) -> InitialSurface:
        goals = [grey(target.numpy()) for target in self.targets] or [goal]
        most, least = max(scene.lens.array), self.effort.lenslet_cells
        each = max(least, cells // most)
        # the cells of all are at most as many as of one lens, and maps are evaluated on finer ones: directly solved, they err more
        coarse = max(least, min(2 * COARSE // most, (each - 1) // 2))
        return InitialSurface(initial_array(scene, goals, self.stages[0].control, each, coarse).heights)
