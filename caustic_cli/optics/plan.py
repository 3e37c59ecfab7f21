"""The simulation plan: which physical effects a scene needs, and why, decided from rigorous bounds where there are any.

A plan holds the scene without the omitted effects, and requests to the tracer that the scene does not express.  Effects in neither
are not executed.  A design, whose heights change, uses the scene alone: bounds for one surface say nothing about the next, and the
masks for total reflection and missed surfaces stay in its path, where they cost nothing.
"""

from __future__ import annotations

import difflib
from collections.abc import Iterable
from dataclasses import dataclass, replace

from torch import Tensor

from caustic_cli.errors import InputError
from caustic_cli.optics.bounds import bounds_of
from caustic_cli.optics.effects import EFFECTS, NO_REQUESTS, Decision, Requests
from caustic_cli.optics.surfaces import HeightField
from caustic_cli.scene import Scene


@dataclass(frozen=True)
class Plan:
    """effects: a decision on each of EFFECTS; scene: the scene to trace; requests: to the tracer."""

    effects: tuple[Decision, ...]
    scene: Scene
    requests: Requests

    def __getitem__(self, name: str) -> Decision:
        return next(e for e in self.effects if e.name == name)

    @property
    def simulated(self) -> tuple[str, ...]:
        """Names of the effects that are simulated."""
        return tuple(e.name for e in self.effects if e.on)


def parse_effects(text: str) -> frozenset[str] | None:
    """The value of the option effects: None for auto, otherwise the set of names.

    Raises:
        InputError: a name is unknown.
    """
    if text.strip() == "auto":
        return None
    known = [effect.name for effect in EFFECTS]
    names = [] if text.strip() == "none" else [n.strip().replace("_", "-") for n in text.split(",")]
    for name in names:
        if name not in known:
            near = difflib.get_close_matches(name, known, 1, 0.4)
            hint = f"; did you mean {near[0]}?" if near else ""
            raise InputError(f"⟨effects⟩ must be auto, none, or some of {', '.join(known)}, got {name!r}{hint}")
    return frozenset(names)


def compile_plan(
    scene: Scene, field: HeightField, heights: Tensor, wanted: Iterable[str] | None = None, steeper: float = 0.0
) -> Plan:
    """The plan of a scene at heights (n, m) mm.

    Args:
        wanted: names of the effects to simulate, or None for those that the scene needs; an effect without which there is no image
            stays on.
        steeper: by how much slopes of the traced surface may exceed those of the spline.
    """
    bounds = bounds_of(scene, field, heights, steeper)
    lacks = scene.lens.interaction.lacks
    decisions = [
        Decision(effect.name, False, lacks[effect.name], present=False) if effect.name in lacks else effect.decide(scene, bounds)
        for effect in EFFECTS
    ]
    if wanted is not None:
        chosen = frozenset(wanted)
        decisions = [
            v
            if (v.name in chosen) == v.on or v.fixed
            else replace(
                v,
                on=not v.on,
                why=f"{'asked for' if not v.on else 'left out as asked'}; by itself {'off' if not v.on else 'on'}: {v.why}",
            )
            for v in decisions
        ]
    traced, requests = scene, NO_REQUESTS
    for effect, decision in zip(EFFECTS, decisions, strict=True):
        traced = effect.including(traced) if decision.on else effect.without(traced)
        requests |= effect.request(scene, decision.on, bounds)
    return Plan(tuple(decisions), traced, requests)
