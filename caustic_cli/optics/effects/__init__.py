"""Physical effects, one file each; listed in the order in which they act on the light.

An effect is loaded when it is asked for: all of them by a plan, those that act on the rays of a system by its trace.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import cache
from importlib import import_module

from caustic_cli.optics.effects.base import NEGLIGIBLE, NO_REQUESTS, Action, Decision, Effect, Probe, Requests
from caustic_cli.optics.system import System

__all__ = ["EFFECTS", "NEGLIGIBLE", "NO_REQUESTS", "Action", "Decision", "Effect", "Probe", "Requests"]


class Effects:
    """All effects, in order.  An effect's name with underscores is that of its module, and in capitals that of its class."""

    names = (
        "source-size",
        "polarisation",
        "dispersion",
        "entrance",
        "gradient-index",
        "intersection",
        "missed-surface",
        "absorption",
        "roughness",
        "fresnel",
        "total-reflection",
        "mirror",
        "secondary-intersection",
        "ghosts",
        "screen-shape",
        "screen-tilt",
        "screen-shift",
        "diffraction",
    )

    def __iter__(self) -> Iterator[Effect]:
        return map(self.__getitem__, self.names)

    def __len__(self) -> int:
        return len(self.names)

    @cache  # noqa: B019  there is one registry
    def __getitem__(self, name: str) -> Effect:
        module = import_module(f"{__name__}.{name.replace('-', '_')}")
        return getattr(module, name.title().replace("-", ""))()

    def acting(self, system: System, requests: Requests) -> list[Effect]:
        """Those that a system asks for, or that are requested or omitted by request: no other acts on its rays."""
        named = system.effects | requests.on | requests.off
        return [self[name] for name in self.names if name in named]


EFFECTS = Effects()
