"""The interaction of rays with one element: the state that effects read and modify."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, Protocol

from torch import Tensor

from caustic_cli.optics.frames import rotate_to_global
from caustic_cli.optics.rays import RayState
from caustic_cli.optics.system import Element, Medium, System

#: Control heights (n, m), mm, by the name of the element.
Parameters = Mapping[str, Tensor]


class RayTracer(Protocol):
    """The interface of `trace.Tracer` that effects use.

    system: the system traced; media: in front of each element and behind the last; start: the rays at the first free surface;
    backend: implementation of the stages.
    """

    system: System
    media: tuple[Medium, ...]
    start: RayState
    backend: Any

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
    """Rays at one element.

    tracer, index, element: the tracer, and the element with its number; forward: whether light propagates in the system's nominal
    direction; side: from which light reaches the surface, +1 from below, -1 from above; n_in, n_out: refractive indices in front of
    and behind the surface in the direction of the light, (N,) for gradient-index media; state: the rays at the surface, with global
    origins, and directions in front of it before the interaction, behind it afterwards; local: points of intersection in the
    element's frame; incoming: directions in front of it, in that frame; slopes: of the surface there; length: of the path to it,
    mm; lift: axial shift of the points from which the rays continue, mm, where an effect asks for one; power_in, power_out: power
    in front of and behind the surface; passes: False where light is totally reflected; direct: whether this is the nominal path,
    not stray light.
    """

    tracer: RayTracer
    index: int
    element: Element
    forward: bool
    side: float
    n_in: float | Tensor
    n_out: float | Tensor
    direct: bool
    state: RayState
    local: tuple = ()
    incoming: tuple = ()
    slopes: tuple = ()
    length: Tensor | float = 0.0
    lift: Tensor | None = None
    power_in: Tensor | None = None
    power_out: Tensor | None = None
    passes: Tensor | None = None

    @property
    def reflects(self) -> bool:
        """Whether the element is a mirror."""
        return self.element.reflects

    @property
    def absorption(self) -> float:
        """Absorption coefficient of the medium in front of the surface, 1/mm."""
        return self.tracer.media[self.index if self.forward else self.index + 1].absorption

    def returned(self) -> RayState:
        """The light that a refracting element reflects, as rays that start at its surface."""
        assert self.power_in is not None and self.power_out is not None
        found = self.tracer.backend.interact(
            self.incoming, self.slopes, self.power_in, eta=1.0, reflects=True, fresnel=self.element.fresnel, side=self.side
        )
        return replace(
            self.state,
            direction=rotate_to_global(self.element.pose, found.direction),
            power=self.power_in - self.power_out,
            lost={},
            sample=None,
        )
