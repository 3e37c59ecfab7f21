"""Rays at one element of a system, on their way through it: what effects see and change."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, Protocol

from torch import Tensor

from caustic_cli.optics.frames import rotate_to_global
from caustic_cli.optics.rays import RayState
from caustic_cli.optics.system import Element, Medium, System

#: Heights (n, m), mm, by the name of the element whose surface they shape.
Parameters = Mapping[str, Tensor]


class RayTracer(Protocol):
    """What takes rays from element to element: a `trace.Tracer`.

    system: what they go through; media: before each element and behind the last; start: the rays where its walks begin; backend:
    what does the arithmetic.
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
        """Rays to element k and behind it."""


@dataclass
class Interaction:
    """Rays at one element: what effects see and change.

    tracer, index, element: whose and which; forward: whether light runs in the system's own direction; side: from which the
    surface is met; n_in, n_out: refractive indices before and behind, in the light's direction, (N,) where
    the medium's varies; state: the rays, at the
    surface (origins in the system's frame, directions before it until `depart`, behind it from then on); local: their points in
    the element's frame; incoming: directions before it, in that frame; slopes: of the surface there; length: of the way to it, mm;
    lift: how far above the met point the rays go on, mm, where an effect says so; arriving, departing: power before and
    after the interaction; passes: of the interaction; straight: whether this is the walk
    itself, not stray light.
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
        """Absorption coefficient of the medium on the way to the surface, 1/mm."""
        return self.tracer.media[self.index if self.forward else self.index + 1].absorption

    def returned(self) -> RayState:
        """The light that this refracting element reflects, at its surface."""
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
