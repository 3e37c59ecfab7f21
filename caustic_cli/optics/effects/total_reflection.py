"""Total internal reflection beyond the critical angle."""

from __future__ import annotations

import torch

from caustic_cli.optics.effects.base import NO_REQUESTS, Action, Decision, Effect, Requests
from caustic_cli.optics.frames import rotate_to_global, rotate_to_local
from caustic_cli.optics.tolerances import PARALLEL
from caustic_cli.scene import Scene


class TotalReflection(Effect):
    """Without it light beyond the critical angle leaves tangentially to the surface."""

    name = "total-reflection"
    free = True

    def decide(self, scene: Scene, b) -> Decision:
        """By the bound of n sin i."""
        at = b.exit
        if scene.elements:
            return Decision(self.name, True, "total reflection may occur at other lenses", fixed=True)
        if at.critical < 1.0:
            return Decision(self.name, False, f"n sin i <= {at.critical:.4g} at slopes up to {at.slope:.3g}", at.critical, 1.0)
        return Decision(self.name, True, f"n sin i may reach {at.critical:.4g} at slopes up to {at.slope:.3g}", at.critical, 1.0)

    def request(self, scene: Scene, on: bool, bounds) -> Requests:
        """A request to omit it, where it may occur."""
        return NO_REQUESTS if on or bounds.exit.critical < 1.0 else Requests.to(without=(self.name,))

    def action(self, system, requests: Requests) -> Action | None:
        """The action that transmits the light instead, on request."""
        return GrazingExit() if self.name in requests.off else None


class GrazingExit(Action):
    """Transmission of totally reflected light tangentially to the surface, with the Fresnel losses of grazing incidence."""

    def after_interaction(self, m) -> None:
        """Replace directions by the tangent in the plane of incidence."""
        if m.reflects or not m.direct or bool(m.out.passes.all()) or not isinstance(m.hit.slopes[0], torch.Tensor):
            return
        d, g, pose, passes = m.hit.incoming, m.hit.slopes, m.element.pose, m.out.passes
        c = (d[2] - d[0] * g[0] - d[1] * g[1]) / (1.0 + g[0] * g[0] + g[1] * g[1])
        along = d[0] + c * g[0], d[1] + c * g[1], d[2] - c
        length = torch.sqrt(along[0] ** 2 + along[1] ** 2 + along[2] ** 2).clamp_min(PARALLEL)
        out = rotate_to_local(pose, m.state.direction)
        tangent = tuple(torch.where(passes, o, v / length) for o, v in zip(out, along, strict=True))
        m.state.direction = rotate_to_global(pose, tangent)
        fresnel = 0.0 if m.element.fresnel == "none" else 1.0  # the reflectance at grazing incidence is 1
        back = torch.where(passes, torch.zeros_like(m.power_in), m.power_in)
        m.state.power = m.state.power + (1.0 - fresnel) * back
        power = m.out.power + (1.0 - fresnel) * back
        m.out = m.out._replace(power=power, passes=torch.ones_like(passes))  # so that it causes no ghosts
        m.state.lose("total_internal_reflection", -back.detach())
        m.state.lose("fresnel", fresnel * back.detach())
