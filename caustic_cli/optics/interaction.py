"""The interaction of rays with one element: the state that effects read and modify."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Protocol

from torch import Tensor

from caustic_cli.optics.frames import rotate_to_global
from caustic_cli.optics.interface import OutgoingRays
from caustic_cli.optics.media import Medium
from caustic_cli.optics.rays import Hit, RayState
from caustic_cli.optics.system import System

#: Control heights (n, m), mm, by the name of the element.
Parameters = Mapping[str, Tensor]


class RayTracer(Protocol):
    """The interface of `trace.Tracer` that effects use.

    system: the system traced; media: in front of each element and behind the last; sides: from which the axis reaches each
    element.
    """

    system: System
    media: tuple[Medium, ...]
    sides: tuple[float, ...]

    @property
    def start(self) -> RayState:
        """The rays at the first free surface."""

    @property
    def backend(self) -> Any:
        """Implementation of the stages."""

    def trace_element(
        self,
        k: int,
        state: RayState,
        heights: Tensor | None,
        *,
        forward: bool = True,
        direct: bool = True,
        parameters: Parameters = ...,
    ) -> Interaction:
        """Trace rays to element k and through it; see `trace.Tracer.trace_element`."""


@dataclass
class Interaction:
    """Rays at one element; what effects read and modify."""

    #: The tracer, and the element's number.
    tracer: RayTracer
    index: int
    #: Whether light propagates in the system's nominal direction.
    forward: bool
    #: Whether this is the nominal path, not stray light.
    direct: bool
    #: The rays at the surface, with global origins, and directions in front of it before the interaction, behind it afterwards.
    state: RayState
    #: Refractive indices in front of and behind the surface in the direction of the light, (N,) for gradient-index media.
    n_in: float | Tensor
    n_out: float | Tensor
    #: Set where the rays meet the surface.
    hit: Hit = field(default_factory=lambda: Hit((), (), ()))
    #: Power in front of the surface, and the rays behind it in the element's frame: set by the interaction.
    power_in: Tensor | None = None
    out: OutgoingRays | None = None

    def __post_init__(self):
        #: The element, and the side from which light reaches it: +1 from below, -1 from above.
        self.element = self.tracer.system.elements[self.index]  # the tracer may be gone when this is read
        self.side = self.tracer.sides[self.index] if self.forward else -self.tracer.sides[self.index]

    @property
    def ahead(self) -> int:
        """Number of the medium in front of the surface, in the direction of the light."""
        return self.index if self.forward else self.index + 1

    @property
    def beyond(self) -> int:
        """Number of the medium behind it."""
        return self.index + 1 if self.forward else self.index

    @property
    def reflects(self) -> bool:
        """Whether the element is a mirror."""
        return self.element.reflects

    @property
    def absorption(self) -> float:
        """Absorption coefficient of the medium in front of the surface, 1/mm."""
        return self.tracer.media[self.ahead].absorption

    def returned(self) -> RayState:
        """The light that a refracting element reflects, as rays that start at its surface."""
        assert self.power_in is not None and self.out is not None
        hit, element = self.hit, self.element
        reflected = self.tracer.backend.interact(
            hit.incoming, hit.slopes, self.power_in, eta=1.0, reflects=True, fresnel=element.fresnel, side=self.side
        )
        return replace(
            self.state,
            direction=rotate_to_global(element.pose, reflected.direction),
            power=self.power_in - self.out.power,
            lost={},
            sample=None,
        )
