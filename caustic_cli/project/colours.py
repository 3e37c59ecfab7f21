"""A coloured picture in the light of three wavelengths: the power of each, pixel by pixel, with which an eye sees its colours.

The linear R, G, B of the picture are X, Y, Z with the white D65 of sRGB (255, 255, 255), and these the powers that have the same
X, Y, Z by the colour-matching functions of the CIE 1931 2-degree observer.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from caustic_cli.config.settings import Given, Settings
from caustic_cli.errors import InputError
from caustic_cli.inverse.target import target_on_screen
from caustic_cli.io.colorimetry import D65, XYZ_OF_RGB, mean_color_difference, mixture
from caustic_cli.io.picture import Picture
from caustic_cli.scene import Screen
from caustic_cli.scene.light import RGB, Light
from caustic_cli.schema.table import TargetSettings

COLOR_GLASS = "N-BK7"  # for a coloured picture without glass or index, since dispersion has to be known


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


def completed(given: Given, goal: TargetSettings, picture: Picture) -> Given:
    """Settings by section with the light of a coloured picture, see `filled`; unchanged of another.

    Raises:
        InputError: the picture has no colours, or as of `filled`.
    """
    if not goal.color:
        return given
    if picture.values.ndim < 3:
        raise InputError("⟨target.color⟩ needs the file of a picture: an array (n_x, n_y) has no colours")
    return {**given, "source": filled(given.get("source", {}), picture)}


def with_glass(s: Settings) -> Settings:
    """Settings with the wavelengths of a coloured picture, and a glass whose dispersion is known; unchanged of another."""
    if not s.target.color:
        return s
    lens = s.lens if "index" in s.lens else s.lens.filled(glass=COLOR_GLASS)
    return s.changed(source=s.source.filled(wavelengths=RGB), lens=lens)


def on_screen(picture: np.ndarray, light: Light, size: tuple[float, float], screen: Screen, flip: str) -> np.ndarray:
    """`target_on_screen` of a picture (a, b), (n_x, n_y), or of R, G, B (3, a, b), (3, n_x, n_y): the power of each wavelength."""
    if picture.ndim == 2:
        return target_on_screen(picture, size, screen, flip)
    mixed = powers(picture, light)
    whole = target_on_screen(mixed.sum(0), size, screen, flip)
    return np.stack([target_on_screen(c, size, screen, flip) if c.any() else 0.0 * whole for c in mixed])


def refuse_without_light(target: np.ndarray, light: Light) -> None:
    """Refuse a second target in colours (3, n_x, n_y) of which the light has nothing.

    Raises:
        InputError: naming the wavelength.
    """
    for wavelength, part, goal in zip(light.wavelengths, light.fractions, target, strict=True) if target.ndim == 3 else ():
        if goal.any() and not part:
            raise InputError(f"⟨second.file⟩ needs light of {wavelength:g} nm, of which the source of both pictures has none")


def beyond_words(picture: Picture, light: Light) -> str:
    """How much of the picture has colours that its light cannot mix, and what that costs; "" for none."""
    if not light.color:
        return ""
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
