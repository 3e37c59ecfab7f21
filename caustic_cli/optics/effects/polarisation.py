"""Polarisation: different Fresnel reflectances of s- and p-polarised light, see `optics.polarisation`."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from caustic_cli.optics.effects.base import NEGLIGIBLE, Action, Decision, Effect, Probe, Requests
from caustic_cli.optics.frames import rotate_to_global, rotate_to_local
from caustic_cli.optics.interface import refract
from caustic_cli.optics.polarisation import polarisation_vector, transmitted_field
from caustic_cli.optics.rays import RayState
from caustic_cli.scene import Scene


class Polarisation(Effect):
    """Without it every surface has the mean reflectance of s and p."""

    name = "polarisation"
    of_glass = True

    def decide(self, scene: Scene, b) -> Decision:
        """Needed for polarised light, and where the polarisation by the entrance changes the reflectance of the exit noticeably."""
        light, lens = scene.light, scene.lens
        if lens.fresnel != "exact":
            return Decision(self.name, False, f"fresnel = {lens.fresnel} knows no polarisation", present=False)
        if light.polarisation is not None:
            return Decision(self.name, True, f"the source is polarised at {light.polarisation:g} degrees")
        if b.incidence == 0:
            return Decision(self.name, False, "unpolarised light at normal incidence stays unpolarised", 0.0, NEGLIGIBLE)
        some = b.polarised > NEGLIGIBLE
        return Decision(
            self.name,
            some,
            "unpolarised light; polarisation at the entrance changes the reflectance of the exit by"
            f" {'up to' if some else 'at most'} {b.polarised:.1e}",
            b.polarised,
            NEGLIGIBLE,
        )

    def without(self, scene: Scene) -> Scene:
        """With unpolarised light."""
        light = scene.light
        return scene if light.polarisation is None else replace(scene, light=replace(light, polarisation=None))

    def including(self, scene: Scene) -> Scene:
        """With unpolarised light traced as two orthogonal polarisations."""
        return scene if scene.light.polarisation is not None else replace(scene, light=replace(scene.light, tracked=True))

    def probe(self, scene: Scene, heights: Tensor) -> Probe | None:
        """Linear polarisation along x."""
        if scene.lens.fresnel != "exact":
            return None
        return Probe(replace(scene, light=replace(scene.light, polarisation=0.0)), None, "along x")

    def prepare(self, system, rays: RayState, requests: Requests) -> RayState:
        """Rays with their electric field."""
        angle = system.light.polarisation
        if angle is None or not any(e.fresnel == "exact" and not e.reflects for e in system.elements):
            return rays
        return replace(rays, polarised=polarisation_vector(angle, rays.direction))

    def action(self, system, requests: Requests) -> Action | None:
        """The action that propagates the field through several surfaces."""
        return FieldPropagation() if system.light.polarisation is not None and len(system.elements) > 1 else None


class FieldPropagation(Action):
    """Propagation of the electric field through a surface."""

    def after_interaction(self, m) -> None:
        """Apply Fresnel's transmission coefficients, or the reflection of a perfect conductor."""
        state, last = m.state, m.index == len(m.tracer.system.elements) - 1
        if state.polarised is None or (last and m.forward):
            return
        pose = m.element.pose
        e, flip = rotate_to_local(pose, state.polarised), m.side
        d = (m.hit.incoming[0], m.hit.incoming[1], flip * m.hit.incoming[2])
        e = (e[0], e[1], flip * e[2])
        gx, gy = (flip * g for g in m.hit.slopes)
        normal = (-gx, -gy, 1.0)
        if m.reflects:
            norm2 = 1.0 + gx * gx + gy * gy
            across = 2.0 * (e[2] - e[0] * gx - e[1] * gy) / norm2
            e = (across * normal[0] - e[0], across * normal[1] - e[1], across * normal[2] - e[2])
        else:
            # What all rays share stays one number: before a plane entrance they may still be a grid, see `RayState.expanded`.
            gx, gy = (torch.as_tensor(g, dtype=state.power.dtype, device=state.power.device) for g in (gx, gy))
            t, _, c, s = refract(d, gx, gy, m.n_in / m.n_out)
            e = transmitted_field(e, d, t, normal, c, s, m.n_in / m.n_out)
        state.polarised = rotate_to_global(pose, (e[0], e[1], flip * e[2]))
