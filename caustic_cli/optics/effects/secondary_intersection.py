"""Secondary intersections: rays that leave a surface and hit it again, passing through the glass or being reflected once more.

The thesis neglects them; here they are computed at the last surface of a system, once per ray.  Reflectances follow the Fresnel
equations or Schlick's approximation for unpolarised light; roughness acts on direct light only.
"""

from __future__ import annotations

import math
from dataclasses import replace

import torch
from torch import Tensor

from caustic_cli.optics.effects.base import NO_REQUESTS, Action, Decision, Effect, Requests
from caustic_cli.optics.frames import rotate_to_global, rotate_to_local, to_global
from caustic_cli.optics.rays import RayState
from caustic_cli.optics.reintersection import hit_with_derivatives, next_intersection
from caustic_cli.optics.surfaces import HeightField
from caustic_cli.scene import Scene


class SecondaryIntersection(Effect):
    """Without it rays behind the surface are unobstructed."""

    name = "secondary-intersection"

    def decide(self, scene: Scene, b) -> Decision:
        """By a bound of the slopes against the angles of the exit rays."""
        if scene.behind:
            return Decision(
                self.name, False, "it is implemented at the last surface only, and other elements follow", present=False
            )
        slope, ratio = b.exit.slope, b.exit.slope_ratio
        if ratio < 1.0:
            why = f"slopes up to {slope:.3g} are {ratio:.3g} of those at which a ray that left could meet it again"
            return Decision(self.name, False, why, ratio, 1.0)
        return Decision(
            self.name,
            True,
            f"slopes up to {slope:.3g} may intersect a ray that has left",
            ratio if math.isfinite(ratio) else None,
            1.0,
        )

    def request(self, scene: Scene, on: bool, bounds) -> Requests:
        """A request to search for them."""
        return Requests.to(self.name) if on else NO_REQUESTS

    def action(self, system, requests: Requests) -> Action | None:
        """The action, if requested and if the last surface is a B-spline."""
        return SecondaryHits() if self.name in requests.on and isinstance(system.elements[-1].surface, HeightField) else None


class SecondaryHits(Action):
    """Removes rays with a secondary intersection from the direct light and traces them on."""

    stray = True

    def stray_light(self, tracer, parameters, interactions) -> list[RayState]:
        """The rays behind their secondary intersection, with losses."""
        m = interactions[-1]
        element, state, side = m.element, m.state, m.side
        surface, pose, heights = element.surface, element.pose, parameters[element.name]
        round_, interact = element.aperture.round, tracer.backend.interact
        full = state.full((*m.hit.local, *rotate_to_local(pose, state.direction)))
        full = [c.double() for c in full]
        t, met = next_intersection(surface, heights, full[:3], full[3:], below=(side > 0) == m.reflects, round=round_)
        met = met & (state.power > 0)
        at = met.nonzero()[:, 0]
        if not len(at):
            return []
        power = state.power.double()[at]
        state.power = torch.where(met, torch.zeros_like(state.power), state.power)
        d = [c[at] for c in full[3:]]
        o, g, _ = hit_with_derivatives(surface, heights, [c[at] for c in full[:3]], d, t[at])

        def leaving(o, d, power, account: dict) -> list[RayState]:
            return [
                replace(
                    state,
                    origin=to_global(pose, o, state.datum),
                    direction=rotate_to_global(pose, d),
                    power=power,
                    path=0.0,
                    polarised=None,
                    status=None,
                    lost={k: v.detach().sum() for k, v in account.items()},
                    sample=None,
                )
            ]

        if m.reflects:
            d = interact(d, g, power, eta=1.0, reflects=True, fresnel=element.fresnel, side=side).direction
            return leaving(o, d, power, {})
        eta, fresnel = m.n_in / m.n_out, element.fresnel
        if isinstance(eta, Tensor):  # gradient index: its value at the exit point, with a straight path inside, which is short
            eta = eta[at]
        entered = interact(d, g, power, eta=1.0 / eta, reflects=False, fresnel=fresnel, side=-side)
        t, through = next_intersection(surface, heights, o, entered.direction, below=side > 0, round=round_)
        none = torch.zeros_like(power)
        o, g, t = hit_with_derivatives(surface, heights, o, entered.direction, t)
        power_in = torch.where(through, entered.power, none)
        kept = power_in * torch.exp(-m.absorption * t) if m.absorption else power_in
        out = interact(entered.direction, g, kept, eta=eta, reflects=False, fresnel=fresnel, side=side)
        return leaving(
            o,
            out.direction,
            out.power,
            {
                "fresnel": torch.where(entered.passes, power - entered.power, none)
                + torch.where(out.passes, kept - out.power, none),
                "missed_surface": entered.power - power_in,
                "absorbed": power_in - kept,
                "total_internal_reflection": torch.where(out.passes, none, kept) + torch.where(entered.passes, none, power),
            },
        )
