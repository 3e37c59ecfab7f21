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

import math
from dataclasses import dataclass, field, replace

import torch
from torch import Tensor

from caustic_cli.optics import intersection
from caustic_cli.optics.bundle import Bundle
from caustic_cli.optics.emission import enter
from caustic_cli.optics.heightfield import HeightField
from caustic_cli.optics.interface import reflect, reflectance, reflectances, refract
from caustic_cli.optics.landing import Landing, Part, Status, collect
from caustic_cli.optics.meeting import again, touch
from caustic_cli.optics.polarisation import field_of, part_s
from caustic_cli.optics.reconstruction import Filter
from caustic_cli.optics.sampling import Sample, random_numbers
from caustic_cli.optics.tolerances import PARALLEL
from caustic_cli.scene import Scene, Screen

#: Odd constants that mix the bits of a ray's coordinates into one index (Knuth's and Steele's multipliers).
_MIX = (-7046029254386353131, -4417276706812531889, 0x632BE59BD9B4E019)


@dataclass(frozen=True)
class Steps:
    """What a trace does beyond what its scene's numbers say; the defaults are the sequential path.

    ghosts, again: as above; general: a plane wave is put through entrance and intersection too; entrance, intersect: False leaves
    them out where they matter, so that rays go on unbent, and leave where they cross the surface's mean height; reflects: False
    lets light beyond the critical angle leave along the surface.
    """

    ghosts: bool = False
    again: bool = False
    general: bool = False
    entrance: bool = True
    intersect: bool = True
    reflects: bool = True


SEQUENTIAL = Steps()


def needed(scene: Scene, steps: Steps) -> bool:
    """Whether a scene needs this, or the sequential tracers do."""
    lens = scene.lens
    polarised = scene.light.polarisation is not None and lens.fresnel == "exact"
    return bool(steps != SEQUENTIAL or lens.mirror or lens.absorption or lens.roughness or any(scene.screen.tilt) or polarised)


@dataclass
class Beam:
    """Rays on their way.  o: where they are, z from the tracer's reference (mm); d: unit directions; g: slopes of the surface there;
    power; length: mm of glass behind them; e: field of polarised light; returned: power reflected back into the glass, and totally:
    where by total reflection; status, lost: as of a `Landing`."""

    o: tuple
    d: tuple
    g: tuple
    power: Tensor
    length: Tensor | float
    e: tuple | None
    status: Tensor
    lost: dict[str, Tensor] = field(default_factory=dict)
    returned: Tensor | None = None
    totally: Tensor | None = None
    inward: tuple | None = None

    def lose(self, name: str, power: Tensor) -> None:
        """Add to the account."""
        self.lost[name] = self.lost.get(name, 0.0) + power.sum()


