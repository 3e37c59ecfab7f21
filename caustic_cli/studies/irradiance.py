"""Absolute light: irradiance on a screen, W/mm^2, or illuminance, lux = lm/m^2, where the source's power is luminous flux.

Notation
    J       image, (n_x, n_y), parts of the source's power per pixel; (3, n_x, n_y) with colours
    P       power of the source, W or lm
    A       area of a pixel, mm^2
    E       P J / A, all colours together, in the unit of P's; its mean over the screen is P sum(J) / (n_x n_y A)
"""

from __future__ import annotations

from caustic_cli.scene import Scene, Screen

#: Of a power's unit: that of E, and how many of it are one of the power's per mm^2.
UNITS = {"W": ("W/mm^2", 1.0), "lm": ("lux", 1e6)}


def per_part(scene: Scene, screen: Screen | None = None) -> float:
    """E of a pixel that gets all of the source's power."""
    wide, tall = (screen or scene.screen).pixel
    return scene.source.power * UNITS[scene.light.unit][1] / (wide * tall)


def irradiance_figures(scene: Scene, image, screen: Screen | None = None) -> dict[str, float]:
    """peak_irradiance, of the brightest pixel of an image J as it is, and mean_irradiance, over the screen."""
    total = image.sum(0) if image.ndim == 3 else image
    scale = per_part(scene, screen)
    return {"peak_irradiance": float(total.max()) * scale, "mean_irradiance": float(total.mean()) * scale}


def unit_figures(scene: Scene) -> dict[str, float | str]:
    """power, of the source, power_unit, and irradiance_unit."""
    unit = scene.light.unit
    return {"power": scene.source.power, "power_unit": unit, "irradiance_unit": UNITS[unit][0]}
