"""Rays of one source point behind a flat entrance, through given points of the exit surface instead of the entrance.

For points of a tensor product the surface is then evaluated by rows, as for a plane wave: nothing is intersected.

Notation, for a source point at distance h in front of the entrance, whose glass has n times the index in front of it
    X, Y        point of the exit, from the source's projection, mm; q = X^2 + Y^2; z its height above the entrance, mm
    u           tangent of the ray's angle to the axis in front of the entrance over sqrt(q), 1/mm
    c           tangent of the angle behind it over the former, by Snell's law 1 / sqrt(n^2 + (n^2 - 1) q u^2);  k = u c
    s           q u^2 / (1 + q u^2), the squared sine of the angle in front of the entrance
    I, T        radiant intensity, 1/sr, and transmittance of the entrance;  J = I T cos^3 of that angle, a function of s
    N           (-z_x, -z_y, 1) at the exit

The ray crosses the entrance at (X, Y) h u from the projection and goes on along D = (k X, k Y, 1), so that

    u (h + z c) = 1,                        du/dz = -k / (h + z n^2 c^3).

The left side has the derivative h + z n^2 c^3 by u, is smaller than 1 at the paraxial value u = n / (n h + z), and concave in u:
Newton's iteration increases from there to the root.  With t = sqrt(q) u, a plane z = const receives dP = I T 2 pi t dt / (1 +
t^2)^(3/2) between the circles q and q + dq, 2 pi sqrt(q) d sqrt(q) = 2 pi t / u dt (h + z n^2 c^3) mm^2 of it; so the light through
dx dy of the exit is

    dP = E D . N dx dy,    E = J u / (h + z n^2 c^3) ,

none where D . N < 0: that light would arrive from above.  Every ray that leaves the exit is met once where D . N > 0 everywhere; a
ray that the surface cuts several times is counted at each exit, like the light of a plane wave behind an overhang.

The crossing of the entrance lies between the exit point and the source's projection.  Where that is inside the aperture, which is
convex and the same at both surfaces, and the cone of the source covers it, the lit points of the exit are thus those of the
aperture, whatever the heights.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, ClassVar, Self, cast

import numpy as np
import torch
from torch import Tensor

from caustic_cli.optics.backends import Fused
from caustic_cli.optics.interface import reflectance
from caustic_cli.optics.rays import RayState
from caustic_cli.optics.sampling import Sample

#: Degrees of the polynomials that J is approximated by, its relative error, and points at which that is measured.
DEGREES, ERROR, POINTS = (4, 8, 12, 16, 24), 1e-11, 257
#: Steps of the reference's iteration: convergence is quadratic.
STEPS = 60
#: Most steps in the fused kernel, and the relative size of a step that is not taken, since the next would be its square.
MOST_STEPS, EXACT = 30, 1e-13


class Bundle:
    """Some rays through points of the aperture of the last surface, of which a kernel makes an image from the source on."""

    #: The points, and the area of the aperture, mm^2, that each stands for.
    sample: Sample
    #: Whether the last surface is clear there, of the sample's shape; None everywhere.
    clear: Tensor | None

    @property
    def count(self) -> int:
        """Number of rays."""
        return self.sample.count

    @property
    def device(self) -> torch.device:
        """Where its points are."""
        return self.sample.device

    @property
    def areas(self) -> Tensor:
        """The clear area of the last surface, mm^2, that each point stands for."""
        return self.sample.flux if self.clear is None else self.sample.flux * self.clear

    def through(self, clear: Tensor | None) -> Self:
        """The same behind a last surface that is clear at these points alone, see `clear`."""
        return replace(cast(Any, self), clear=clear)

    #: Whether the fused kernel for them also reflects.
    reflects: ClassVar[bool] = False

    def at_pupil(self) -> RayState:
        """As many rays through the entrance's aperture."""
        raise NotImplementedError

    def maker(self, backend) -> Callable[..., Fused | None]:
        """What makes the fused kernel of a backend for such rays."""
        raise NotImplementedError


