"""Ghost images: light that is reflected at two surfaces before it leaves the system.

The thesis neglects it; here it is computed.  For every pair of refracting elements i < j the light reflected at j is traced
backwards through the elements in between, reflected at i, and traced forwards through all that follow.  Reflectances follow the
Fresnel equations or Schlick's approximation for unpolarised light.  Roughness acts on direct light only.  The power of a ghost
behind the system is subtracted from the losses at j.
"""

from __future__ import annotations

from dataclasses import replace

import torch

from caustic_cli.optics.effects.base import NEGLIGIBLE, NO_REQUESTS, Action, Decision, Effect, Requests
from caustic_cli.optics.rays import RayState
from caustic_cli.scene import Scene


class Ghosts(Effect):
    """Without it internally reflected light is lost."""

    name = "ghosts"

    def decide(self, scene: Scene, b) -> Decision:
        """By a bound of the power that is reflected twice, and by an estimate of its contribution to the image, where it may
        focus."""
        amount = max(b.ghost, b.ghost_error)
        if amount <= NEGLIGIBLE:
            why = f"at most {b.ghost:.2%} of the power is reflected twice, which changes the image by about {b.ghost_error:.1g}"
            return Decision(self.name, False, why, amount, NEGLIGIBLE)
        if b.ghost_error > b.ghost:
            why = f"{b.ghost:.2%} of the power, reflected twice, may be focused and change the image by {b.ghost_error:.2g}"
            return Decision(self.name, True, why, amount, NEGLIGIBLE)
        return Decision(self.name, True, f"up to {b.ghost:.2%} of the power may be reflected twice", amount, NEGLIGIBLE)

    def request(self, scene: Scene, on: bool, bounds) -> Requests:
        """A request to trace them."""
        return Requests.to(self.name) if on else NO_REQUESTS

    def action(self, system, requests: Requests) -> Action | None:
        """The action, if requested and if there are two refracting elements."""
        return DoubleReflections() if self.name in requests.on and sum(not e.reflects for e in system.elements) > 1 else None


class DoubleReflections(Action):
    """A set of stray rays for each pair of elements."""

    stray = True

    def stray_light(self, tracer, parameters, interactions) -> list[RayState]:
        """The ghosts behind the last element."""
        found, elements = [], tracer.system.elements
        heights = [parameters.get(e.name) for e in elements]
        for j, m in enumerate(interactions):
            if m.reflects or not bool((m.power_in > m.out.power).any()):
                continue
            totally = ~m.out.passes
            for i in range(j - 1, -1, -1):
                if elements[i].reflects:  # ghosts between elements separated by a mirror are not traced
                    break
                ghost = replace(m.returned(), lost={}, status=None, polarised=None)
                for k in range(j - 1, i, -1):
                    ghost = tracer.trace_element(k, ghost, heights[k], forward=False, direct=False, parameters=parameters).state
                ghost = tracer.trace_element(i, ghost, heights[i], forward=False, direct=False, parameters=parameters).returned()
                for k in range(i + 1, len(elements)):
                    ghost = tracer.trace_element(k, ghost, heights[k], direct=False, parameters=parameters).state
                with torch.no_grad():
                    of_total = torch.where(totally, ghost.power, torch.zeros_like(ghost.power)).sum(dtype=torch.float64)
                    lost = {"total_internal_reflection": -of_total, "fresnel": of_total - ghost.power.sum(dtype=torch.float64)}
                found.append(replace(ghost, lost=lost))
        return found
