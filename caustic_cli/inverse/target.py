"""Resampling of a picture onto the pixels of a screen by exact area averages."""

from __future__ import annotations

import numpy as np

from caustic_cli.errors import InputError
from caustic_cli.optics.resampling import area_average
from caustic_cli.optics.screen_shape import areas
from caustic_cli.scene import Screen


def target_on_screen(irradiance: np.ndarray, size: tuple[float, float], screen: Screen, flip: str = "") -> np.ndarray:
    """Relative power on each pixel of a screen, dark around the picture: (n_x, n_y) float64.

    This is the mean irradiance of the picture there, on a curved screen times the true area of the pixel (`optics.screen_shape`).

    Args:
        irradiance: (a, b), [i, j] with i along +x and j along +y, finite and not negative, any scale.
        size: width and height of the picture on the screen, mm, centred.
        flip: "x" and/or "y": mirror the picture for a viewer on the lens' side.

    Raises:
        InputError: the picture is larger than the screen, or black there.
    """
    for name, picture, whole in zip(("width", "height"), size, screen.size, strict=True):
        if picture > whole * (1 + 1e-9):
            raise InputError(
                f"⟨target.size⟩: the picture's {name} of {picture:g} mm must fit on the screen's {whole:g} mm"
                " (a smaller ⟨mag⟩, a larger ⟨screen_size⟩)"
            )
    if "x" in flip:
        irradiance = irradiance[::-1]
    if "y" in flip:
        irradiance = irradiance[:, ::-1]
    cells = [np.linspace(-0.5, 0.5, n + 1) * w for n, w in zip(irradiance.shape, size, strict=True)]
    pixels = [np.linspace(-0.5, 0.5, n + 1) * w for n, w in zip(screen.resolution, screen.size, strict=True)]
    for own, whole in zip(cells, pixels, strict=True):
        if abs(own[0] - whole[0]) < 2e-9 * whole[-1]:  # a picture as wide as the screen has exactly its edges
            own[[0, -1]] = whole[[0, -1]]
    mean = area_average(irradiance, cells, pixels)
    if not mean.sum() > 0:
        raise InputError("target is black all over: a picture with some light in it is needed")
    true = areas(screen)
    return mean if true is None else mean * true


def tiles(light: np.ndarray, array: tuple[int, int]) -> list[np.ndarray]:
    """Split a sheet (a, b) into N x M pictures, [i, j] with i along +x and j along +y, j fastest.

    Raises:
        InputError: the sheet cannot be divided evenly, or one of the pictures is black.
    """
    a, b = (size // n for size, n in zip(light.shape, array, strict=True))
    if (a * array[0], b * array[1]) != light.shape or min(a, b) < 2:
        raise InputError(
            f"⟨target.sheet⟩ must hold {array[0]} x {array[1]} pictures of the same size, of 2 x 2 pixels or more; it has"
            f" {light.shape[0]} x {light.shape[1]} pixels"
        )
    found = [light[i * a : (i + 1) * a, j * b : (j + 1) * b] for i in range(array[0]) for j in range(array[1])]
    for k, tile in enumerate(found):
        if not tile.any():
            raise InputError(f"⟨target.sheet⟩: the picture of lenslet {k // array[1]}, {k % array[1]} is black all over")
    return found


def grey(image: np.ndarray) -> np.ndarray:
    """Sum over the colour channels of an image (3, n_x, n_y): (n_x, n_y); a monochrome one is returned as it is."""
    return image if image.ndim == 2 else image.sum(0)
