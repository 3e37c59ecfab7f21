"""Rays of one mode of a source on a regular grid of the pupil."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import torch

from caustic_cli.optics.emission.base import Emission
from caustic_cli.optics.emission.coherent import Mode
from caustic_cli.optics.rays import RayState

#: Offsets between successive grids, in cells: the additive recurrence of Roberts' R2 sequence.
SHIFTS = (0.7548776662466927, 0.5698402909980532)


@dataclass(frozen=True, eq=False)
class RegularGrid(Emission):
    """Rays through the points of a regular grid on the pupil, offset by a fraction of a cell."""

    #: The source point.
    mode: Mode | None = None
    #: Of the grid, which determines the offset.
    number: int = 0

    @classmethod
    def of_modes(cls, modes: list[Mode], rays: int, device: str | torch.device = "cpu") -> list[RegularGrid]:
        """Grids for all modes, about `rays` rays in total."""
        scene = modes[0].scene
        base = cls.of_size(scene, "grid", max(1, rays // len(modes)), 0, device)
        return [replace(base, mode=mode, number=k) for k, mode in enumerate(modes)]

    @property
    def count(self) -> int:
        """Number of rays."""
        return self.shape[0] * self.shape[1]

    def chunks(self, size: int = 1 << 20) -> Iterator[RayState]:
        """As of an `Emission`; powers sum to the mode's power on the pupil within the accuracy of the quadrature."""
        assert self.mode is not None
        (nu, nv), pupil = self.shape, self.scene.pupil
        shift = [(0.5 + self.number * s) % 1.0 for s in SHIFTS]
        cell = 4.0 * pupil.half_size[0] * pupil.half_size[1] / self.count
        for start in range(0, self.count, size):
            k = torch.arange(start, min(start + size, self.count), device=self.device)
            u, v = ((i.double() + s) / n for i, s, n in zip((k // nv, k % nv), shift, (nu, nv), strict=True))
            state = self.mode.through(u, v)
            power = torch.as_tensor(state.power) * cell
            power = torch.where(pupil.aperture.covers(2.0 * u - 1.0, 2.0 * v - 1.0), power, torch.zeros_like(power))
            yield replace(state, power=power)
