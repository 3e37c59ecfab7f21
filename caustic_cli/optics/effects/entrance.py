"""Refraction at the flat entrance."""

from __future__ import annotations

import math
from dataclasses import replace

from caustic_cli.optics.effects.base import NO_REQUESTS, Action, Effect, Requests, Verdict
from caustic_cli.optics.frames import turned_back
from caustic_cli.optics.rays import RayState
from caustic_cli.scene import Scene


class Entrance(Effect):
    """Left out, rays enter the glass unbent, with Fresnel's losses."""

    name = "entrance"

    def judge(self, scene: Scene, b) -> Verdict:
        """On where rays come slanted."""
        angle, collimated = math.degrees(b.incidence), scene.source.collimated
        if collimated or scene.lens.mirror or angle == 0:
            why = "there is no glass before a mirror" if scene.lens.mirror else "normal incidence on a flat entrance bends nothing"
            return Verdict(self.name, not collimated and not scene.lens.mirror, why, angle, 0.0)
        return Verdict(self.name, True, f"rays meet the entrance at up to {angle:.3g} degrees", angle, 0.0)

    def request(self, scene: Scene, on: bool, bounds) -> Requests:
        """Of a plane wave, to go by the general way; of others, not to bend."""
        if on == scene.source.collimated:
            return Requests.to(self.name) if on else Requests.to(without=(self.name,))
        return NO_REQUESTS

    def prepare(self, system, rays: RayState, requests: Requests) -> RayState:
        """A plane wave's rays as any others."""
        return general(rays) if self.name in requests.on else rays

    def action(self, system, requests: Requests) -> Action | None:
        """Keeps directions at a flat first element."""
        first = system.elements[0]
        return Unbent() if self.name in requests.off and first.surface.flat and not first.reflects else None


class Unbent(Action):
    """Straight through the first element."""

    def depart(self, m) -> None:
        """Directions as they came."""
        if m.index == 0 and m.forward:
            m.state.direction = turned_back(m.element.pose, m.incoming)


def general(rays: RayState) -> RayState:
    """Rays that forget that they stand on a sample of the aperture: they are put through every step of the general way."""
    rays = rays.spread()
    return replace(rays, direction=rays.full(rays.direction), sample=None)
