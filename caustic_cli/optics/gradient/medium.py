"""A medium with a gradient index as a part of a system: it carries rays along curves, by `transfer`.

Its frame is that of the element in front of it.  Its free coefficients, if it has any, are parameters of the trace under the name
`index_name` of that element; where they are missing its own are used.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar

import torch
from torch import Tensor

from caustic_cli.errors import InputError
from caustic_cli.optics.backends import backend_for
from caustic_cli.optics.frames import rotate_to_global, to_global, to_local
from caustic_cli.optics.gradient.fields import IndexField, index_field_of
from caustic_cli.optics.gradient.transfer import NextSurface, RayFlow, transfer
from caustic_cli.optics.media import Medium
from caustic_cli.optics.rays import Hit, RayState
from caustic_cli.optics.surfaces.plane import Plane
from caustic_cli.optics.system import Element
from caustic_cli.scene import Lens


def index_name(element: Element) -> str:
    """Key in `Parameters` of the coefficients of the gradient-index field behind an element."""
    return f"{element.name}.index"


@dataclass(frozen=True, kw_only=True)
class GradientMedium(Medium):
    """A gradient-index medium."""

    #: Its index field, scaled by the ratio of the glass' index at a wavelength to `index`.
    gradient: IndexField

    varies: ClassVar[bool] = True

    @classmethod
    def of(cls, lens: Lens) -> GradientMedium:
        """The medium of a lens with a gradient index."""
        field = index_field_of(lens)
        assert field is not None
        return cls(lens.index, lens.absorption, lens.glass, gradient=field)

    def variation(self, half_size: tuple[float, float], depth: float) -> tuple[float, float, float]:
        """Of the field (`IndexField.extremes`)."""
        least, most, steepest = self.gradient.extremes(half_size, depth)
        return least / self.index, most / self.index, steepest

    def check_first(self) -> None:
        """No element defines its frame there."""
        raise InputError("the medium in front of a system cannot have a gradient: no element defines its frame; add one")

    def entering(self, rays: RayState) -> RayState:
        """One by one: each has its own index."""
        return rays.expanded()

    def carry(self, tracer, m, heights: Tensor | None, parameters) -> None:
        """Along curves (`transfer`)."""
        element, state = m.element, replace(m.state, lost=dict(m.state.lost)).expanded()
        owner, scale = tracer.owner(m.ahead), self._scale(state)
        name, pose = index_name(owner), owner.pose
        point, direction = (
            tuple(c.double() for c in state.full(v)) for v in to_local(pose, state.origin, state.direction, state.datum)
        )

        def seen(points, vectors):
            o, d = to_global(pose, points, state.datum), rotate_to_global(pose, vectors)
            return to_local(element.pose, o, d, state.datum)

        way, given = (m.ahead, m.index, m.forward), [None if c is None else c.detach() for c in (parameters.get(name), heights)]
        steps, before = tracer.steps.get(way, (None, given))
        if not all(a is b or (a is not None and b is not None and torch.equal(a, b)) for a, b in zip(given, before, strict=True)):
            steps = None  # the number for other parameters may be too small
        rays = RayFlow(tracer.backend.flow, self.gradient, parameters.get(name))
        found = transfer(rays, point, direction, NextSurface(element.surface, heights, seen, m.side), steps)
        if steps is None:
            tracer.steps[way] = found.steps, [None if c is None else c.clone() for c in given]
        local, incoming = seen(found.point, found.direction)
        m.hit, m.n_in = Hit(local, incoming, found.slopes, found.length), scale * found.n
        tracer.keep(state, found.found & element.aperture.contains(*local[:2]))
        state.sample = None
        state.origin = to_global(element.pose, local, state.datum)
        state.path = state.path + scale * found.path
        m.state = state

    @property
    def _flow(self) -> RayFlow:
        """Rays on the CPU, with its own coefficients."""
        return RayFlow(backend_for("cpu").flow, self.gradient, None)

    def relative_index(self, point: tuple) -> Tensor:
        return self._flow.index_at(point) / self.index

    def onto_plane(self, point: tuple, direction: tuple, z: Tensor) -> tuple[tuple, tuple]:
        """Along curves."""
        plane = NextSurface(Plane(), None, lambda points, vectors: ((points[0], points[1], points[2] - z), vectors), 1.0)
        found = transfer(self._flow, point, direction, plane)
        return found.point, found.direction

    def receive(self, tracer, m, parameters) -> None:
        """That of the field at the points of intersection; behind a mirror light stays in the medium in front."""
        if m.reflects:
            return
        state, owner = m.state, tracer.owner(m.beyond)
        point = to_local(owner.pose, tuple(c.double() for c in state.full(state.origin)), (0.0, 0.0, 1.0), state.datum)[0]
        m.hit.incoming = state.full(m.hit.incoming)
        rays = RayFlow(tracer.backend.flow, self.gradient, parameters.get(index_name(owner)))
        m.n_out = self._scale(state) * rays.index_at(point)

    def _scale(self, rays: RayState) -> float:
        """Factor of the index at the rays' wavelength."""
        return self.index_at(rays.wavelength) / self.index
