"""Stray light of an array with a source behind every lenslet: light of a source that enters another lenslet than its own."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from caustic_cli.optics.effects import NO_REQUESTS, Requests
from caustic_cli.optics.emission import Rays
from caustic_cli.optics.rays import RayState
from caustic_cli.optics.surfaces.heightfield import HeightField
from caustic_cli.optics.trace import expose
from caustic_cli.scene import Scene
from caustic_cli.scene.cells import Cells
from caustic_cli.studies.retrace import sampler_for


@dataclass(frozen=True, eq=False)
class _Beside:
    """The rays of a near source beside lenslet `own` of the pupil; those through it count as missing the lens."""

    rays: Rays
    cells: Cells
    own: int
    device: str | torch.device = "cpu"

    @property
    def count(self) -> int:
        """Number of rays."""
        return self.rays.count

    def chunks(self, size: int = 1 << 20) -> Iterator[RayState]:
        """As of an `Emission`."""
        for rays in self.rays.chunks(size):
            assert isinstance(rays, RayState)  # of all near sources
            own = self.cells.number(*map(torch.as_tensor, rays.origin[:2])) == self.own
            power = torch.where(own, torch.zeros_like(rays.power), rays.power)
            missed = rays.lost["missed_lens"] + float((rays.power - power).sum())
            yield replace(rays, power=power, lost={**rays.lost, "missed_lens": missed})


@torch.no_grad()
def stray_light(
    scene: Scene,
    field: HeightField,
    heights: Tensor,
    rays: int,
    seed: int = 0,
    device: str = "cpu",
    requests: Requests = NO_REQUESTS,
) -> tuple[float, float]:
    """Stray light on the array and on the screen, as fractions of the power of all sources.

    Args:
        scene: with a source behind every lenslet; heights: control net (n, m) of the array, mm.
        rays: of all sources; requests: of a plan.
    """
    lens, fallen, seen = scene.lens, [], []
    for k, (one, part) in enumerate(zip(scene.by_source, scene.source.fractions, strict=True)):
        whole = sampler_for(one, max(1, rays // math.prod(lens.array)), seed + k, device)
        light = _Beside(whole, lens.cells, k, device)
        image = expose(one, field, heights.to(device), light, None, torch.float64, requests=requests)
        fallen.append(part * (1.0 - image.lost["missed_lens"]))
        seen.append(part * float(image.image.sum()))
    return math.fsum(fallen), math.fsum(seen)
