"""The rays of a scene's source, up to the inside of the lens' flat entrance (thesis 4.2, 4.3.1).

Nothing here depends on the heights, so a design does it once.

Notation, a source point at distance h before the entrance plane
    theta   angle of a ray to +z; theta_c half-angle of the cone
    w       1 - cos theta = 2 sin^2(theta / 2), which stays exact where 1 - cos loses all digits
    rho     distance on the entrance plane from the point below the source; r^2 = rho^2 + h^2

A ray sampled evenly over the cone carries an even share.  Aimed at an even sample of the aperture (area A), it carries the
power that dA takes: I(theta) cos theta / r^2 dA with I = 1 / (4 pi sin^2(theta_c / 2)), or for a Lambertian source
I = cos theta / (pi sin^2 theta_c).  A cone that lies within the aperture is sampled itself: no ray is wasted either way.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property

import torch
from torch import Tensor

from caustic_cli.errors import InputError
from caustic_cli.optics.bundle import Bundle
from caustic_cli.optics.interface import reflectance, reflectances
from caustic_cli.optics.polarisation import beyond, field_of, part_s
from caustic_cli.optics.sampling import SAMPLERS, Sampler, numbers
from caustic_cli.scene import PlaneWave, Points, Scene
from caustic_cli.scene.source import covering_cone


@dataclass(frozen=True, eq=False)
class Emission:
    """All rays of points or of a disc.

    Args:
        scene: its source is not a plane wave.
        kind: sampler, one of `sampling.SAMPLERS`.
        shape: cells (nu, nv) for each point; every one sends out as many rays.
        seed, device: as of a `Sampler`.
    """

    scene: Scene
    kind: str
    shape: tuple[int, int]
    seed: int = 0
    device: str | torch.device = "cpu"

    def __post_init__(self):
        if self.kind not in SAMPLERS:
            raise InputError(f"sampler must be one of {', '.join(SAMPLERS)}, got {self.kind!r}")

    @property
    def count(self) -> int:
        """Number of rays."""
        return self.shape[0] * self.shape[1] * len(self._points[0])

    def through(self, scene: Scene) -> Emission:
        """The same rays as another scene refracts them: of its own index and polarisation."""
        return self if scene is self.scene else replace(self, scene=scene)

    @cached_property
    def _points(self) -> tuple[Tensor, Tensor]:
        """Positions (k, 3) mm, and parts of the power (k,)."""
        source = self.scene.source
        if isinstance(source, Points):
            powers = torch.tensor(source.powers, dtype=torch.float64, device=self.device)
            return torch.tensor(source.positions, dtype=torch.float64, device=self.device), powers / powers.sum()
        one = torch.ones(1, dtype=torch.float64, device=self.device)
        return torch.tensor([source.position], dtype=torch.float64, device=self.device), one

    def chunks(self, size: int = 1 << 20) -> Iterator[Bundle]:
        """The rays in order, at most `size` at a time; their shares and what they lost sum to 1 over all chunks."""
        far = not isinstance(self.scene.source, Points) and self.scene.source.angle is not None
        for start in range(0, self.count, size):
            stop = min(start + size, self.count)
            dimensions = 2 if isinstance(self.scene.source, Points) else 4
            draws = numbers(self.kind, self.shape, self.seed, dimensions, start, stop, self.device)
            yield self._far(*draws) if far else self._near(torch.arange(start, stop, device=self.device), *draws)

    def _near(self, index: Tensor, u: Tensor, v: Tensor, a: Tensor | None = None, b: Tensor | None = None) -> Bundle:
        source, lens = self.scene.source, self.scene.lens
        (rx, ry), cone = lens.half_size, covering_cone(source, lens.half_size, lens.z_in, lens.round)
        per, (positions, powers) = self.shape[0] * self.shape[1], self._points
        which = index // per
        part = powers[which] / per  # emitted by each ray
        x0, y0, z0 = positions[which].unbind(1)
        h, ex, ey = lens.z_in - z0, 0.0, 0.0
        radius = h * math.tan(cone) if cone < math.pi / 2 else torch.full_like(h, math.inf)
        lows = [x0 - radius, y0 - radius]
        highs = [x0 + radius, y0 + radius]
        if a is not None:  # a point of the ellipse
            ex, ey = source.size[0] / 2.0, source.size[1] / 2.0
            lows, highs = [lows[0] - ex, lows[1] - ey], [highs[0] + ex, highs[1] + ey]
            x0, y0 = x0 + ex * a.sqrt() * torch.cos(2 * math.pi * b), y0 + ey * a.sqrt() * torch.sin(2 * math.pi * b)
        within = (lows[0] >= -rx) & (highs[0] <= rx) & (lows[1] >= -ry) & (highs[1] <= ry)
        if lens.round:
            within &= torch.maximum(-lows[0], highs[0]) ** 2 + torch.maximum(-lows[1], highs[1]) ** 2 <= rx * rx
        from_cone = within if source.aimed else torch.ones_like(within)

        lambertian = source.intensity == "lambertian"
        w_c = 2.0 * math.sin(cone / 2.0) ** 2
        sine2 = u * math.sin(cone) ** 2
        w = sine2 / (1.0 + torch.sqrt(1.0 - sine2)) if lambertian else u * w_c
        sine, cosine = torch.sqrt(w * (2.0 - w)), 1.0 - w
        tangent = sine / cosine.clamp_min(1e-300)
        cx, cy = tangent * torch.cos(2 * math.pi * v), tangent * torch.sin(2 * math.pi * v)  # tangents along x and y

        lows = [torch.maximum(lo, torch.full_like(lo, -r)) for lo, r in zip(lows, (rx, ry), strict=True)]
        highs = [torch.minimum(hi, torch.full_like(hi, r)) for hi, r in zip(highs, (rx, ry), strict=True)]
        wide, tall = (highs[0] - lows[0]).clamp_min(0.0), (highs[1] - lows[1]).clamp_min(0.0)
        ax, ay = (lows[0] + u * wide - x0) / h, (lows[1] + v * tall - y0) / h
        rho2 = ax * ax + ay * ay  # in units of h
        intensity = 1.0 / (math.pi * math.sin(cone) ** 2 * torch.sqrt(1.0 + rho2)) if lambertian else 1.0 / (2.0 * math.pi * w_c)
        # the clamp keeps infinities out; such rays are dark by the test of the cone or of the aperture
        aimed = part * (wide / h) * (tall / h) * intensity / (1.0 + rho2) ** 1.5
        limit = math.tan(cone) ** 2 * (1.0 + 2.0 * torch.finfo(torch.float64).eps) if cone < math.pi / 2 else math.inf
        aimed = torch.where(rho2 <= limit, aimed, torch.zeros_like(aimed))

        sx, sy = torch.where(from_cone, cx, ax), torch.where(from_cone, cy, ay)
        x, y = x0 + h * sx, y0 + h * sy
        on_lens = (x * x + y * y <= rx * rx) if lens.round else (x.abs() <= rx) & (y.abs() <= ry)
        share = torch.where(on_lens, torch.where(from_cone, part, aimed), torch.zeros_like(part))
        x, y = x.clamp(-rx, rx), y.clamp(-ry, ry)
        sx, sy = (x - x0) / h, (y - y0) / h  # rays that miss the lens stay finite; they carry nothing
        dz = 1.0 / torch.sqrt(1.0 + sx * sx + sy * sy)
        return enter(self.scene, x, y, sx * dz, sy * dz, dz, share, float(part.sum()))

    def _far(self, u: Tensor, v: Tensor, a: Tensor, b: Tensor) -> Bundle:
        (rx, ry), half = self.scene.lens.half_size, math.radians(self.scene.source.angle) / 2.0
        sine = a.sqrt() * math.sin(half)  # even over the projected solid angle: an evenly bright disc
        dx, dy = sine * torch.cos(2 * math.pi * b), sine * torch.sin(2 * math.pi * b)
        share, x, y = torch.full_like(u, 1.0 / self.count), (2.0 * u - 1.0) * rx, (2.0 * v - 1.0) * ry
        if self.scene.lens.round:  # even over the disc
            x, y = rx * u.sqrt() * torch.cos(2 * math.pi * v), rx * u.sqrt() * torch.sin(2 * math.pi * v)
        return enter(self.scene, x, y, dx, dy, torch.sqrt(1.0 - dx * dx - dy * dy), share, len(u) / self.count)


def enter(scene: Scene, x: Tensor, y: Tensor, dx: Tensor, dy: Tensor, dz: Tensor, share: Tensor, emitted: float) -> Bundle:
    """Rays of unit directions through points of the flat entrance: Snell keeps n (d_x, d_y), Fresnel takes its part.

    share: power of each that arrives there; emitted: of all at their source.
    """
    lens, n = scene.lens, scene.lens.inside
    ux, uy = dx / n, dy / n
    uz = torch.sqrt(1.0 - ux * ux - uy * uy)
    kind, field = "none" if lens.mirror else lens.fresnel, None
    if kind == "exact" and scene.light.polarisation is not None:
        before, after, flat = (dx, dy, dz), (ux, uy, uz), (0.0, 0.0, 1.0)
        e = field_of(scene.light.polarisation, before)
        (rs, rp), s = reflectances(dz, uz, 1.0 / n), part_s(e, before, flat)
        reflected, field = (s * rs + (1.0 - s) * rp) * share, beyond(e, before, after, flat, dz, uz, 1.0 / n)
    else:
        reflected = reflectance(kind, dz, uz, 1.0 / n) * share
    arriving, lost = float(share.sum()), float(reflected.sum())
    return Bundle(x, y, lens.z_in, ux, uy, uz, share - reflected, {"missed_lens": emitted - arriving, "fresnel": lost}, field,
                  lens.half_size[0] if lens.round else None)


Rays = Sampler | Emission


def rays_of(scene: Scene, kind: str, rays: int, seed: int = 0, device: str | torch.device = "cpu") -> Rays:
    """About `rays` rays of the scene's source, at least one for each of its points."""
    aspect = scene.lens.size[0] / scene.lens.size[1]
    if isinstance(scene.source, PlaneWave):
        profile = None if scene.source.profile is None else torch.from_numpy(scene.source.profile)
        return Sampler.of_size(kind, rays, aspect, seed=seed, profile=profile, device=device, round=scene.lens.round)
    points = len(scene.source.positions) if isinstance(scene.source, Points) else 1
    each = max(1, round(rays / points))
    nu = max(1, min(each, round(math.sqrt(each * aspect))))
    return Emission(scene, kind, (nu, max(1, round(each / nu))), seed, device)
