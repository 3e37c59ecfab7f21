"""Images as seen by an eye that has adapted to the source, or a camera with that white balance."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from caustic_cli.loading import OnDemand
from caustic_cli.optics.image import Image
from caustic_cli.scene import Scene
from caustic_cli.studies.color_error import shown
from caustic_cli.studies.irradiance import irradiance
from caustic_cli.studies.retrace import white_level

if TYPE_CHECKING:
    from caustic_cli.optics.waves.image import WaveImage

colorimetry = OnDemand("caustic_cli.io.colorimetry")


def tristimulus_values(scene: Scene, found: Image | WaveImage) -> np.ndarray | None:
    """X, Y, Z of an image (3, n_x, n_y), float64, Y that of the image; None for light without colour (`Scene.white`)."""
    return separated(scene, (found.image if found.xyz is None else found.xyz).cpu().numpy())[1]  # of one colour, or of several


def separated(scene: Scene | None, image: np.ndarray) -> tuple[np.ndarray, np.ndarray | None]:
    """An image and its tristimulus values, None for light without colour, of either of them."""
    if scene is None or scene.white is None:
        return image, None
    return (image, np.array(scene.white)[:, None, None] * image) if image.ndim == 2 else (image[1], image)


def as_viewed(
    scene: Scene | None, image: np.ndarray, target: np.ndarray | None, xyz: np.ndarray | None = None
) -> tuple[np.ndarray, float]:
    """What is shown of an image of irradiance, and the value of white in it, at the exposure of the target: a coloured picture's
    channels, and tristimulus values `xyz`, as linear R, G, B of sRGB (3, n_x, n_y); without these the image itself."""
    if scene is not None and scene.colored:
        return shown(scene.light, image, target), 1.0
    white = white_level(image, target)
    return (image if xyz is None or scene is None else in_colour(scene, xyz, white)), white


def as_lit(
    scene: Scene | None, image: np.ndarray, target: np.ndarray | None, xyz: np.ndarray | None = None
) -> tuple[np.ndarray, float]:
    """`as_viewed` of images of power per pixel: their irradiance on the screen."""
    if scene is None:
        return as_viewed(scene, image, target, xyz)
    seen, aim, colour = (None if a is None else irradiance(a, scene.screen) for a in (image, target, xyz))
    assert seen is not None
    return as_viewed(scene, seen, aim, colour)


def in_colour(scene: Scene, xyz: np.ndarray, white: float) -> np.ndarray:
    """Linear R, G, B of sRGB (3, n_x, n_y), at most `white`, of tristimulus values (3, n_x, n_y); Y = `white` is shown as white."""
    return white * colorimetry.xyz_to_rgb(xyz, scene.white, 1.0 / white if white > 0 else 0.0, axis=0)
