"""Evaluation behind the picture for a lens with two free-form sides: a second picture, or the error of the ray directions."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from caustic_cli.optics.angular_error import rms_angle, squared_angular_error
from caustic_cli.optics.effects import NO_REQUESTS, Requests
from caustic_cli.optics.surfaces.heightfield import HeightField
from caustic_cli.optics.system import EXIT
from caustic_cli.optics.trace import tracers
from caustic_cli.scene import Scene
from caustic_cli.studies.retrace import retrace, sampler_for

#: Rays traced at a time, and rays for the directions.
CHUNK, ENOUGH = 1 << 19, 500_000


def second_figures(
    scene: Scene,
    field: HeightField,
    heights: Tensor,
    target: np.ndarray | None,
    *,
    rays: int,
    seed: int,
    device: str = "cpu",
    requests: Requests = NO_REQUESTS,
) -> tuple[np.ndarray | None, dict]:
    """The image on the second screen, power per pixel (n_x, n_y) float64, or (3, n_x, n_y) in colour, None where there is none, and
    figures.

    Args:
        scene: with its lens' designed entrance; heights: (n, m) mm of the exit; target: irradiance on the second screen.

    Returns:
        figures: second_relative_rms, second_noise, second_on_target, second_on_screen and second_of_source of a second picture, in
        colour second_ciede2000;
        angle_rms_mrad, the RMS angle to the prescribed directions, weighted by power, for collimated or focused light.
    """
    second = scene.second_target
    assert second is not None
    if second.screen is not None:
        elsewhere = scene.onto(second.screen)
        exposure, found = retrace(elsewhere, field, heights, target, rays=rays, seed=seed, device=device, requests=requests)
        names = ("relative_rms", "noise", "on_target", "on_screen", "of_source", "ciede2000")
        return exposure.image.cpu().numpy(), {f"second_{name}": found[name] for name in names if name in found}
    squares = power = 0.0
    with torch.no_grad():
        for traced in tracers(scene, field, sampler_for(scene, min(rays, ENOUGH), seed, device), torch.float64, CHUNK, requests):
            state = traced({EXIT: heights.to(device)})[0]
            squares += traced.weight * float(squared_angular_error(traced, state, scene))
            power += traced.weight * float(state.power.sum())
    return None, {"angle_rms_mrad": 1e3 * rms_angle(squares, power)}
