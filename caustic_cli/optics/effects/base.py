"""What an effect is: why a scene calls for it or not, what it does to rays, how it is left out, and how its cost is measured.

A new effect is one file with a subclass of `Effect`, and its line in the registry of this package.  Most effects are either told
by the numbers of a scene (absorption: the coefficient), so that leaving them out is another scene, or by a request to the trace
(ghosts), which no number of a scene says.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, replace

from torch import Tensor

from caustic_cli.optics.bounds import Bounds
from caustic_cli.optics.interaction import Interaction, Parameters, RayTracer
from caustic_cli.optics.rays import RayState
from caustic_cli.optics.surfaces import SurfaceIntersection
from caustic_cli.optics.system import System
from caustic_cli.scene import Scene

#: Ghost light below this part of the source's power is left out: the other effects' own models are no better than that.
NEGLIGIBLE = 0.01


@dataclass(frozen=True)
class Decision:
    """What was decided of an effect in a scene.

    name: of the effect; on: whether it is simulated; why: one clause; bound, limit: the number that decides and what it is compared
    with, or None; fixed: without it there is no image of this scene; present: False where the scene has nothing of it.
    """

    name: str
    on: bool
    why: str
    bound: float | None = None
    limit: float | None = None
    fixed: bool = False
    present: bool = True


@dataclass(frozen=True)
class Requests:
    """What a trace is asked beyond what its system says: names of effects to simulate, and to leave out where they matter; and
    whether to go by stages even where a fused kernel does the same."""

    on: frozenset[str] = frozenset()
    off: frozenset[str] = frozenset()
    stages: bool = False

    @classmethod
    def to(cls, *on: str, without: tuple[str, ...] = (), stages: bool = False) -> Requests:
        """Requests by names."""
        return cls(frozenset(on), frozenset(without), stages)

    def __or__(self, other: Requests) -> Requests:
        """Both."""
        return Requests(self.on | other.on, self.off | other.off, self.stages or other.stages)


NO_REQUESTS = Requests()


@dataclass(frozen=True)
class Probe:
    """An amount of an effect at which a study measures it: the scene with it, the scene to compare it with (None: the same
    without it), and the amount in words."""

    scene: Scene
    baseline: Scene | None
    words: str


class Action:
    """What an effect does to rays in one trace; an `Interaction`'s fields are read and changed in place."""

    #: Whether `stray_light` adds light that goes another way.
    stray = False

    def intersect(self, interaction: Interaction, origin, direction, heights: Tensor | None) -> SurfaceIntersection | None:
        """Another way to meet the surface, from rays in its frame; None for the usual one."""
        return None

    def before_interaction(self, interaction: Interaction) -> None:
        """At the surface, before Snell's law."""

    def after_interaction(self, interaction: Interaction) -> None:
        """Behind the surface."""

    def stray_light(self, tracer: RayTracer, parameters: Parameters, interactions: list[Interaction]) -> list[RayState]:
        """Light behind the last element that has not gone straight on; takes it off the `interactions`' states and accounts."""
        return []


class Effect(ABC):
    """One effect; see the package for the sequence."""

    name: str
    #: It costs nothing that could be saved: a mask of every path, or an addend in a sum.
    free = False
    #: It is seen in the wave image alone.
    waves = False

    @abstractmethod
    def decide(self, scene: Scene, bounds: Bounds) -> Decision:
        """Whether a scene calls for it, and why."""

    def without(self, scene: Scene) -> Scene:
        """The scene with nothing of it."""
        return scene

    def including(self, scene: Scene) -> Scene:
        """The scene with it, where it was asked for."""
        return scene

    def request(self, scene: Scene, on: bool, bounds: Bounds) -> Requests:
        """What to ask of the trace for the effect to be on, or off."""
        return NO_REQUESTS

    def probe(self, scene: Scene, heights: Tensor) -> Probe | None:
        """An amount to measure in a scene that has nothing of it; None where there is none."""
        return None

    def prepare(self, system: System, rays: RayState, requests: Requests) -> RayState:
        """Rays of the source as the effect would have them."""
        return rays

    def action(self, system: System, requests: Requests) -> Action | None:
        """What it does to rays in a trace of this system; None for nothing."""
        return None


class GeneralRayEffect(Effect):
    """An effect that rays of a plane wave do not need, but can be put through; that others go through, unless it is left out."""

    def request(self, scene: Scene, on: bool, bounds: Bounds) -> Requests:
        """Of a plane wave, to go by the general way; of others, not to."""
        if on == scene.axial:
            return Requests.to(self.name) if on else Requests.to(without=(self.name,))
        return NO_REQUESTS

    def prepare(self, system: System, rays: RayState, requests: Requests) -> RayState:
        """A plane wave's rays as any others: they forget that they stand on a sample of the aperture."""
        if self.name not in requests.on:
            return rays
        rays = rays.expanded()
        return replace(rays, direction=rays.full(rays.direction), sample=None)
