"""The target `road`: the illuminance of a road whose luminance is the same everywhere for a driver.

The luminance is L = q E, E being the illuminance and q the luminance coefficient of the road surface.  With the lamp at the height
h over its foot, the point at (x, y) from there is lit from (-x, -y, h), and a driver who looks along +x sees it under 1 degree,
from (-cos 1, 0, sin 1), as in tables r = q cos^3(gamma) of road surfaces (CIE 144:2001).  q is the reflection model of Ward
(Measuring and modeling anisotropic reflection, SIGGRAPH 1992), isotropic,

    q = DIFFUSE + GLOSS exp(-tan^2(delta) / WIDTH^2) / sqrt(cos gamma),

delta being the angle of the half vector of light and view from the vertical.  It is no table of a road that was measured: for the
width that is assumed, its two factors are those with which two published figures of the standard surface R3 are met, the mean
luminance coefficient Q0 = 0.07, over the solid angle of the rectangle from 4 h before to 12 h behind the point and 3 h to both
sides at the height of the lamps, and the specular factor S1 = r(0, 2) / r(0, 0) = 1.11.

It is the light of one lamp alone.  Where the stretches of several lamps adjoin, so do those of equal luminance.
"""

from __future__ import annotations

import math

import numpy as np

from caustic_cli.errors import InputError
from caustic_cli.inverse.lamp import pixels_of
from caustic_cli.scene.lamp import Goal

#: Factors of the model, 1 / sr, the width of its gloss, and the angle of view, degrees.
DIFFUSE, GLOSS, WIDTH, VIEW = 0.04789, 0.55893, 0.35, 1.0
#: Pixels of the picture.
PIXELS = 60_000


def luminance_coefficient(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """q, 1 / sr, of points lit from (x, y, 1), up to the length, for a driver who looks along +x."""
    slant = np.sqrt(1.0 + x * x + y * y)
    view = math.radians(VIEW)
    half_x, half_z = x / slant - math.cos(view), 1.0 / slant + math.sin(view)
    tangent = (half_x**2 + (y / slant) ** 2) / half_z**2
    return DIFFUSE + GLOSS * np.exp(-tangent / WIDTH**2) * np.sqrt(slant)


def picture_of(goal: Goal) -> np.ndarray:
    """The illuminance of a road of equal luminance, (a, b), [i, j] with i along +x, up to a factor.

    Raises:
        InputError: the target is in the far field.
    """
    if goal.far:
        raise InputError(
            "this is an illuminance on a plane: it needs ⟨+picture_size⟩ and ⟨+throw⟩, and has no meaning in the far field"
        )
    pixels = pixels_of(goal, PIXELS)
    x, y, z = goal.directions(pixels).T
    return 1.0 / luminance_coefficient(-x / z, -y / z).reshape(pixels)
