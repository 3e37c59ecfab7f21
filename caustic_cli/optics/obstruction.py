"""Obstruction: what stands in the light on its way from the source to the screen, by geometry alone.

A path is a straight segment of the light's way: from the source to the first element, between the apertures of successive elements,
and from the last of them to the screen.  A body is what a path may not cross: the screen, the lens or mirror, another element, or
a source with a size; it is a box, or a cylinder, of no thickness where it is flat.  A path begins and ends at two bodies, which do
not obstruct it.

    source -> first element     rays of the source, weighted by their power, so that the fraction is that of the light on it
    element -> element, screen  paths from every point of one to every point of the other, whatever is between

The paths from the last element to a plane screen have to arrive at that face of it which is lit by the light of the axis: at the
other one, no light is counted.

A trace is sequential, so it does not notice bodies that light would have to cross; here they are found before.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import singledispatch

import numpy as np
import torch

from caustic_cli.errors import InputError
from caustic_cli.optics.emission import Emission, rays_of
from caustic_cli.optics.frames import IDENTITY, Axes, AxisSegment, Pose
from caustic_cli.optics.rays import RayState
from caustic_cli.optics.receiver import Receiver
from caustic_cli.optics.screen_shape import shape_of
from caustic_cli.optics.system import System
from caustic_cli.scene import Aperture, CircularAperture, Component, Scene, Screen

#: Rays of the source, and paths between two apertures: a fraction of light below one of them is nil.
RAYS, PATHS = 8_192, 4_096
#: A body that only touches a path, or the ends of one, to this relative accuracy does not obstruct it.
TOUCH = 1e-9
#: Steps of the search for a shift of the screen: doublings from a hundredth of its size, then bisections, to a hundredth; and the
#: factor by which a shift along x must be shorter than one along y.
DOUBLINGS, BISECTIONS, SHORTER = 16, 7, 0.95


@dataclass(frozen=True)
class Obstacle:
    """A box or a cylinder, with the name by which messages call it."""

    name: str
    #: mm.
    origin: tuple[float, float, float]
    #: Unit vectors of its frame.
    axes: Axes
    #: Its outline along x and y.
    aperture: Aperture
    #: Range along z, mm.
    depth: tuple[float, float] = (0.0, 0.0)

    def crossed(self, start: np.ndarray, end: np.ndarray) -> np.ndarray:
        """Whether paths from `start` to `end`, (N, 3) mm, cross it, (N,)."""
        axes = np.array(self.axes).T
        o, d = (start - self.origin) @ axes, (end - start) @ axes
        within = [_between(o[:, 2], d[:, 2], *self.depth), *_inside(self.aperture, o, d)]
        enter = np.max([TOUCH * np.ones(len(o)), *(a for a, _ in within)], axis=0)
        leave = np.min([(1.0 - TOUCH) * np.ones(len(o)), *(b for _, b in within)], axis=0)
        return enter <= leave

    def points(self, u: np.ndarray, v: np.ndarray, z: float) -> np.ndarray:
        """Points of its aperture at u, v in [0, 1] and z of its frame, (N, 3) mm."""
        return np.array(self.origin) + np.stack([*self.aperture.spread(u, v), np.full_like(u, z)], 1) @ np.array(self.axes)


@dataclass(frozen=True)
class ScreenObstacle:
    """A screen as flat pieces, one unless it is curved."""

    screen: Screen
    leg: AxisSegment

    name = "the screen"
    depth = 0.0, 0.0

    @property
    def pieces(self) -> list[Obstacle]:
        """Its pieces."""
        (hx, hy), k = self.screen.half_size, shape_of(self.screen).pieces
        x, y = (np.linspace(-h, h, k + 1) for h in (hx, hy))
        p = self._at(x[:, None], y[None, :])
        found = []
        for i, j in itertools.product(range(k), range(k)):
            corners = p[i : i + 2, j : j + 2]
            a, b = (corners[1] - corners[0]).mean(0), (corners[:, 1] - corners[:, 0]).mean(0)
            n = np.cross(a, b) / np.linalg.norm(np.cross(a, b))
            wide, tall = np.linalg.norm(a), np.linalg.norm(b)
            axes = tuple(tuple(map(float, axis)) for axis in (a / wide, np.cross(n, a / wide), n))
            middle = tuple(map(float, corners.mean((0, 1))))
            found.append(Obstacle(self.name, middle, axes, Aperture((float(wide) / 2.0, float(tall) / 2.0))))  # type: ignore[arg-type]
        return found

    def crossed(self, start: np.ndarray, end: np.ndarray) -> np.ndarray:
        """As of a body."""
        return np.any([piece.crossed(start, end) for piece in self.pieces], axis=0)

    def points(self, u: np.ndarray, v: np.ndarray, z: float) -> np.ndarray:
        """As of a body."""
        hx, hy = self.screen.half_size
        return self._at((2.0 * u - 1.0) * hx, (2.0 * v - 1.0) * hy)

    def _at(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """Points in space, (..., 3) mm, from its own coordinates, measured from its centre."""
        (sx, sy), (x, y) = self.screen.shift, np.broadcast_arrays(x, y)
        s = shape_of(self.screen).at(x, y)[0]
        axes = Pose(tilt=self.screen.tilt, frame=self.leg.frame).axes
        return np.array(self.leg.at(sx, sy, self.screen.z)) + np.stack([x, y, s], -1) @ np.array(axes)


@dataclass(frozen=True)
class Obstruction:
    """A body in the light between two others: the names of all three, and the fraction of that light, or of the paths."""

    body: str
    before: str
    behind: str
    fraction: float

    def sentence(self) -> str:
        """What is wrong."""
        light = f"that falls on {self.behind}" if self.before == "the source" else f"between {self.before} and {self.behind}"
        return f"{self.body} stands in the light {light} and shadows {100.0 * self.fraction:.3g}% of it"


class LightPath:
    """The way of a scene's light, sampled once, for any position of its screen."""

    def __init__(self, scene: Scene):
        self.elements, self.screen = _stations(scene)
        self.receiver = Receiver.of(System.of(scene), scene.screen)
        self.sources = _sources(scene)
        self.emitted = _from_source(scene, [*self.elements, self.screen])
        self.ends = torch.quasirandom.SobolEngine(4, scramble=True, seed=0).draw(PATHS, dtype=torch.float64).numpy().T

    def lit_face(self) -> float:
        """Fraction of the paths from the last element to the screen that arrive at its lit face; 1 of a curved screen."""
        if self.screen.screen.curved:
            return 1.0
        a, b, c, d = self.ends
        last, normal = self.elements[-1], np.array(self.receiver.axes[2])
        way = self.screen.points(c, d, 0.0) - last.points(a, b, last.depth[1])
        return float((self.receiver.forward * (way @ normal) > 0).mean())

    def obstruction(self, shift: tuple[float, float] | None = None) -> Obstruction | None:
        """The body that obstructs most of the first part of the way which any obstructs, None if the light is free; shift: of the
        screen, mm, instead of its own."""
        screen = self.screen
        if shift is not None:
            screen = replace(screen, screen=replace(screen.screen, shift=shift))
        stations: list[Obstacle | ScreenObstacle] = [*self.elements, screen]
        bodies, first = [*stations, *self.sources], stations[0]
        found = [
            (sum(float(power[body.crossed(start, end)].sum()) for own, start, end, power in self.emitted if body not in own), body)
            for body in bodies[1:]
        ]
        if (most := max(found, key=lambda one: one[0]))[0] > 0:
            return Obstruction(most[1].name, "the source", first.name, most[0])
        a, b, c, d = self.ends
        for before, behind in itertools.pairwise(stations):
            start, end = before.points(a, b, before.depth[1]), behind.points(c, d, behind.depth[0])
            found = [(float(one.crossed(start, end).mean()), one) for one in bodies if one not in (before, behind)]
            if found and (most := max(found, key=lambda one: one[0]))[0] > 0:
                return Obstruction(most[1].name, before.name, behind.name, most[0])
        return None


