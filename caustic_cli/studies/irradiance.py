"""Absolute light: irradiance on a screen, W/mm^2, or illuminance, lux = lm/m^2, where the source's power is luminous flux.

Notation
    J       image, (n_x, n_y), parts of the source's power per pixel; (3, n_x, n_y) with colours
    P       power of the source, W or lm
    A       area of a pixel, mm^2: true area, of which a curved screen's pixels have more than their cells of its plane
    E       P J / A, all colours together, in the unit of P's; its mean over the screen is P sum(J) / sum(A)
"""

from __future__ import annotations

import numpy as np
from torch import Tensor

from caustic_cli.optics.screen_shape import areas
from caustic_cli.scene import Scene, Screen

#: Of a power's unit: that of E, and how many of it are one of the power's per mm^2.
UNITS = {"W": ("W/mm^2", 1.0), "lm": ("lux", 1e6)}


def irradiance(image: np.ndarray, screen: Screen) -> np.ndarray:
    """E up to a factor, of an image or a target: what is shown of them; on a plane screen they themselves."""
    true = areas(screen)
    return image if true is None else image / true


def per_part(scene: Scene) -> float:
    """E of a plane screen's pixel that gets all of the source's power."""
    wide, tall = scene.screen.pixel
    return scene.source.power * UNITS[scene.light.unit][1] / (wide * tall)


def irradiance_figures(scene: Scene, image) -> dict[str, float]:
    """peak_irradiance, of the brightest pixel of an image J as it is, and mean_irradiance, over the screen."""
    total = image.sum(0) if image.ndim == 3 else image
    scale, true = per_part(scene), areas(scene.screen)
    if true is None:
        return {"peak_irradiance": float(total.max()) * scale, "mean_irradiance": float(total.mean()) * scale}
    total = np.asarray(total.cpu() if isinstance(total, Tensor) else total)
    return {"peak_irradiance": float((total / true).max()) * scale, "mean_irradiance": float(total.sum() / true.sum()) * scale}


def unit_figures(scene: Scene) -> dict[str, float | str]:
    """power, of the source, power_unit, and irradiance_unit."""
    unit = scene.light.unit
    return {"power": scene.source.power, "power_unit": unit, "irradiance_unit": UNITS[unit][0]}
