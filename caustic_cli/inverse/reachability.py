"""Reachability of a picture by refraction: bounds on the deflection, checked before a design.

Refraction out of glass of index n deflects a ray by less than arccos(1 / n): between the direction d in the glass and t behind the
surface, n (d . t) > 1.  Entrance and picture are sampled; the exit is taken at the height of its offset and, for light that would
leave a thick lens through its sides, at the least height.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from caustic_cli.errors import InputError
from caustic_cli.optics.screen_shape import points_in_space
from caustic_cli.scene import Scene
from caustic_cli.scene.sources.distribution import relative

#: Points along each axis of the entrance, and of the picture at most.
ENTRANCE, PICTURE = 17, 15


def refuse_unreachable(scene: Scene, target: np.ndarray) -> None:
    """Refuse a scene in which no light of the source can reach the picture, (n_x, n_y) on the scene's screen.

    Raises:
        InputError: no light falls on the lens, or none of it can be deflected far enough.
    """
    lens = scene.lens
    if lens.mirror or scene.source.rays is not None or scene.source.apart:
        return
    x, y, d = _in_glass(scene)
    if not len(x):
        raise InputError(
            "[source] none of its light falls on the lens: its position, direction or cone miss the aperture of"
            f" {lens.size[0]:g} x {lens.size[1]:g} mm at z = {lens.z_in:g} mm"
        )
    goal = _lit(scene, target)
    most = -1.0
    for height in (lens.offset.thickness, lens.z_in + lens.min_thickness):
        over = (height - lens.z_in) / d[2]
        at = np.stack([x + over * d[0], y + over * d[1], np.full_like(x, height)])
        within = (np.abs(at[0]) <= lens.half_size[0]) & (np.abs(at[1]) <= lens.half_size[1])
        if within.any():
            t = goal[:, None, :] - at[:, within, None]
            most = max(most, float(((t * d[:, within, None]).sum(0) / np.sqrt((t * t).sum(0)))[t[2] > 0].max(initial=-1.0)))
    if not lens.inside * most > 1.0:
        turn, limit = (math.degrees(math.acos(min(1.0, c))) for c in (most, 1.0 / lens.inside))
        raise InputError(
            "[screen] no light can be refracted to the picture: it would have to be deflected by at least"
            f" {turn:.3g} degrees, and glass of index {lens.inside:g} deflects it by less than {limit:.3g}; a picture"
            " closer to the undeflected light, or a higher index, is needed"
        )


def largest_magnification(scene: Scene, picture: Sequence[float]) -> float | None:
    """Approximate largest magnification of a picture of this width and height, mm, over the lens width; None where unknown.

    For collimated light: a map without folds sends the corner of the lens, whose rays are deflected most, to that of the picture.
    """
    lens = scene.lens
    if lens.mirror or not scene.source.collimated:
        return None
    throw = scene.screen.z - lens.offset.thickness
    reach = throw * math.tan(math.acos(1.0 / lens.inside))
    corner, goal = np.array(lens.half_size), 0.5 * np.array(picture)
    along, square = goal @ corner, goal @ goal  # |f goal - corner| = reach
    root = along**2 - square * (corner @ corner - reach**2)
    return None if root < 0 else float((along + math.sqrt(root)) / square * goal[0] / corner[0])


def _in_glass(scene: Scene) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points x, y (k,) of the entrance where light of the source falls, mm, and its unit directions in the glass there (3, k)."""
    source, lens = scene.source, scene.lens
    x, y = (c.ravel() for c in np.meshgrid(*(np.linspace(-h, h, ENTRANCE) for h in lens.half_size), indexing="ij"))
    if lens.round:
        inside = np.hypot(x, y) <= lens.half_size[0] * (1.0 + 1e-9)
        x, y = x[inside], y[inside]
    if source.distant:
        sine = math.sin(source.half_angle)
        tangents = [(np.full_like(x, sine * a), np.full_like(y, sine * b)) for a, b in ((0, 0), (1, 0), (-1, 0), (0, 1), (0, -1))]
        tangents = [(a / np.sqrt(1.0 - a * a - b * b), b / np.sqrt(1.0 - a * a - b * b)) for a, b in tangents]
        lit = [np.ones_like(x, dtype=bool)] * len(tangents)
    else:
        (wide, high), cone = source.extent, min(source.cone_over(lens.half_size, lens.z_in, lens.round), 0.5 * math.pi)
        tangents, lit = [], []
        for x0, y0, z0 in source.points()[0]:
            for a, b in ((0, 0), (wide, 0), (-wide, 0), (0, high), (0, -high)):
                p, q = (x - x0 - a) / (lens.z_in - z0), (y - y0 - b) / (lens.z_in - z0)
                tangents.append((p, q))
                q = np.hypot(p, q)
                lit.append((np.arctan(q) <= cone * (1.0 + 1e-9)) & (relative(source.intensity, q) > 0))
    p, q = (np.concatenate(c) for c in zip(*tangents, strict=True))
    length = np.sqrt(1.0 + p * p + q * q)
    dx, dy = p / (length * lens.inside), q / (length * lens.inside)
    keep = np.concatenate(lit)
    return np.tile(x, len(lit))[keep], np.tile(y, len(lit))[keep], np.stack([dx, dy, np.sqrt(1.0 - dx * dx - dy * dy)])[:, keep]


def _lit(scene: Scene, target: np.ndarray) -> np.ndarray:
    """Sampled points in space of the bright part of the picture (3, k), mm."""
    screen = scene.screen
    i, j = np.nonzero(target)
    every = max(1, len(i) // PICTURE**2)
    edge = np.array([i.argmin(), i.argmax(), j.argmin(), j.argmax()])
    chosen = np.concatenate([np.arange(0, len(i), every), edge])
    along = [(k[chosen] + 0.5) * w - h for k, w, h in zip((i, j), screen.pixel, screen.half_size, strict=True)]
    return np.stack(points_in_space(screen, *along))
