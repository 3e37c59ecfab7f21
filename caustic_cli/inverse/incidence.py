"""Irradiance and ray directions at the exit surface: light of the centre of the source, refracted by the flat entrance.

Notation
    p = (x, y, z)   a point of the exit surface; o = (x_0, y_0, z_0) the source, h its distance before the entrance
    s               tangents of the ray's direction from the source, (d_x, d_y) / d_z; q = |s|
    f               power on the exit surface per area projected along z

A ray of tangent q crosses the entrance at h q from the axis through the source and the glass under it by t q', with
q' = q / sqrt(n^2 (1 + q^2) - q^2) by Snell; t is the height of p above the entrance.  So the point p is reached by the q with
h q + t q' = |(x - x_0, y - y_0)|, unless it would enter through the sides of the lens, and
f = I(q) (1 - R(q)) (1 + q^2)^(-3/2) |d(s_x, s_y) / d(x, y)|.

With other lenses before the lens, rays are traced through them from points (a, b) of the pupil, which has the irradiance g(a, b);
the ray to p is found by Newton's method for (a, b), and f = T g |d(a, b) / d(x, y)| with the transmittance T.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
import torch
from scipy.ndimage import map_coordinates

from caustic_cli.errors import InputError
from caustic_cli.inverse.relay import trace_through, without_apertures, without_freeforms
from caustic_cli.inverse.transport import cell_means
from caustic_cli.optics.emission.measured import irradiance
from caustic_cli.optics.frames import turned_about
from caustic_cli.optics.interface import reflectance, slopes_inside
from caustic_cli.optics.media import medium_of
from caustic_cli.optics.parallel import beyond_aperture
from caustic_cli.optics.rays import RayState
from caustic_cli.optics.resampling import resampled
from caustic_cli.optics.system import ENTRANCE, System
from caustic_cli.scene import Aperture, PlaneWave, Points, Scene, Source
from caustic_cli.scene.sources.distribution import relative

#: Newton iterations for q; the function is concave, so that they increase monotonically from the greater of two lower bounds.
STEPS = 40
#: Finite-difference step on the pupil, mm; cells of the pupil along each axis; least magnification from the pupil to the exit.
_STEP, CELLS, LEAST_GROWTH = 1e-5, 128, 1e-3
#: Subsamples along each axis of a cell cut by an aperture.
PARTS = 8
#: Points along an edge of the lit part of the exit, and iterations for its place.
EDGE, PASSES = 65, 3
#: Largest sine of an extrapolated direction.
STEEPEST = 0.6
#: Most Newton iterations for (a, b), and their tolerance in parts of the half width of the lens.
TRACED_STEPS, FOUND = 12, 1e-7
#: What rounding may add to the distance from the axis of a ray at the edge of an aperture, as a part of it.
ROUNDED = 1e-9
#: What makes a lens one of air.
AIR: dict[str, Any] = {"index": 1.0 + 1e-9, "glass": None, "gradient": None, "fresnel": "none", "entrance": None}
#: Corners that are traced at a time, for their memory.
CORNERS = 1 << 17
#: A point and two beside it, along x and y, in the steps of finite differences.
BESIDE = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
#: The scene of an array, and the centre of a lens in it, mm.
Place = tuple[Scene, tuple[float, float]]


def incident(scene: Scene, x: np.ndarray, y: np.ndarray, z: np.ndarray) -> tuple[np.ndarray, tuple | None]:
    """Power per area projected along z in the cells with corners x (n + 1,), y (m + 1,): (n, m); and directions inside the glass
    at the corners, three (n + 1, m + 1) arrays of the length of the index there over that of the lens, or None for light along z.
    z: heights of the surface there, mm.

    The unit is that of intensity over its axial value times solid angle for a source nearby, and arbitrary for others.

    Raises:
        InputError: the source lies behind the entrance.
    """
    light, directions = (_traced if is_traced(scene) else _direct)(scene, x, y, z)
    return light * part_within(scene.lens.clear, x, y), directions


def is_traced(scene: Scene) -> bool:
    """Whether the light at the exit follows from its heights by rays: behind other lenses or a curved entrance, or in a medium that
    bends them."""
    return bool(scene.in_front) or scene.lens.entrance is not None or medium_of(scene.lens).varies


def on_entrance(scene: Scene, x: np.ndarray, y: np.ndarray, z: np.ndarray | None = None) -> tuple[np.ndarray, tuple | None]:
    """The same in air at heights z of the entrance, mm; None for its plane."""
    air = replace(scene, lens=replace(scene.lens, **AIR), second_target=None)
    return incident(air, x, y, np.full((len(x), len(y)), scene.lens.z_in) if z is None else z)


@dataclass(frozen=True, eq=False)
class _WayToExit:
    """The light from points of the pupil of a scene, through the lenses before the lens and its medium, to heights of the exit."""

    scene: Scene

    @cached_property
    def systems(self) -> tuple[System, System]:
        """What lies before the glass, without and with the apertures of all lenses."""
        whole, lens = System.of(without_freeforms(self.scene)), self.scene.lens
        count = [e.name for e in whole.elements].index(ENTRANCE) + 1
        if lens.entrance is not None:
            wider = replace(whole.elements[count - 1], surface=beyond_aperture(lens))
            whole = replace(whole, elements=(*whole.elements[: count - 1], wider, *whole.elements[count:]))
        bare = without_apertures(whole, 0, count)
        return bare, replace(bare, elements=whole.elements[:count])

    def entering(self, system: System, at: np.ndarray) -> RayState:
        """Rays from points (2, N) of the pupil, behind the entrance."""
        pupil, d = self.scene.pupil, _from_source(self.scene, *at)
        back = (pupil.z - self.scene.lowest) / d[2] + 1e-6  # the first surface may reach through the pupil
        return trace_through(system, (at[0] - back * d[0], at[1] - back * d[1], pupil.z - back * d[2]), d)

    def arrive(self, at: np.ndarray, z: np.ndarray):
        """Intersections with the heights z of rays from points (2, N) of the pupil, their directions in the glass, and their
        transmittance."""
        lens, state = self.scene.lens, self.entering(self.systems[0], at)
        entered, direction = (tuple(c.double() for c in state.full(v)) for v in (state.origin, state.direction))
        depth, below = torch.from_numpy(z.ravel() - lens.z_in), entered[2] + (state.datum - lens.z_in)
        point, direction = medium_of(lens).onto_plane((*entered[:2], below), direction, depth)
        there, inside = (np.stack([c.numpy().reshape(z.shape) for c in v]) for v in (point[:2], direction))
        return there, inside, state.power.numpy().reshape(z.shape)

    def growth(self, mean: float) -> np.ndarray:
        """Magnification along x and y from the pupil to a mean height, near the axis.

        Raises:
            InputError: the light is focused there.
        """
        small = 1e-3 * min(self.scene.pupil.half_size)
        start = self.arrive(small * BESIDE, np.full(3, mean))[0]
        grown = np.array([start[0, 1] - start[0, 0], start[1, 2] - start[1, 0]]) / small
        if not (np.abs(grown) > LEAST_GROWTH).all():
            raise InputError(
                "⟨element.radius⟩: the lenses before the lens focus their light inside it; transport needs an extended beam on its"
                " exit"
            )
        return grown

    def aimed(self, goal: np.ndarray, z: np.ndarray, grown: np.ndarray) -> np.ndarray:
        """Of rays that arrive at points (2, N) of heights z, (7, N): whether they were found, where they cross the pupil, their
        directions in the glass, and their transmittance, 0 where an aperture stops them.  grown: see `growth`."""
        at, left = goal / grown[:, None], np.arange(z.size)
        for _ in range(TRACED_STEPS):  # of the corners not converged; those that no ray reaches remain
            near = at[:, None, left] + _STEP * BESIDE[:, :, None]
            here, by_a, by_b = np.moveaxis(self.arrive(near, np.stack([z[left]] * 3))[0], 1, 0)
            ja, jb, off = (by_a - here) / _STEP, (by_b - here) / _STEP, goal[:, left] - here
            with np.errstate(divide="ignore", invalid="ignore"):
                area = ja[0] * jb[1] - ja[1] * jb[0]
                move = np.stack([jb[1] * off[0] - jb[0] * off[1], ja[0] * off[1] - ja[1] * off[0]]) / area
            finite = np.isfinite(move).all(0)
            at[:, left] += np.where(finite, move, 0.0)
            left = left[~finite | (np.abs(off).max(0) > FOUND * max(self.scene.lens.half_size))]
            if not len(left):
                break
        known = np.ones(z.size, dtype=bool)
        known[left] = False
        _, d, part = self.arrive(at, z)
        part = part * (self.entering(self.systems[1], (1.0 - ROUNDED) * at).power.numpy() > 0.0)
        return np.concatenate([known[None], at, d, part[None]])


def _traced(scene: Scene, x: np.ndarray, y: np.ndarray, z: np.ndarray) -> tuple[np.ndarray, tuple]:
    """`incident` over the whole rectangle, traced through the lenses before the lens and in its medium."""
    pupil, lens, shape = scene.pupil, scene.lens, z.shape
    goal = np.stack([c.ravel() for c in np.broadcast_arrays(x[:, None], y[None, :])])
    known, at, d, part = (c.reshape(*c.shape[:-1], *shape) for c in _aimed(scene, goal, z.ravel()))
    ga, gb = (np.gradient(c, x, y) for c in at)
    power = part * np.abs(ga[0] * gb[1] - ga[1] * gb[0])
    inside = np.all([far / r <= 1 + ROUNDED for far, r in pupil.aperture.distances(*at)], axis=0)
    power = np.where(known & inside, power, 0.0)
    power = power * _pupil_irradiance(scene, *at)
    points = np.concatenate([goal, z.reshape(1, -1)])
    d = _extrapolated(d, known & (power > 0), goal.reshape(2, *shape) / np.array(lens.half_size)[:, None, None])
    dx, dy, dz = _optical(scene, points, np.stack(d).reshape(3, -1)).reshape(3, *shape)
    return cell_means(power), (dx, dy, dz)


def _aimed(scene: Scene, goal: np.ndarray, z: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Of light that arrives at points (2, N) of heights z (N,): whether it was found (N,), where it crosses the pupil (2, N), its
    unit directions in the glass (3, N), and its transmittance (N,), see `_WayToExit.aimed`."""
    way = _WayToExit(scene)
    grown = way.growth(float(z.mean()))
    found = [way.aimed(goal[:, k : k + CORNERS], z[k : k + CORNERS], grown) for k in range(0, z.size, CORNERS)]
    known, at, d, part = np.split(np.concatenate(found, axis=1), [1, 3, 6])
    return known[0] > 0.0, at, d, part[0]


