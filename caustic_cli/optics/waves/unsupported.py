"""Scenes without a wave image, and why: the one table of them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from caustic_cli.errors import CausticError, InputError
from caustic_cli.optics.receiver import Receiver, dot
from caustic_cli.optics.system import PlacedScreen, System
from caustic_cli.scene import Scene, Screen, features
from caustic_cli.scene.features import FEATURES

#: Least cosine between a screen's normal and the axis: near grazing incidence off-axis light is parallel to the screen.
LEAST_COSINE = 0.08


class NoWaveImage(CausticError):
    """The wave image of a scene is undefined, or cannot be computed."""


@dataclass(frozen=True)
class Limit:
    """A trait of scenes that have no wave image."""

    #: Whether a scene has it.
    present: Callable[[Scene], bool]
    #: Why there is no wave image then, a clause; and what to add to it for one that was asked for.
    why: str
    more: str = ""
    #: Whether it is what is implemented that ends there, so that the effect cannot be asked for.
    fixed: bool = False

    def refusal(self) -> NoWaveImage:
        """The error for a wave image that was asked for."""
        return NoWaveImage(self.why + self.more)


RAY_FILE = Limit(lambda s: s.source.rays is not None, "a ray file contains no phase", ", so that it has no wave image")
CURVED = Limit(FEATURES[features.CURVED], "a curved screen has no wave image", ": the field is taken on planes")
GRADIENT = Limit(FEATURES[features.GRADIENT], "wave images are implemented for homogeneous lenses only", fixed=True)
ELEMENTS = Limit(FEATURES[features.ELEMENTS], "wave images are implemented for a single lens only", fixed=True)
LIMITS = (RAY_FILE, CURVED, GRADIENT, ELEMENTS)


def limit_of(scene: Scene) -> Limit | None:
    """The first trait of a scene for which it has no wave image; None if there is none."""
    return next((limit for limit in LIMITS if limit.present(scene)), None)


def receiver_of(system: System, screen: Screen | PlacedScreen) -> Receiver:
    """The receiver of a system's light for a wave image.

    Raises:
        InputError: it is nearly parallel to the axis.
        NoWaveImage: it is curved, or the rays are those of a file.
    """
    if system.source.rays is not None:
        raise RAY_FILE.refusal()
    found = Receiver.of(system, screen)
    if found.screen.curved:
        raise CURVED.refusal()
    if abs(dot(found.axes[2], found.axis)) < LEAST_COSINE:
        raise InputError("⟨screen.tilt⟩ makes the screen nearly parallel to the light, where there is no wave image")
    return found