def refuse_obstructed(scene: Scene, designed: bool = False) -> None:
    """Refuse a scene in which a body stands in the light, or in which light arrives at the back of the screen; designed: whether
    its lens is designed already, for this screen.

    Raises:
        InputError: naming the body, the light, the fraction of it, and what would be accepted.
    """
    way = LightPath(scene)
    if (part := way.lit_face()) < 1.0:
        tilt, place = "less ⟨+screen.tilt⟩, or " * any(scene.screen.tilt), "⟨screen_at⟩" if designed else "⟨+throw⟩"
        last, beyond = way.elements[-1].name, "behind" if scene.behind else scene.lens.interaction.beyond
        raise InputError(
            f"the screen must lie {beyond} {last} and face it:"
            f" {'its plane passes through it' if part else 'it turns its back to it'}, so that {100.0 * (1.0 - part):.3g}% of the"
            f" light would arrive from behind; accepted: {tilt}another ⟨+screen.shift⟩ or {place}"
        )
    found = way.obstruction()
    if found is None:
        return
    if "the screen" in (found.body, found.behind):
        shift = clear_shift([scene])
        such = "" if shift is None else f", such as ⟨+screen.shift⟩ {shift[0]:g},{shift[1]:g}"
        accepted = f"a screen beside it{such}, or of another ⟨+screen_size⟩, ⟨+throw⟩ or ⟨+screen.tilt⟩"
    else:
        accepted = "another ⟨element.z⟩ or ⟨element.size⟩, or ⟨element.tilt⟩ of a mirror before it"
    raise InputError(f"{found.sentence()}; accepted: {'a lens designed for ' if designed else ''}{accepted}")


