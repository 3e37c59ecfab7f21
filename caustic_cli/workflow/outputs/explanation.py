"""Which effects are simulated and why, and what each costs and changes."""

from __future__ import annotations

from typing import Any, ClassVar

from caustic_cli.effort import current_effort
from caustic_cli.studies import effects
from caustic_cli.workflow.compilation import compile_for
from caustic_cli.workflow.outputs.base import Output, Rendering


class Explanation(Output):
    """The table of effects."""

    option: ClassVar[str] = "explain"
    beyond: ClassVar[bool] = True

    def write(self, rendering: Rendering) -> dict[str, Any]:
        """effects: a row for each, see `studies.effects.explain`."""
        lens, effort = rendering.lens, current_effort()
        compile_for(None, rendering.device, rendering.say)
        rows = effects.explain(
            rendering.plan,
            lens.scene,
            lens.field,
            lens.heights.to(rendering.device),
            rays=min(rendering.count, effort.effect_rays),
            effort=effort,
            seed=rendering.seed,
            dtype=rendering.asked.tracing.dtype,
        )
        return {"effects": rows}

    def show(self, figures: dict[str, Any], say: Any) -> None:
        say.result(*effects.table(figures["effects"]))
