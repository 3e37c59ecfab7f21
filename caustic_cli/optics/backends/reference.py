"""The reference backend: every stage of a trace in plain torch, for any device.

Stages of optional capabilities are in modules of their own, loaded when they are called.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from importlib import import_module
from typing import Any

import torch
from torch import Tensor

from caustic_cli.errors import InputError
from caustic_cli.optics import intersection
from caustic_cli.optics.backends import Fused
from caustic_cli.optics.interface import OutgoingRays, interact
from caustic_cli.optics.reconstruction import Filter, splat
from caustic_cli.optics.sampling import Sample, scattered_points
from caustic_cli.optics.surfaces.base import SurfaceIntersection
from caustic_cli.optics.tolerances import PARALLEL
from caustic_cli.scene import Screen


class Torch:
    """See the package."""

    name = "torch"
    #: Whether kernels are compiled before the first trace.
    compiled = False

    def precision(self, dtype: torch.dtype) -> torch.dtype:
        """The precision used for rays requested in `dtype`."""
        return dtype

    def scatter(
        self, seed: int, start: int, stop: int, shape: tuple[int, int], stratified: bool, device: torch.device | str
    ) -> list[Tensor]:
        """Random points u, v of the unit square for rays start..stop, `stratified` in cells: see `sampling`."""
        return scattered_points(seed, start, stop, shape, stratified, device)

    @contextlib.contextmanager
    def keeping_surfaces(self) -> Iterator[None]:
        """Within it, what has been prepared for a height field serves all intersections with it."""
        yield

    def spline_on(self, field, sample: Sample, dtype: torch.dtype):
        """A function of sags (n, m) mm: height (mm) and slopes at the points of a sample, (N,) each in `dtype`."""
        evaluate = field.prepare(sample, dtype)
        return lambda sag: tuple(v.reshape(-1) for v in evaluate(sag.to(dtype)))

    def spline_at(self, field, heights: Tensor, x: Tensor, y: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Height and slopes at fixed points (N,) mm, float64, linear in the heights."""
        return tuple(field.at(heights, x, y))

    def intersect(self, surface, heights: Tensor | None, origin, direction, side: float) -> SurfaceIntersection:
        """`Surface.intersect` for any surface."""
        return intersection.intersect_any(surface, heights, origin, direction, side)

    def intersect_spline(self, field, heights: Tensor, origin, direction, side: float) -> SurfaceIntersection:
        """`Surface.intersect` for a B-spline."""
        return intersection.intersect_any(field, heights, origin, direction, side)

    def intersect_fixed(self, field, origin, direction):
        """A function of heights (n, m) mm: `SurfaceIntersection` from below, of rays that do not depend on the heights."""
        return lambda heights: intersection.intersect_any(field, heights, origin, direction, 1.0)

    def find(
        self, field, heights: Tensor, origin, direction, method: intersection.Method, radius: float | None
    ) -> tuple[Tensor, Tensor]:
        """`intersection.find`."""
        start, found = method.start(field, heights, origin, direction, radius)
        if found is not None:
            return found
        if start is not None:
            raise InputError("mesh+newton intersection needs the kernels of a CPU: unset CAUSTIC_KERNELS, or use newton")
        return intersection.reference(field, heights, origin, direction, 1.0, radius)

    def finder(self, field, origin, direction):
        """`find` by Newton's method for fixed rays: a function of heights."""
        return lambda heights: intersection.reference(field, heights, origin, direction)

    def next_intersections(self, field, heights: Tensor, origin, direction, below: bool, round: bool, step: float) -> Tensor:
        """Distances (N,) mm to the next intersection of rays that start on a B-spline, 0 for none: see `reintersection`."""
        reintersection = import_module("caustic_cli.optics.reintersection")
        return reintersection.reference(field, heights, origin, direction, below, round, step)

    def interact(
        self, direction, slopes, power: Tensor, *, eta: float, reflects: bool, fresnel: str, polarised=None, side: float = 1.0
    ) -> OutgoingRays:
        """Refraction or reflection: `interface.interact`."""
        return interact(direction, slopes, power, eta=eta, reflects=reflects, fresnel=fresnel, polarised=polarised, side=side)

    def flow(self, field, coefficients: Tensor | None, point, momentum, time: Tensor, steps: int, order: int):
        """Rays in a gradient-index medium: `integrator.flow`."""
        integrator = import_module("caustic_cli.optics.gradient.integrator")
        return integrator.flow(field, coefficients, point, momentum, time, steps, order)

    def exposure(self, phase: Tensor, amplitude: Tensor, factor: float, shape: tuple[int, int], edges: tuple[Tensor, Tensor]):
        """`waves.propagation.Exposure`."""
        return import_module("caustic_cli.optics.waves.propagation").Exposure(phase, amplitude, factor, shape, edges)

    def path_change(self, surface, last, dtype: torch.dtype):
        """`waves.wavefront.PathChange`."""
        return import_module("caustic_cli.optics.waves.wavefront").PathChange(surface, last, dtype)

    def land(self, origin, direction, point, axes, forward: float) -> tuple[Tensor, Tensor, Tensor]:
        """Ray transfer to a plane.

        Args:
            point, axes: a point of the plane, mm, and unit vectors along its x and y and along its normal.
            forward: +1 for rays that arrive along the normal, -1 against it.

        Returns:
            x, y (N,) mm from `point` along the plane's axes, and whether the rays reach the plane; others keep their position.
        """
        away = [p - o for p, o in zip(point, origin, strict=True)]
        along, up, normal = axes
        distance, speed = _dot(away, normal), _dot(direction, normal)
        speed = speed if isinstance(speed, Tensor) else torch.tensor(speed, dtype=torch.float64)
        arrives = forward * speed > PARALLEL
        path = distance / torch.where(arrives, speed, torch.ones_like(speed))
        on_way = arrives & (path > 0)
        path = torch.where(on_way, path, torch.zeros_like(path))
        x, y = (path * _dot(direction, a) - _dot(away, a) for a in (along, up))
        return x, y, on_way

    def splat(self, x: Tensor, y: Tensor, weight: Tensor, screen: Screen, filter: Filter) -> tuple[Tensor, Tensor]:
        """`reconstruction.splat`."""
        return splat(x, y, weight, screen, filter)

    def plane_image(self, *_: Any, **__: Any) -> Fused | None:
        """No fused kernel for rays of a plane wave on a B-spline."""
        return None

    def pencil_image(self, *_: Any, **__: Any) -> Fused | None:
        """No fused kernel for rays of a source point."""
        return None

    def beam_image(self, *_: Any, **__: Any) -> Fused | None:
        """None: no fused kernel."""
        return None

    def ray_image(self, *_: Any, **__: Any) -> Fused | None:
        """No fused kernel for other rays."""
        return None


def _dot(a, b):
    """Scalar product of three components, skipping plain zeros and ones."""
    total = 0.0
    for u, v in zip(a, b, strict=True):
        if (isinstance(v, float) and v == 0.0) or (isinstance(u, float) and u == 0.0):
            continue
        total = total + (u if isinstance(v, float) and v == 1.0 else u * v)
    return total