def clear_shift(scenes: Sequence[Scene]) -> tuple[float, float] | None:
    """The least shift (x, y) mm of the screen along one axis, rounded up to two digits, with which the light of all these scenes is
    free; (0, 0) if it is without; None if no shift helps."""
    ways = [LightPath(scene) for scene in scenes]

    def clear(x: float, y: float) -> bool:
        return all(way.obstruction((x, y)) is None for way in ways)

    if clear(0.0, 0.0):
        return 0.0, 0.0
    best: tuple[float, float] | None = None
    for a, b in ((0.0, 1.0), (1.0, 0.0), (0.0, -1.0), (-1.0, 0.0)):
        limit, high = math.inf if best is None else SHORTER * max(map(abs, best)), 0.01 * max(scenes[0].screen.size)
        for _ in range(DOUBLINGS):
            if high >= 2.0 * limit or clear(a * high, b * high):
                break
            high *= 2.0
        if high >= 2.0 * limit or not clear(a * high, b * high):
            continue
        low = high / 2.0
        for _ in range(BISECTIONS):
            middle = (low + high) / 2.0
            low, high = (low, middle) if clear(a * middle, b * middle) else (middle, high)
        unit = 10.0 ** (math.floor(math.log10(high)) - 1)
        high = math.ceil(high / unit - TOUCH) * unit
        if high < limit:
            best = a * high + 0.0, b * high + 0.0
    return best


def _between(o: np.ndarray, d: np.ndarray, low: float, high: float) -> tuple[np.ndarray, np.ndarray]:
    """Range of t in which o + t d is in [low, high], empty as (inf, -inf)."""
    with np.errstate(divide="ignore", invalid="ignore"):
        a, b = (low - o) / d, (high - o) / d
    still, inside = d == 0.0, (o >= low) & (o <= high)
    enter = np.where(still, np.where(inside, -np.inf, np.inf), np.minimum(a, b))
    return enter, np.where(still, -enter, np.maximum(a, b))


@singledispatch
def _inside(aperture: Aperture, o: np.ndarray, d: np.ndarray) -> list[tuple[np.ndarray, np.ndarray]]:
    """Ranges of t in all of which (x, y) of o + t d is within an aperture, empty as (inf, -inf)."""
    return [_between(o[:, k], d[:, k], -h * (1.0 - TOUCH), h * (1.0 - TOUCH)) for k, h in enumerate(aperture.half_size)]


