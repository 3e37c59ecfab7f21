"""Absolute irradiance on a screen, W/mm^2, or illuminance, lux = lm/m^2, where the source's power is luminous flux; in the far
field radiant intensity, W/mrad^2, or luminous intensity, cd = lm/sr.

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

#: Unit of power, unit of lengths on the screen -> unit of E, and conversion factor from the unit of power per square of the latter.
UNITS = {
    ("W", "mm"): ("W/mm^2", 1.0),
    ("lm", "mm"): ("lux", 1e6),
    ("W", "mrad"): ("W/mrad^2", 1.0),
    ("lm", "mrad"): ("cd", 1e6),
}
#: Both -> name of E.
QUANTITIES = {
    ("W", "mm"): "irradiance",
    ("lm", "mm"): "illuminance",
    ("W", "mrad"): "radiant intensity",
    ("lm", "mrad"): "luminous intensity",
}


def irradiance(image: np.ndarray, screen: Screen) -> np.ndarray:
    """E up to a constant factor, of an image or a target (n_x, n_y), for display; on a plane screen the argument itself."""
    true = areas(screen)
    return image if true is None else image / true


def per_part(scene: Scene) -> float:
    """E of a pixel of a plane screen that receives all the power of the source."""
    wide, tall = scene.screen.pixel
    return scene.source.power * UNITS[scene.light.unit, scene.screen.unit][1] / (wide * tall)


def irradiance_figures(scene: Scene, image) -> dict[str, float]:
    """Figures peak_irradiance, of the brightest pixel of an image J, and mean_irradiance, over the screen."""
    total = image.sum(0) if image.ndim == 3 else image
    scale, true = per_part(scene), areas(scene.screen)
    if true is None:
        return {"peak_irradiance": float(total.max()) * scale, "mean_irradiance": float(total.mean()) * scale}
    total = np.asarray(total.cpu() if isinstance(total, Tensor) else total)
    return {"peak_irradiance": float((total / true).max()) * scale, "mean_irradiance": float(total.sum() / true.sum()) * scale}


def unit_figures(scene: Scene) -> dict[str, float | str]:
    """Figures power, of the source, power_unit, screen_unit, of lengths on the screen, and irradiance_unit; fractions_of, what that
    power is; and, of a source whose spectrum is known, radiant_flux, W, luminous_flux, lm, and luminous_efficacy, lm/W."""
    unit, power, each, on_screen = scene.light.unit, scene.source.power, scene.light.efficacy, scene.screen.unit
    found = {"power": power, "power_unit": unit, "screen_unit": on_screen, "irradiance_unit": UNITS[unit, on_screen][0]}
    found["fractions_of"] = scene.source.power_words(scene.pupil)
    if not each:
        return found
    radiant = power if unit == "W" else power / each
    return found | {"radiant_flux": radiant, "luminous_flux": radiant * each, "luminous_efficacy": each}


def in_units(figures: dict, prefix: str = "") -> list[tuple[str, str, float, float]]:
    """Quantity, unit, peak and mean of E on the screen; and those of the other quantity, of a source whose spectrum is known."""
    peak, mean = (figures[f"{prefix}{name}_irradiance"] for name in ("peak", "mean"))
    own = next(key for key, (name, _) in UNITS.items() if name == figures["irradiance_unit"])
    found = [(QUANTITIES[own], UNITS[own][0], peak, mean)]
    if each := figures.get("luminous_efficacy"):
        other = "lm" if own[0] == "W" else "W", own[1]
        scale = UNITS[other][1] / UNITS[own][1] * (each if own[0] == "W" else 1.0 / each)
        found.append((QUANTITIES[other], UNITS[other][0], scale * peak, scale * mean))
    return found


def source_figures(scene: Scene, on_target: float | None) -> dict[str, float | str | None]:
    """Figures of_source, the fraction of all the light that the source emits which lands on the picture, and source_emits, what
    all that light is; on_target: the same fraction of the source's power."""
    pupil = scene.pupil
    part, words = scene.source.emitted(pupil)
    return {"of_source": None if on_target is None else part * on_target, "source_emits": words}
