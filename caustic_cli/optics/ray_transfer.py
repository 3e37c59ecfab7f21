"""Ray transfer along straight lines to the next surface of a trace.

Rays of a plane wave in front of the first free-form surface, and other rays that do not depend on heights, meet that surface by a
function prepared once for all heights.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import torch
from torch import Tensor

from caustic_cli.optics.frames import advance, to_global, to_local
from caustic_cli.optics.rays import Hit, RayState
from caustic_cli.optics.surfaces import HeightField, SurfaceIntersection
from caustic_cli.scene import Aperture

#: Distance along z, mm, from which rays meet a surface that touches their pupil: an intersection lies ahead of its ray.
BEFORE = 1e-6


def meet(tracer, m, heights: Tensor | None) -> None:
    """Transfer the rays of an `Interaction` to its surface, of these heights."""
    element, system = m.element, tracer.system
    prepared = tracer.prepared_intersection if m.state is tracer.begun else None  # valid for these rays only
    state = replace(m.state, lost=dict(m.state.lost))
    if heights is not None and m.forward and m.index == tracer.first:
        state = state.counted_from(element.pose.position[2] + element.surface.centred(heights)[1])
    if _at_pupil(system, m):
        state = tracer.media[m.beyond].entering(state)
        o, d = to_local(element.pose, state.origin, state.direction, state.datum)
        m.state, m.hit = state, Hit(o, d, (0.0, 0.0))
        return
    state = state.expanded()
    o, d = to_local(element.pose, state.origin, state.direction, state.datum)
    if m.index == 0 and m.forward and prepared is None and not element.surface.flat:
        o, state = _moved_before_surface(tracer, o, d, state, element, heights)
    hit = _intersection(tracer, m, o, d, heights, prepared)
    if state.power.dtype != tracer.dtype:  # the first intersection is always computed in float64
        t, gx, gy = (_cast(c, tracer.dtype) for c in hit[:3])
        state, hit = state.to(tracer.dtype), SurfaceIntersection(t, gx, gy, hit.valid)
        o, d = (tuple(_cast(c, tracer.dtype) for c in v) for v in (o, d))
    m.hit = Hit(advance(o, d, hit.t), d, (hit.gx, hit.gy), hit.t)
    sampled_there = state.sample is not None and _is_pupil(element, system)
    if prepared is None or not sampled_there:
        tracer.keep(state, _passed(element, m.hit, hit.valid))
    state.origin = to_global(element.pose, m.hit.local, state.datum)
    state.path = state.path + m.n_in * hit.t
    m.state = state


def _intersection(tracer, m, o, d, heights: Tensor | None, prepared) -> SurfaceIntersection:
    """Intersections of rays in the element's frame with its surface: of an effect that replaces it, prepared, or of the surface."""
    for action in tracer.actions:
        if (hit := action.intersect(m, o, d, heights)) is not None:
            return hit
    return prepared(heights) if prepared else m.element.surface.intersect(heights, o, d, m.side)


def _at_pupil(system, m) -> bool:
    """Whether the rays lie on this plane first element already, without any that miss it, as their source emits them."""
    e, pupil, z = m.element, system.pupil, m.state.origin[2]
    if m.index or not m.forward or not isinstance(z, float) or z + m.state.datum != pupil.z:
        return False
    return e.surface.flat and e.pose.upright and e.pose.position == (0.0, 0.0, pupil.z) and _is_pupil(e, system)


def _is_pupil(element, system) -> bool:
    """Whether an element's aperture is that of the pupil."""
    return element.aperture == system.pupil.aperture


def _passed(element, hit: Hit, valid: Tensor) -> Tensor:
    """Which of the rays that meet an element's surface, the `valid` ones, are within its aperture."""
    if element.aperture != Aperture(element.surface.half_size):
        valid = valid & element.aperture.contains(*hit.local[:2])
    return valid


def _moved_before_surface(tracer, o, d, state: RayState, element, heights) -> tuple[tuple, RayState]:
    """Rays on a pupil, moved back in front of the first surface where that intersects the pupil."""
    back = float(torch.as_tensor(o[2], dtype=torch.float64).max()) - element.surface.hull(heights)[0]
    if back < 0.0:
        return o, state
    way = -(back * (1.0 + 1e-9) + BEFORE) / d[2]
    moved = (torch.as_tensor(c + way * v, dtype=torch.float64, device=state.power.device) for c, v in zip(o, d, strict=True))
    path = state.path + tracer.media[0].index_at(state.wavelength) * way
    return tuple(c.expand(state.power.shape) for c in moved), replace(state, path=path)


def prepared_intersection(tracer) -> Callable[[Tensor], SurfaceIntersection] | None:
    """Intersections of a tracer's rays `start` with the first free surface as a prepared function of its heights; None if that case
    is not covered."""
    system, first, start = tracer.system, tracer.first, tracer.start
    if first == len(system.elements) or "intersection" in tracer.requests.off:
        return None
    element = system.elements[first]
    surface, pupil = element.surface, system.pupil
    if not isinstance(surface, HeightField) or tracer.sides[first] < 0 or not element.pose.upright:
        return None
    if first == 0 and system.lit is None and start.sample is None:
        return None
    px, py, pz = element.pose.position
    centred = (px, py) == (0.0, 0.0)
    on_axis = start.sample is not None and start.direction == (0.0, 0.0, 1.0)
    if on_axis and centred and surface.half_size == pupil.half_size:
        evaluate = tracer.backend.spline_on(surface, start.sample, tracer.dtype)

        def sampled(heights: Tensor) -> SurfaceIntersection:
            sag, gx, gy = evaluate(surface.centred(heights)[0])
            below = start.origin[2] - pz - float(heights.detach().double().mean()) - start.datum
            valid = torch.ones((), dtype=torch.bool, device=sag.device).expand(sag.shape)
            return SurfaceIntersection(sag - below, gx, gy, valid)

        return sampled
    spread = start.expanded()
    full = spread.full((*spread.origin, *spread.direction))
    origin, direction = (full[0] - px, full[1] - py, full[2] + (start.datum - pz)), full[3:]
    if first > 0:
        return tracer.backend.intersect_fixed(surface, origin, direction)
    return _from_afar(tracer, surface, origin, direction)


def _from_afar(tracer, surface: HeightField, origin: tuple, direction: tuple) -> Callable[[Tensor], SurfaceIntersection]:
    """Intersections of rays that may start on either side of a surface, which intersects their pupil: from half a width before it,
    or from in front of a surface that reaches farther."""
    room = max(surface.half_size)

    def moved(by: float) -> tuple[Tensor, tuple]:
        way = -by / direction[2]
        return way, tuple(o + way * d for o, d in zip(origin, direction, strict=True))

    back, starts = moved(room)
    fixed, last = tracer.backend.intersect_fixed(surface, starts, direction), float(starts[2].max())

    def met(heights: Tensor) -> SurfaceIntersection:
        beyond = last - surface.hull(heights)[0]
        if beyond < 0.0:
            hit, way = fixed(heights), back
        else:
            way, far = moved(room + beyond + BEFORE)
            hit = tracer.backend.intersect_spline(surface, heights, far, direction, 1.0)
        return hit._replace(t=hit.t + way)

    return met


def _cast(value, dtype: torch.dtype):
    return value.to(dtype) if isinstance(value, Tensor) else value
