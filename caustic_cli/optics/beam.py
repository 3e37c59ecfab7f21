"""Parallel rays behind a flat entrance, through given points of the exit surface instead of the entrance; or on a mirror.

As of a `pencil`, whose vertex is at infinity here: nothing is intersected.

Notation, for a beam along d, a unit vector, in front of an entrance whose glass has n times the index in front of it
    D           (k_x, k_y, 1), along the rays behind the entrance: by Snell's law k = d / sqrt(n^2 - d_x^2 - d_y^2)
    T           transmittance of the entrance
    E           power per area of the entrance, 1 / mm^2
    z           height of the exit above the entrance, mm;  N = (-z_x, -z_y, 1) there

All light behind the entrance has one direction, so that a plane z = const receives E T everywhere, and the light through dx dy of
the exit is

    dP = E T D . N dx dy

where the ray crossed the aperture of the entrance, at (x, y) - z k; other points of the exit are dark.  The light that crosses the
entrance and does not reach the exit is lost through the sides of the lens.  For a mirror the entrance is its aperture in the plane
of its edge, with n = 1.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from caustic_cli.optics.backends import Fused
from caustic_cli.optics.interface import slopes_inside
from caustic_cli.optics.pencil import Bundle, entrance_transmittance
from caustic_cli.optics.rays import RayState
from caustic_cli.optics.sampling import Sample
from caustic_cli.scene import Aperture


@dataclass(frozen=True, eq=False)
class Beam(Bundle):
    """Some parallel rays through points of the aperture of the last surface.

    sample: the points and the area of the aperture, mm^2, that each stands for, scalar or of their shape; aperture: of entrance and
    exit.
    """

    reflects = True

    sample: Sample
    aperture: Aperture
    #: d.
    direction: tuple[float, float, float]
    #: Of the entrance plane, mm.
    z_in: float
    #: E.
    irradiance: float
    #: Power of these rays.
    emitted: float
    #: See `at_pupil`.
    rays_at_pupil: Callable[[], RayState]
    #: As of a `Bundle`.
    clear: Tensor | None = None

    def at_pupil(self) -> RayState:
        """As of a `Bundle`."""
        return self.rays_at_pupil()

    def maker(self, backend) -> Callable[..., Fused | None]:
        """As of a `Bundle`."""
        return backend.beam_image

    def points(self) -> tuple[Tensor, Tensor]:
        """x (a, 1) and y (1, b) of a tensor product of points of the exit, or (N,) each, mm."""
        x, y = ((2.0 * c - 1.0) * r for c, r in zip((self.sample.u, self.sample.v), self.aperture.half_size, strict=True))
        return (x[:, None], y[None, :]) if self.sample.tensor else (x, y)

    def inside(self, n: float) -> tuple[float, float]:
        """k."""
        return slopes_inside(self.direction, n)

    def transmittance(self, n: float, fresnel: str) -> float:
        """T."""
        return float(entrance_transmittance(torch.tensor(1.0 / self.direction[2], dtype=torch.float64), n, fresnel))

    def rays(self, z: Tensor, slopes: tuple[Tensor, Tensor], n: float, fresnel: str) -> tuple[tuple, Tensor]:
        """Unit directions in front of the exit, and powers there, for its heights above the entrance, mm, and slopes, of the shape
        of the sample; differentiable once."""
        (x, y), (kx, ky) = self.points(), self.inside(n)
        over = 1.0 / math.sqrt(1.0 + kx * kx + ky * ky)
        lit = self.aperture.contains(x - kx * z.detach(), y - ky * z.detach())
        along = (1.0 - kx * slopes[0] - ky * slopes[1]).clamp_min(0.0)
        power = self.areas * self.irradiance * self.transmittance(n, fresnel) * torch.where(lit, along, 0.0)
        direction = tuple(torch.full_like(power, c * over) for c in (kx, ky, 1.0))
        return direction, power
