"""The point where a ray meets the free-form surface, which is not the one above the point where it entered."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from caustic_cli.optics.effects.base import Action, Decision, GeneralRayEffect, Requests
from caustic_cli.optics.surfaces import HeightField, SurfaceIntersection
from caustic_cli.scene import Scene


class Intersection(GeneralRayEffect):
    """Left out, rays leave where they cross the surface's mean height."""

    name = "intersection"

    def decide(self, scene: Scene, b) -> Decision:
        """On where rays run oblique inside the lens."""
        if scene.axial:
            return Decision(self.name, False, "rays of a plane wave are sampled on the surface itself", 0.0, 0.0)
        angle = math.degrees(b.inside)
        return Decision(self.name, True, f"rays cross the lens at up to {angle:.3g} degrees", angle, 0.0)

    def action(self, system, requests: Requests) -> Action | None:
        """Meets the mean plane instead."""
        return MeanPlane() if self.name in requests.off else None


class MeanPlane(Action):
    """A B-spline met where rays cross its mean height, with the height and the slopes that it has there."""

    def intersect(self, m, origin, direction, heights: Tensor | None) -> SurfaceIntersection | None:
        """The height there is what the ray goes on from; no time passes between it and the mean plane."""
        surface = m.element.surface
        if not isinstance(surface, HeightField) or m.state.sample is not None:  # a plane wave's rays stand on the surface itself
            return None
        assert heights is not None
        sag, mean = surface.centred(heights)
        t = (mean - origin[2]) / direction[2]
        x, y = (o + t * d for o, d in zip(origin[:2], direction[:2], strict=True))
        (rx, ry) = surface.half_size
        found = (x.abs() <= rx) & (y.abs() <= ry)
        z, gx, gy = surface.evaluate(sag, x.detach().clamp(-rx, rx), y.detach().clamp(-ry, ry))
        m.lift = torch.where(found, z, torch.zeros_like(z))
        t = torch.where(found, t, torch.zeros_like(t))
        return SurfaceIntersection(t, gx, gy, found)

    def before_interaction(self, m) -> None:
        """Onto the surface above or below."""
        if m.lift is not None:
            x, y, z = m.state.origin
            m.state.origin = (x, y, z + m.lift)
