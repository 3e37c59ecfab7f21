"""A coloured picture in the light of three wavelengths: the power of each, pixel by pixel, with which an eye sees its colours.

The linear R, G, B of the picture are X, Y, Z with the white D65 of sRGB (255, 255, 255), and these the powers that have the same
X, Y, Z by the colour-matching functions of the CIE 1931 2-degree observer.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from caustic_cli.io.colorimetry import D65, XYZ_OF_RGB, mean_color_difference, mixture
from caustic_cli.io.picture import Picture
from caustic_cli.scene.light import RGB, Light


def powers(rgb: np.ndarray, light: Light) -> np.ndarray:
    """Power of each wavelength of the light in each pixel, (3, a, b), in units in which the white of the picture has Y = 1, of the
    linear R, G, B (3, a, b) of a picture."""
    return mixture(rgb, light.primaries)[0]


def filled(source: Mapping[str, Any], picture: Picture) -> dict[str, Any]:
    """A [source] section with the wavelengths of a coloured picture, and the weights with which its colours come out right, unless
    they are given.

    Raises:
        InputError: the wavelengths are not three that mix colours.
    """
    found = {"wavelengths": list(RGB), **source}
    if not found.get("weights"):
        totals = powers(picture.irradiance(), Light(wavelengths=tuple(found["wavelengths"]), color=True)).sum((1, 2))
        found["weights"] = [float(part) for part in totals / totals.sum()]
    return found


def beyond_words(picture: Picture, light: Light) -> str:
    """How much of the picture has colours that its light cannot mix, and what that costs; "" for none."""
    rgb = picture.irradiance()
    shown, moved = mixture(rgb, light.primaries)
    if not moved.any():
        return ""
    cost = mean_color_difference(*(np.tensordot(m, c, 1) for m, c in ((light.primaries, shown), (XYZ_OF_RGB, rgb))), D65)
    at = ", ".join(f"{w:g}" for w in light.wavelengths)
    return (
        f"light of {at} nm cannot mix the colours of {moved.mean():.2%} of the picture: these are moved towards grey at the same"
        f" luminance, a mean CIEDE2000 of {cost:.2g} over the picture"
    )
