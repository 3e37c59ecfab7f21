"""Targets of lamps from photometric files: the intensities of a file as a picture over angles, or on a plane.

The power on an element dA of the plane z = h is I cos^3(gamma) dA / h^2.
"""

from __future__ import annotations

import math

import numpy as np
from scipy.interpolate import PchipInterpolator
from scipy.ndimage import maximum_filter, minimum_filter

from caustic_cli.errors import InputError
from caustic_cli.inverse.lamp import directions_of, pixels_of
from caustic_cli.io.photometry import Photometry
from caustic_cli.scene import anglemap
from caustic_cli.scene.lamp import Goal

#: Pixels of the picture, and part of the greatest intensity that counts as light.
PIXELS, DARK = 240_000, 0.005
#: Steps between the angles of a file, an odd number, and iterations towards its values as means over cells.
FINER, ROUNDS = 7, 8
#: Part of the greatest intensity by which values fall within a step of the angle at an edge.
EDGE = 0.4
#: Cells along either axis among which the bright and the dark side of an edge are; part of the step between them that the
#: differences beside a cell add up to if the edge is sharp; and part of it within which a cell beside an edge is even.
AROUND, PLATEAU, EVEN = 5, 0.75, 0.03
#: Difference of equal light, over the greatest.
EQUAL = 1e-9


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
    step, most = float(light.angles[1] - light.angles[0]), anglemap.widest_of(projection)
    return min(width + 2.0 * step, most), min(height + 2.0 * step, most)  # light ends within a step beyond the last lit angle


def edges_of(light: Photometry) -> str:
    """What is uncertain of a file with sharp edges, "" for one without."""
    ahead = light.values[:, light.angles < 90.0]
    if not np.abs(np.diff(ahead, axis=1)).max(initial=0.0) > EDGE * ahead.max(initial=0.0):
        return ""
    step = float(light.angles[1] - light.angles[0])
    return (
        f"has sharp edges, within one of its steps of {step:g} degrees: where they run is estimated from its cells, and the file of"
        " the lamp's light differs by some 1 %; the picture itself as target, over ⟨+lamp.angles⟩, keeps them"
    )


def as_means(light: Photometry) -> Photometry:
    """The light, `refined`, with the values of a file as means over their cells, which reach half a step to all sides, as of those
    that are counted from rays (`studies.photometry`): otherwise every passage through a file blurs edges by a cell.

    The values are corrected by what the means deviate, ROUNDS times, and in the end scaled cell by cell, by nearly 1 unless there
    is an edge, whose dark side the interpolation would light.  Cells through which an edge runs are then divided (`divided`).
    """
    planes = len(light.planes)
    found, corrected = refined(light), light.values
    for _ in range(ROUNDS):
        corrected = (light.values + corrected - means(found, planes)).clip(0.0)
        found = refined(light._replace(values=corrected))
    scale = light.values / means(found, planes).clip(max(1e-9 * float(light.values.max()), 1e-300))
    return divided(found._replace(values=found.values * over_cells(scale)), light.values)


def means(finely: Photometry, planes: int) -> np.ndarray:
    """Of refined light over the cells of its nodes, (planes, angles)."""
    half = FINER // 2
    weight = np.sin(np.radians(finely.angles)).clip(1e-9)
    power, area = (np.pad(c, ((0, 0), (half, half))) for c in (np.roll(finely.values, half, 0) * weight, weight[None]))
    return power.reshape(planes, FINER, -1, FINER).sum((1, 3)) / area.reshape(1, 1, -1, FINER).sum((1, 3)) / FINER


def divided(finely: Photometry, values: np.ndarray) -> Photometry:
    """Refined light with the cells through which a sharp edge runs divided into a bright and a dark part, of the greatest and the
    least value of the cells around, so that their means (planes, angles) are kept: the bright part is where the light is greater.

    Of a straight edge, the differences of the means beside a cell along both axes add up to its step, however it runs; those of
    light that falls over several cells to less.  Cells beside an edge are even.
    """
    low, high = (extreme(values, AROUND, mode=("wrap", "nearest")) for extreme in (minimum_filter, maximum_filter))
    beside = np.pad(np.pad(values, ((1, 1), (0, 0)), mode="wrap"), ((0, 0), (1, 1)), mode="edge")
    across = np.abs(beside[2:, 1:-1] - beside[:-2, 1:-1]) + np.abs(beside[1:-1, 2:] - beside[1:-1, :-2])
    step = high - low
    sharp = (step > EDGE * values.max(initial=0.0)) & (across > PLATEAU * step)
    part = (values - low) / np.where(step > 0, step, 1.0)
    even = maximum_filter(sharp, 3, mode=("wrap", "nearest")) & ((part < EVEN) | (part > 1.0 - EVEN))
    light = in_cells(finely.values, len(values))
    lit = brightest(light, in_cells(0.0 * finely.values + np.sin(np.radians(finely.angles)).clip(0.0), len(values)), part)
    light = np.where(sharp[..., None], low[..., None] + step[..., None] * lit, light)
    light = np.where(even[..., None], values[..., None], light)
    half, (planes, angles) = FINER // 2, values.shape
    found = light.reshape(planes, angles, FINER, FINER).swapaxes(1, 2).reshape(planes * FINER, angles * FINER)
    return finely._replace(values=np.roll(found, -half, 0)[:, half:-half])


def brightest(light: np.ndarray, area: np.ndarray, part: np.ndarray) -> np.ndarray:
    """How much of each small area of cells, (.., k), belongs to a `part` (..) of the area of the whole cell, the brightest one;
    areas of equal light have equal parts."""
    order = np.argsort(-light, axis=-1, kind="stable")
    own, values = (np.take_along_axis(c, order, -1) for c in (area, light))
    until = np.cumsum(own, -1)
    darker = values[..., :-1] - values[..., 1:] > EQUAL * light.max(initial=0.0)
    begins, ends = (np.insert(darker, at, True, -1) for at in (0, darker.shape[-1]))
    before = np.maximum.accumulate(np.where(begins, until - own, 0.0), -1)
    after = np.minimum.accumulate(np.where(ends, until, np.inf)[..., ::-1], -1)[..., ::-1]
    found, lit = np.empty_like(light), (part * until[..., -1])[..., None] - before
    np.put_along_axis(found, order, (lit / (after - before).clip(1e-300)).clip(0.0, 1.0), -1)
    return found


def in_cells(finely: np.ndarray, planes: int) -> np.ndarray:
    """Refined values in the cells of nodes, (planes, angles, FINER^2); 0 beyond the poles."""
    half = FINER // 2
    found = np.pad(np.roll(finely, half, 0), ((0, 0), (half, half)))
    return found.reshape(planes, FINER, -1, FINER).swapaxes(1, 2).reshape(planes, -1, FINER * FINER)


def over_cells(values: np.ndarray) -> np.ndarray:
    """Values (planes, angles) of nodes at all refined angles of their cells."""
    half = FINER // 2
    return np.roll(values.repeat(FINER, 0), -half, 0).repeat(FINER, 1)[:, half:-half]


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
    found = as_means(light).intensity(directions).clip(0.0) * (1.0 if goal.far else directions[:, 2] ** 3)
    if not found.any():
        raise InputError("has no light on the target")
    return found.reshape(pixels)