@_inside.register(CircularAperture)
def _(aperture: CircularAperture, o: np.ndarray, d: np.ndarray) -> list[tuple[np.ndarray, np.ndarray]]:
    radius = aperture.radius * (1.0 - TOUCH)
    a, b, c = (d[:, :2] ** 2).sum(1), (o[:, :2] * d[:, :2]).sum(1), (o[:, :2] ** 2).sum(1) - radius * radius
    root = b * b - a * c
    with np.errstate(divide="ignore", invalid="ignore"):
        way = np.sqrt(root)
        enter, leave = (-b - way) / a, (-b + way) / a
    still, missed = a == 0.0, root < 0.0
    enter = np.where(still, np.where(c <= 0.0, -np.inf, np.inf), np.where(missed, np.inf, enter))
    return [(enter, np.where(still, -enter, np.where(missed, -np.inf, leave)))]


def _stations(scene: Scene) -> tuple[list[Obstacle], ScreenObstacle]:
    """The elements in the order in which light reaches them, and the screen."""
    lens, leg = scene.lens, AxisSegment()

    def body(number: int, part: Component) -> Obstacle:
        pose, (low, high) = leg.pose(part.z, part.tilt), part.extent
        name, depth = f"the {part.kind} of [[element]] {number + 1}", (low - part.z, high - part.z)
        return Obstacle(name, pose.position, pose.axes, part.opening, depth)

    found = [body(k, part) for k, part in enumerate(scene.in_front)]
    name = "the free-form lens" if scene.elements else f"the {lens.kind}"
    depth = lens.interaction.extent(lens.lowest, lens.offset.thickness)
    found.append(Obstacle(name, (0.0, 0.0, 0.0), IDENTITY, lens.opening.grown(lens.border), depth))
    for k, part in enumerate(scene.behind, len(scene.in_front)):
        found.append(body(k, part))
        leg = part.axis_behind(leg)
    return found, ScreenObstacle(scene.screen, leg)


def _sources(scene: Scene) -> list[Obstacle]:
    """Near sources that have a size."""
    found = []
    for one in scene.source.members:
        if one.distant or not one.sized:
            continue
        places, extent = one.points()[0], one.extent
        x, y, z = (float(c) for c in (places.max(0) + places.min(0)) / 2.0)
        wide, high = (float(np.ptp(places[:, k])) / 2.0 + extent[k] for k in (0, 1))
        if min(wide, high) > 0:
            outline = CircularAperture if wide == high and len(places) == 1 else Aperture
            found.append(Obstacle("the source", (x, y, z), IDENTITY, outline((wide, high))))
    return found


def _from_source(
    scene: Scene, stations: Sequence[Obstacle | ScreenObstacle]
) -> list[tuple[list[Obstacle], np.ndarray, np.ndarray, np.ndarray]]:
    """Rays of each source that fall on the first element: the source's own body, starts and ends, (N, 3) mm, and fractions of all
    that light, (N,)."""
    u, v = np.array([[0.0, 0.0, 1.0, 1.0], [0.0, 1.0, 0.0, 1.0]])
    far = 4.0 * (1.0 + max(float(np.abs(body.points(u, v, 0.0)).max()) for body in stations))
    found = []
    for one, part in zip(scene.by_source, scene.source.fractions, strict=True):
        pupil, rays = one.pupil, rays_of(one, "sobol", RAYS)
        states = [s if isinstance(s, RayState) else RayState.on_axis(s, pupil.half_size, pupil.z) for s in rays.chunks()]
        rows = [torch.stack([*s.full(s.origin), *s.full(s.direction), s.power]) for s in (s.expanded() for s in states)]
        x, y, _, *way, power = torch.cat(rows, 1).double().numpy()
        if one.source.distant:
            back = np.full(len(x), far)
        else:  # the positions of an `Emission` emit equally many rays, one after another
            z = one.source.points()[0][:, 2] if isinstance(rays, Emission) else np.array([one.source.nearest])
            back = (pupil.z - np.repeat(z, len(x) // len(z))) / way[2]
        lit = power > 0
        end = np.stack([x, y, np.full_like(x, pupil.z)], 1)
        found.append((_sources(one), (end - np.stack(way, 1) * back[:, None])[lit], end[lit], part * power[lit]))
    whole = sum(float(power.sum()) for *_, power in found)
    return [(own, start, end, power / whole) for own, start, end, power in found]
