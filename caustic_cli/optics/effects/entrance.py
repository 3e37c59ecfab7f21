"""Refraction at the entrance."""

from __future__ import annotations

import math

from caustic_cli.optics.effects.base import Action, Decision, GeneralRayEffect, Requests
from caustic_cli.optics.frames import rotate_to_global
from caustic_cli.scene import Scene


class Entrance(GeneralRayEffect):
    """Without it rays enter the glass undeviated, with Fresnel losses."""

    name = "entrance"

    def decide(self, scene: Scene, b) -> Decision:
        """Needed at oblique incidence."""
        angle, collimated = math.degrees(b.incidence), scene.source.collimated
        if scene.two_sided:
            return Decision(self.name, True, "the entrance is free-form", fixed=True)
        if scene.in_front:
            return Decision(self.name, True, f"other lenses send rays to it at up to {angle:.3g} degrees", angle, fixed=True)
        if collimated or scene.lens.mirror or angle == 0:
            why = "there is no glass before a mirror" if scene.lens.mirror else "normal incidence on a flat entrance bends nothing"
            return Decision(self.name, not collimated and not scene.lens.mirror, why, angle, 0.0)
        return Decision(self.name, True, f"rays meet the entrance at up to {angle:.3g} degrees", angle, 0.0)

    def action(self, system, requests: Requests) -> Action | None:
        """The action that omits refraction at a plane first element, on request."""
        first = system.elements[0]
        return NoRefraction() if self.name in requests.off and first.surface.flat and not first.reflects else None


class NoRefraction(Action):
    """Undeviated transmission through the first element."""

    def after_interaction(self, m) -> None:
        """Restore the incident directions."""
        if m.index == 0 and m.forward:
            m.state.direction = rotate_to_global(m.element.pose, m.hit.incoming)
