"""The loss of a lens under errors of making and placing: over a few draws of them, the same at every evaluation.

    L = (sum over k of w_k L_k^POWER)^(1 / POWER),    L_k the loss in the scene of draw k,    k = 0 the scene without errors

with w_0 = 1 - WEIGHT and the rest in equal parts.  Draws are a Latin hypercube of their own, which no study of tolerances takes;
each comes with its opposite, so that no error has a mean.  A draw's scene is the upright one nearest to it
(`Misalignment.upright`): what only turns the picture or the screen is left out, and so is roughness.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

import numpy as np
import torch
from torch import Tensor

from caustic_cli.errors import InputError
from caustic_cli.inverse.losses import ColorLoss, Loss
from caustic_cli.inverse.objective import Evaluation
from caustic_cli.optics.form_error import FormErrors
from caustic_cli.optics.misalignment import Misalignment, reason_ignored
from caustic_cli.optics.surfaces import HeightField
from caustic_cli.optics.system import EXIT
from caustic_cli.scene import Scene
from caustic_cli.scene.tolerances import Tolerances, hypercube

#: Pairs of opposite draws, the power of the mean over them, and their weight in all.
PAIRS, POWER, WEIGHT = 2, 2.0, 0.1
#: Purpose of these draws.
PURPOSE = 2


class Plain(Protocol):
    """The loss in one scene."""

    loss: Loss | ColorLoss

    def __call__(self, heights: Tensor) -> Evaluation:
        """Value and gradient at heights (n, m) mm."""


class RobustObjective:
    """The loss as a function of the heights; see above.

    Args:
        objective: makes the loss in a scene, near heights (n, m) mm.
        scene, field, begun: without errors; begun, the heights at which the stage begins.
        tolerances: the errors.

    Raises:
        InputError: none of the errors means anything here.
    """

    def __init__(
        self,
        objective: Callable[[Scene, Tensor], Plain],
        scene: Scene,
        field: HeightField,
        begun: Tensor,
        tolerances: Tolerances,
    ):
        parameters = tuple(p for p in tolerances.parameters if p.error != "roughness" and not reason_ignored(scene, p.error))
        fits = tolerances.surface and _holds(field, tolerances.shortest)
        if not (parameters or fits):
            raise InputError("⟨design.robust⟩ names no error that a design can be for in this scene")
        surfaces = FormErrors(field, tolerances.form, tolerances.waviness) if fits else None
        rng = np.random.default_rng([tolerances.seed, PURPOSE, 1])
        self.parts: list[tuple[Plain, Tensor | float]] = [(objective(scene, begun), 0.0)]
        for row in hypercube(parameters, PAIRS, tolerances.seed, PURPOSE):
            surface = surfaces.heights(rng, tolerances.surface) if surfaces else 0.0
            for sign in (-1.0, 1.0):
                values = {(p.error, p.axis): sign * float(v) for p, v in zip(parameters, row, strict=True)}
                errors = Misalignment.of(values)
                added = sign * surface + errors.thickness
                self.parts.append((objective(errors.upright(scene), begun + added), added))
        self.loss = self.parts[0][0].loss

    def __call__(self, heights: Tensor) -> Evaluation:
        """Value, gradient and the mean light on the screen at heights (n, m) mm float64; the image without errors."""
        found = [part(heights + added) for part, added in self.parts]
        losses = torch.tensor([e.loss for e in found], dtype=torch.float64)
        share = torch.full_like(losses, WEIGHT / max(1, len(found) - 1))
        share[0] = 1.0 - WEIGHT
        level = float(losses.max())
        loss = level * float((share * (losses / level) ** POWER).sum() ** (1.0 / POWER)) if level > 0 else 0.0
        weights = share * (losses / loss) ** (POWER - 1.0) if loss > 0 else torch.zeros_like(losses)
        gradient = sum(float(w) * e.gradient for w, e in zip(weights, found, strict=True))
        on_screen = sum(e.on_screen for e in found) / len(found)
        return Evaluation(loss, {EXIT: torch.as_tensor(gradient)}, on_screen, found[0].image)


def _holds(field: HeightField, shortest: float) -> bool:
    """Whether a net holds waves of that length at all."""
    return all(
        3.0 * float(space.breaks.diff().max()) * 2.0 * half <= shortest
        for space, half in zip(field.spaces, field.half_size, strict=True)
    )
