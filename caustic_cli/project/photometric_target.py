"""Targets of lamps from photometric files: the intensities of a file as a picture over angles, or on a plane.

The power on an element dA of the plane z = h is I cos^3(gamma) dA / h^2.
"""

from __future__ import annotations

import math

import numpy as np
from scipy.interpolate import PchipInterpolator

from caustic_cli.errors import InputError
from caustic_cli.inverse.lamp import directions_of, pixels_of
from caustic_cli.io.photometry import Photometry
from caustic_cli.scene import anglemap
from caustic_cli.scene.lamp import Goal

#: Pixels of the picture, and part of the greatest intensity that counts as light.
PIXELS, DARK = 60_000, 0.005
#: Steps between the angles of a file.
FINER = 6


def angles_of(light: Photometry, projection: str = "latitude") -> tuple[float, float]:
    """Width and height, degrees, of the smallest target in the far field, centred on the axis of a map, that holds all light.

    Raises:
        InputError: there is no light towards z > 0.
    """
    plane, gamma = np.meshgrid(np.radians(light.planes), np.radians(light.angles), indexing="ij")
    ahead = light.angles < 90.0
    lit = (light.values > DARK * light.values[:, ahead].max(initial=0.0)) & ahead
    if len(light.angles) < 2 or not lit.any():
        raise InputError("has no light within 90 degrees of its axis")
    x, y, z = np.sin(gamma) * np.cos(plane), np.sin(gamma) * np.sin(plane), np.cos(gamma)
    coordinates = (np.arctan2(x, z), np.arcsin(y))
    if projection in anglemap.RADIAL:
        radius, back, *_ = anglemap.RADIAL[projection]
        coordinates = back(radius(gamma) * abs(np.cos(plane))), back(radius(gamma) * abs(np.sin(plane)))
    width, height = (2.0 * math.degrees(float(np.abs(angle[lit]).max())) for angle in coordinates)
    least, most = 2.0 * float(light.angles[1] - light.angles[0]), anglemap.widest_of(projection)
    return min(max(width, least), most), min(max(height, least), most)


def refined(light: Photometry) -> Photometry:
    """The light at FINER times as many angles, by monotone cubic splines: a lens cannot follow the kinks of linear interpolation,
    and monotone ones do not overshoot at edges."""
    finely = [np.interp(np.arange(FINER * (len(a) - 1) + 1) / FINER, np.arange(len(a)), a) for a in (light.planes, light.angles)]
    planes = np.append(finely[0], np.linspace(light.planes[-1], light.planes[0] + 360.0, FINER, endpoint=False)[1:])
    around = np.concatenate([light.planes - 360.0, light.planes, light.planes + 360.0])
    values = PchipInterpolator(around, np.concatenate([light.values] * 3))(planes)
    return light._replace(planes=planes, angles=finely[1], values=PchipInterpolator(light.angles, values, axis=1)(finely[1]))


def picture_of(light: Photometry, goal: Goal) -> np.ndarray:
    """The picture (a, b) of a target, [i, j] with i along +x: intensities in the far field, or irradiance on a plane.

    Raises:
        InputError: no light falls there.
    """
    pixels = pixels_of(goal, PIXELS)
    directions = directions_of(goal, pixels).numpy()
    found = refined(light).intensity(directions).clip(0.0) * (1.0 if goal.far else directions[:, 2] ** 3)
    if not found.any():
        raise InputError("has no light on the target")
    return found.reshape(pixels)
