"""A rough surface: microfacets, of which every ray meets one, whose slopes scatter about the surface's own.

Facets neither shade nor hide each other, which needs slopes of a few tenths at most.  Their slopes are a pure function of where a
ray runs.
"""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from caustic_cli.optics.effects.base import Action, Decision, Effect, Probe, Requests
from caustic_cli.optics.rays import RayState
from caustic_cli.optics.sampling import normal_numbers
from caustic_cli.scene import Scene

#: Odd constants that mix the bits of a ray's coordinates into one index (Knuth's and Steele's multipliers).
MIX = (-7046029254386353131, -4417276706812531889, 0x632BE59BD9B4E019)
#: Seed of the microfacets' slopes; that of element k is k more than that of a lens' exit.
FACETS = 0xFACE7
#: Standard deviation that is measured where there is none.
AMOUNT = 0.001


class Roughness(Effect):
    """Left out, the surface is smooth."""

    name = "roughness"

    def decide(self, scene: Scene, bounds) -> Decision:
        """By the facets' standard deviation."""
        r = scene.lens.roughness
        why = f"microfacets of slopes {r:g}" if r > 0 else "the surface is smooth"
        return Decision(self.name, r > 0, why, r, 0.0, present=r > 0)

    def without(self, scene: Scene) -> Scene:
        """A smooth surface."""
        return replace(scene, lens=replace(scene.lens, roughness=0.0)) if scene.lens.roughness else scene

    def probe(self, scene: Scene, heights: Tensor) -> Probe:
        """A little."""
        return Probe(replace(scene, lens=replace(scene.lens, roughness=AMOUNT)), None, f"slopes {AMOUNT:g}")

    def action(self, system, requests: Requests) -> Action | None:
        """At every element that is rough."""
        return Microfacets() if any(e.roughness for e in system.elements) else None


class Microfacets(Action):
    """Adds to the slopes what each ray's facet has; the same in every walk of a tracer."""

    def __init__(self) -> None:
        self.noise: dict[int, tuple[Tensor, ...]] = {}

    def before_interaction(self, m) -> None:
        """At the surface, on the straight way only."""
        if not (m.element.roughness and m.direct):
            return
        if m.index not in self.noise:
            last = len(m.tracer.system.elements) - 1
            rays = getattr(m.tracer, "start", m.state)  # before the first free surface a tracer has not begun: as they come there
            numbers = normal_numbers(FACETS + last - m.index, index_of(rays))
            self.noise[m.index] = tuple(m.element.roughness * n.to(m.state.power.dtype) for n in numbers)
        m.slopes = tuple(g + n for g, n in zip(m.slopes, self.noise[m.index], strict=True))


def index_of(rays: RayState) -> Tensor:
    """A number for each ray, from where it runs: (N,) int64."""
    if rays.sample is not None:
        s = rays.sample
        mixed = [c.double().contiguous().view(torch.int64) * m for c, m in zip((s.u, s.v), MIX, strict=False)]
        return (mixed[0][:, None] ^ mixed[1][None, :]).reshape(-1) if s.tensor else mixed[0] ^ mixed[1]
    full = rays.full((*rays.origin[:2], rays.direction[0]))
    bits = [c.double().contiguous().view(torch.int64) for c in full]
    return bits[0] * MIX[0] ^ bits[1] * MIX[1] ^ bits[2] * MIX[2]
