"""A lens among other lenses and mirrors, of which some may have free-form surfaces that are designed together with it."""

from __future__ import annotations

from collections.abc import Iterator

import torch
from torch import Tensor

from caustic_cli.config.settings import Settings
from caustic_cli.errors import InputError
from caustic_cli.inverse.initial_surface import departure_bound, sphere_net
from caustic_cli.kinds.defaults import Defaults
from caustic_cli.kinds.several_surfaces import SeveralSurfaces
from caustic_cli.kinds.surface import OneSurface
from caustic_cli.optics.resolution import Resolution


class AmongElements(OneSurface):
    """The lens' exit, among other elements."""

    @classmethod
    def applies(cls, s: Settings) -> bool:
        return bool(s.elements)

    def _bounds(self, k: int) -> tuple[Tensor, Tensor]:
        low, high = super()._bounds(k)
        ahead = [e.extent[0] for e in self.scene.behind[:1]]
        if ahead and high.max() >= ahead[0]:
            raise InputError(
                f"⟨element.z⟩ of the element behind the lens must lie beyond {high.max():.4g} mm, which the lens' surface may"
                f" reach, got a body from {ahead[0]:.4g} mm on"
            )
        return low, high

    @property
    def _folded(self) -> bool:
        """Whether the other elements only fold the axis."""
        return not self.scene.unfolded.elements

    def refuse_unreachable(self) -> None:
        """Behind elements that do more than fold the axis, the transport says what it cannot reach."""
        if self._folded:
            super().refuse_unreachable()

    def resolution_notes(self, seen: Resolution) -> Iterator[str]:
        """But for an extended source behind elements in front of the lens, which change how wide it looks from there."""
        if not (self.scene.in_front and self.scene.source.extended):
            yield from super().resolution_notes(seen)


class FreeElements(SeveralSurfaces, AmongElements):
    """The lens' exit and free surfaces of other elements."""

    @classmethod
    def applies(cls, s: Settings) -> bool:
        return any(element.free != "none" for element in s.elements)

    @classmethod
    def known_to_transport(cls, d: Defaults) -> bool:
        return False

    @property
    def half_sizes(self) -> list[tuple[float, float]]:
        return [*(e.half_size for e in self.scene.elements for _ in e.free_sides), self.scene.lens.half_size]

    def _spheres(self) -> list[Tensor]:
        """Heights of the initial spheres of the other designed surfaces on the control net of the first stage."""
        return [sphere_net(e, side, self.field(0)) for e in self.scene.elements for side in e.free_sides]

    def all_surfaces(self, heights: Tensor) -> Tensor:
        return heights if heights.ndim == 3 else torch.stack([*self._spheres(), heights])

    def _bounds(self, k: int) -> tuple[Tensor, Tensor]:
        low, high = super()._bounds(k)
        nets, rooms = [], []
        for e in self.scene.elements:
            nets += [sphere_net(e, side, self.field(k)) for side in e.free_sides]
            rooms += [departure_bound(e, self.scene.lens)] * len(e.free_sides)
        low = torch.stack([*(net - room for net, room in zip(nets, rooms, strict=True)), low])
        high = torch.stack([*(net + room for net, room in zip(nets, rooms, strict=True)), high])
        return low, high
