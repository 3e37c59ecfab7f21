"""Initial surface of a design by optimal transport of the irradiance on the exit to the picture.

Light of a near source can be lost: through the sides of a thick lens, or because a thin one is not deep enough for the relief.
Where much is lost, surfaces with several heights of their vertex are computed, each truncated at the least thickness, with
transport of only that light which can reach the picture: light on the truncated part, or beyond the limit of refraction, is left
out.  The surface of highest efficiency is taken.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import torch
from torch import Tensor

from caustic_cli.effort import STANDARD
from caustic_cli.errors import InputError
from caustic_cli.inverse.incidence import Place, incident, is_traced, lit_rectangle, part_within
from caustic_cli.inverse.projection import CrossedProjection, ScreenProjection, projection_of, seen_by_light
from caustic_cli.inverse.relay import RelayedScreen
from caustic_cli.inverse.scattered import Pixels
from caustic_cli.inverse.surface_from_map import SLOPES, MappedSurface, OutOfReach, Projection, finer, refract_to_screen
from caustic_cli.inverse.surface_from_map import surface as refracting_surface
from caustic_cli.inverse.transport import cell_lines, cell_means, corners
from caustic_cli.optics.bspline import GridSpline
from caustic_cli.optics.interface import slopes_inside
from caustic_cli.optics.surfaces import Sphere
from caustic_cli.optics.surfaces.heightfield import HeightField
from caustic_cli.scene import Aperture, Component, Lens, Scene
from caustic_cli.scene.elements import SIDES

#: Cells on which transport is solved, about, where more than twice as many are needed, as for creases: the map is then evaluated on
#: finer cells.
COARSE = 512
#: See `extended`.
BESIDE = 0.005
#: Cells along the lens on which the shadow of its sides is found in tilted light.
ROUGH = 128
#: Cells per bright pixel where the map is evaluated on finer cells, as are sites: 2 x 2, at a distance from its edges that the
#: spread of their light needs, and not too near to each other; fraction of the cells then needed that is accepted if it divides the
#: finer ones.
SITES, NEARLY = 4, 0.95
#: Fewest cells on which it then is solved, unless `coarse` is less.
FEWEST = 256
#: Transport error and Newton steps per level for finer cells, which resolve it: 5e-3 left text with errors of 0.088 to 0.123.
EXACT, STEPS = 5e-4, 30
#: Largest peak-to-valley ratio of an interpolated control net to the surface.
OVERSHOOT = 2.0
#: Fixed-point iterations where the irradiance on the surface depends on its heights.
PASSES = 3
#: Lower bound of the irradiance of a near source over its mean: a trade-off between the picture and the number of Newton steps.
DARKEST = 0.02
#: Efficiency of a vertex height for a near source that is accepted at once.
ENOUGH_LIGHT = 0.7
#: Vertex heights that are tried otherwise, in parts of the thickness of the lens.
TRIED = (0.3, 0.45, 0.65, 1.5, 2.2, 3.3)
#: Most repetitions without the cells whose light cannot be refracted to the picture, before it counts as out of reach.
RETRIES = 4
#: Fraction of the least thickness of another lens by which each of its surfaces may depart from its sphere.
THICKNESS_PART = 0.45
UNREACHED = (
    "no light of the source that falls on the lens can be refracted to the picture by a surface over this aperture; a picture"
    " closer to the undeflected light, or a source farther away, is needed"
)


#: Heights (n, m), mm, at x (n,), y (m,), mm.
Surface = Callable[[np.ndarray, np.ndarray], np.ndarray]


@dataclass(frozen=True, eq=False)
class InitialSurface:
    """An initial surface: control heights (n, m) mm float64, its vertex height, mm, where that was chosen (near sources), the part
    of the light that its transport left in wrong places (`transport`, e), and of distant light its potential, mm^2."""

    heights: Tensor
    middle: float | None = None
    misplaced: float = 0.0
    potential: np.ndarray | None = None


@dataclass(frozen=True, eq=False)
class _Grid:
    """Grid of source cells over the lens of a scene, or over its part that is lit, with corners x (n + 1,), y (m + 1,) mm from the
    middle of that part, which lies at `middle` on the lens, mm; the target; and the array to which the lens belongs, if any."""

    whole: Scene
    target: np.ndarray
    x: np.ndarray
    y: np.ndarray
    middle: tuple[float, float] = (0.0, 0.0)
    array: Place | None = None

    @classmethod
    def of(cls, scene: Scene, target: np.ndarray, cells: int, surface: Surface | None = None, array: Place | None = None) -> _Grid:
        """Cells where light reaches a surface, the offset unless it is given."""
        low, high = lit_rectangle(scene, surface or scene.lens.offset.heights, array)
        half, middle = ([0.5 * (b + s * a) for a, b in zip(low, high, strict=True)] for s in (-1.0, 1.0))
        return cls(scene, target, *cell_lines((half[0], half[1]), cells), (middle[0], middle[1]), array)

    def finer(self, cells: int) -> _Grid:
        """Cells over the same lens, so many along it."""
        return _Grid.of(self.whole, self.target, cells, array=self.array)

    @cached_property
    def scene(self) -> Scene:
        """The scene in the frame of the grid, with a lens of its size."""
        (mx, my), whole = self.middle, self.whole
        if not (mx or my):
            return whole
        size = 2.0 * float(self.x[-1]), 2.0 * float(self.y[-1])
        lens = replace(whole.lens, size=size, aperture=Aperture.name, outline=None)  # what is dark of it is so in `incident`
        screen = (
            whole.screen
            if whole.screen.far
            else replace(whole.screen, shift=(whole.screen.shift[0] - mx, whole.screen.shift[1] - my))
        )
        return replace(whole, lens=lens, screen=screen)

    @property
    def places(self) -> tuple[np.ndarray, np.ndarray]:
        """x and y of the corners on the lens, mm."""
        return self.x + self.middle[0], self.y + self.middle[1]

    @property
    def offset(self) -> np.ndarray:
        """Heights of the offset surface at the corners, mm."""
        return self.whole.lens.offset.heights(*self.places)

    def incident(self, z: np.ndarray) -> tuple[np.ndarray, tuple | None]:
        """`incidence.incident` for heights z at the corners, mm; of a lens in an array with the light through its neighbours."""
        if self.array is None:
            return incident(self.whole, *self.places, z)
        scene, at = self.array
        light, directions = incident(scene, *(c + a for c, a in zip(self.places, at, strict=True)), z)
        return light * part_within(self.whole.lens.clear, *self.places), directions

    @property
    def floor(self) -> float:
        """Least height of the exit by the least thickness, mm."""
        return self.scene.lens.floor

    def scaled(self, values: np.ndarray, onto: _Grid) -> np.ndarray:
        """Values at the corners, interpolated at those of another grid."""
        return GridSpline(self.x, self.y, values)(onto.x, onto.y)

    def solved(self, light: np.ndarray, directions, mean: float, potential: np.ndarray | None = None, **options) -> MappedSurface:
        """The surface of this mean height that maps the light to the picture; potential: initial one at these corners, mm^2."""
        scene = self.scene
        if not light.all() and (is_traced(scene) or not scene.source.collimated):
            options["darkest"] = DARKEST
        projection = self.projection(mean)
        target, half, centre = (
            (self.target, scene.screen.half_size, scene.screen.shift)
            if projection is None
            else projection.projected_target(self.target)
        )
        return refracting_surface(
            light,
            target,
            scene.lens.half_size,
            half,
            scene.lens.effective_index,
            scene.screen.z,
            mean,
            directions,
            centre=centre,
            projection=projection,
            pixels=None if projection is None else Pixels(self.target, scene.screen.half_size, projection.project, centre),
            start=potential,
            **options,
        )

    def sharper(self, found: MappedSurface, directions, times: int) -> tuple[_Grid, np.ndarray]:
        """A grid of cells `times` finer, and the heights there of a surface solved on this grid with light of these directions,
        with sharper creases."""
        scene, mean = self.scene, float(found.heights.mean())
        x, y = (corners(times * (len(c) - 1), c[-1]) for c in (self.x, self.y))
        fine = replace(self, x=x, y=y)
        if directions is not None:
            directions = tuple(self.scaled(c, fine) for c in directions)
        projection = self.projection(mean)
        centre = scene.screen.shift if projection is None else projection.projected_target(self.target)[2]
        index = scene.lens.effective_index
        z = finer(found, times, scene.lens.half_size, index, scene.screen.z, directions, centre=centre, projection=projection)
        return fine, z

    def projection(self, mean: float) -> Projection | None:
        """Projection of the screen for a surface of this mean height; None for an upright plane screen without a crossing."""
        scene, lens = self.scene, self.scene.lens
        found = RelayedScreen(self.whole, mean, self.middle) if scene.behind else projection_of(scene, mean)
        if not lens.crossing:
            return found
        return CrossedProjection(found or ScreenProjection(scene.screen, mean, lens.interaction.side), found is None)

    def above(self, z: np.ndarray) -> np.ndarray:
        """Fraction of the corners of each cell where the surface is not truncated."""
        return cell_means((z > self.floor).astype(float))

    def efficiency(self, z: np.ndarray) -> float:
        """Fraction of the light on the lens that a surface, truncated at the least thickness, sends to the screen."""
        scene, lens, screen = self.scene, self.scene.lens, self.scene.screen
        z = np.maximum(z, self.floor)
        on_lens = incident(scene, self.x, self.y, np.full_like(z, lens.z_in))[0].sum()
        light, directions = incident(scene, self.x, self.y, z)
        slopes = GridSpline(self.x, self.y, z).derivatives(self.x, self.y, SLOPES)
        at = np.broadcast_arrays(self.x[:, None], self.y[None, :])
        projection = self.projection(float(z.mean()))
        u, v, part = refract_to_screen(
            *at,
            z,
            *slopes,
            directions,
            lens.effective_index,
            screen.z,
            "none" if lens.fresnel == "none" else "exact",
            projection,
        )
        u, v = (u - screen.shift[0], v - screen.shift[1]) if projection is None else projection.screen_coordinates(u, v)
        on = (np.abs(u) <= screen.half_size[0]) & (np.abs(v) <= screen.half_size[1])
        return float((light * self.above(z) * cell_means(np.where(on, part, 0.0))).sum() / on_lens) if on_lens > 0 else 0.0

    def truncated(
        self, z: np.ndarray, middle: float, passes: int, potential: np.ndarray | None = None, **options
    ) -> _TruncatedSurface:
        """The surface of this vertex height that maps all light in reach to the picture, truncated at the least thickness.

        Args:
            z, potential: initial heights, and the initial potential of their map, mm^2, where one is known.
            options: of `transport.solve`.

        Raises:
            InputError: no light can be refracted to the picture.
        """
        reached = 1.0
        for _ in range(passes):
            z = np.maximum(z + middle - _middle(z), self.floor)
            light, directions = self.incident(z)
            for left in range(RETRIES, -1, -1):
                lit = light * self.above(z) * reached
                if not lit.max() > 0:
                    raise InputError(UNREACHED)
                try:
                    found = self.solved(lit, directions, float(z.mean()), potential, **options)
                    break
                except OutOfReach as error:
                    if not left:
                        raise
                    reached = reached * cell_means((~error.where).astype(float))
            z, potential = found.heights, found.transport.potential
        z = z + middle - _middle(z)
        return _TruncatedSurface(replace(found, heights=z), directions, middle, max(0.0, self.floor - float(z.min())))


@dataclass(frozen=True, eq=False)
class _TruncatedSurface:
    """A surface before truncation; directions of the light that it is for; vertex height, how far it extends below the truncation,
    mm."""

    mapped: MappedSurface
    directions: tuple | None
    middle: float
    short: float

    @property
    def z(self) -> np.ndarray:
        """Its heights, mm."""
        return self.mapped.heights


def _rough_surface(scene: Scene, target: np.ndarray, array: Place | None) -> Surface:
    """Heights of a first surface on ROUGH cells in tilted light, as a function of places x (n,), y (m,), mm: (n, m)."""
    lens = scene.lens
    begun = _in_aperture(lens) if lens.mirror else lens.offset.heights
    rough = _Grid.of(scene, target, ROUGH, begun, array)
    solved = rough.solved(*rough.incident(begun(*rough.places)), float(rough.offset.mean())).heights
    if lens.mirror:  # with its edge in the aperture of the light, none of which then passes it
        solved = solved + lens.pupil.z - _edge(solved, slopes_inside(scene.source.axis, 1.0))
    return extended(*rough.places, solved)


def first_surface(
    scene: Scene,
    target: np.ndarray,
    field: HeightField,
    cells: int = STANDARD.source_cells,
    fixed: bool = False,
    seconds: float = math.inf,
    few: int = STANDARD.vertex_cells,
    array: Place | None = None,
    coarse: int = COARSE,
    similar: np.ndarray | None = None,
) -> InitialSurface:
    """Initial surface for a picture, from light of the centre of the source.

    Args:
        scene: source, lens and screen.
        target: (n_x, n_y) irradiance on its screen.
        field: spline spaces of the heights.
        cells: source cells along the lens' longer side; more than twice `coarse` sharpen creases.
        fixed: the thickness is given by the user, and no other is tried.
        seconds: approximate time allowed for a near source, which limits its cells.
        few: cells on which the vertex height is chosen for such a source.
        array: the array that the lens belongs to, from whose source its light comes, and its place there.
        coarse: cells on which the transport is solved, about, where more are needed.
        similar: potential of a similar surface in distant light, by which this one is found sooner.

    Raises:
        InputError: the picture cannot be reached by refraction.
    """
    began = time.monotonic()
    scene, target = seen_by_light(scene, target)
    times, options = _refinement(cells, target, coarse), {}
    cells = min(cells, 2 * coarse * times) // times
    if times > 1:
        options = {"tolerance": EXACT, "most": STEPS, "times": times}
    grid, lens = _Grid.of(scene, target, cells, array=array), scene.lens
    z = grid.offset
    if scene.source.oblique:  # the shadow of the lens' sides depends on the heights
        surface = _rough_surface(scene, target, array)
        grid = _Grid.of(scene, target, cells, surface, array)
        z = surface(*grid.places)
    if scene.source.distant or lens.mirror or scene.elements or lens.entrance is not None:
        known = similar if similar is not None and similar.shape == z.shape else None
        error = 0.0
        for _ in range(1 if scene.source.distant and not is_traced(scene) else PASSES):
            light, directions = grid.incident(z)
            found = grid.solved(light, directions, float(z.mean()), known, **options)
            z, known, error = found.heights, found.transport.potential, found.transport.error
        if times > 1:
            grid, z = grid.sharper(found, directions, times)
        return InitialSurface(net_of(*grid.places, z, field), misplaced=error, potential=known)
    found, grid = _near_surface(grid, cells, fixed, began + seconds, few, options)
    z = found.z
    if times > 1:
        grid, z = grid.sharper(found.mapped, found.directions, times)
        z = z + found.middle - _middle(z)
    net = net_of(*grid.places, np.maximum(z, grid.floor), field)
    net = net.clamp_min(grid.floor)  # the spline undershoots at a kink
    return InitialSurface(net, found.middle, found.mapped.transport.error)


def _near_surface(grid: _Grid, cells: int, fixed: bool, end: float, few: int, options: dict) -> tuple[_TruncatedSurface, _Grid]:
    """The truncated surface of a near source and its grid, of `cells` cells or so many as the time until `end` permits; options of
    the last transport."""
    coarse = grid.finer(min(cells, few))
    found = _best(coarse, grid.scene.lens.offset.thickness, fixed)
    within = cells
    for most, passes, exactly in ((round(math.sqrt(few * cells)), PASSES - 1, {}), (cells, 1, options)):
        n, started = min(most, within), time.monotonic()
        if n < max(len(coarse.x), len(coarse.y)):
            continue
        fine = grid.finer(n)
        known = coarse.scaled(found.mapped.transport.potential, fine)
        found = fine.truncated(coarse.scaled(found.z, fine), found.middle, passes, known, **exactly)
        coarse, now = fine, time.monotonic()
        left = max(0.0, end - now)  # the time of a pass is proportional to the number of cells
        within = int(min(cells, n * math.sqrt(left * passes / (now - started))))
    return found, coarse


def _refinement(cells: int, target: np.ndarray, coarse: int) -> int:
    """Refinement factor from the cells on which transport is solved to `cells`; 1 where it is solved on these, or on 2 `coarse`.

    A map on finer cells concentrates the light of a site in a point, so that sites have to be finer than bright pixels.
    """
    most, needed = 2 * coarse, max(min(FEWEST, coarse), math.sqrt(SITES * np.count_nonzero(target)))
    if cells <= most or needed > most:
        return 1
    whole = max(t for t in range(1, cells) if cells % t == 0 and cells >= NEARLY * needed * t)
    return whole if cells <= most * whole else math.ceil(cells / needed)


def _best(grid: _Grid, middle: float, fixed: bool) -> _TruncatedSurface:
    """The truncated surface of highest efficiency: with this vertex height, or others where it is not fixed."""
    tried: list[tuple[float, _TruncatedSurface]] = []

    def attempt(middle: float) -> _TruncatedSurface | None:
        try:
            found = grid.truncated(grid.offset, middle, PASSES)
        except InputError as error:
            problems.append(error)
            return None
        tried.append((grid.efficiency(found.z), found))
        return found

    problems: list[InputError] = []
    found = attempt(middle)
    if not fixed:
        if found is not None and found.short:
            attempt(middle + found.short)
        if max((kept for kept, _ in tried), default=0.0) < ENOUGH_LIGHT:
            low = grid.scene.lens.z_in
            for part in TRIED:
                attempt(low + part * (middle - low))
    if not any(kept > 0 for kept, _ in tried):
        raise problems[0] if problems else InputError(UNREACHED)
    return max(tried, key=lambda t: t[0])[1]


def extended(x: np.ndarray, y: np.ndarray, z: np.ndarray) -> Surface:
    """The cubic spline through heights z (k, l) at x (k,), y (l,), mm; beyond its edges, where it is dark, the slope decays within
    BESIDE of its width: continued, a crease would become a cliff."""
    spline = GridSpline(x, y, z)

    def heights(*places: np.ndarray) -> np.ndarray:
        inner = [np.clip(at, c[0], c[-1]) for at, c in zip(places, (x, y), strict=True)]
        fades = [BESIDE * (c[-1] - c[0]) for c in (x, y)]
        beside = [n * np.tanh((at - c) / n) for at, c, n in zip(places, inner, fades, strict=True)]
        orders = [(0, 0), (1, 0), (0, 1)] if any(b.any() for b in beside) else [(0, 0)]
        found, *slopes = spline.derivatives(*places, orders)
        for slope, further in zip(slopes, (beside[0][:, None], beside[1]), strict=False):
            found = found + slope * further
        return found

    return heights


@dataclass(frozen=True, eq=False)
class TurnedLight:
    """Light on the corners x (n,), y (m,), mm, of cells over the offset surface, and where transport sends it."""

    x: np.ndarray
    y: np.ndarray
    #: Directions inside the glass there, three (n, m) arrays.
    inside: tuple[np.ndarray, ...]
    #: A function of points x, y, z (n, m), mm, near the corners that returns the directions, of any length, to the picture.
    towards: Callable[..., tuple]


def turned_light(scene: Scene, target: np.ndarray, cells: int) -> TurnedLight:
    """The light of the centre of the source on the offset surface, and the directions in which it has to leave for a picture.

    Args:
        scene, target: as of `first_surface`; cells: along the lens' longer side.

    Raises:
        InputError: the picture cannot be reached by refraction.
    """
    grid = _Grid.of(*seen_by_light(scene, target), cells)
    light, directions = grid.incident(grid.offset)
    mean, (mx, my) = float(grid.offset.mean()), grid.middle
    found, projection, screen = grid.solved(light, directions, mean), grid.projection(mean), grid.scene.screen
    centre = screen.shift if projection is None else projection.projected_target(grid.target)[2]
    u, v = (t + e + c for t, e, c in zip((found.transport.x, found.transport.y), found.shift, centre, strict=True))
    ahead = (lambda x, y, z: (u - x, v - y, screen.z - z)) if projection is None else projection.directions_to(u, v)
    inside = tuple(np.broadcast_to(c, u.shape) for c in directions or (0.0, 0.0, 1.0))
    return TurnedLight(*grid.places, inside, lambda x, y, z: ahead(x - mx, y - my, z))


def net_of(x: np.ndarray, y: np.ndarray, z: np.ndarray, field: HeightField) -> Tensor:
    """Control heights (n, m) of the surface with these heights at corners x (k,), y (l,): z (k, l), mm, `extended` beyond them."""
    values = torch.from_numpy(extended(x, y, z)(*(c.numpy() for c in field.control_xy())))
    net = field.interpolated(values)
    # An interpolating spline of high degree with repeated knots overshoots; the values as control net (Schoenberg) do not.
    return net if float(net.max() - net.min()) <= OVERSHOOT * float(values.max() - values.min()) else values


def sphere_net(element: Component, side: str, field: HeightField) -> Tensor:
    """Control heights (n, m) of the spherical surface of another element, on the spline spaces of the exit over its own aperture,
    from its vertex plane, mm."""
    x, y = (corners(2 * n, h) for n, h in zip(field.shape, element.half_size, strict=True))
    radius = element.radius[SIDES.index(side)]
    points = (torch.from_numpy(c) for c in np.broadcast_arrays(x[:, None], y[None, :]))
    z = Sphere(radius, element.reach).at(None, *points, orders=((0, 0),))[0] if np.isfinite(radius) else torch.zeros(len(x), len(y))
    return net_of(x, y, z.numpy(), replace(field, half_size=element.half_size))


def departure_bound(element: Component, lens: Lens) -> float:
    """Largest departure of a designed surface of another element from its sphere, mm: that of the exit, limited by the
    thickness."""
    thinnest = element.thinnest
    return min(lens.height_range[1], THICKNESS_PART * thinnest)


def _in_aperture(lens: Lens) -> Surface:
    """The plane of the aperture that the source illuminates."""
    return lambda x, y: np.full((len(x), len(y)), lens.pupil.z)


def _edge(z: np.ndarray, slopes: tuple[float, float]) -> float:
    """Mean height along the edge, of the sides along y and those along x by the slope of light across them."""
    (across, along), sides = (abs(s) for s in slopes), (z[[0, -1]].mean(), z[:, [0, -1]].mean())
    return float((across * sides[0] + along * sides[1]) / (across + along))


def _middle(z: np.ndarray) -> float:
    """Height at the centre of the lens."""
    n, m = z.shape
    return float(z[(n - 1) // 2 : n // 2 + 1, (m - 1) // 2 : m // 2 + 1].mean())
