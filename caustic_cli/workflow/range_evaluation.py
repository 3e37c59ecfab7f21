"""Evaluation of a network trained over ranges of scene parameters: its lenses at several values, retraced there."""

from __future__ import annotations

import numpy as np

from caustic_cli.inverse.designer import Designer, State
from caustic_cli.studies.retrace import retrace


def errors(
    designer: Designer, state: State, target: np.ndarray, *, rays: int, seed: int = 0, device: str = "cpu", middle: bool = True
) -> list[dict[str, float]]:
    """Figures at each of `Ranges.evaluation_points`, with independent rays: the parameter values by their keys, mm; relative_rms,
    noise, on_screen and of_source of the lens for them; and, with `middle`, middle_relative_rms, of the lens for the middle of the
    ranges used there.

    Raises:
        CausticError: no light reaches the screen.
    """
    over, field = designer.options.over, designer.field(state.stage)
    if over is None:
        return []
    lens_of_middle, found = designer.heights_at(state, over.middle), []
    for values in over.evaluation_points():
        scene, row = over.scene(designer.scene, values), dict(zip(over.keys, values, strict=True))
        own = retrace(scene, field, designer.heights_at(state, values), target, rays=rays, seed=seed, device=device)[1]
        row |= {key: own[key] for key in ("relative_rms", "noise", "on_screen", "of_source")}
        if middle:
            other = retrace(scene, field, lens_of_middle, target, rays=rays, seed=seed, device=device, noise=False)[1]
            row["middle_relative_rms"] = other["relative_rms"]
        found.append(row)
    return found
