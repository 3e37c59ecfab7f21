"""Light that does not go straight through: reflected twice inside the lens, or caught by the surface it has left.

The thesis takes both for negligible; here they are measured.  Only the first detour is followed.  Reflectances are those of
unpolarised light, and the surface is met without microfacets from here on.
"""

from __future__ import annotations

import torch
from torch import Tensor

from caustic_cli.optics import intersection
from caustic_cli.optics.beam import Beam, unlost
from caustic_cli.optics.bundle import Bundle
from caustic_cli.optics.heightfield import HeightField
from caustic_cli.optics.interface import reflect, reflectance, refract
from caustic_cli.optics.meeting import again, touch
from caustic_cli.optics.tolerances import PARALLEL
from caustic_cli.scene import Lens


def ghost(lens: Lens, field: HeightField, beam: Beam, heights: Tensor, reference: float) -> Beam | None:
    """Light returned by the exit: back to the entrance, reflected there, and out through the exit."""
    rx, ry = field.half_size
    keep = beam.returned.detach().reshape(-1).nonzero()[:, 0]
    if not len(keep):
        return None
    flat = [torch.broadcast_to(torch.as_tensor(c, device=beam.power.device), beam.power.shape).reshape(-1)[keep].double()
            for c in (*beam.o, *beam.inward, *beam.g, beam.returned)]
    o, d, g, power = flat[:3], flat[3:6], flat[6:8], flat[8]
    totally = beam.totally.reshape(-1)[keep]
    d, _ = reflect(tuple(d), *g)
    down = d[2] < -PARALLEL
    back = torch.where(down, (lens.z_in - reference - o[2]) / torch.where(down, d[2], -torch.ones_like(d[2])), 0.0)
    x, y = o[0] + back * d[0], o[1] + back * d[1]
    on = down & ((x * x + y * y <= rx * rx) if lens.round else (x.abs() <= rx) & (y.abs() <= ry))
    c = torch.where(on, -d[2], torch.ones_like(d[2]))
    outside = 1.0 - lens.index**2 * (1.0 - c * c)  # sin^2 by Snell's law at the flat entrance; below 0 it reflects all
    beyond = outside <= 0
    partly = reflectance(lens.fresnel, c, torch.where(beyond, torch.ones_like(outside), outside).sqrt(), lens.index)
    power = torch.where(on, power * torch.where(beyond, torch.ones_like(c), partly), 0.0)
    start = Bundle(x.detach().clamp(-rx, rx), y.detach().clamp(-ry, ry), lens.z_in, d[0].detach(), d[1].detach(),
                   c.detach(), power.detach(), {}, radius=rx if lens.round else None)
    t, status = intersection.find(field, heights, start)
    on = on & (status == intersection.Status.HIT)
    t = torch.where(on, t, torch.zeros_like(t))
    z = torch.full_like(x, lens.z_in)
    o = torch.where(on, x, start.x), torch.where(on, y, start.y), z
    out, _ = _exit(lens, field, heights, reference, o, (d[0], d[1], c), t, torch.where(on, power, 0.0), back)
    for name, which in (("total_internal_reflection", totally), ("fresnel", ~totally)):
        out.lost[name] = -torch.where(which, out.power, torch.zeros_like(out.power)).sum()
    return out


def second_meeting(lens: Lens, field: HeightField, beam: Beam, heights: Tensor, reference: float) -> Beam | None:
    """Takes rays that meet the surface again off `beam`; they go through the glass, or off the mirror, once more."""
    shape = beam.power.shape
    o, d = ([torch.broadcast_to(c, shape).reshape(-1).double() for c in v] for v in (beam.o, beam.d))
    o[2] = o[2] + reference
    t, met = again(field, heights, o, d, below=lens.mirror, round=lens.round)
    met &= beam.power.reshape(-1) > 0
    at = met.nonzero()[:, 0]
    if not len(at):
        return None
    power = beam.power.reshape(-1).double()[at]
    beam.power = torch.where(met.view(shape), torch.zeros_like(beam.power), beam.power)
    hit, g, _ = touch(field, heights, [c[at] for c in o], [c[at] for c in d], t[at])
    if lens.mirror:
        d, _ = reflect(tuple(c[at] for c in d), *g)
        return Beam((hit[0], hit[1], hit[2] - reference), d, g, power, 0.0, None, unlost(power))
    d, _, c, s = refract(tuple(-v[at] for v in d), *g, 1.0 / lens.index)  # upside down: the normal looks into the air
    d = tuple(-v for v in d)
    reflected = reflectance("none" if lens.fresnel == "none" else "exact", c, s, 1.0 / lens.index)
    inside = power * (1.0 - reflected)
    t, through = again(field, heights, hit, d, below=True, round=lens.round)
    out, arriving = _exit(lens, field, heights, reference, hit, d, t, torch.where(through, inside, 0.0), 0.0)
    out.lose("fresnel", power - inside)
    none = torch.zeros_like(inside)
    out.lose("missed_surface", torch.where(through, none, inside))
    out.lose("absorbed", torch.where(through, inside - arriving, none))
    out.lose("total_internal_reflection", torch.where(out.totally, arriving, none))
    out.lose("fresnel", torch.where(out.totally, none, arriving - out.power))
    return out


def _exit(lens: Lens, field: HeightField, heights: Tensor, reference: float, o, d, t: Tensor, power: Tensor,
          behind) -> tuple[Beam, Tensor]:
    """Out of the glass at distance t, `behind` mm of glass behind them already: what leaves, with nothing in its account, and the
    power that arrived at the surface."""
    hit, g, t = touch(field, heights, o, d, t)
    d, passes, c, s = refract(tuple(d), *g, lens.index)
    reflected = reflectance("none" if lens.fresnel == "none" else "exact", c, s, lens.index)
    if lens.absorption:
        power = power * torch.exp(-lens.absorption * (behind + t))
    out = torch.where(passes, power * (1.0 - reflected), torch.zeros_like(power))
    return Beam((hit[0], hit[1], hit[2] - reference), d, g, out, 0.0, None, unlost(out), totally=~passes), power