class StepTracer:
    """Traces rays by the steps that a scene needs; arguments as of `tracing.PlaneTracer`."""

    def __init__(self, scene: Scene, field: HeightField, rays: Sample | Bundle, dtype: torch.dtype, steps: Steps = SEQUENTIAL):
        self.scene, self.field, self.dtype, self.options = scene, field, dtype, steps
        lens = scene.lens
        if isinstance(rays, Sample) and steps.general:
            rays = _parallel(scene, rays)
        if isinstance(rays, Bundle) and not steps.entrance:
            dx, dy = rays.dx * lens.inside, rays.dy * lens.inside
            rays = replace(rays, dx=dx, dy=dy, dz=torch.sqrt(1.0 - dx * dx - dy * dy))
        self.rays = rays
        self.steps = [self._sampled if isinstance(rays, Sample) else self._meet]
        if isinstance(rays, Sample):
            self.evaluator = field.prepare(rays, dtype)
        if lens.absorption and not lens.mirror:
            self.steps.append(self._absorb)
        if lens.roughness:
            self.noise = tuple(lens.roughness * n.to(dtype) for n in _normal(rays))
            self.steps.append(self._roughen)
        self.steps.append(self._mirror if lens.mirror else self._refract)
        self.detours = [self._ghost] if steps.ghosts and not lens.mirror else []
        self.detours += [self._again] if steps.again else []

    def __call__(self, heights: Tensor, screen: Screen | None = None) -> list[Landing]:
        """Heights (n, m) mm float64 -> where the light lands: along the sequential path, then by detours."""
        screen, reference = screen or self.scene.screen, float(heights.detach().mean())
        beam = None
        for step in self.steps:
            beam = step(beam, heights, reference)
        beams = [beam, *(detour(beam, heights, reference) for detour in self.detours)]
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
        sag, gx, gy = self.evaluator((heights - reference).to(d))
        x, y = ((2.0 * s.u - 1.0) * rx).to(d), ((2.0 * s.v - 1.0) * ry).to(d)
        if s.tensor:
            x, y = x[:, None].expand(s.shape), y[None, :].expand(s.shape)
        emitted = torch.broadcast_to(s.share.to(d), s.shape)
        passed = 1.0 - reflectance("none" if lens.mirror else lens.fresnel, 1.0, 1.0, 1.0 / lens.inside)
        e = None
        if self.scene.light.polarisation is not None:
            e = field_of(self.scene.light.polarisation, (0.0, 0.0, 1.0))
        beam = Beam((x, y, sag), (0.0, 0.0, 1.0), (gx, gy), emitted * passed, (reference - z) + sag, e, _ok(sag))
        beam.lose("fresnel", emitted * (1.0 - passed))
        return beam

    def _meet(self, _, heights: Tensor, reference: float) -> Beam:
        b, d = self.rays, self.dtype
        if self.options.intersect:
            t, gx, gy, found = intersection.meet(self.field, heights, b)
            hit = found == intersection.Status.HIT
            x, y, z = b.x + t * b.dx, b.y + t * b.dy, b.z - reference + t * b.dz
        else:
            t, (rx, ry) = (reference - b.z) / b.dz, self.field.half_size
            x, y = b.x + t * b.dx, b.y + t * b.dy
            hit = (x.abs() <= rx) & (y.abs() <= ry)
            x, y = x.clamp(-rx, rx), y.clamp(-ry, ry)
            z, gx, gy = self.field.at(heights, x, y)
            z = z - reference
        none = torch.zeros_like(t)
        inside = torch.where(hit, b.share, none)
        e = None if b.field is None else tuple(c.to(d) for c in b.field)
        beam = Beam(tuple(c.to(d) for c in (x, y, z)), tuple(c.to(d) for c in (b.dx, b.dy, b.dz)), (gx.to(d), gy.to(d)),
                    inside.to(d), torch.where(hit, t, none).to(d), e, torch.where(hit, _ok(t), int(Status.MISSED_SURFACE)))
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

    def _ghost(self, beam: Beam, heights: Tensor, reference: float) -> Beam | None:
        """Light returned by the exit: back to the entrance, reflected there, and out through the exit."""
        lens, (rx, ry) = self.scene.lens, self.field.half_size
        keep = beam.returned.detach().reshape(-1).nonzero()[:, 0]
        if not len(keep):
            return None
        flat = [torch.broadcast_to(torch.as_tensor(c), beam.power.shape).reshape(-1)[keep].double()
                for c in (*beam.o, *beam.inward, *beam.g, beam.returned)]
        o, d, g, power = flat[:3], flat[3:6], flat[6:8], flat[8]
        totally = beam.totally.reshape(-1)[keep]
        d, _ = reflect(tuple(d), *g)
        down = d[2] < -PARALLEL
        back = torch.where(down, (lens.z_in - reference - o[2]) / torch.where(down, d[2], -torch.ones_like(d[2])), 0.0)
        x, y = o[0] + back * d[0], o[1] + back * d[1]
        on = down & (x.abs() <= rx) & (y.abs() <= ry)
        c = torch.where(on, -d[2], torch.ones_like(d[2]))
        outside = 1.0 - lens.index**2 * (1.0 - c * c)  # sin^2 by Snell's law at the flat entrance; below 0 it reflects all
        beyond = outside <= 0
        partly = reflectance(lens.fresnel, c, torch.where(beyond, torch.ones_like(outside), outside).sqrt(), lens.index)
        power = torch.where(on, power * torch.where(beyond, torch.ones_like(c), partly), 0.0)
        start = Bundle(x.detach().clamp(-rx, rx), y.detach().clamp(-ry, ry), lens.z_in, d[0].detach(), d[1].detach(),
                       c.detach(), power.detach(), {})
        t, status = intersection.find(self.field, heights, start)
        on &= status == intersection.Status.HIT
        t = torch.where(on, t, torch.zeros_like(t))
        z = torch.full_like(x, lens.z_in)
        out = self._exit(heights, reference, (torch.where(on, x, start.x), torch.where(on, y, start.y), z),
                         (d[0], d[1], c), t, torch.where(on, power, 0.0), back)
        for name, which in (("total_internal_reflection", totally), ("fresnel", ~totally)):
            out.lost[name] = -torch.where(which, out.power, torch.zeros_like(out.power)).sum()
        return out

    def _again(self, beam: Beam, heights: Tensor, reference: float) -> Beam | None:
        """Takes rays that meet the surface again off `beam`; they go through the glass, or off the mirror, once more."""
        lens, shape = self.scene.lens, beam.power.shape
        o, d = ([torch.broadcast_to(c, shape).reshape(-1).double() for c in v] for v in (beam.o, beam.d))
        o[2] = o[2] + reference
        t, met = again(self.field, heights, o, d, below=lens.mirror)
        met &= beam.power.reshape(-1) > 0
        at = met.nonzero()[:, 0]
        if not len(at):
            return None
        power = beam.power.reshape(-1).double()[at]
        beam.power = torch.where(met.view(shape), torch.zeros_like(beam.power), beam.power)
        hit, g, _ = touch(self.field, heights, [c[at] for c in o], [c[at] for c in d], t[at])
        if lens.mirror:
            d, _ = reflect(tuple(c[at] for c in d), *g)
            return Beam((hit[0], hit[1], hit[2] - reference), d, g, power, 0.0, None, _ok(power))
        d, _, c, s = refract(tuple(-v[at] for v in d), *g, 1.0 / lens.index)  # upside down: the normal looks into the air
        d, reflected = tuple(-v for v in d), reflectance(lens.fresnel if lens.fresnel == "none" else "exact", c, s, 1.0 / lens.index)
        inside = power * (1.0 - reflected)
        t, through = again(self.field, heights, hit, d, below=True)
        out = self._exit(heights, reference, hit, d, t, torch.where(through, inside, 0.0), 0.0)
        out.lose("fresnel", power - inside)
        out.lose("missed_surface", torch.where(through, torch.zeros_like(inside), inside))
        spent = torch.where(through, inside - out.power, torch.zeros_like(inside))
        out.lose("total_internal_reflection", torch.where(out.totally, spent, torch.zeros_like(spent)))
        out.lose("fresnel", torch.where(out.totally, torch.zeros_like(spent), spent))
        return out

    def _exit(self, heights: Tensor, reference: float, o, d, t: Tensor, power: Tensor, behind) -> Beam:
        """Out of the glass at distance t, `behind` mm of glass behind them already; nothing in the account."""
        lens = self.scene.lens
        hit, g, t = touch(self.field, heights, o, d, t)
        d, passes, c, s = refract(tuple(d), *g, lens.index)
        reflected = reflectance("none" if lens.fresnel == "none" else "exact", c, s, lens.index)
        if lens.absorption:
            power = power * torch.exp(-lens.absorption * (behind + t))
        out = torch.where(passes, power * (1.0 - reflected), torch.zeros_like(power))
        return Beam((hit[0], hit[1], hit[2] - reference), d, g, out, 0.0, None, _ok(out), totally=~passes)

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
    """Two independent standard normal numbers for each ray: a pure function of where it runs (Box and Muller)."""
    if isinstance(rays, Sample):
        bits = [c.double().contiguous().view(torch.int64) for c in (rays.u, rays.v)]
        mixed = [b * m for b, m in zip(bits, _MIX, strict=False)]
        index = mixed[0][:, None] ^ mixed[1][None, :] if rays.tensor else mixed[0] ^ mixed[1]
    else:
        bits = [c.contiguous().view(torch.int64) for c in (rays.x, rays.y, rays.dx)]
        index = bits[0] * _MIX[0] ^ bits[1] * _MIX[1] ^ bits[2] * _MIX[2]
    radius = torch.sqrt(-2.0 * torch.log(random_numbers(0, 11, index)))
    angle = 2.0 * math.pi * random_numbers(0, 12, index)
    return radius * torch.cos(angle), radius * torch.sin(angle)


def _along(d, g):
    """Unit directions along a surface of slopes g, where light at the critical angle goes."""
    c = (d[2] - d[0] * g[0] - d[1] * g[1]) / (1.0 + g[0] * g[0] + g[1] * g[1])
    t = d[0] + c * g[0], d[1] + c * g[1], d[2] - c
    length = torch.sqrt(t[0] * t[0] + t[1] * t[1] + t[2] * t[2]).clamp_min(PARALLEL)
    return tuple(v / length for v in t)


def _ok(like: Tensor) -> Tensor:
    return torch.zeros(like.shape, dtype=torch.int64, device=like.device)
