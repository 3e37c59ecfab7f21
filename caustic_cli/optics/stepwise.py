"""A trace put together from steps, for scenes with an effect that the fused kernels do not know.

A tracer is prepared with the steps that its scene has, and no others: an effect that is absent is no step, so it costs nothing.

    meet       the free-form surface: rays of a plane wave are sampled on it, others are intersected with it
    absorb     in the glass on the way there (Beer-Lambert)
    roughen    the surface is made of microfacets, of which every ray meets one
    bend       Snell's law and Fresnel's, or a mirror
    again      rays that leave and meet the surface once more
    ghosts     light reflected at the exit, then at the entrance, that leaves through the exit after all

Everything is plain torch and differentiable in reverse mode.  What a step takes from the light is in the account by name; a ghost
is taken off what had been lost before.  Microfacets neither shade nor hide each other, which needs slopes of a few tenths at most.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from caustic_cli.optics import intersection
from caustic_cli.optics.beam import Beam, unlost
from caustic_cli.optics.bundle import Bundle
from caustic_cli.optics.detours import ghost, second_meeting
from caustic_cli.optics.emission import enter
from caustic_cli.optics.heightfield import HeightField
from caustic_cli.optics.interface import reflect, reflectance, reflectances, refract
from caustic_cli.optics.kernels import fused, precision
from caustic_cli.optics.landing import Landing, Part, Status, collect
from caustic_cli.optics.meeting import surface_at
from caustic_cli.optics.polarisation import field_of, part_s
from caustic_cli.optics.reconstruction import Filter
from caustic_cli.optics.sampling import Sample, normal_numbers
from caustic_cli.optics.tolerances import PARALLEL
from caustic_cli.scene import Scene, Screen

#: Odd constants that mix the bits of a ray's coordinates into one index (Knuth's and Steele's multipliers).
_MIX = (-7046029254386353131, -4417276706812531889, 0x632BE59BD9B4E019)
#: Seed of the microfacets' slopes.
FACETS = 0xFACE7


@dataclass(frozen=True)
class Steps:
    """What a trace does beyond what its scene's numbers say; the defaults are the sequential path.

    ghosts, again: as above; general: a plane wave is put through entrance and intersection too; entrance, intersect: False leaves
    them out where they matter, so that rays go on unbent, and leave where they cross the surface's mean height; reflects: False
    lets light beyond the critical angle leave along the surface; plain: put together from steps even without need.
    """

    ghosts: bool = False
    again: bool = False
    general: bool = False
    entrance: bool = True
    intersect: bool = True
    reflects: bool = True
    plain: bool = False


SEQUENTIAL = Steps()


def needed(scene: Scene, steps: Steps) -> bool:
    """Whether a scene needs this, or the sequential tracers do."""
    lens = scene.lens
    polarised = scene.light.polarisation is not None and lens.fresnel == "exact"
    return bool(steps != SEQUENTIAL or lens.mirror or lens.absorption or lens.roughness or any(scene.screen.tilt) or polarised)


class StepTracer:
    """Traces rays by the steps that a scene needs; arguments as of `tracing.PlaneTracer`."""

    def __init__(self, scene: Scene, field: HeightField, rays: Sample | Bundle, dtype: torch.dtype, steps: Steps = SEQUENTIAL):
        dtype = precision(dtype, (rays.u if isinstance(rays, Sample) else rays.x).device)
        self.scene, self.field, self.dtype, self.options = scene, field, dtype, steps
        lens = scene.lens
        if isinstance(rays, Sample) and steps.general:
            rays = _parallel(scene, rays)
        if isinstance(rays, Bundle) and not steps.entrance:
            dx, dy = rays.dx * lens.inside, rays.dy * lens.inside
            rays = replace(rays, dx=dx, dy=dy, dz=torch.sqrt(1.0 - dx * dx - dy * dy))
        self.rays = rays
        self.steps = [self._sampled if isinstance(rays, Sample) else self._meet]
        self.surface = self._surface()
        if lens.absorption and not lens.mirror:
            self.steps.append(self._absorb)
        if lens.roughness:
            self.noise = tuple(lens.roughness * n.to(dtype) for n in _normal(rays))
            self.steps.append(self._roughen)
        self.steps.append(self._mirror if lens.mirror else self._refract)
        self.detours = [second_meeting] if steps.again else []
        self.detours += [ghost] if steps.ghosts and not lens.mirror else []

    def _surface(self) -> Callable:
        """heights -> sag, slopes of rays sampled on the surface, or t, slopes and hits of others; on a CPU by the kernels."""
        rays, field, dtype = self.rays, self.field, self.dtype
        on_cpu = fused((rays.u if isinstance(rays, Sample) else rays.x).device)
        if on_cpu and not (isinstance(rays, Sample) and rays.tensor):
            from caustic_cli.optics.kernels.surface import FusedSurface, RayHits, scattered_surface  # noqa: PLC0415

            surface = FusedSurface(field.spaces, field.half_size)
            if isinstance(rays, Sample):
                u, v = rays.u.contiguous().numpy(), rays.v.contiguous().numpy()
                return lambda sag: scattered_surface(surface, sag, u, v)
            hits = RayHits(surface, rays)

            def met(heights: Tensor) -> tuple:
                found = hits(heights)
                return *found, found[0].detach() >= 0

            return met
        if isinstance(rays, Sample):
            return field.prepare(rays, dtype)

        def meet(heights: Tensor) -> tuple:
            *found, status = intersection.meet(field, heights, rays)
            return *found, status == intersection.Status.HIT

        return meet

    def __call__(self, heights: Tensor, screen: Screen | None = None) -> list[Landing]:
        """Heights (n, m) mm float64 -> where the light lands: along the sequential path, then by detours."""
        screen, reference = screen or self.scene.screen, float(heights.detach().mean())
        beam = None
        for step in self.steps:
            beam = step(beam, heights, reference)
        beams = [beam, *(detour(self.scene.lens, self.field, beam, heights, reference) for detour in self.detours)]
        return [self._land(b, screen, reference) for b in beams if b is not None]

    def expose(self, heights: Tensor, screen: Screen, filter: Filter) -> Part:
        """Heights (n, m) mm float64 -> image and energy account on a screen."""
        parts = [collect(landing, screen, filter) for landing in self(heights, screen)]
        lost: dict[str, Tensor] = {}
        for part in parts:
            for name, value in part.lost.items():
                lost[name] = lost.get(name, 0.0) + value.detach()
        if isinstance(self.rays, Bundle):
            for name, value in self.rays.lost.items():
                lost[name] = lost.get(name, 0.0) + value
        return Part(sum(p.image for p in parts), sum(p.leaving for p in parts), lost)

    # Steps: (beam so far, heights, height of z = 0) -> beam.

    def _sampled(self, _, heights: Tensor, reference: float) -> Beam:
        lens, s, d = self.scene.lens, self.rays, self.dtype
        (rx, ry), z = self.field.half_size, self.scene.lens.z_in
        sag, gx, gy = self.surface((heights - reference).to(d))
        x, y = ((2.0 * s.u - 1.0) * rx).to(d), ((2.0 * s.v - 1.0) * ry).to(d)
        if s.tensor:
            x, y = x[:, None].expand(s.shape), y[None, :].expand(s.shape)
        emitted = torch.broadcast_to(s.share.to(d), s.shape)
        passed = 1.0 - reflectance("none" if lens.mirror else lens.fresnel, 1.0, 1.0, 1.0 / lens.inside)
        e = None
        if self.scene.light.polarisation is not None:
            e = field_of(self.scene.light.polarisation, (0.0, 0.0, 1.0))
        beam = Beam((x, y, sag), (0.0, 0.0, 1.0), (gx, gy), emitted * passed, (reference - z) + sag, e, unlost(sag))
        beam.lose("fresnel", emitted * (1.0 - passed))
        return beam

    def _meet(self, _, heights: Tensor, reference: float) -> Beam:
        b, d = self.rays, self.dtype
        if self.options.intersect:
            t, gx, gy, hit = self.surface(heights)
            x, y, z = b.x + t * b.dx, b.y + t * b.dy, b.z - reference + t * b.dz
        else:
            t, (rx, ry) = (reference - b.z) / b.dz, self.field.half_size
            x, y = b.x + t * b.dx, b.y + t * b.dy
            hit = (x * x + y * y <= rx * rx) if self.scene.lens.round else (x.abs() <= rx) & (y.abs() <= ry)
            x, y = x.clamp(-rx, rx), y.clamp(-ry, ry)
            z, gx, gy = surface_at(self.field, heights, x, y)
            z = z - reference
        none = torch.zeros_like(t)
        inside = torch.where(hit, b.share, none)
        e = None if b.field is None else tuple(c.to(d) for c in b.field)
        beam = Beam(tuple(c.to(d) for c in (x, y, z)), tuple(c.to(d) for c in (b.dx, b.dy, b.dz)), (gx.to(d), gy.to(d)),
                    inside.to(d), torch.where(hit, t, none).to(d), e, torch.where(hit, unlost(t), int(Status.MISSED_SURFACE)))
        beam.lose("missed_surface", (b.share - inside).to(d))
        return beam

    def _absorb(self, beam: Beam, _, __) -> Beam:
        passes = torch.exp(-self.scene.lens.absorption * beam.length)
        beam.lose("absorbed", beam.power * (1.0 - passes))
        beam.power = beam.power * passes
        return beam

    def _roughen(self, beam: Beam, _, __) -> Beam:
        beam.g = tuple(g + n for g, n in zip(beam.g, self.noise, strict=True))
        return beam

    def _mirror(self, beam: Beam, _, __) -> Beam:
        beam.d, _ = reflect(beam.d, *beam.g)
        return beam

    def _refract(self, beam: Beam, _, __) -> Beam:
        lens, d = self.scene.lens, beam.d
        beam.inward = d
        beam.d, passes, c, s = refract(d, *beam.g, lens.index)
        if not self.options.reflects:
            beam.d = tuple(torch.where(passes, t, g) for t, g in zip(beam.d, _along(d, beam.g), strict=True))
            s = torch.where(passes, s, torch.zeros_like(s))
            passes = torch.ones_like(passes)
        if beam.e is not None and lens.fresnel == "exact":
            (rs, rp), part = reflectances(c, s, lens.index), part_s(beam.e, d, (-beam.g[0], -beam.g[1], 1.0))
            reflected = part * rs + (1.0 - part) * rp
        else:
            length = torch.sqrt(1.0 + beam.g[0] ** 2 + beam.g[1] ** 2) if lens.fresnel == "schlick" else 1.0
            reflected = reflectance(lens.fresnel, c / length, s / length, lens.index)
        none, before = torch.zeros_like(beam.power), beam.power
        beam.power = torch.where(passes, before * (1.0 - reflected), none)
        beam.returned, beam.totally = before - beam.power, ~passes
        beam.lose("fresnel", torch.where(passes, beam.returned, none))
        beam.lose("total_internal_reflection", torch.where(passes, none, before))
        beam.status = torch.where(passes | (before == 0), beam.status, int(Status.TOTAL_INTERNAL_REFLECTION))
        return beam

    def _land(self, beam: Beam, screen: Screen, reference: float) -> Landing:
        """Straight on to the screen's plane."""
        (ox, oy, oz), (dx, dy, dz), forward = beam.o, beam.d, -1.0 if self.scene.lens.mirror else 1.0
        if any(screen.tilt):
            along, up, normal = screen.axes
            (sx, sy), sz = screen.shift, screen.z - reference
            away = (sx - ox) * normal[0] + (sy - oy) * normal[1] + (sz - oz) * normal[2]
            speed = dx * normal[0] + dy * normal[1] + dz * normal[2]
        else:
            away, speed = screen.z - reference - oz, dz
        arrives = forward * speed > PARALLEL
        path = away / torch.where(arrives, speed, torch.ones_like(speed))
        on_way = arrives & (path > 0)
        path = torch.where(on_way, path, torch.zeros_like(path))
        x, y = ox + path * dx, oy + path * dy
        if any(screen.tilt):
            qx, qy, qz = x - sx, y - sy, oz + path * dz - sz
            x = sx + qx * along[0] + qy * along[1] + qz * along[2]
            y = sy + qx * up[0] + qy * up[1] + qz * up[2]
        weight = torch.where(on_way, beam.power, torch.zeros_like(beam.power))
        leaving = beam.power.sum()
        lost = {**beam.lost, "off_screen": (beam.power - weight).sum()}
        status = torch.where((beam.status == Status.OK) & ~on_way, int(Status.AWAY_FROM_SCREEN), beam.status)
        return Landing(x, y, weight, status, lost, leaving)


