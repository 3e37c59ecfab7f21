"""The image of an extended source by the light through one point of the lens to one point of the screen, to first order.

It does not depend on the rest of the lens: the ray from the centre of the source through the point E of the exit to the point S of
the screen determines the normal there by Snell's law, and with it where light from the other points of the source lands.  Of any
lens the image is a superposition of these images, over all E and S, with weights that are not negative.

Notation
    i, o    unit directions in front of the exit and behind it, of the ray from the source's centre; i', o' from another point
    N       normal at E, parallel to n i - o (i - o for a mirror);  n: index in front of the exit
    M       (2, 2), landing point on the screen per displacement on the source: mm per mm, or per direction sine of a distant source

E is taken on the offset surface, the screen as its tangent plane at S.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from itertools import chain

import numpy as np

from caustic_cli.optics.frames import turned_about
from caustic_cli.optics.screen_shape import normals, points_in_space
from caustic_cli.optics.spread import Spread
from caustic_cli.scene import Scene, Source
from caustic_cli.scene.traits import Capability

SOURCE_IMAGES = Capability(
    "images of an extended source",
    {"ray file": "its rays have no common image"}
    | dict.fromkeys(
        ("other elements", "designed entrance", "gradient index"),
        "one refraction behind a flat entrance does not give the image",
    ),
)

#: Positions along each axis of the lens and of the screen, in half widths.
LENS, SCREEN, MIDDLE = np.linspace(-1.0, 1.0, 3), np.linspace(-1.0, 1.0, 5), np.zeros(1)
#: The same of the lens, where it is known where light lands, and how far from there it may land, in parts of the lit rectangle.
FINE_LENS, NEAR = np.linspace(-1.0, 1.0, 17), 0.2
#: Points (2, N) of the exit -> where their light lands on the screen, from its middle, (2, N), mm.
Sent = Callable[[np.ndarray], np.ndarray]
#: Displacement on the source for M, in parts of its distance, or of a direction sine; Newton steps for refraction at a plane.
STEP, STEPS = 1e-4, 8
#: Difference of two images, relative to the sharper one, up to which they count as one: of all images, and of those of light to
#: a place; most images, and the factor by which the difference grows until there are no more.
ALIKE, ALIKE_THERE, MOST, COARSER = 0.05, 0.15, 4, 1.3


def source_images(scene: Scene, middle: bool = False) -> list[Spread]:
    """The different images of a scene's source for light anywhere through the lens to anywhere on the screen, the sharpest first;
    middle: only that for light through the middle of the lens to the middle of the screen.

    Empty without an extended source, for separate points, each of which has a sharp image, where positions lie at several depths,
    for a ray file, with other elements, a free-form entrance or a gradient index.  Those of several sources are those of each, none
    if one of them has none.
    """
    scene = scene.unfolded
    source = scene.source
    if not (source.extended and SOURCE_IMAGES.supports(scene)):
        return []
    if len(source.members) > 1:
        each = [source_images(one, middle) for one in scene.by_source]
        return sorted(chain(*each), key=lambda image: max(image.reach())) if all(each) else []
    if source.apart:
        return []
    if not source.distant and float(np.ptp(source.points()[0][:, 2])) > 0:
        return []
    onto = [(MIDDLE if middle else SCREEN) * h for h in scene.screen.half_size]
    return [Spread.of(source, matrix) for matrix, _ in _distinct(_matrices(scene, MIDDLE if middle else LENS, onto)[0], ALIKE)]


@dataclass(frozen=True, eq=False)
class PlacedImage:
    """An image of the source, and where on the screen light has it."""

    image: Spread
    #: Lines (k,) along u and v, mm, ascending, and whether it is the image at their crossings (k, k).
    lines: tuple[np.ndarray, np.ndarray]
    at: np.ndarray

    def covers(self, u: np.ndarray, v: np.ndarray) -> np.ndarray:
        """Whether light at places u (n,), v (m,), mm, may have it: (n, m); none beyond the outermost lines."""
        ends = [_between(line, c) for line, c in zip(self.lines, (u, v), strict=True)]
        found = np.any([self.at[i[:, None], j[None, :]] for i in ends[0][0] for j in ends[1][0]], axis=0)
        return found & ends[0][1][:, None] & ends[1][1][None, :]


def _between(line: np.ndarray, at: np.ndarray) -> tuple[tuple[np.ndarray, np.ndarray], np.ndarray]:
    """Indices of the lines on both sides of places, and whether these are between any."""
    upper = np.clip(np.searchsorted(line, at), 1, len(line) - 1)
    return (upper - 1, upper), (at >= line[0]) & (at <= line[-1])


def placed_images(scene: Scene, low: tuple[float, float], high: tuple[float, float], sent: Sent | None = None) -> list[PlacedImage]:
    """The different images of light to each place of a rectangle of the screen, by its limits along u and v, mm; where
    `source_images` are known.

    sent: where light through points of the exit lands; that to places farther from there than NEAR of the rectangle is left out.
    """
    if len(scene.source.members) > 1:
        return [image for one in scene.by_source for image in placed_images(one, low, high)]
    lines = [np.linspace(a, b, len(SCREEN)) for a, b in zip(low, high, strict=True)]
    matrices, (points, places) = _matrices(scene, LENS if sent is None else FINE_LENS, lines)
    if sent is not None:
        wide = [b - a for a, b in zip(low, high, strict=True)]
        at = np.stack([c.ravel() for c in np.meshgrid(*(FINE_LENS * h for h in scene.lens.half_size), indexing="ij")])
        to = np.stack([c.ravel() for c in np.meshgrid(*lines, indexing="ij")])
        near = (np.abs(sent(at)[:, points] - to[:, places]) <= NEAR * np.array(wide)[:, None]).all(0)
        matrices, places = matrices[near], places[near]
    found = []
    for matrix, mine in _distinct(matrices, ALIKE_THERE):
        at_lines = np.zeros((len(SCREEN),) * 2, bool)
        at_lines.flat[places[mine]] = True
        found.append(PlacedImage(Spread.of(scene.source, matrix), (lines[0], lines[1]), at_lines))
    return found


def _distinct(matrices: np.ndarray, alike: float) -> list[tuple[np.ndarray, np.ndarray]]:
    """At most MOST matrices, the sharpest first, that differ from all before them by more than a part of these, each with the
    indices of all that count as it."""
    order = np.argsort(np.abs(np.linalg.det(matrices)), kind="stable")
    while True:
        left = order
        found: list[tuple[np.ndarray, np.ndarray]] = []
        while len(left) and len(found) <= MOST:
            first = matrices[left[0]]
            near = np.linalg.norm(matrices[left] - first, 2, axis=(1, 2)) <= alike * np.linalg.norm(first, 2)
            found.append((first, left[near]))
            left = left[~near]
        if len(found) <= MOST:
            return found
        alike *= COARSER


def _matrices(scene: Scene, through: np.ndarray, onto: list[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """M (k, 2, 2) of light through points of the lens, at these positions along its half widths, to the crossings of lines u and v
    of the screen, mm, where it can be refracted so; and the indices of point and crossing (2, k), y and v fastest."""
    lens, screen = scene.lens, scene.screen
    lines = [through * h for h in lens.half_size]
    x, y = (c.ravel() for c in np.meshgrid(*lines, indexing="ij"))
    z = lens.offset.heights(*lines).ravel()
    inside = np.all([far <= r * (1.0 + 1e-9) for far, r in lens.opening.distances(x, y)], axis=0)
    x, y, z, numbers = x[inside], y[inside], z[inside], np.flatnonzero(inside)
    u, v = (c.ravel() for c in np.meshgrid(*onto, indexing="ij"))
    exit, at = np.stack([x, y, z], -1)[:, None], np.stack(points_in_space(screen, u, v), -1)[None]
    upright = np.stack(normals(screen, u, v), -1)[None]
    n, interaction = lens.inside, lens.interaction
    chief, toward = _arriving(scene, exit, (0.0, 0.0)), at - exit
    toward = toward / np.linalg.norm(toward, axis=-1, keepdims=True)
    normal = n * chief - toward
    reached = interaction.reaches(n, (chief * toward).sum(-1))
    normal = normal / np.maximum(np.linalg.norm(normal, axis=-1, keepdims=True), 1e-300)
    step = STEP if scene.source.distant else STEP * abs(lens.z_in - scene.source.centre[2])
    along = np.stack(np.broadcast_arrays(*screen.axes[:2]), -1)
    columns = []
    for k in (0, 1):
        ends = []
        for sign in (1.0, -1.0):
            arriving = _arriving(scene, exit, (sign * step * (k == 0), sign * step * (k == 1)))
            leaving, passed = interaction.leaving(arriving, normal, n)
            reached = reached & passed
            cosine = (leaving * upright).sum(-1, keepdims=True)
            reached = reached & (np.abs(cosine[..., 0]) > STEP)
            far = ((at - exit) * upright).sum(-1, keepdims=True) / np.where(np.abs(cosine) > STEP, cosine, 1.0)
            ends.append((exit + far * leaving - at) @ along)
        columns.append((ends[0] - ends[1]) / (2.0 * step))
    of_lens, of_screen = np.nonzero(reached)
    found = np.stack(columns, -1)[reached]
    return _unturned(found) if _is_round(scene.source) else found, np.stack([numbers[of_lens], of_screen])


def _is_round(source: Source) -> bool:
    """Whether a source looks the same turned about its centre."""
    return source.even and (source.distant or (source.extent[0] == source.extent[1] and len(source.points()[0]) == 1))


def _unturned(matrices: np.ndarray) -> np.ndarray:
    """M (k, 2, 2) without the rotation or reflection that precedes its stretch: its polar decomposition."""
    u, stretches, _ = np.linalg.svd(matrices)
    return (u * stretches[:, None, :]) @ np.swapaxes(u, 1, 2)


def _arriving(scene: Scene, exit: np.ndarray, moved: tuple[float, float]) -> np.ndarray:
    """Unit directions (..., 3) in front of the exit at points (..., 3) of it, of light from a point of the source that is displaced
    by `moved` from its centre."""
    lens, source = scene.lens, scene.source
    n = lens.inside
    if source.distant:
        length = math.sqrt(1.0 - moved[0] ** 2 - moved[1] ** 2)
        p, q = (length * m / n for m in turned_about(source.axis, *(m / length for m in moved))[:2])
        return np.array([p, q, math.sqrt(1.0 - p * p - q * q)]) + 0.0 * exit
    d = exit[..., :2] - np.array(source.centre[:2]) - np.array(moved)
    entrance = lens.interaction.entered(lens.z_in, exit[..., 2])
    far, before, within = np.linalg.norm(d, axis=-1), entrance - source.centre[2], exit[..., 2] - entrance
    tangent = far / before  # of the angle in front of the entrance: before t + within t / sqrt(n^2 + (n^2 - 1) t^2) = far
    for _ in range(STEPS):
        root = np.sqrt(n * n + (n * n - 1.0) * tangent**2)
        tangent -= (before * tangent + within * tangent / root - far) / (before + within * n * n / root**3)
    part = tangent / (n * np.sqrt(1.0 + tangent**2) * np.maximum(far, 1e-300))  # sine in the glass over the distance
    d = d * part[..., None]
    return np.concatenate([d, np.sqrt(1.0 - (d * d).sum(-1, keepdims=True))], -1)