def _optical(scene: Scene, at: np.ndarray, d: np.ndarray) -> np.ndarray:
    """Unit directions (3, N) at points (3, N) of the exit, mm, of the length of the index there over that of the lens."""
    x, y, z = (torch.from_numpy(np.ascontiguousarray(c)) for c in at)
    n = medium_of(scene.lens).relative_index((x, y, z - scene.lens.z_in))
    return (n if isinstance(n, float) else n.numpy()) * d


def _extrapolated(d: np.ndarray, lit: np.ndarray, at: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Unit directions (3, n, m) at lit corners, extrapolated to the others by a least-squares cubic, since a discontinuity would be
    one of the slopes of the surface; at: positions over the half size of the aperture."""
    terms = np.stack([at[0] ** i * at[1] ** j for i in range(4) for j in range(4 - i)], -1)
    found = d[:2].copy()
    if lit.any():
        found[:, ~lit] = (terms[~lit] @ np.linalg.lstsq(terms[lit], d[:2, lit].T, rcond=None)[0]).T
    else:
        found[:] = 0.0
    sine = np.hypot(*found)
    found *= np.minimum(1.0, STEEPEST / np.maximum(sine, STEEPEST))
    return found[0], found[1], np.sqrt(1.0 - (found * found).sum(0))


def _from_source(scene: Scene, a: np.ndarray, b: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Unit directions of the light of the source's centre at points (a, b) of the pupil, mm."""
    if scene.source.beam:
        dx, dy, dz = (c + 0.0 * a for c in scene.source.beam(a, b, scene.pupil).directions)
        return dx, dy, dz
    if scene.source.distant:
        dx, dy, dz = (np.full_like(a, c) for c in scene.source.axis)
        return dx, dy, dz
    x0, y0, z0 = scene.source.centre
    dx, dy, h = a - x0, b - y0, scene.pupil.z - z0
    length = np.sqrt(dx * dx + dy * dy + h * h)
    return dx / length, dy / length, h / length


def _tilted(scene: Scene, x: np.ndarray, y: np.ndarray, z: np.ndarray) -> tuple[np.ndarray, tuple]:
    """`incident` of light from infinity along the source's axis: that of its profile where it crossed the entrance."""
    lens, source = scene.lens, scene.source
    kx, ky = slopes_inside(source.axis, lens.inside)
    depth = z - lens.pupil.z
    crossed = [cell_means(c + 0.0 * depth) for c in (x[:, None] - kx * depth, y[None, :] - ky * depth)]
    zx, zy = np.gradient(z, x, y)
    light = cell_means(1.0 - kx * zx - ky * zy)  # D . N, see `optics.beam`
    for inside, step in zip(lens.opening.edges(*crossed, lens.half_size), (x[1] - x[0], y[1] - y[0]), strict=True):
        light *= 1.0 if inside is None else np.clip(inside / step + 0.5, 0.0, 1.0)  # the lit part of a cell at the edge
    if source.uneven:
        light *= source.irradiance(*crossed, lens.pupil)
    over = 1.0 / math.sqrt(1.0 + kx * kx + ky * ky)
    return light, tuple(np.full_like(z, c * over) for c in (kx, ky, 1.0))


def _of_beam(scene: Scene, x: np.ndarray, y: np.ndarray, z: np.ndarray) -> tuple[np.ndarray, tuple | None]:
    """`incident` of a laser beam along z, by the normals of its wavefront at the entrance."""
    source, lens = scene.source, scene.lens
    assert source.beam is not None
    pupil, at, depth = lens.pupil, list(np.broadcast_arrays(x[:, None], y[None, :])), z - lens.pupil.z
    goal = list(at)
    for _ in range(PASSES):
        inside = slopes_inside(source.beam(*at, pupil).directions, lens.inside)
        at = [c - k * depth for c, k in zip(goal, inside, strict=True)]
    growth = np.gradient(at[0], x, axis=0) * np.gradient(at[1], y, axis=1)
    light = cell_means(source.irradiance(*at, pupil) * growth)
    if source.collimated:
        return light, None
    kx, ky = slopes_inside(source.beam(*at, pupil).directions, lens.inside)
    over = 1.0 / np.sqrt(1.0 + kx * kx + ky * ky)
    return light, (kx * over, ky * over, over)


def lit_rectangle(
    scene: Scene, surface: Callable[[np.ndarray, np.ndarray], np.ndarray], array: Place | None = None
) -> tuple[tuple[float, float], tuple[float, float]]:
    """Lower and upper limits, x and y, mm, of the rectangle of the exit that light reaches: all of it, less what is in the shadow
    of the lens' sides, or of those of the array to which it belongs, where light is tilted to the axis.

    surface: heights (n, m) of the exit, mm, at x (n,), y (m,).

    Raises:
        InputError: no light reaches the exit.
    """
    lens, source = scene.lens, scene.source
    whole, middle = (scene, (0.0, 0.0)) if array is None else array
    low, high = [-r for r in lens.half_size], list(lens.half_size)
    if not source.oblique or scene.in_front:  # behind other lenses `incident` finds what is dark
        return (low[0], low[1]), (high[0], high[1])
    lines = [np.linspace(-r, r, EDGE) for r in lens.half_size]
    for axis, slope in enumerate(slopes_inside(source.axis, lens.inside)):
        limit, half = low if slope > 0 else high, lens.half_size[axis]
        edge = math.copysign(whole.lens.half_size[axis], -slope) - middle[axis]
        for _ in range(PASSES if slope else 0):  # the light that passes this edge of the entrance meets the exit at its own height
            places = list(lines)
            places[axis] = np.array([limit[axis]])
            depth = float(surface(*places).min()) - lens.pupil.z
            limit[axis] = min(half, max(-half, edge + slope * depth))
    if not all(a < b for a, b in zip(low, high, strict=True)):
        raise InputError("⟨source.tilt⟩: all light leaves the lens through its sides; a thinner lens or less tilt keeps some")
    return (low[0], low[1]), (high[0], high[1])


def _pupil_irradiance(scene: Scene, a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Irradiance of the pupil at (a, b), interpolated between the centres of CELLS x CELLS cells."""
    pupil = scene.pupil
    size = (2.0 * pupil.half_size[0], 2.0 * pupil.half_size[1])
    lens = replace(scene.lens, size=size, z_in=pupil.z, aperture=pupil.aperture.name, border=0.0)
    edges = [np.linspace(-h, h, CELLS + 1) for h in pupil.half_size]
    light = on_entrance(replace(scene, lens=lens, elements=()), *edges)[0]
    middles = [0.5 * (e[1:] + e[:-1]) for e in edges]
    return map_coordinates(
        light, [(c - m[0]) / (m[1] - m[0]) for c, m in zip((a, b), middles, strict=True)], order=1, mode="nearest"
    )


def part_within(aperture: Aperture, x: np.ndarray, y: np.ndarray) -> np.ndarray | float:
    """Fraction of each cell with corners x, y of the rectangle of its half widths that is within the aperture, by PARTS x PARTS
    subsamples."""
    if aperture.area == 4.0 * math.prod(aperture.half_size):
        return 1.0
    fine = [np.linspace(c[0], c[-1], 2 * PARTS * (len(c) - 1) + 1)[1::2] for c in (x, y)]
    inside = aperture.contains(fine[0][:, None], fine[1][None, :]).astype(float)
    return inside.reshape(len(x) - 1, PARTS, len(y) - 1, PARTS).mean((1, 3))


def _direct(scene: Scene, x: np.ndarray, y: np.ndarray, z: np.ndarray) -> tuple[np.ndarray, tuple | None]:
    """`incident` over the whole rectangle, by the closed form above."""
    source, lens, shape = scene.source, scene.lens, (len(x) - 1, len(y) - 1)
    if source.oblique:
        return _tilted(scene, x, y, z)
    if source.beam:
        return _of_beam(scene, x, y, z)
    if source.distant:
        profile = source.profile
        return (np.ones(shape) if profile is None else resampled(profile, shape)), None
    x0, y0, z0 = source.centre
    h, n = lens.pupil.z - z0, lens.inside
    if h <= 0:
        raise InputError(
            f"⟨source.file⟩: its rays meet at z = {z0:.4g} mm, not before the lens, as an initial surface by transport"
            " requires; ⟨start⟩ offset does not"
        )
    q, (sx, sy) = _tangents(scene, x[:, None], y[None, :], z)
    gx, gy = np.gradient(sx, x, y), np.gradient(sy, x, y)
    cosine = 1.0 / np.sqrt(1.0 + q * q)
    directions = _within(scene, q, (sx, sy))
    power = np.abs(gx[0] * gy[1] - gx[1] * gy[0]) * cosine**3
    if lens.fresnel != "none":
        power *= 1.0 - reflectance("exact", cosine, directions[2], 1.0 / n)
    power *= relative(source.intensity, q)
    cone = min(source.cone_over(lens.pupil), 1.57079)
    through = [np.abs(c0 + h * s) <= r * (1 + 1e-9) for c0, s, r in zip((x0, y0), (sx, sy), lens.half_size, strict=True)]
    power = np.where((q <= math.tan(cone) * (1 + 1e-9)) & through[0] & through[1], power, 0.0)
    light = irradiance(scene, x, y, float(z.mean()))
    if light is None:
        light = cell_means(power)
    return light, directions


def _tangents(scene: Scene, x: np.ndarray, y: np.ndarray, z: np.ndarray) -> tuple[np.ndarray, tuple[np.ndarray, np.ndarray]]:
    """q and s of the light of a near source's centre that reaches points of the exit, mm, arrays that can be broadcast."""
    (x0, y0, z0), n = scene.source.centre, scene.lens.inside
    h, t = scene.lens.pupil.z - z0, z - scene.lens.pupil.z
    dx, dy = x - x0, y - y0
    rho = np.hypot(dx, dy)
    q = rho / (h + t / n)
    if n > 1.0:
        q = np.maximum(q, (rho - t / math.sqrt((n - 1.0) * (n + 1.0))) / h)
    for _ in range(STEPS):
        root = np.sqrt(n * n + (n - 1.0) * (n + 1.0) * q * q)
        step = (rho - h * q - t * q / root) / (h + t * n * n / root**3)
        q = q + step
        if (np.abs(step) <= 1e-14 * q).all():
            break
    root = np.sqrt(n * n + (n - 1.0) * (n + 1.0) * q * q)
    ratio = 1.0 / (h + t / root)  # q / rho
    return q, (dx * ratio, dy * ratio)


def _within(scene: Scene, q: np.ndarray, s: tuple[np.ndarray, np.ndarray]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Unit directions behind the flat entrance of light of these tangents in front of it."""
    n, cosine = scene.lens.inside, 1.0 / np.sqrt(1.0 + q * q)
    root = np.sqrt(n * n + (n - 1.0) * (n + 1.0) * q * q)
    return s[0] * cosine / n, s[1] * cosine / n, root * cosine / n


def directions(scene: Scene, at: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Directions (3, N) in front of the exit at points (3, N) of it, mm, of light of the source's centre, of the length of the
    index there over that of the lens, and whether there is such light, (N,), arbitrary where there is none.

    Raises:
        InputError: as of `incident`.
    """
    x, y, z = at
    if is_traced(scene):
        known, _, d, part = _aimed(scene, at[:2], z)
        return _optical(scene, at, d), known & (part > 0.0)
    if scene.source.distant:
        kx, ky = slopes_inside(scene.source.axis, scene.lens.inside)
        d = np.array([kx, ky, 1.0]) / math.sqrt(1.0 + kx * kx + ky * ky)
        return np.repeat(d[:, None], len(x), 1), np.ones(len(x), dtype=bool)
    return np.stack(_within(scene, *_tangents(scene, x, y, z))), np.ones(len(x), dtype=bool)


def is_aimed(scene: Scene) -> bool:
    """Whether rays can be aimed at points of the exit: not where the light is focused within the lens."""
    try:
        return not is_traced(scene) or bool(_WayToExit(scene).growth(scene.lens.offset.thickness).all())
    except InputError:
        return False


def from_point(scene: Scene, moved: tuple[float, float]) -> Scene:
    """The scene with a point source or plane wave in place of its source: of a point of that which is displaced by `moved` from its
    centre, mm, or direction sines across the axis of a distant one."""
    source = scene.source
    point: Source
    if source.distant:
        length = math.sqrt(1.0 - moved[0] ** 2 - moved[1] ** 2)
        x, y, z = (length * c for c in turned_about(source.axis, *(m / length for m in moved)))
        point = PlaneWave(tilt=(math.degrees(-math.asin(y)), math.degrees(math.atan2(x, z))))
    else:
        x, y, z = source.centre
        point = Points(((x + moved[0], y + moved[1], z),))
    return replace(scene, source=point)
