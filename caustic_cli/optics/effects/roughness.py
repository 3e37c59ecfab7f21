"""Surface roughness: a microfacet model with normally distributed slopes, one facet per ray.

Shadowing and masking are neglected, which requires slopes of a few tenths at most.  The facet slopes are a deterministic function
(hash) of the ray.
"""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from caustic_cli.optics.effects.base import Action, Decision, Effect, Probe, Requests
from caustic_cli.optics.rays import RayState
from caustic_cli.optics.sampling import normal_numbers
from caustic_cli.scene import Scene

#: Odd multipliers that hash a ray's coordinates to one index (Knuth; Steele).
MIX = (-7046029254386353131, -4417276706812531889, 0x632BE59BD9B4E019)
#: Quantum of coordinates that are hashed, mm or 1: coarser than their rounding, which depends on where a ray is in a chunk.
QUANTUM = 2.0**-30
#: Seed of the facet slopes at the last element; at the k-th element in front of it the seed is greater by k.
FACETS = 0xFACE7
#: Slope standard deviation for the measurement in a scene with smooth surfaces.
AMOUNT = 0.001


class Roughness(Effect):
    """Without it the surface is smooth."""

    name = "roughness"

    def decide(self, scene: Scene, bounds) -> Decision:
        """Needed if the standard deviation of the facet slopes is above 0."""
        r = scene.lens.roughness
        why = f"microfacets of slopes {r:g}" if r > 0 else "the surface is smooth"
        return Decision(self.name, r > 0, why, r, 0.0, present=r > 0)

    def without(self, scene: Scene) -> Scene:
        """With a smooth surface."""
        return replace(scene, lens=replace(scene.lens, roughness=0.0)) if scene.lens.roughness else scene

    def probe(self, scene: Scene, heights: Tensor) -> Probe:
        """Slight roughness."""
        return Probe(replace(scene, lens=replace(scene.lens, roughness=AMOUNT)), None, f"slopes {AMOUNT:g}")

    def action(self, system, requests: Requests) -> Action:
        """The facets."""
        return Microfacets()


class Microfacets(Action):
    """Adds the facet slopes to those of the surface; they are the same in every trace by one tracer."""

    def __init__(self) -> None:
        self.noise: dict[int, tuple[Tensor, ...]] = {}

    def before_interaction(self, m) -> None:
        """Perturb the slopes, for direct light only."""
        if not (m.element.roughness and m.direct):
            return
        if m.index not in self.noise:
            last = len(m.tracer.system.elements) - 1
            rays = m.tracer.begun or m.state
            numbers = normal_numbers(FACETS + last - m.index, index_of(rays))
            self.noise[m.index] = tuple(m.element.roughness * n.to(m.state.power.dtype) for n in numbers)
        m.hit.slopes = tuple(g + n for g, n in zip(m.hit.slopes, self.noise[m.index], strict=True))


def index_of(rays: RayState) -> Tensor:
    """A hash of each ray's coordinates: (N,) int64."""
    if rays.sample is not None:
        s = rays.sample
        mixed = [c.double().contiguous().view(torch.int64) * m for c, m in zip((s.u, s.v), MIX, strict=False)]
        return (mixed[0][:, None] ^ mixed[1][None, :]).reshape(-1) if s.tensor else mixed[0] ^ mixed[1]
    full = rays.full((*rays.origin[:2], rays.direction[0]))
    whole = [(c.double() / QUANTUM).round().to(torch.int64) for c in full]
    return whole[0] * MIX[0] ^ whole[1] * MIX[1] ^ whole[2] * MIX[2]
