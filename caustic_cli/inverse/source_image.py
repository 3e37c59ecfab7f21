"""The image of an extended source by the light through one point of the lens to one point of the screen, to first order.

It does not depend on the rest of the exit: the ray from the centre of the source that arrives at the point E of the exit and the
ray that leaves it for the point S of the screen determine the normal there by Snell's law, and with it where light from the other
points of the source lands.  Of any lens the image is a superposition of these images, over all E and S, with weights that are not
negative.  Both rays, and the displaced ones, are traced through what else there is: a curved entrance, a medium whose index varies,
lenses and mirrors in front of the lens and behind it.

Notation
    i, o    unit directions in front of the exit and behind it, of the ray from the source's centre; i', o' from another point
    N       normal at E, parallel to n i - o (i - o for a mirror);  n: index in front of the exit, at E
    M       (2, 2), landing point on the screen per displacement on the source: mm per mm, or per direction sine of a distant source

E is taken on the offset surface.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import chain

import numpy as np
import torch

from caustic_cli.errors import InputError
from caustic_cli.inverse.incidence import directions, from_point
from caustic_cli.inverse.projection import ScreenProjection
from caustic_cli.inverse.relay import RelayedScreen
from caustic_cli.optics.emission.coherent import offset, outermost_modes
from caustic_cli.optics.screen_shape import points_in_space
from caustic_cli.optics.spread import Spread
from caustic_cli.scene import Scene, Source
from caustic_cli.scene.traits import Capability

SOURCE_IMAGES = Capability(
    "images of an extended source",
    {
        "unknown entrance": "the entrance that is designed decides how wide the source looks through it",
        "unknown elements": "the surfaces that are designed between source and screen decide how large its image is",
        "ray file": "its rays have no common image",
    },
)

#: Positions along each axis of the lens and of the screen, in half widths.
LENS, SCREEN, MIDDLE = np.linspace(-1.0, 1.0, 3), np.linspace(-1.0, 1.0, 5), np.zeros(1)
#: The same of the lens, where it is known where light lands, and how far from there it may land, in parts of the lit rectangle.
FINE_LENS, NEAR = np.linspace(-1.0, 1.0, 17), 0.2
#: Points (2, N) of the exit -> where their light lands on the screen, from its middle, (2, N), mm.
Sent = Callable[[np.ndarray], np.ndarray]
#: Displacement on the source for M, in parts of its distance, or of a direction sine; how close to a place light must land to be
#: that to it, in parts of the screen.
STEP, AIMED = 1e-3, 1e-4
#: Points of the lens, in half widths, through which light may be cut by an aperture, and the largest fraction of the light of which
#: parts of the source are cut: an image that is cut is sharper.
WITHIN, CUT = np.array([-0.9, -0.6, -0.3, 0.0, 0.3, 0.6, 0.9]), 0.1
#: Difference of two images, relative to the sharper one, up to which they count as one: of all images, and of those of light to
#: a place; most images, and the factor by which the difference grows until there are no more.
ALIKE, ALIKE_THERE, MOST, COARSER = 0.05, 0.15, 4, 1.3


def source_images(scene: Scene, middle: bool = False) -> list[Spread]:
    """The different images of a scene's source for light anywhere through the lens to anywhere on the screen, the sharpest first;
    middle: only that for light through the middle of the lens to the middle of the screen.

    Empty without an extended source, for separate points, each of which has a sharp image, where positions lie at several depths,
    where light of parts of the source alone passes other elements' apertures, or where `SOURCE_IMAGES` does not support the scene.
    Those of several sources are those of each, none if one of them has none.
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
    if scene.elements and not middle and _cut(scene, onto) > CUT:
        return []
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
    of the screen, mm, where it can be sent so; and the indices of point and crossing (2, k), y and v fastest."""
    source = scene.source
    step = STEP if source.distant else STEP * abs(scene.lens.z_in - source.centre[2])
    try:
        pairs = _Pairs.of(scene, through, onto)
        ends = [pairs.landing(moved) for moved in ((step, 0.0), (-step, 0.0), (0.0, step), (0.0, -step))]
    except InputError:  # the light is focused within the lens, or the lens imaged onto the screen: there slopes do not send light
        return np.zeros((0, 2, 2)), np.zeros((2, 0), dtype=int)
    reached = np.all([pairs.sent, *(np.isfinite(end).all(0) for end in ends)], axis=0)
    columns = [(one - other) / (2.0 * step) for one, other in (ends[:2], ends[2:])]
    found = np.moveaxis(np.stack(columns, 1), (0, 1), (-2, -1))[reached]
    of_lens, of_screen = np.nonzero(reached)
    return _unturned(found) if _is_round(source) else found, np.stack([pairs.numbers[of_lens], of_screen])


def _cut(scene: Scene, onto: list[np.ndarray]) -> float:
    """Part of the pairs of a point of the lens and a crossing of lines u and v of the screen, mm, between which the light of some
    points of the source is cut by apertures, of those with light."""
    try:
        pairs = _Pairs.of(scene, WITHIN, onto)
        moves = [(0.0, 0.0), *(offset(scene.source, mode.position) for mode in outermost_modes(scene))]
        passed = np.stack([np.isfinite(pairs.landing(moved, stopped=True)).all(0) for moved in moves]) & pairs.sent
    except InputError:
        return 1.0
    return float((passed.any(0) & ~passed.all(0)).sum() / max(1, passed.any(0).sum()))


@dataclass(frozen=True, eq=False)
class _Pairs:
    """Points E (P) of the exit and S (S) of the screen, and the rays of the source's centre through both."""

    scene: Scene
    #: E, mm, three components (P, 1), and its indices (P,) among all that were asked for.
    exit: tuple[np.ndarray, ...]
    numbers: np.ndarray
    #: Index in front of E (P, 1, 1), unit normals there (P, S, 3), and whether there is light from the centre to S (P, S).
    n: np.ndarray
    normal: np.ndarray
    sent: np.ndarray

    @classmethod
    def of(cls, scene: Scene, through: np.ndarray, onto: list[np.ndarray]) -> _Pairs:
        """Of points as of `_matrices`.

        Raises:
            InputError: the light is focused within the lens, or the lens imaged onto the screen.
        """
        lens, lines = scene.lens, [through * h for h in scene.lens.half_size]
        x, y = (c.ravel() for c in np.meshgrid(*lines, indexing="ij"))
        inside = np.all([far <= r * (1.0 + 1e-9) for far, r in lens.opening.distances(x, y)], axis=0)
        exit = np.stack([x, y, lens.offset.heights(*lines).ravel()])[:, inside]
        chief, lit = _arriving(scene, exit, (0.0, 0.0))
        length = np.linalg.norm(chief, axis=-1, keepdims=True)
        behind = _Behind(scene, tuple(c[:, None] for c in exit))
        toward, aimed = behind.toward(*(c.ravel() for c in np.meshgrid(*onto, indexing="ij")))
        chief, n = chief / length, length * lens.inside
        sent = aimed & lit & lens.interaction.reaches(n[..., 0], (chief * toward).sum(-1))
        normal = n * chief - toward
        normal = normal / np.maximum(np.linalg.norm(normal, axis=-1, keepdims=True), 1e-300)
        return cls(scene, behind.exit, np.flatnonzero(inside), n, normal, sent)

    def landing(self, moved: tuple[float, float], stopped: bool = False) -> np.ndarray:
        """Where light lands, as of `_Behind.landing`, that leaves E from a point of the source displaced by `moved` from its
        centre: (2, P, S), NaN where it does not; stopped: also where an aperture stops it."""
        arriving, lit = _arriving(self.scene, np.stack([c[:, 0] for c in self.exit]), moved)
        interaction, inside = self.scene.lens.interaction, self.scene.lens.inside
        leaving, passed = interaction.leaving(arriving * (inside / self.n), self.normal, self.n)
        return np.where(lit & passed, _Behind(self.scene, self.exit).landing(leaving, stopped), np.nan)


