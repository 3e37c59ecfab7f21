"""The lowering of a trace to one fused kernel: the only place that knows which systems it covers.

It takes the rays in front of the last surface, a single upright B-spline at the origin in front of an upright screen, where nothing
but refraction with Fresnel losses happens to them, or reflection of parallel light; see `backends`.  Rays through given points of
that surface have no power where its aperture is not clear, between round lenslets or beside the cell of a hexagonal one.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TypeGuard

from torch import Tensor

from caustic_cli.optics.backends import Fused
from caustic_cli.optics.frames import Pose
from caustic_cli.optics.pencil import Bundle
from caustic_cli.optics.rays import RayState
from caustic_cli.optics.sampling import Sample
from caustic_cli.optics.surfaces import HeightField, Plane
from caustic_cli.optics.system import Element, PlacedScreen
from caustic_cli.scene import Pupil, Screen


def lowered(tracer, previous: Fused | None) -> Fused | None:
    """The rest of a tracer's system as one fused kernel; None where it does not apply.  previous: that of the previous chunk, whose
    prepared arrays are reused."""
    if isinstance(tracer.rays, Bundle) and (fused := _pencil(tracer, tracer.rays, previous)) is not None:
        return fused
    system, start, (inside, outside) = tracer.system, tracer.start, tracer.media[-2:]
    element = system.elements[-1]
    if _needs_stages(tracer) or tracer.first != len(system.elements) - 1 or not _is_plain(element, system.pupil):
        return None
    start = _in_a_plane(start)
    if tracer.sides[-1] < 0 or not _are_plain(start) or not (system.lit or tracer.first):
        return None
    eta = inside.index_at(start.wavelength) / outside.index_at(start.wavelength)
    if element.fresnel == "schlick" and eta < 1.0:  # the fused kernels use the cosine behind the surface
        return None
    if start.sample is None or not start.along_axis:
        aperture = element.aperture
        if not aperture.compiled:
            return None
        return tracer.backend.ray_image(element.surface, start, eta, element.fresnel, aperture.radius, previous)
    clear = _clear(element, system.pupil, start.sample)
    return tracer.backend.plane_image(element.surface, start, eta, element.fresnel, clear, previous)


def _pencil(tracer, pencil: Bundle, previous: Fused | None) -> Fused | None:
    """All of a tracer's system as one kernel for the rays of a source point, or of one at infinity: a flat entrance in front of the
    last surface, or a mirror alone."""
    if _needs_stages(tracer) or not tracer.system.lit:
        return None
    match tracer.system.elements:
        case (exit,):
            ways = _reflected(tracer, exit, pencil)
        case (entrance, exit):
            ways = _refracted(tracer, entrance, exit)
        case _:
            return None
    if ways is None:
        return None
    pencil = pencil.through(_clear(exit, tracer.system.pupil, pencil.sample))
    return pencil.maker(tracer.backend)(exit.surface, pencil, *ways, previous)


def _reflected(tracer, exit: Element, pencil: Bundle) -> tuple | None:
    """What happens to a pencil at the entrance and at the exit, a mirror alone, as arguments of the kernel; None where that has
    none."""
    if not (pencil.reflects and exit.reflects and _is_upright(exit, tracer.system.pupil)):
        return None
    return (1.0, "none"), -1.0, "none"


def _refracted(tracer, entrance: Element, exit: Element) -> tuple | None:
    """The same behind a flat entrance."""
    pupil = tracer.system.pupil
    upright = isinstance(entrance.surface, Plane) and entrance.pose == Pose((0.0, 0.0, pupil.z)) and not entrance.reflects
    if not (upright and _is_plain(exit, pupil) and entrance.aperture == pupil.aperture):
        return None
    before, inside, outside = (medium.index_at(tracer.wavelength) for medium in tracer.media)
    if inside <= before or (exit.fresnel == "schlick" and inside < outside):
        return None
    return (inside / before, entrance.fresnel), inside / outside, exit.fresnel


def _clear(exit: Element, pupil: Pupil, sample: Sample) -> Tensor | None:
    """Whether the aperture of the last surface is clear at points of it, of the sample's shape; None if it is the pupil's."""
    if exit.aperture == pupil.aperture:
        return None
    x, y = ((2.0 * c - 1.0) * r for c, r in zip((sample.u, sample.v), pupil.half_size, strict=True))
    return exit.aperture.contains(*((x[:, None], y[None, :]) if sample.tensor else (x, y)))


def _needs_stages(tracer) -> bool:
    """Whether effects, the outcome of every ray or a gradient index need the trace by stages, or it is asked for."""
    return bool(tracer.requests.stages or tracer.actions or tracer.track) or any(medium.varies for medium in tracer.media)


def _is_plain(element: Element, pupil: Pupil) -> bool:
    """Whether an element is a refracting B-spline over the pupil, upright at the origin."""
    return not element.reflects and _is_upright(element, pupil)


def _is_upright(element: Element, pupil: Pupil) -> bool:
    """Whether an element is a B-spline over the pupil, upright at the origin."""
    surface = element.surface
    return (
        isinstance(surface, HeightField)
        and element.pose == Pose()
        and element.aperture.half_size == surface.half_size == pupil.half_size
    )


def _in_a_plane(rays: RayState) -> RayState:
    """Rays as they cross a plane, on their lines: in front of the last surface nothing else happens to them.  It is z = `datum`, or
    as low as a ray begins, behind a curved entrance above whose edges the exit may lie lower."""
    x, y, z = rays.origin
    if isinstance(z, float):
        return rays
    rays = rays.expanded()
    dx, dy, dz = rays.direction
    low = min(0.0, float(z.min()))
    t = (low - z) / dz
    return replace(rays, origin=(x + t * dx, y + t * dy, low))


def _are_plain(rays: RayState) -> bool:
    """Whether rays start in one plane, and their polarisation is not tracked."""
    return rays.polarised is None and isinstance(rays.origin[2], float)


def covers(screen: Screen | PlacedScreen, fused: Fused | None) -> TypeGuard[Screen]:
    """Whether a fused kernel splats onto such a screen."""
    if not isinstance(screen, Screen) or fused is None:
        return False
    return screen.upright or (getattr(fused, "tilts", False) and not (screen.curved or screen.windows or screen.far))
