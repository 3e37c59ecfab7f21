"""Intersection of oblique rays with the free-form surface."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from caustic_cli.optics.effects.base import Action, Decision, GeneralRayEffect, Requests
from caustic_cli.optics.surfaces import HeightField, SurfaceIntersection
from caustic_cli.scene import Scene


class Intersection(GeneralRayEffect):
    """Without it rays leave at their intersection with the plane of mean height."""

    name = "intersection"

    def decide(self, scene: Scene, b) -> Decision:
        """Needed for oblique rays inside the lens."""
        if scene.axial:
            return Decision(self.name, False, "rays of a plane wave are sampled on the surface itself", 0.0, 0.0)
        angle = math.degrees(b.inside)
        return Decision(self.name, True, f"rays {scene.lens.interaction.way} at up to {angle:.3g} degrees", angle, 0.0)

    def action(self, system, requests: Requests) -> Action | None:
        """The action that uses the mean plane instead, on request."""
        return MeanPlane() if self.name in requests.off else None


class MeanPlane(Action):
    """The approximation by the plane of mean height: the surface's height and slopes at the intersection with that plane."""

    #: Height of the points above the mean plane, mm, of rays that have just met it.
    _lift: Tensor | None = None

    def intersect(self, m, origin, direction, heights: Tensor | None) -> SurfaceIntersection | None:
        """Intersect the mean plane; the ray continues from the surface's height there, without additional path length."""
        surface = m.element.surface
        if not isinstance(surface, HeightField) or m.state.sample is not None:  # rays of a plane wave lie on the surface already
            return None
        assert heights is not None
        sag, mean = surface.centred(heights)
        t = (mean - origin[2]) / direction[2]
        x, y = (o + t * d for o, d in zip(origin[:2], direction[:2], strict=True))
        (rx, ry) = surface.half_size
        found = (x.abs() <= rx) & (y.abs() <= ry)
        z, gx, gy = surface.evaluate(sag, x.detach().clamp(-rx, rx), y.detach().clamp(-ry, ry))
        self._lift = torch.where(found, z, torch.zeros_like(z))
        t = torch.where(found, t, torch.zeros_like(t))
        return SurfaceIntersection(t, gx, gy, found)

    def before_interaction(self, m) -> None:
        """Shift the points from the mean plane to the surface."""
        if self._lift is not None:
            x, y, z = m.state.origin
            m.state.origin, self._lift = (x, y, z + self._lift), None
