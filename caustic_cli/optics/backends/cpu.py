"""The CPU backend: compiled kernels, always in float64, which costs no more here.

The reference handles stages without a kernel, and empty sets of rays.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Iterator
from functools import lru_cache
from importlib import import_module
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

from caustic_cli.optics import intersection
from caustic_cli.optics.backends.reference import Torch
from caustic_cli.optics.gradient.fields import LEAST_SQUARE, SplineIndex
from caustic_cli.optics.gradient.integrator import WEIGHTS, Flow
from caustic_cli.optics.interface import OutgoingRays
from caustic_cli.optics.kernels import fused_functions
from caustic_cli.optics.kernels.grid import GridSurface
from caustic_cli.optics.kernels.polynomial_index import formula_flow
from caustic_cli.optics.kernels.ray_intersections import RayIntersections, hits_of_rays
from caustic_cli.optics.kernels.refraction import interact
from caustic_cli.optics.kernels.splat import splat_rays
from caustic_cli.optics.kernels.spline_index import volume_axis, volume_flow
from caustic_cli.optics.kernels.surface import FusedSurface, next_intersections, scattered_surface
from caustic_cli.optics.kernels.transfer import land
from caustic_cli.optics.pencil import Pencil
from caustic_cli.optics.rays import RayState
from caustic_cli.optics.receiver import Receiver
from caustic_cli.optics.reconstruction import Filter
from caustic_cli.optics.reintersection import HALVINGS, MOST_STEPS
from caustic_cli.optics.sampling import Sample, key, salt
from caustic_cli.optics.surfaces.base import SurfaceIntersection
from caustic_cli.scene import Screen

if TYPE_CHECKING:
    from caustic_cli.optics.beam import Beam


class Numba(Torch):
    """See the package."""

    name = "numba"
    compiled = True

    def __init__(self) -> None:
        self.kept: dict[int, tuple[Any, FusedSurface]] | None = None

    def precision(self, dtype: torch.dtype) -> torch.dtype:
        """float64."""
        return torch.float64

    @contextlib.contextmanager
    def keeping_surfaces(self) -> Iterator[None]:
        """As the reference: with the polynomials of the last heights, which take a gigabyte for 3000 x 3000 control points."""
        before, self.kept = self.kept, {} if self.kept is None else self.kept
        try:
            yield
        finally:
            self.kept = before

    def surface_of(self, field) -> FusedSurface:
        """Kernel data of a height field."""
        if self.kept is None:
            return FusedSurface(field.spaces, field.half_size)
        if id(field) not in self.kept:
            self.kept[id(field)] = field, FusedSurface(field.spaces, field.half_size)
        return self.kept[id(field)][1]

    def scatter(
        self, seed: int, start: int, stop: int, shape: tuple[int, int], stratified: bool, device: torch.device | str
    ) -> list[Tensor]:
        """As the reference."""
        return list(
            fused_functions.scattered_points([key(seed, d) for d in (0, 1)], [salt(0), salt(1)], start, stop, *shape, stratified)
        )

    def spline_on(self, field, sample: Sample, dtype: torch.dtype):
        """As the reference; tensor-product samples by rows, from nets contracted along v."""
        if sample.tensor:
            return GridSurface(field.spaces, field.half_size, sample.u, sample.v)
        surface, u, v = self.surface_of(field), sample.u.contiguous().numpy(), sample.v.contiguous().numpy()
        return lambda sag: scattered_surface(surface, sag, u, v)

    def spline_at(self, field, heights: Tensor, x: Tensor, y: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """As the reference, which handles a few points of a large net."""
        surface = self.surface_of(field)
        if surface.few(len(x)):
            return super().spline_at(field, heights, x, y)
        at = ((0.5 * (c / r + 1.0)).contiguous().numpy() for c, r in zip((x, y), field.half_size, strict=True))
        return scattered_surface(surface, heights.double(), *at)

    def intersect_spline(self, field, heights: Tensor, origin, direction, side: float) -> SurfaceIntersection:
        """As the reference."""
        rays = [torch.as_tensor(c, dtype=torch.float64) for c in (*origin, *direction)]
        ox, oy, oz, dx, dy, dz = (c.contiguous() for c in torch.broadcast_tensors(*rays))
        if not ox.numel():
            return super().intersect_spline(field, heights, origin, direction, side)
        surface = self.surface_of(field)
        return SurfaceIntersection(*hits_of_rays(surface, heights, (ox, oy, oz), (dx, dy, dz), side=side))

    def intersect_fixed(self, field, origin, direction):
        """As the reference; for rays that start inside the aperture, data independent of the heights is precomputed."""
        if any(bool((c.abs() > half).any()) for c, half in zip(origin[:2], field.half_size, strict=True)):
            return lambda heights: self.intersect_spline(field, heights, origin, direction, 1.0)
        hits = RayIntersections(self.surface_of(field), origin, direction, None)

        def intersect(heights: Tensor) -> SurfaceIntersection:
            t, gx, gy = hits(heights)
            found = t.detach() >= 0
            return SurfaceIntersection(torch.where(found, t, torch.zeros_like(t)), gx, gy, found)

        return intersect

    def flow(self, field, coefficients: Tensor | None, point, momentum, time: Tensor, steps: int, order: int) -> Flow:
        """As the reference; B-spline volumes and polynomial fields by kernels."""
        if time.numel() and field.formula is not None:
            terms, axial, squared = field.formula
            medium, terms = (axial, squared, LEAST_SQUARE), torch.tensor(terms, dtype=torch.float64)
            out = formula_flow(terms, medium, (*point, *momentum), time, WEIGHTS[order], steps)
            return Flow(out[:3], out[3:6], out[6], out[7])
        if not isinstance(field, SplineIndex) or not time.numel():
            return super().flow(field, coefficients, point, momentum, time, steps, order)
        values = field.coefficients if coefficients is None else coefficients
        out = volume_flow(values, _axes(field), (*point, *momentum), time, WEIGHTS[order], steps)
        return Flow(out[:3], out[3:6], out[6], out[7])

    def find(
        self, field, heights: Tensor, origin, direction, method: intersection.Method, radius: float | None
    ) -> tuple[Tensor, Tensor]:
        """As the reference."""
        start, found = method.start(field, heights, origin, direction, radius)
        if found is not None:
            return found
        hits = RayIntersections(self.surface_of(field), origin, direction, radius)
        t, status = hits.find(heights, None if start is None else np.ascontiguousarray(start.numpy()))
        return torch.from_numpy(t), torch.from_numpy(status).long()

    def finder(self, field, origin, direction):
        """As the reference."""
        hits = RayIntersections(self.surface_of(field), origin, direction, None)
        return lambda heights: tuple(torch.from_numpy(found) for found in hits.find(heights))

    def next_intersections(self, field, heights: Tensor, origin, direction, below: bool, round: bool, step: float) -> Tensor:
        """As the reference."""
        if not len(origin[0]):
            return super().next_intersections(field, heights, origin, direction, below, round, step)
        return next_intersections(self.surface_of(field), heights, origin, direction, below, round, step, HALVINGS, MOST_STEPS)

    def interact(
        self, direction, slopes, power: Tensor, *, eta: float, reflects: bool, fresnel: str, polarised=None, side: float = 1.0
    ) -> OutgoingRays:
        """As the reference, which handles mirrors and constant slopes; the kernel infers the side from the sign of d . N."""
        if reflects or not isinstance(slopes[0], Tensor):
            return super().interact(
                direction, slopes, power, eta=eta, reflects=reflects, fresnel=fresnel, polarised=polarised, side=side
            )
        direction, polarised = _components(direction), None if polarised is None else _components(polarised)
        return OutgoingRays(*interact(direction, slopes, power, eta=eta, fresnel=fresnel, field=polarised))

    def exposure(self, phase: Tensor, amplitude: Tensor, factor: float, shape: tuple[int, int], edges: tuple[Tensor, Tensor]):
        """As the reference, which handles float64."""
        make = fields().FusedExposure if phase.dtype == torch.float32 else super().exposure
        return make(phase, amplitude, factor, shape, edges)

    def path_change(self, surface, last, dtype: torch.dtype):
        """As the reference, which handles float64."""
        make = fields().FusedPathChange if dtype == torch.float32 else super().path_change
        return make(surface, last, dtype)

    def land(self, origin, direction, point, axes, forward: float) -> tuple[Tensor, Tensor, Tensor]:
        """As the reference."""
        return land(origin, direction, point, axes, forward)

    def splat(self, x: Tensor, y: Tensor, weight: Tensor, screen: Screen, filter: Filter) -> tuple[Tensor, Tensor]:
        """As the reference."""
        return splat_rays(x, y, weight, screen, filter)

    def plane_image(
        self, field, rays: RayState, eta: float, fresnel: str, clear: Tensor | None, like: PlaneImage | None
    ) -> PlaneImage:
        """The fused kernel for rays of a plane wave on a B-spline: a function of heights, screen and filter.

        clear: whether its aperture is clear at each ray, of the sample's shape; None for all.
        """
        return PlaneImage(field, rays, eta, fresnel, clear, like)

    def pencil_image(
        self, field, pencil: Pencil, entrance: tuple[float, str], eta: float, fresnel: str, like: PencilImage | None
    ) -> PencilImage | None:
        """The fused kernel for the rays of a source point behind a flat entrance, of this index and with these Fresnel losses."""
        emission = pencil.polynomial(*entrance)
        return None if emission is None else PencilImage(field, pencil, entrance, emission, (eta, fresnel), like)

    def beam_image(
        self, field, beam: Beam, entrance: tuple[float, str], eta: float, fresnel: str, like: BeamImage | None
    ) -> BeamImage:
        """The same for parallel rays at an angle to z, also of a mirror, whose eta is -1."""
        return BeamImage(field, beam, entrance, (eta, fresnel), like)

    def ray_image(self, field, rays: RayState, eta: float, fresnel: str, radius: float | None, like: RayImage | None) -> RayImage:
        """The fused kernel for arbitrary rays below a B-spline."""
        return RayImage(field, rays, eta, fresnel, radius, like)


def fields():
    """The kernels of wave images, which not every design needs."""
    return import_module("caustic_cli.optics.kernels.fields")


def _components(vector) -> tuple:
    """Components as tensors (N,) or plain floats."""
    return tuple(float(c) if isinstance(c, Tensor) and c.ndim == 0 else c for c in vector)


class PlaneImage:
    """See `Numba.plane_image`; like: that of the previous chunk, whose basis values along v are reused if they are the same."""

    def __init__(self, field, rays: RayState, eta: float, fresnel: str, clear: Tensor | None, like: PlaneImage | None):
        s = rays.sample
        assert s is not None
        self.interface = eta, fresnel
        power = rays.power if clear is None else rays.power * clear
        #: What is lost beside the aperture.
        self.lost = {} if clear is None else {"missed_surface": rays.total(rays.power - power)}
        self.kernel: fused_functions.PlaneKernel = fused_functions.PlaneKernel(
            field.spaces, field.half_size, s.u, s.v, s.tensor, power, like.kernel if isinstance(like, PlaneImage) else None
        )

    def __call__(self, heights: Tensor, screen: Screen, filter: Filter) -> tuple[Tensor, Tensor, dict]:
        """Image, power that leaves the surface, and what was lost there."""
        reference = float(heights.detach().mean())
        image, leaving, lost = self.kernel(heights - reference, *self.interface, screen.z - reference, screen, filter)
        return image, leaving, lost | self.lost


class PencilImage:
    """See `Numba.pencil_image`; like: as for `PlaneImage`."""

    def __init__(
        self, field, pencil: Pencil, entrance: tuple[float, str], emission, interface: tuple[float, str], like: PencilImage | None
    ):
        self.interface, self.emitted = interface, pencil.emitted
        #: Power through the pupil, and less what the entrance reflects, ().
        self.entering, self.passed = pencil.entering(*entrance)
        before = like.kernel if isinstance(like, PencilImage) else None
        self.kernel: fused_functions.PencilKernel = fused_functions.PencilKernel(
            field.spaces, field.half_size, pencil, entrance[0], emission, before
        )

    def __call__(self, heights: Tensor, screen: Screen, filter: Filter) -> tuple[Tensor, Tensor, dict]:
        """Image, power that leaves the surface, and what was lost since the source; what misses the surface is the rest."""
        reference = float(heights.detach().mean())
        image, leaving, lost = self.kernel(heights - reference, *self.interface, reference, screen, filter)
        return image, leaving, _since_source(self, leaving, lost) | {"missed_lens": self.emitted - self.entering}


class BeamImage:
    """See `Numba.beam_image`; like: as for `PlaneImage`."""

    #: It has plane screens of any orientation.
    tilts = True

    def __init__(self, field, beam: Beam, entrance: tuple[float, str], interface: tuple[float, str], like: BeamImage | None):
        self.interface, (x, y, z) = interface, beam.direction
        #: Of the light behind the exit, if it is flat.
        self.axis = x, y, math.copysign(z, interface[0])
        #: Power through the pupil, and less what the entrance reflects, ().
        self.entering = torch.tensor(beam.emitted, dtype=torch.float64)
        self.passed = self.entering * beam.transmittance(*entrance)
        before = like.kernel if isinstance(like, BeamImage) else None
        self.kernel: fused_functions.BeamKernel = fused_functions.BeamKernel(field.spaces, field.half_size, beam, entrance, before)

    def __call__(self, heights: Tensor, screen: Screen, filter: Filter) -> tuple[Tensor, Tensor, dict]:
        """Image, power that leaves the surface, and what was lost since the source; what misses the surface is the rest."""
        reference = float(heights.detach().mean())
        receiver = Receiver.on_axis(screen, self.axis)
        image, leaving, lost = self.kernel.onto(heights - reference, *self.interface, reference, receiver, filter)
        return image, leaving, _since_source(self, leaving, lost)


def _since_source(image: PencilImage | BeamImage, leaving: Tensor, lost: dict) -> dict:
    """Losses from the pupil on, from those at the exit; what misses the exit is the rest of what passed the entrance."""
    met = leaving.detach() + lost["fresnel"] + lost["total_internal_reflection"]
    return lost | {"missed_surface": image.passed - met, "fresnel": image.entering - image.passed + lost["fresnel"]}


class RayImage:
    """See `Numba.ray_image`; like: as for `PlaneImage`."""

    def __init__(self, field, rays: RayState, eta: float, fresnel: str, radius: float | None, like: RayImage | None):
        self.interface = eta, fresnel
        x, y, *direction = (c.contiguous() for c in rays.full((*rays.origin[:2], *rays.direction)))
        self.kernel: fused_functions.RayKernel = fused_functions.RayKernel(
            field.spaces,
            field.half_size,
            (x, y, rays.origin[2] + rays.datum),
            direction,
            rays.power,
            radius,
            like.kernel if isinstance(like, RayImage) else None,
        )

    def __call__(self, heights: Tensor, screen: Screen, filter: Filter) -> tuple[Tensor, Tensor, dict]:
        """Image, power that leaves the surface, and what was lost there."""
        return self.kernel(heights, *self.interface, float(heights.detach().mean()), screen, filter)


@lru_cache(maxsize=8)
def _axes(field: SplineIndex) -> tuple:
    """Kernel data of the axes of a B-spline volume."""
    return tuple(volume_axis(s, *place) for s, place in zip(field.spaces, field.frame, strict=True))
