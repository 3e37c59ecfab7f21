"""Colours of a coloured image as an eye sees them, beside those of its picture.

The channels of image and target are powers of three wavelengths; X, Y, Z follow by the CIE 1931 2-degree observer.  The image is
seen at the exposure at which its luminance Y, summed over the screen, is that of the picture, and beside the picture's white: D65,
sRGB (255, 255, 255).
"""

from __future__ import annotations

from typing import Any

import numpy as np

from caustic_cli.io.colorimetry import D65, mean_color_difference, xyz_to_rgb
from caustic_cli.scene import Light, Scene
from caustic_cli.studies.irradiance import irradiance


def color_figures(scene: Scene, image: Any, target: np.ndarray | None) -> dict[str, float | None]:
    """ciede2000, the mean CIEDE2000 between a coloured image (3, n_x, n_y) and its target, over the pixels of the picture: of the
    smallest rectangle that holds all of its light.  None without a target, or of a black image; empty for an image without colours.

    The noise of the rays adds to it.
    """
    if not scene.colored:
        return {}
    if target is None or not float(image.sum()) > 0:
        return {"ciede2000": None}
    seen, aim = (irradiance(_array(a), scene.screen) for a in (image, target))
    lit = aim.sum(0) > 0
    box = tuple(slice(at[0], at[-1] + 1) for at in (np.flatnonzero(lit.any(k)) for k in (1, 0)))
    own, goal = (xyz[:, *box] for xyz in _exposed(scene.light, seen, aim))
    return {"ciede2000": mean_color_difference(own, goal, D65)}


def shown(light: Light, image: np.ndarray, target: np.ndarray | None) -> np.ndarray:
    """Linear R, G, B from 0 to 1 of a coloured image (3, n_x, n_y) of irradiance; without a target its brightest pixel is white."""
    return xyz_to_rgb(_exposed(light, image, target)[0], D65, axis=0)


def _exposed(light: Light, image: np.ndarray, target: np.ndarray | None) -> tuple[np.ndarray, np.ndarray]:
    """X, Y, Z of an image, at the exposure of its target, and of that; the image itself without one."""
    seen = np.tensordot(light.primaries, image, 1)
    goal = seen / (seen[1].max() or 1.0) if target is None else np.tensordot(light.primaries, target, 1)
    return seen * (goal[1].sum() / (seen[1].sum() or 1.0)), goal


def _array(a: Any) -> np.ndarray:
    """An array, or a tensor on any device."""
    return np.asarray(a.detach().cpu() if hasattr(a, "detach") else a, dtype=np.float64)