def _is_round(source: Source) -> bool:
    """Whether a source looks the same turned about its centre."""
    return source.even and (source.distant or (source.extent[0] == source.extent[1] and len(source.points()[0]) == 1))


def _unturned(matrices: np.ndarray) -> np.ndarray:
    """M (k, 2, 2) without the rotation or reflection that precedes its stretch: its polar decomposition."""
    u, stretches, _ = np.linalg.svd(matrices)
    return (u * stretches[:, None, :]) @ np.swapaxes(u, 1, 2)


def _arriving(scene: Scene, exit: np.ndarray, moved: tuple[float, float]) -> tuple[np.ndarray, np.ndarray]:
    """`directions` (N, 1, 3) in front of the exit at points (3, N) of it, of light from a point of the source that is displaced by
    `moved` from its centre, and whether there is such light, (N, 1)."""
    d, lit = directions(from_point(scene, moved), exit)
    return d.T[:, None], lit[:, None]


@dataclass(frozen=True, eq=False)
class _Behind:
    """What lies between points of the exit, three components (P, 1) in mm, and the screen."""

    scene: Scene
    exit: tuple[np.ndarray, ...]

    @cached_property
    def relay(self) -> RelayedScreen:
        """The screen through the elements behind the lens."""
        return RelayedScreen(self.scene, float(self.exit[2].mean()))

    def toward(self, u: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Unit directions (P, S, 3) from the points to coordinates u, v (S,) of the screen, and whether light arrives there so."""
        screen, shape = self.scene.screen, (len(self.exit[0]), len(u))
        if self.scene.behind:
            goal = [np.broadcast_to(c, shape) for c in self.relay.project(u, v)]
            toward = _unit(self.relay.directions_to(*goal)(*self.exit))
            off = self.landing(toward) - np.stack([u + screen.shift[0], v + screen.shift[1]])[:, None]
            with np.errstate(invalid="ignore"):
                return toward, (np.abs(off) < AIMED * min(screen.size)).all(0)
        origin = (0.0, 0.0, 0.0) if screen.far else self.exit
        toward = [a - b for a, b in zip(points_in_space(screen, u, v), origin, strict=True)]
        return _unit([np.broadcast_to(c, shape) for c in toward]), np.ones(shape, dtype=bool)

    def landing(self, leaving: np.ndarray, stopped: bool = False) -> np.ndarray:
        """Coordinates (2, P, S) on the screen, mm, up to a constant, of rays in directions (P, S, 3); NaN where they miss it;
        stopped: also where an aperture stops them."""
        rays = [np.moveaxis(leaving, -1, 0), [np.broadcast_to(c, leaving.shape[:-1]) for c in self.exit]]
        way, start = (tuple(map(np.array, v)) for v in rays)
        if self.scene.behind:
            return np.stack(self.relay.landing(start, way, stopped))
        bare = ScreenProjection(self.scene.screen, float(self.exit[2].mean()), self.scene.lens.interaction.side)
        o, d = (tuple(torch.from_numpy(c.ravel()) for c in v) for v in (start, way))
        *at, there = bare.land(o, d)
        return np.stack([torch.where(there, c, torch.nan).numpy().reshape(leaving.shape[:-1]) for c in at])


def _unit(components: Sequence[np.ndarray]) -> np.ndarray:
    """Unit vectors (..., 3) along these."""
    v = np.stack(tuple(components), -1)
    return v / np.linalg.norm(v, axis=-1, keepdims=True)
