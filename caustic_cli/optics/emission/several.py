"""Sampling of several sources, with numbers of rays in proportion to their powers."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import torch

from caustic_cli.optics.emission.base import Illuminated
from caustic_cli.optics.rays import RayState
from caustic_cli.optics.sampling import Sample
from caustic_cli.scene import Pupil, Source


@dataclass(frozen=True, eq=False)
class SeveralRays:
    """Rays of several sources: members, the rays of each; fractions, of the total power of each."""

    members: tuple
    fractions: tuple[float, ...]
    device: str | torch.device = "cpu"

    @property
    def count(self) -> int:
        """Total number of rays."""
        return sum(one.count for one in self.members)

    def chunks(self, size: int = 1 << 20) -> Iterator[Sample | RayState]:
        """As of an `Emission`, source by source; powers and losses of all sum to 1."""
        for one, fraction in zip(self.members, self.fractions, strict=True):
            for rays in one.chunks(size):
                if isinstance(rays, Sample):
                    yield replace(rays, flux=fraction * rays.flux)
                else:
                    yield replace(rays, power=fraction * rays.power, lost={k: fraction * v for k, v in rays.lost.items()})


class _NoRays:
    """No rays at all."""

    count = 0

    def chunks(self, size: int = 1 << 20) -> Iterator[Sample | RayState]:
        """As of an `Emission`."""
        return iter(())


def of_one(rays: Any, number: int, source: Source) -> SeveralRays:
    """Rays of one of several sources, by its index, and none of the others."""
    members = tuple(rays if k == number else _NoRays() for k in range(len(source.members)))
    return SeveralRays(members, source.fractions, rays.device)


@dataclass(frozen=True)
class _Alone:
    """An illuminated pupil with one of several sources."""

    source: Source
    pupil: Pupil


def several(scene: Illuminated, kind: str, rays: int, seed: int = 0, device: str | torch.device = "cpu") -> SeveralRays:
    """About `rays` rays in total."""
    from caustic_cli.optics.emission import rays_of  # noqa: PLC0415  every way of drawing is registered there by now

    source = scene.source
    members = tuple(
        rays_of(_Alone(one, scene.pupil), kind, max(1, round(rays * fraction)), seed + k, device)
        for k, (one, fraction) in enumerate(zip(source.members, source.fractions, strict=True))
    )
    return SeveralRays(members, source.fractions, device)


EMISSIONS = {"several": several}
