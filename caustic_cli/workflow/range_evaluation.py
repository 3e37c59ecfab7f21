"""What a network that was trained over ranges of the scene's values is worth: its lens for some of them, retraced there."""

from __future__ import annotations

import numpy as np

from caustic_cli.inverse.designer import Designer, State
from caustic_cli.studies.retrace import retrace


def errors(
    designer: Designer, state: State, target: np.ndarray, *, rays: int, seed: int = 0, device: str = "cpu", middle: bool = True
) -> list[dict[str, float]]:
    """At each of the values that are judged (`Ranges.judged`), by rays that the design has not seen: the values by their keys, mm;
    relative_rms and noise of the lens for them, on_screen; and middle_relative_rms of the lens for the middle, used there, unless
    that is left out.

    Raises:
        CausticError: no light reaches the screen.
    """
    over, field = designer.options.over, designer.field(state.stage)
    if over is None:
        return []
    lens_of_middle, found = designer.heights_at(state, over.middle), []
    for values in over.judged():
        scene, row = over.scene(designer.scene, values), dict(zip(over.keys, values, strict=True))
        own = retrace(scene, field, designer.heights_at(state, values), target, rays=rays, seed=seed, device=device)[1]
        row |= {key: own[key] for key in ("relative_rms", "noise", "on_screen")}
        if middle:
            other = retrace(scene, field, lens_of_middle, target, rays=rays, seed=seed, device=device, noise=False)[1]
            row["middle_relative_rms"] = other["relative_rms"]
        found.append(row)
    return found
