"""Rays on the screen's plane, what was lost on the way, and the image they make together."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum

from torch import Tensor

from caustic_cli.optics.reconstruction import Filter, splat
from caustic_cli.scene import Screen

LOSSES = ("missed_lens", "missed_surface", "total_internal_reflection", "fresnel", "absorbed", "off_screen")


class Status(IntEnum):
    """What became of a ray before the screen."""

    OK = 0
    TOTAL_INTERNAL_REFLECTION = 1
    AWAY_FROM_SCREEN = 2
    MISSED_SURFACE = 3


@dataclass(frozen=True)
class Landing:
    """Rays on the screen's plane.

    x, y (shape of the sample) mm; weight, the power each carries (0 where lost); status, a `Status` a ray;
    lost, the power lost on the way, by name; leaving, the power that left the lens.
    """

    x: Tensor
    y: Tensor
    weight: Tensor
    status: Tensor
    lost: dict[str, Tensor]
    leaving: Tensor


@dataclass(frozen=True)
class Part:
    """What some rays contribute: image (n_x, n_y) and leaving (), differentiable; lost by name, not differentiable."""

    image: Tensor
    leaving: Tensor
    lost: dict[str, Tensor]


def collect(landing: Landing, screen: Screen, filter: Filter) -> Part:
    """The image of rays that have landed."""
    image, off = splat(landing.x, landing.y, landing.weight, screen, filter)
    return Part(image, landing.leaving, {**landing.lost, "off_screen": landing.lost["off_screen"] + off})
