"""Absorption in glass: transmittance exp(-a t) over t mm (Beer-Lambert law)."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from caustic_cli.optics.effects.base import Action, Decision, Effect, Probe, Requests
from caustic_cli.scene import Scene

#: Absorption coefficient for the measurement in a scene without absorption, 1/mm.
AMOUNT = 0.01


class Absorption(Effect):
    """Without it the glass is perfectly transparent."""

    name = "absorption"
    of_glass = True

    def decide(self, scene: Scene, bounds) -> Decision:
        """Needed if a coefficient is above 0."""
        a = max(scene.lens.interior.absorption, *(e.absorption for e in scene.elements), 0.0)
        why = f"the glass absorbs {a:g} per mm" if a > 0 else "the glass is clear"
        return Decision(self.name, a > 0, why, a, 0.0, present=a > 0)

    def without(self, scene: Scene) -> Scene:
        """With transparent glass."""
        if not (scene.lens.absorption or any(e.absorption for e in scene.elements)):
            return scene
        clear = tuple(replace(e, absorption=0.0) for e in scene.elements)
        return replace(scene, lens=replace(scene.lens, absorption=0.0), elements=clear)

    def probe(self, scene: Scene, heights: Tensor) -> Probe | None:
        """Weak absorption."""
        return Probe(replace(scene, lens=replace(scene.lens, absorption=AMOUNT)), None, f"{AMOUNT:g} per mm")

    def action(self, system, requests: Requests) -> Action:
        """The attenuation."""
        return AbsorptionAction()


class AbsorptionAction(Action):
    """Attenuation on the path to every surface."""

    def before_interaction(self, m) -> None:
        """Attenuate by the factor exp(-a length)."""
        if m.absorption:
            before = m.state.power
            m.state.power = before * torch.exp(-m.absorption * torch.as_tensor(m.hit.length))  # 0.0 for rays on the pupil already
            m.state.lose("absorbed", (before - m.state.power).detach())
