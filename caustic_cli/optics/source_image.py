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

import numpy as np

from caustic_cli.optics.frames import turned_about
from caustic_cli.optics.screen_shape import normals, points_in_space
from caustic_cli.optics.spread import Spread
from caustic_cli.scene import Scene
from caustic_cli.scene.traits import Capability

SOURCE_IMAGES = Capability(
    "images of an extended source",
    dict.fromkeys(("separate places", "several sources"), "its places have images of their own")
    | {"ray file": "its rays have no common image"}
    | dict.fromkeys(
        ("other elements", "folded axis", "designed entrance", "gradient index"),
        "one refraction behind a flat entrance does not give the image",
    ),
)

#: Positions along each axis of the lens and of the screen, in half widths.
LENS, SCREEN, MIDDLE = np.linspace(-1.0, 1.0, 3), np.linspace(-1.0, 1.0, 5), np.zeros(1)
#: Displacement on the source for M, in parts of its distance, or of a direction sine; Newton steps for refraction at a plane.
STEP, STEPS = 1e-4, 8
#: Difference of two images, relative to the sharper one, up to which they count as one; most images, and the factor by which the
#: difference grows until there are no more.
ALIKE, MOST, COARSER = 0.05, 4, 1.3


def source_images(scene: Scene, middle: bool = False) -> list[Spread]:
    """The different images of a scene's source for light anywhere through the lens to anywhere on the screen, the sharpest first;
    middle: only that for light through the middle of the lens to the middle of the screen.

    Empty without an extended source, where its positions lie at several depths or its light is that of several sources, for a ray
    file, with other elements, a free-form entrance or a gradient index.
    """
    source = scene.source
    if not (source.extended and SOURCE_IMAGES.supports(scene)):
        return []
    if not source.distant and float(np.ptp(source.points()[0][:, 2])) > 0:
        return []
    matrices, alike = (
        sorted(_matrices(scene, *((MIDDLE, MIDDLE) if middle else (LENS, SCREEN))), key=lambda m: abs(float(np.linalg.det(m)))),
        ALIKE,
    )
    while len(distinct := _distinct(matrices, alike)) > MOST:
        alike *= COARSER
    return [Spread.of(source, matrix) for matrix in distinct]


def _distinct(matrices: list[np.ndarray], alike: float) -> list[np.ndarray]:
    """Those that differ from all before them by more than a part of these."""
    found: list[np.ndarray] = []
    for matrix in matrices:
        if all(np.linalg.norm(matrix - m, 2) > alike * np.linalg.norm(m, 2) for m in found):
            found.append(matrix)
    return found


def _matrices(scene: Scene, through: np.ndarray, onto: np.ndarray) -> np.ndarray:
    """M (k, 2, 2) of light through points of the lens to points of the screen, at these positions along their half widths, where it
    can be refracted so."""
    lens, screen = scene.lens, scene.screen
    lines = [through * h for h in lens.half_size]
    x, y = (c.ravel() for c in np.meshgrid(*lines, indexing="ij"))
    z = lens.offset.heights(*lines).ravel()
    inside = np.all([far <= r * (1.0 + 1e-9) for far, r in lens.opening.distances(x, y)], axis=0)
    x, y, z = x[inside], y[inside], z[inside]
    u, v = (c.ravel() for c in np.meshgrid(*(onto * h for h in screen.half_size), indexing="ij"))
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
    return np.stack(columns, -1)[reached]


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