def _parallel(scene: Scene, sample: Sample) -> Bundle:
    """The rays of a plane wave from the entrance on."""
    (rx, ry), shape = scene.lens.half_size, sample.shape
    u, v = (sample.u[:, None], sample.v[None, :]) if sample.tensor else (sample.u, sample.v)
    x, y = (torch.broadcast_to((2.0 * a - 1.0) * r, shape).reshape(-1) for a, r in ((u, rx), (v, ry)))
    share, none = torch.broadcast_to(sample.share, shape).reshape(-1), torch.zeros_like(x)
    return enter(scene, x, y, none, none, torch.ones_like(x), share, float(share.sum()))


def _normal(rays: Sample | Bundle) -> tuple[Tensor, Tensor]:
    """Two independent standard normal numbers for each ray: a pure function of where it runs."""
    if isinstance(rays, Sample):
        bits = [c.double().contiguous().view(torch.int64) for c in (rays.u, rays.v)]
        mixed = [b * m for b, m in zip(bits, _MIX, strict=False)]
        index = mixed[0][:, None] ^ mixed[1][None, :] if rays.tensor else mixed[0] ^ mixed[1]
    else:
        bits = [c.contiguous().view(torch.int64) for c in (rays.x, rays.y, rays.dx)]
        index = bits[0] * _MIX[0] ^ bits[1] * _MIX[1] ^ bits[2] * _MIX[2]
    return normal_numbers(FACETS, index)


def _along(d, g):
    """Unit directions along a surface of slopes g, where light at the critical angle goes."""
    c = (d[2] - d[0] * g[0] - d[1] * g[1]) / (1.0 + g[0] * g[0] + g[1] * g[1])
    t = d[0] + c * g[0], d[1] + c * g[1], d[2] - c
    length = torch.sqrt(t[0] * t[0] + t[1] * t[1] + t[2] * t[2]).clamp_min(PARALLEL)
    return tuple(v / length for v in t)