@dataclass(frozen=True, eq=False)
class Pencil(Bundle):
    """Some rays of one source point, through the points of a tensor product on the aperture of the last surface.

    sample: its points and the area of the aperture, mm^2, that each stands for, scalar or (a, b); half_size: of the aperture, mm.
    """

    sample: Sample
    half_size: tuple[float, float]
    #: Of the source point, mm, and of the entrance plane.
    position: tuple[float, float, float]
    z_in: float
    #: Radiant intensity, 1/sr, by the secant of the angle to z, of a source of power 1.
    intensity: Callable[[Tensor], Tensor | float]
    #: Power that the source emits for these rays.
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
        return backend.pencil_image

    @property
    def distance(self) -> float:
        """h, mm."""
        return self.z_in - self.position[2]

    def points(self) -> tuple[Tensor, Tensor]:
        """X (a, 1) and Y (1, b), mm."""
        x, y = (
            (2.0 * c - 1.0) * r - p for c, r, p in zip((self.sample.u, self.sample.v), self.half_size, self.position, strict=False)
        )
        return x[:, None], y[None, :]

    def entering(self, n: float, fresnel: str) -> tuple[Tensor, Tensor]:
        """Power through the aperture of the entrance, by its points of the same coordinates, and behind it, ()."""
        x, y = self.points()
        secant = torch.sqrt(1.0 + (x * x + y * y) / self.distance**2)
        power = self.intensity(secant) * self.sample.flux / (self.distance**2 * secant**3)
        power = power.expand(self.sample.shape) if isinstance(power, Tensor) else power
        return power.sum(), (power * entrance_transmittance(secant, n, fresnel)).sum()

    def emission(self, s: Tensor, n: float, fresnel: str) -> Tensor:
        """J, 1/sr, at s."""
        secant = 1.0 / torch.sqrt(1.0 - s)
        return self.intensity(secant) * entrance_transmittance(secant, n, fresnel) / secant**3

    def polynomial(self, n: float, fresnel: str) -> tuple[np.ndarray, float] | None:
        """J as a polynomial in 2 s / s_max - 1, the highest coefficient first, and s_max, the largest s at which the entrance is
        lit; None if it is no smooth function."""
        x, y = self.half_size[0] + abs(self.position[0]), self.half_size[1] + abs(self.position[1])
        q = x * x + y * y
        most = q / (q + self.distance**2)
        at = np.cos(np.linspace(0.0, np.pi, POINTS))
        wanted = self._emission_at(at, most, n, fresnel)
        for degree in DEGREES:
            fit = np.polynomial.Chebyshev.interpolate(lambda t: self._emission_at(t, most, n, fresnel), degree)
            coefficients = np.array(fit.convert(kind=np.polynomial.Polynomial).coef[::-1], np.float64)
            if np.abs(np.polyval(coefficients, at) - wanted).max() <= ERROR * wanted.max():
                return coefficients, most
        return None

    def _emission_at(self, at: np.ndarray, most: float, n: float, fresnel: str) -> np.ndarray:
        return self.emission(torch.from_numpy(0.5 * most * (np.asarray(at) + 1.0)), n, fresnel).expand(len(at)).numpy()

    def newton_steps(self, n: float, thickest: float) -> int:
        """Newton steps after which u is exact to rounding for any point at most `thickest` mm behind the entrance."""
        x, y = self.points()
        reach2 = float(x.square().max() + y.square().max())
        q, z = (c.ravel() for c in np.meshgrid(np.linspace(0.0, reach2, 65), np.linspace(0.0, max(thickest, 0.0), 9)))
        u, steps = n / (n * self.distance + z), 0
        while True:
            c = 1.0 / np.sqrt(n * n + (n - 1.0) * (n + 1.0) * q * u * u)
            step = (u * (self.distance + z * c) - 1.0) / (self.distance + z * n * n * c**3)
            if steps == MOST_STEPS or np.abs(step / u).max() < EXACT:
                return steps
            u, steps = u - step, steps + 1

    def rays(self, z: Tensor, slopes: tuple[Tensor, Tensor], n: float, fresnel: str) -> tuple[tuple, Tensor]:
        """Unit directions in front of the exit, and powers there, for its heights above the entrance, mm, and slopes, (a, b) each;
        differentiable once."""
        x, y = self.points()
        q, h = x * x + y * y, self.distance

        def step(u: Tensor, z: Tensor) -> Tensor:
            c = 1.0 / torch.sqrt(n * n + (n - 1.0) * (n + 1.0) * q * u * u)
            return (u * (h + z * c) - 1.0) / (h + z * n * n * c**3).detach()

        with torch.no_grad():
            u = n / (n * h + z)
            for _ in range(STEPS):
                u = u - step(u, z)
        u = u - step(u, z)  # attached: the exact derivative by z
        c = 1.0 / torch.sqrt(n * n + (n - 1.0) * (n + 1.0) * q * u * u)
        k, t = u * c, q * u * u
        density = self.emission(t / (1.0 + t), n, fresnel) * u / (h + z * n * n * c**3)
        along = 1.0 - k * (x * slopes[0] + y * slopes[1])
        over = 1.0 / torch.sqrt(1.0 + k * k * q)
        return (k * x * over, k * y * over, over), self.areas * density * along.clamp_min(0.0)


def entrance_transmittance(secant: Tensor, n: float, fresnel: str) -> Tensor:
    """T at angles with this secant in front of the entrance."""
    cosine = 1.0 / secant
    behind = torch.sqrt(1.0 - (1.0 - cosine * cosine) / (n * n))
    return 1.0 - reflectance(fresnel, cosine, behind, 1.0 / n)
