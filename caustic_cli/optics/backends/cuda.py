"""The CUDA backend: compiled kernels, always in float64, with sums that are bitwise reproducible.

The reference handles stages without a kernel, and empty sets of rays, on the device, too.
"""

from __future__ import annotations

import torch
from torch import Tensor

from caustic_cli.optics.backends.reference import Torch
from caustic_cli.optics.interface import OutgoingRays
from caustic_cli.optics.kernels.cuda import sums
from caustic_cli.optics.kernels.cuda.image import LitRays, expose, splat_rays
from caustic_cli.optics.kernels.cuda.rays import on_device
from caustic_cli.optics.kernels.cuda.surface import hits_of_rays, surface_of
from caustic_cli.optics.kernels.interact import interact
from caustic_cli.optics.kernels.surface import scattered_surface
from caustic_cli.optics.kernels.transfer import land
from caustic_cli.optics.rays import RayState
from caustic_cli.optics.reconstruction import Filter
from caustic_cli.optics.sampling import Sample
from caustic_cli.optics.surfaces.base import SurfaceIntersection
from caustic_cli.scene import Screen


class Cuda(Torch):
    """See the package."""

    name = "cuda"

    def precision(self, dtype: torch.dtype) -> torch.dtype:
        """float64."""
        return torch.float64

    def spline_on(self, field, sample: Sample, dtype: torch.dtype):
        """As the reference."""
        surface, u, v = surface_of(field, sample.u.device), *_points(sample)
        return lambda sag: scattered_surface(surface, sag, u, v)

    def spline_at(self, field, heights: Tensor, x: Tensor, y: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """As the reference."""
        if not len(x):
            return super().spline_at(field, heights, x, y)
        u, v = ((0.5 * (c.detach().double() / r + 1.0)).contiguous() for c, r in zip((x, y), field.half_size, strict=True))
        return scattered_surface(surface_of(field, u.device), heights, u, v)

    def intersect_spline(self, field, heights: Tensor, origin, direction, side: float) -> SurfaceIntersection:
        """As the reference."""
        rays = [torch.as_tensor(c, dtype=torch.float64, device=heights.device) for c in (*origin, *direction)]
        ox, oy, oz, dx, dy, dz = torch.broadcast_tensors(*rays)
        if not ox.numel():
            return super().intersect_spline(field, heights, origin, direction, side)
        surface = surface_of(field, heights.device)
        return SurfaceIntersection(*hits_of_rays(surface, heights, (ox, oy, oz), (dx, dy, dz), side=side))

    def intersect_fixed(self, field, origin, direction):
        """As the reference."""
        return lambda heights: self.intersect_spline(field, heights, origin, direction, 1.0)

    def interact(
        self, direction, slopes, power: Tensor, *, eta: float, reflects: bool, fresnel: str, polarised=None, side: float = 1.0
    ) -> OutgoingRays:
        """As the reference, which handles constant slopes and varying indices; the kernel infers the side from the sign of d .
        N."""
        if not isinstance(slopes[0], Tensor) or isinstance(eta, Tensor):
            return super().interact(
                direction, slopes, power, eta=eta, reflects=reflects, fresnel=fresnel, polarised=polarised, side=side
            )
        return OutgoingRays(
            *interact(direction, slopes, power, eta=eta, reflects=reflects, fresnel=fresnel, field=polarised, on=on_device)
        )

    def land(self, origin, direction, point, axes, forward: float) -> tuple[Tensor, Tensor, Tensor]:
        """As the reference."""
        return land(origin, direction, point, axes, forward, on=on_device)

    def splat(self, x: Tensor, y: Tensor, weight: Tensor, screen: Screen, filter: Filter) -> tuple[Tensor, Tensor]:
        """As the reference."""
        return splat_rays(x, y, weight, screen, filter)

    def plane_image(self, field, rays: RayState, eta: float, fresnel: str, like) -> CudaPlaneImage:
        """The fused kernel for rays of a plane wave on a B-spline: a function of heights, screen and filter."""
        return CudaPlaneImage(field, rays, eta, fresnel)

    def ray_image(self, field, rays: RayState, eta: float, fresnel: str, radius: float | None, like) -> CudaRayImage:
        """The fused kernel for arbitrary rays below a B-spline."""
        return CudaRayImage(field, rays, eta, fresnel, radius)


def _points(sample: Sample) -> tuple[Tensor, Tensor]:
    """u, v (N,) of all rays of a sample."""
    u, v = (sample.u[:, None], sample.v[None, :]) if sample.tensor else (sample.u, sample.v)
    u, v = (c.expand(sample.shape).reshape(-1).double().contiguous() for c in (u, v))
    return u, v


class CudaPlaneImage:
    """See `Cuda.plane_image`."""

    def __init__(self, field, rays: RayState, eta: float, fresnel: str):
        sample = rays.sample
        assert sample is not None
        self.u, self.v = _points(sample)
        (rx, ry), none = field.half_size, self.u[:0]
        power = rays.power.double().expand(sample.shape).reshape(-1).contiguous()
        self.surface, self.interface = surface_of(field, self.u.device), (eta, fresnel)
        self.light = LitRays((2.0 * self.u - 1.0) * rx, (2.0 * self.v - 1.0) * ry, (none, none), power, False)
        self.unit = sums.unit_of(power.abs().sum())

    def __call__(self, heights: Tensor, screen: Screen, filter: Filter) -> tuple[Tensor, Tensor, dict]:
        """Image, power that leaves the surface, and what was lost there."""
        middle = heights.detach().double().mean()
        sag = scattered_surface(self.surface, heights - middle, self.u, self.v)
        place = torch.stack([torch.zeros_like(middle), screen.z - middle])
        return expose(sag, self.light, self.unit, place, *self.interface, screen, filter)


class CudaRayImage:
    """See `Cuda.ray_image`."""

    def __init__(self, field, rays: RayState, eta: float, fresnel: str, radius: float | None):
        x, y, *direction = (c.double().contiguous() for c in rays.full((*rays.origin[:2], *rays.direction)))
        self.surface, self.interface, self.radius = surface_of(field, x.device), (eta, fresnel), radius
        self.z, self.direction, power = rays.origin[2] + rays.datum, direction, rays.power.double().contiguous()
        self.light = LitRays(x, y, (direction[0], direction[1]), power, True)
        self.unit = sums.unit_of(power.abs().sum())

    def __call__(self, heights: Tensor, screen: Screen, filter: Filter) -> tuple[Tensor, Tensor, dict]:
        """Image, power that leaves the surface, and what was lost there."""
        origin = (self.light.x, self.light.y, torch.full_like(self.light.x, self.z))
        t, gx, gy, found = hits_of_rays(self.surface, heights, origin, self.direction, radius=self.radius)
        middle = heights.detach().double().mean()
        place = torch.stack([self.z - middle, screen.z - middle])
        hits = (torch.where(found, t, -torch.ones_like(t)), gx, gy)
        return expose(hits, self.light, self.unit, place, *self.interface, screen, filter)
