"""The interface of physical effects: whether a scene needs one, its action on rays, its omission, and the measurement of its cost.

A new effect is one file with a subclass of `Effect` and a line in the registry of this package.  An effect is controlled either by
parameters of the scene (absorption: the coefficient), so that it is omitted by changing the scene, or by a request to the tracer
(ghosts).
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, replace
from typing import Any

from torch import Tensor

from caustic_cli.optics.interaction import Interaction, Parameters, RayTracer
from caustic_cli.optics.rays import RayState
from caustic_cli.optics.surfaces.base import SurfaceIntersection
from caustic_cli.optics.system import System
from caustic_cli.scene import Scene

#: Fraction of the source's power below which stray light is neglected: the models of other effects are no more accurate.
NEGLIGIBLE = 0.01


@dataclass(frozen=True)
class ExitBounds:
    """Bounds over all rays at the exit surface."""

    #: Of the surface.
    slope: float
    #: n sin i, below 1 there is no total internal reflection.
    critical: float
    #: Slope bound times the tangent of the exit ray's angle, below 1 there is no secondary intersection.
    slope_ratio: float
    #: Distance of rays from the axis at the greatest height, in half widths of the aperture.
    reach: float


@dataclass(frozen=True)
class Bounds:
    """Bounds over all rays; see `optics.bounds`.  Angles in rad, slopes dimensionless, heights in mm."""

    #: Angle of rays to z in front of and behind the entrance.
    incidence: float
    inside: float
    exit: ExitBounds
    #: Largest over all wavelengths.
    index: float
    #: Of the glass, mm.
    depth: float
    #: Fraction of the power that is reflected twice inside; estimate of the relative RMS that this light adds to the image, see
    #: `bounds.ghost_error`.
    ghost: float
    ghost_error: float
    #: For unpolarised light, the change of the exit's reflectance by the polarisation acquired at the entrance.
    polarised: float
    #: Limit set by diffraction, source and pixels: a `resolution.Resolution`, which a trace finds.
    resolution: Any


@dataclass(frozen=True)
class Decision:
    """The decision on an effect in a scene."""

    #: Of the effect.
    name: str
    #: Whether it is simulated.
    on: bool
    #: The reason, a clause.
    why: str
    #: The deciding quantity and the value that it is compared with, or None.
    bound: float | None = None
    limit: float | None = None
    #: Whether the effect cannot be switched.
    fixed: bool = False
    #: False if the scene has no such effect at all.
    present: bool = True


@dataclass(frozen=True)
class Requests:
    """Requests to a tracer beyond its system: names of effects to simulate, and to omit although the system has them; and whether
    to use the stages even where a fused kernel is equivalent."""

    on: frozenset[str] = frozenset()
    off: frozenset[str] = frozenset()
    stages: bool = False

    @classmethod
    def to(cls, *on: str, without: tuple[str, ...] = (), stages: bool = False) -> Requests:
        """Requests by names."""
        return cls(frozenset(on), frozenset(without), stages)

    def __or__(self, other: Requests) -> Requests:
        """The union of both."""
        return Requests(self.on | other.on, self.off | other.off, self.stages or other.stages)


NO_REQUESTS = Requests()


@dataclass(frozen=True)
class Probe:
    """A scene for the measurement of an effect: the scene with it, the scene to compare with (None: the same without the effect),
    and the magnitude in words."""

    scene: Scene
    baseline: Scene | None
    words: str


class Action:
    """The action of an effect on rays in one trace; it reads and modifies the fields of an `Interaction` in place."""

    #: Whether `stray_light` adds rays.
    stray = False

    def intersect(self, interaction: Interaction, origin, direction, heights: Tensor | None) -> SurfaceIntersection | None:
        """Intersection with the surface in place of the usual one, from rays in its frame; None for the usual one."""
        return None

    def before_interaction(self, interaction: Interaction) -> None:
        """Called at the surface, before refraction or reflection."""

    def after_interaction(self, interaction: Interaction) -> None:
        """Called behind the surface, after refraction or reflection."""

    def stray_light(self, tracer: RayTracer, parameters: Parameters, interactions: list[Interaction]) -> list[RayState]:
        """Stray light behind the last element; it is subtracted from the states and losses of `interactions`."""
        return []


class Effect(ABC):
    """A physical effect."""

    name: str
    #: Whether omitting it saves no time.
    free = False
    #: Whether it affects the wave image only.
    waves = False
    #: Whether it is one of glass, which a mirror does not have.
    of_glass = False

    @abstractmethod
    def decide(self, scene: Scene, bounds: Bounds) -> Decision:
        """Whether a scene needs the effect, and why; not asked where its lens or mirror lacks it."""

    def without(self, scene: Scene) -> Scene:
        """The scene without the effect."""
        return scene

    def including(self, scene: Scene) -> Scene:
        """The scene with the effect, on request."""
        return scene

    def request(self, scene: Scene, on: bool, bounds: Bounds) -> Requests:
        """Requests to the tracer that switch the effect on or off."""
        return NO_REQUESTS

    def probe(self, scene: Scene, heights: Tensor) -> Probe | None:
        """A scene for the measurement of the effect where `scene` has none of it; None if there is no such scene."""
        return None

    def prepare(self, system: System, rays: RayState, requests: Requests) -> RayState:
        """The source's rays, modified by the effect."""
        return rays

    def action(self, system: System, requests: Requests) -> Action | None:
        """Its action in a trace of this system; None if there is none."""
        return None


class GeneralRayEffect(Effect):
    """An effect that axial plane waves do not need but that can be simulated for them on request; other rays always need it."""

    def request(self, scene: Scene, on: bool, bounds: Bounds) -> Requests:
        """For an axial plane wave a request to simulate it, for other light a request to omit it."""
        if on == scene.axial:
            return Requests.to(self.name) if on else Requests.to(without=(self.name,))
        return NO_REQUESTS

    def prepare(self, system: System, rays: RayState, requests: Requests) -> RayState:
        """On request, the rays of a plane wave as general rays, without their sample of the aperture."""
        if self.name not in requests.on:
            return rays
        rays = rays.expanded()
        return replace(rays, direction=rays.full(rays.direction), sample=None)
