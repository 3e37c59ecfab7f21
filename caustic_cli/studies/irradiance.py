"""Absolute irradiance on a screen, W/mm^2, or illuminance, lux = lm/m^2, where the source's power is luminous flux.

Notation
    J       image, (n_x, n_y), parts of the source's power per pixel; (3, n_x, n_y) with colours
    P       power of the source, W or lm
    A       area of a pixel, mm^2; on a curved screen the true area, not that of its projection
    E       P J / A, summed over colours, in the unit of P per area; its mean over the screen is P sum(J) / sum(A)
"""

from __future__ import annotations

import numpy as np
from torch import Tensor

from caustic_cli.optics.screen_shape import areas
from caustic_cli.scene import Scene, Screen

#: Unit of power -> unit of E, and conversion factor from the unit of power per mm^2.
UNITS = {"W": ("W/mm^2", 1.0), "lm": ("lux", 1e6)}


def irradiance(image: np.ndarray, screen: Screen) -> np.ndarray:
    """E up to a constant factor, of an image or a target (n_x, n_y), for display; on a plane screen the argument itself."""
    true = areas(screen)
    return image if true is None else image / true


def per_part(scene: Scene) -> float:
    """E of a pixel of a plane screen that receives all the power of the source."""
    wide, tall = scene.screen.pixel
    return scene.source.power * UNITS[scene.light.unit][1] / (wide * tall)


def irradiance_figures(scene: Scene, image) -> dict[str, float]:
    """Figures peak_irradiance, of the brightest pixel of an image J, and mean_irradiance, over the screen."""
    total = image.sum(0) if image.ndim == 3 else image
    scale, true = per_part(scene), areas(scene.screen)
    if true is None:
        return {"peak_irradiance": float(total.max()) * scale, "mean_irradiance": float(total.mean()) * scale}
    total = np.asarray(total.cpu() if isinstance(total, Tensor) else total)
    return {"peak_irradiance": float((total / true).max()) * scale, "mean_irradiance": float(total.sum() / true.sum()) * scale}


def unit_figures(scene: Scene) -> dict[str, float | str]:
    """Figures power, of the source, power_unit, and irradiance_unit; fractions_of, what that power is."""
    unit, pupil = scene.light.unit, scene.pupil
    words = scene.source.power_words(pupil)
    return {"power": scene.source.power, "power_unit": unit, "irradiance_unit": UNITS[unit][0], "fractions_of": words}


def source_figures(scene: Scene, on_target: float | None) -> dict[str, float | str | None]:
    """Figures of_source, the fraction of all the light that the source emits which lands on the picture, and source_emits, what
    all that light is; on_target: the same fraction of the source's power."""
    pupil = scene.pupil
    part, words = scene.source.emitted(pupil)
    return {"of_source": None if on_target is None else part * on_target, "source_emits": words}
