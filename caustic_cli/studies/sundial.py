"""What the lenslets of a sundial show: each its own picture at its hour, and at that hour the light of the others, beside it and
on it.

Notation, at the hour of lenslet k
    I_k         power on the screen of all lenslets, as a fraction of what falls on the array; O_k of lenslet k by itself
    contrast    mean of O_k over the bright part of its picture, over that of I_k - O_k: its light to that of the others
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from caustic_cli.optics.surfaces.heightfield import HeightField
from caustic_cli.optics.trace import expose
from caustic_cli.scene import Scene
from caustic_cli.studies.metrics import relative_rms
from caustic_cli.studies.retrace import sampler_for

#: Fraction of a picture's greatest value from which on it counts as bright.
BRIGHT = 0.5


class Alone(NamedTuple):
    """A lenslet by itself: scene, spline spaces and heights, and its fraction of the light on the array."""

    scene: Scene
    field: HeightField
    heights: Tensor
    share: float


@torch.no_grad()
def shown(
    scene: Scene,
    field: HeightField,
    heights: Tensor,
    lenslets: Sequence[Alone],
    targets: Sequence[np.ndarray],
    rays: int,
    seed: int = 0,
) -> tuple[list[np.ndarray], list[dict[str, Any]]]:
    """Images (n_x, n_y) at the hour of each lenslet, j fastest, and their figures.

    Args:
        scene: whose sources shine in turn, one for each lenslet; heights: control net (n, m) of the array, mm.
        targets: (n_x, n_y) of each lenslet; rays: of an hour.

    Returns:
        The images, and for each its figures: relative_rms of all light on the screen against its target, and contrast, None
        without other light.
    """
    images, figures = [], []
    for k, (one, alone, target) in enumerate(zip(scene.by_source, lenslets, targets, strict=True)):
        image = expose(one, field, heights, sampler_for(one, rays, seed + k)).image.cpu().numpy()
        some = max(1, rays // len(targets))
        own = expose(alone.scene, alone.field, alone.heights, sampler_for(alone.scene, some, seed + k)).image.cpu().numpy()
        bright = target >= BRIGHT * target.max()
        mine = alone.share * float(own[bright].mean())
        others = float(image[bright].mean()) - mine
        error = relative_rms(image, target * (image.sum() / target.sum())) if image.any() else math.inf
        figures.append({"relative_rms": error, "contrast": mine / others if others > 0 else None})
        images.append(image)
    return images, figures


def rows(figures: Sequence[dict[str, Any]]) -> list[tuple[str, str]]:
    """The rows of a table."""
    errors, contrasts = ([f[key] for f in figures if f[key] is not None] for key in ("relative_rms", "contrast"))
    found = [("each at its hour", f"relative RMS error {min(errors):.3g} to {max(errors):.3g}")]
    if contrasts:
        found.append(("", f"{min(contrasts):.3g} to {max(contrasts):.3g} times as bright as the light of the others there"))
    return found
