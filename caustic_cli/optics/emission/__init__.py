"""Sampling of the rays of light sources, up to the pupil of the illuminated system (thesis 4.2, 4.3.1).

A source names its sampling method in `Source.emission`.  A new method is a module of this package with a dictionary EMISSIONS of
names and functions that sample about a given number of rays, usually `of_size` of a subclass of `Emission`; it is discovered
automatically.
"""

from __future__ import annotations

import pkgutil
from collections.abc import Callable
from functools import cache
from importlib import import_module
from typing import TYPE_CHECKING, TypeAlias, cast

import torch

from caustic_cli.errors import InputError
from caustic_cli.optics.emission.base import Emission, Illuminated
from caustic_cli.optics.sampling import Sampler

if TYPE_CHECKING:
    from caustic_cli.optics.emission.measured import MeasuredRays
    from caustic_cli.optics.emission.several import SeveralRays

__all__ = ["Emission", "Lit", "Rays", "of_member", "rays_of", "register"]

Rays: TypeAlias = "Sampler | Emission | MeasuredRays | SeveralRays"
#: Illuminated system, sampler, number of rays, seed, device -> rays.
Maker = Callable[[Illuminated, str, int, int, str | torch.device], Rays]


@cache
def _makers() -> dict[str, Maker]:
    """The registry, made when it is first asked for."""
    modules = [import_module(f"{__name__}.{found.name}") for found in pkgutil.iter_modules(__path__)]
    return {name: maker for module in modules for name, maker in getattr(module, "EMISSIONS", {}).items()}


def register(name: str, maker: Maker) -> None:
    """Add a sampling method to the registry."""
    _makers()[name] = maker


def rays_of(scene: Illuminated, kind: str, rays: int, seed: int = 0, device: str | torch.device = "cpu") -> Rays:
    """About `rays` rays of the source of a scene or system, at least one for each of its points.

    Raises:
        InputError: no sampling method is registered for the source, or the sampler is unknown.
    """
    name = scene.source.emission
    if name not in _makers():
        raise InputError(f"⟨source.type⟩ {scene.source.kind} has no rays: no emission is registered as {name!r}")
    return _makers()[name](scene, kind, rays, seed, device)


def of_member(rays: Rays, member: int | None) -> Rays:
    """The rays of one of several sources, by its index; all rays for None."""
    return rays if member is None else cast("SeveralRays", rays).members[member]
