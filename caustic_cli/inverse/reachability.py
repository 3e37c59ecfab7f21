"""Reachability of a picture by refraction: bounds on the deflection, checked before a design.

Refraction out of glass of index n deflects a ray by less than arccos(1 / n): between the direction d in the glass and t behind the
surface, n (d . t) > 1.  Entrance and picture are sampled; the exit is taken at the height of its offset and, for light that would
leave a thick lens through its sides, at the least height.  Behind a curved entrance, or in a medium whose index varies, the rays
to points of the exit at these heights are traced, and n is the index there.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from itertools import chain, product

import numpy as np
import torch

from caustic_cli.errors import InputError
from caustic_cli.inverse.incidence import directions, from_point, is_aimed, is_traced
from caustic_cli.optics.emission import rays_of
from caustic_cli.optics.emission.coherent import central_mode, offset, outermost_modes
from caustic_cli.optics.frames import turned_about
from caustic_cli.optics.screen_shape import points_in_space
from caustic_cli.scene import Scene
from caustic_cli.scene.sources.distribution import relative
from caustic_cli.scene.traits import Capability

REACHABILITY = Capability(
    "check of what refraction can reach",
    {"mirror": "reflection deflects by any angle"},
)

#: Points along each axis of the entrance, and of the picture at most.
ENTRANCE, PICTURE = 17, 15
#: Most rays of a file.
FILED = 1 << 14
#: Pairs of a ray in the glass and a point of the picture treated at a time, 50 bytes each.
PAIRS = 1 << 20
#: Points of an extended source, in parts of its half widths along x and y: its centre, and its outermost along each axis.
AROUND = np.array([(0.0, 0.0), (1.0, 0.0), (-1.0, 0.0), (0.0, 1.0), (0.0, -1.0)]).T


def refuse_unreachable(scene: Scene, target: np.ndarray) -> None:
    """Refuse a scene in which no light of the source can reach the picture, (n_x, n_y) on the scene's screen.

    Raises:
        InputError: no light falls on the lens, or none of it can be deflected far enough.
    """
    lens, limit = scene.lens, scene.lens.interaction.largest_deflection(scene.lens.index)
    each = scene.by_source
    if not REACHABILITY.supports(scene) or not all(is_aimed(one) for one in each):
        return
    if any(is_traced(one) and one.source.rays is not None for one in each):  # whose rays are not aimed at the exit
        return
    goal, most, lit = _lit(scene, target), -1.0, False
    for count, at, d in chain(*(_at_exit(one, max(1, PAIRS // goal.shape[1])) for one in each)):
        lit = lit or count > 0
        most = max(most, _largest_cosine(at, d, goal))
        if lens.inside * most > 1.0:
            return
    if not lit:
        raise InputError(
            "[source] none of its light falls on the lens: its position, direction or cone miss the aperture of"
            f" {lens.size[0]:g} x {lens.size[1]:g} mm at z = {lens.z_in:g} mm"
        )
    turn, limit = math.degrees(math.acos(min(1.0, most))), math.degrees(limit)
    raise InputError(
        "[screen] no light can be refracted to the picture: it would have to be deflected by at least"
        f" {turn:.3g} degrees, and glass of index {lens.inside:g} deflects it by less than {limit:.3g}; a picture"
        " closer to the undeflected light, or a higher index, is needed"
    )


def _largest_cosine(at: np.ndarray, d: np.ndarray, goal: np.ndarray) -> float:
    """Largest d . t of rays (3, k) at points (3, k) of the exit, as of `_at_exit`, to points of the picture (3, m); at least -1."""
    t = goal[:, None, :] - at[:, :, None]
    return float(((t * d[:, :, None]).sum(0) / np.sqrt((t * t).sum(0)))[t[2] > 0].max(initial=-1.0))


def _at_exit(scene: Scene, rays: int) -> Iterator[tuple[int, np.ndarray, np.ndarray]]:
    """Rays that fall on the lens, their number, and of those that arrive at the heights of the exit within its aperture points
    (3, k), mm, and directions (3, k), of the length of the index there over that of the lens; about `rays` rays at a time."""
    lens = scene.lens
    heights = lens.offset.thickness, lens.z_in + lens.min_thickness
    if is_traced(scene):
        x, y = _grid(scene)
        for height, mode in product(heights, (central_mode(scene), *outermost_modes(scene))):
            at = np.stack([x, y, np.full_like(x, height)])
            d, lit = directions(from_point(scene, offset(scene.source, mode.position)), at)
            yield int(lit.sum()), at[:, lit], d[:, lit]
        return
    for x, y, d in _in_glass(scene, rays):
        for height in heights:
            over = (height - lens.z_in) / d[2]
            at = np.stack([x + over * d[0], y + over * d[1], np.full_like(x, height)])
            within = (np.abs(at[0]) <= lens.half_size[0]) & (np.abs(at[1]) <= lens.half_size[1])
            yield len(x), at[:, within], d[:, within]


def _grid(scene: Scene) -> tuple[np.ndarray, np.ndarray]:
    """Points x, y (k,) of the aperture, mm."""
    lens = scene.lens
    x, y = (c.ravel() for c in np.meshgrid(*(np.linspace(-h, h, ENTRANCE) for h in lens.half_size), indexing="ij"))
    inside = np.all([far <= r * (1.0 + 1e-9) for far, r in lens.opening.distances(x, y)], axis=0)
    return x[inside], y[inside]


def largest_magnification(scene: Scene, picture: Sequence[float]) -> float | None:
    """Approximate largest magnification of a picture of this width and height, mm, over the lens width; None where unknown.

    For collimated light: a map without folds sends the corner of the lens, whose rays are deflected most, to that of the picture.
    """
    lens, limit = scene.lens, scene.lens.interaction.largest_deflection(scene.lens.index)
    if limit >= math.pi or not scene.source.collimated:
        return None
    throw = scene.screen.z - lens.offset.thickness
    reach = throw * math.tan(limit)
    corner, goal = np.array(lens.half_size), 0.5 * np.array(picture)
    along, square = goal @ corner, goal @ goal  # |f goal - corner| = reach
    root = along**2 - square * (corner @ corner - reach**2)
    return None if root < 0 else float((along + math.sqrt(root)) / square * goal[0] / corner[0])


def _in_glass(scene: Scene, rays: int) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Points x, y (k,) of the entrance where light of the source falls, mm, and its unit directions in the glass there (3, k).

    The points of a source in turn, about `rays` rays at a time, so that the memory does not depend on their number.

    Raises:
        InputError: none of the rays of a file meets the lens.
    """
    source, lens = scene.source, scene.lens
    if source.rays is not None:
        for state in rays_of(scene, "sobol", FILED).chunks(rays):
            x, y, dx, dy, dz = (torch.as_tensor(c).numpy() for c in (*state.origin[:2], *state.direction))
            yield _refracted(scene, x, y, dx / dz, dy / dz)
        return
    x, y = _grid(scene)
    if source.distant:
        sine = math.sin(source.half_angle)
        a, b = (sine * c[:, None] for c in AROUND)
        along = np.sqrt(1.0 - a * a - b * b)
        p, q, up = turned_about(source.axis, a / along, b / along)
        yield _refracted(scene, x, y, p / up + 0.0 * x, q / up + 0.0 * y)
        return
    cone = min(source.cone_over(lens.pupil), 0.5 * math.pi)
    around = AROUND if max(source.extent) > 0 else AROUND[:, :1]
    (a, b), points = (w * c for w, c in zip(source.extent, around, strict=True)), source.points()[0]
    each = max(1, rays // (len(x) * around.shape[1]))
    for first in range(0, len(points), each):
        x0, y0, z0 = (c[:, None, None] for c in points[first : first + each].T)
        p, q = (x - x0 - a[:, None]) / (lens.z_in - z0), (y - y0 - b[:, None]) / (lens.z_in - z0)
        tangent = np.hypot(p, q)
        lit = (np.arctan(tangent) <= cone * (1.0 + 1e-9)) & (relative(source.intensity, tangent) > 0)
        yield _refracted(scene, x, y, p, q, lit)


def _refracted(scene: Scene, x: np.ndarray, y: np.ndarray, p: np.ndarray, q: np.ndarray, lit: np.ndarray | None = None):
    """As `_in_glass`, of rays with tangents p, q (..., k) through x, y (k,), those that are `lit`."""
    n, length = scene.lens.inside, np.sqrt(1.0 + p * p + q * q)
    dx, dy = p / (length * n), q / (length * n)
    keep = np.ones(p.shape, dtype=bool) if lit is None else lit
    x, y = (np.broadcast_to(c, p.shape)[keep] for c in (x, y))
    return x, y, np.stack([dx, dy, np.sqrt(1.0 - dx * dx - dy * dy)])[:, keep]


def _lit(scene: Scene, target: np.ndarray) -> np.ndarray:
    """Sampled points in space of the bright part of the picture (3, k), mm."""
    screen = scene.screen
    i, j = np.nonzero(target)
    every = max(1, len(i) // PICTURE**2)
    edge = np.array([i.argmin(), i.argmax(), j.argmin(), j.argmax()])
    chosen = np.concatenate([np.arange(0, len(i), every), edge])
    along = [(k[chosen] + 0.5) * w - h for k, w, h in zip((i, j), screen.pixel, screen.half_size, strict=True)]
    return np.stack(points_in_space(screen, *along))
