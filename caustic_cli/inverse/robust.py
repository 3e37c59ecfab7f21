"""Robust design: the loss averaged over a fixed sample of manufacturing and alignment errors.

    L = (sum over k of w_k L_k^POWER)^(1 / POWER),    L_k the loss in the scene of draw k,    k = 0 the scene without errors

with w_0 = 1 - WEIGHT and equal weights otherwise.  The draws are a Latin hypercube, independent of that of a tolerance study, in
antithetic pairs, so that every error has zero mean.  The scene of a draw is the nearest one with an upright screen
(`Misalignment.upright`): rotations of the picture or the screen, roughness and the aperture are
left out, and the direction of light behind a field lens.  Of several free-form surfaces each has form errors of its own; the
thickness is that of the lens.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor

from caustic_cli.errors import InputError
from caustic_cli.inverse.mixture import Member, Mixture
from caustic_cli.inverse.objective import LossOfHeights, LossOfLens
from caustic_cli.optics.form_error import FormErrors
from caustic_cli.optics.misalignment import Misalignment, reason_ignored
from caustic_cli.optics.surfaces import HeightField
from caustic_cli.scene import Scene
from caustic_cli.scene.tolerances import Tolerances, hypercube

#: Antithetic pairs of draws, exponent of the power mean over them, and their total weight.
PAIRS, POWER, WEIGHT = 2, 2.0, 0.1
#: Errors that are left out.
OMITTED = ("roughness", "aperture")
#: Stream of random numbers of these draws.
PURPOSE = 2


def robust_objective(
    objective: Callable[[Scene, Tensor], LossOfHeights | LossOfLens],
    scene: Scene,
    field: HeightField,
    initial: Tensor,
    tolerances: Tolerances,
) -> Mixture:
    """The loss over draws as a function of the heights; see above.  Its image is that without errors.

    Args:
        objective: returns the loss in a scene, near heights (n, m) mm.
        scene, field: without errors; initial: heights at the beginning of the stage, (n, m) mm, or (k, n, m) of all free surfaces.
        tolerances: the errors.

    Raises:
        InputError: none of the errors applies to the scene.
    """
    scene = scene.unfolded
    omitted = (*OMITTED, *(["source_tilt"] if scene.in_front else []))
    parameters = tuple(p for p in tolerances.parameters if p.error not in omitted and not reason_ignored(scene, p.error))
    fits = tolerances.surface and _resolves(field, tolerances.shortest)
    if not (parameters or fits):
        raise InputError("⟨design.robust⟩ names no error that a design can take into account in this scene")
    surfaces = FormErrors(field, tolerances.form, tolerances.waviness) if fits else None
    rng, count = np.random.default_rng([tolerances.seed, PURPOSE, 1]), 2 * PAIRS
    seen = 1.0 / (count + 1)
    members = [Member(objective(scene, initial), 1.0 - WEIGHT, seen, 1.0)]
    for row in hypercube(parameters, PAIRS, tolerances.seed, PURPOSE):
        surface = torch.stack([surfaces.heights(rng, tolerances.surface) for _ in scene.free_surfaces]) if surfaces else 0.0
        for sign in (-1.0, 1.0):
            values = {(p.error, p.axis): sign * float(v) for p, v in zip(parameters, row, strict=True)}
            errors = Misalignment.of(values)
            added = torch.zeros(len(scene.free_surfaces), *field.shape, dtype=torch.float64) + sign * surface
            added[-1] += errors.thickness
            added = added if scene.joint else added[0]
            members.append(Member(objective(errors.upright(scene), initial + added), WEIGHT / count, seen, 0.0, added=added))
    return Mixture(members, POWER)


def _resolves(field: HeightField, shortest: float) -> bool:
    """Whether a control net resolves surface errors of this period, mm."""
    return all(
        3.0 * float(space.breaks.diff().max()) * 2.0 * half <= shortest
        for space, half in zip(field.spaces, field.half_size, strict=True)
    )
