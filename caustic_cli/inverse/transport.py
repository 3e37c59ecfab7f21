"""Semi-discrete optimal transport of irradiance from a rectangle onto a picture: T = grad phi, phi convex (Brenier 1991).

Notation
    f, g         source density on [-a, a] x [-b, b], constant or bilinear between cell centres; picture g, constant per pixel
    y_p, m_p     sites: point masses that discretise g, one or a few pixels each; black pixels have none
    psi_p        their prices (Kantorovich dual variables);  phi(x) = max_p (x . y_p - psi_p)
    A_p          light in the Laguerre cell of p, where p attains that maximum;  dA_p / dpsi_q = w_pq, weights of the cell borders
    e            transport error, sum |A_p - m_p| / 2, as a fraction of the total: light in a wrong cell

Newton's method (Kitagawa, Merigot & Thibert, J. Eur. Math. Soc. 21, 2019), multilevel from coarse to fine sites (Merigot, Comput.
Graph. Forum 30, 2011).  Black pixels have no sites, so zeros of g are exact: phi has a kink there and the map a discontinuity.  Two
modifications make full Newton steps robust from a poor initial guess:

    the mass of a cell lighter than its site grows like the square of its price, so its borders are weighted by the secant
    (1 + sqrt(m / A)) / 2 instead of the tangent;
    a site with an empty cell gets the price at which its plane touches phi, and a border with the site it touches as
    long as that of a round cell of its mass.

Where the source is dark outside a convex region, cells end at its edge (`_lit_part`).  Dark cells within are lit by a fraction
`darkest` of the mean, since a cell without light has no derivative.

The final phi is averaged over a few source cells, which keeps it convex and the map its exact gradient.

Between separate bright regions phi has a kink, which that average smooths: light that crosses it falls into the dark gap.  So kinks
have to be resolved more finely than masses: `Transport.finer` averages the same phi over smaller cells.  This solves no equation;
time and memory are linear in the number of cells, processed in strips.  What light still falls there is made up for by the masses
(`inverse.creases`).
"""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from scipy import ndimage

from caustic_cli.errors import InputError
from caustic_cli.inverse import creases, multigrid
from caustic_cli.loading import OnDemand
from caustic_cli.optics.bspline import GridSpline

spatial = OnDemand("scipy.spatial")
#: Compiled on first use.
kernels, laguerre = OnDemand("caustic_cli.optics.kernels"), OnDemand("caustic_cli.optics.kernels.laguerre")

FINE = 4  # raster points per source cell along each axis, over which phi is averaged
#: The same for Newton's method: cells of sites along a line are long and narrow, and one between the points of the raster appears
#: empty.  With 4 a picture of lines kept 3 % of its light in wrong cells after any number of steps; with 8 convergence is
#: quadratic, and text, lines and photographs take a half to a fifth of the time.
SEEN, MANY = 8, 4096  # FINE at least; beyond that, at most so many points along an axis
#: Transport error at which sites whose cells the raster misses are merged with neighbours, for convergence; most repetitions.
MERGED, ROUNDS = 5e-3, 4
STRICTER = 0.2  # tolerance of scattered sites in that of others: what is left is the light of a few, at the edge of the source
LEAST_ERROR = 4e-4  # of scattered sites, below which Newton's method mostly empties and fills a few cells at the edge
#: Most Newton steps of scattered sites: a mirror in light at 75 degrees took 16 to 20; with 10 it had 1 to 3 times the error.
SLOWLY = 30
#: Mass of the lightest site that is a pixel beside brighter ones, in that of the lightest part of a pixel: light of a fainter one
#: goes to these. With 4 sites a pixel a flame had an error of 0.053 without such sites, and 0.017 with them; with 1/50 the raster
#: misses cells (0.020 on a net on which 1/16 has 0.015).
FAINT = 1.0 / 16.0
#: Tolerance with these, and so for the masses that make up for creases, in that of others, and most steps to it.
AGAIN, STEPS_AGAIN = 0.2, 10
#: Part of the sites whose cells the raster misses up to which Newton's method goes on with them; more make it slow.
FEW = 5e-3
COVERED = 0.99  # part of the scattered sites that move by no more than the map is widened for its first prices
LEAST = 128  # raster points along an axis
LEVELS = (256, 64, 16, 4, 1)  # ratios of the number of sites on the finest level to that on each level
ROUGH, WIDE = 0.5, 0.4  # resolution of the raster on which a coarse phi is smoothed, relative to the next level; width in cells
MAX_LATTICE = 2048  # the picture is downsampled by 2 until it has at most so many pixels along an axis
BOND = 4.0  # length of the border of an empty cell
COARSE_TOLERANCE, LINEAR_TOLERANCE = 1e-2, 3e-2
EVENER = (1.0, 0.7, 0.4, 0.2, 0.1, 0.03, 0.0)  # continuation in the fraction of uniform light, if a level fails otherwise
DARKEST = 1e-3  # lower bound of the source over its mean: a cell without light has no derivative
MAX_CELLS = 4096
#: No sides of a source (`laguerre.cells`), and the signs of qhull's equations in them.
WHOLE, OUTWARD = np.zeros((0, 3)), (1.0, 1.0, -1.0)
#: Width of the average of phi in `finer`, in its cells, which are smaller than the Laguerre cells.
SHARP = 0.75
STRIP = 128  # columns of corners averaged together, which bounds the memory


@dataclass(frozen=True, eq=False)
class Transport:
    """A transport map and the solution it derives from: `finer` evaluates it on smaller cells."""

    #: phi at the corners of the source's cells, edges included, (n + 1, m + 1) float64, mm^2; its mean is 0.
    potential: np.ndarray
    #: The map there, mm; the exact gradient of phi.
    x: np.ndarray
    y: np.ndarray
    #: e, before phi is smoothed.
    error: float
    #: Point masses of the finest level, and Newton steps of all levels.
    sites: int
    steps: int
    #: Wall time.
    seconds: float
    #: Prices and sites, and the source cells.
    solved: _Solved

    def finer(self, times: int) -> Transport:
        """The same map at the corners of cells `times` smaller along each axis, with sharper kinks."""
        began, s = time.perf_counter(), self.solved
        shape = tuple(times * n for n in s.shape)
        potential, x, y = _smoothed(s.psi, s.sites, shape, s.half, SHARP)
        seconds = self.seconds + time.perf_counter() - began
        return replace(self, potential=potential - potential.mean(), x=x, y=y, seconds=seconds)


@dataclass(frozen=True, eq=False)
class _Sites:
    """Point masses sorted by row: rows y_1 (k,), first (k + 1,), coordinates and masses (N,)."""

    rows: np.ndarray
    first: np.ndarray
    y1: np.ndarray
    y2: np.ndarray
    mass: np.ndarray

    @property
    def lines(self) -> tuple:
        return self.rows, self.first, self.y2

    def prices(self, phi: np.ndarray, raster: list, inside: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
        """As of `laguerre.prices`, on the part `inside` of the raster."""
        return laguerre.prices(np.ascontiguousarray(phi if inside is None else np.where(inside, phi, np.inf)), *self.lines, *raster)

    def envelope(self, psi: np.ndarray) -> _Envelope:
        """phi of these sites at these prices."""
        return _Envelope(psi, self)

    def without(self, seen: np.ndarray, mass: np.ndarray) -> _Sites:
        """Those that are `seen` (N,) bool, with these masses."""
        first = np.append(0, np.cumsum(seen))[self.first]
        kept = np.diff(first) > 0
        return _Sites(self.rows[kept], np.append(first[:-1][kept], first[-1]), self.y1[seen], self.y2[seen], mass)


@dataclass(frozen=True, eq=False)
class _Envelope:
    """phi of sites at prices psi (N,)."""

    psi: np.ndarray
    sites: _Sites

    def on(self, x1: np.ndarray, x2: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """As of `laguerre.envelope`."""
        return laguerre.envelope(self.psi, *self.sites.lines, x1, x2)

    def borders(self, site: np.ndarray) -> tuple[np.ndarray, ...]:
        """As of `laguerre.borders`; site: as `on` a raster."""
        return laguerre.borders(site, len(self.psi))

    def touched(self, missing: np.ndarray, phi: np.ndarray, site: np.ndarray, raster: list, inside: np.ndarray | None) -> tuple:
        """Prices at which the planes of these sites, indices (k,), touch phi, and the sites where they do, (k,) each; phi, site: as
        `on` the raster, whose part `inside` counts."""
        back, at = self.sites.prices(phi, raster, inside)
        return back[missing], site.ravel()[at[missing]].astype(np.int64)


@dataclass(frozen=True, eq=False)
class _Solved:
    """Solution of the dual problem: prices psi (N,) of the sites; shape and half sizes of the grid of source cells."""

    psi: np.ndarray
    sites: _Sites
    shape: tuple[int, int]
    half: tuple[float, float]


class _Light(NamedTuple):
    """The source on a raster: cell values, these sampled, half sizes, and sides of the part outside of which it is dark, as of
    `laguerre.cells`; inside: that part of the raster, or None for all."""

    cells: np.ndarray
    values: np.ndarray
    a: float
    b: float
    sides: np.ndarray
    inside: np.ndarray | None

    def seen(self, site: np.ndarray) -> np.ndarray:
        """Sites on the raster, -1 where it is dark."""
        return site if self.inside is None else np.where(self.inside, site, np.int32(-1))


def centres(n: int, half: float, pad: int = 0) -> np.ndarray:
    """Centres of n cells on [-half, half], and of `pad` more on either side, (n + 2 pad,)."""
    return (np.arange(-pad, n + pad) + 0.5) * (2.0 * half / n) - half


def corners(n: int, half: float) -> np.ndarray:
    """Edges of n cells on [-half, half], (n + 1,)."""
    return np.linspace(-half, half, n + 1)


def cell_means(values: np.ndarray) -> np.ndarray:
    """Mean over the four corners of each cell: (n + 1, m + 1) -> (n, m)."""
    return 0.25 * (values[1:, 1:] + values[:-1, 1:] + values[1:, :-1] + values[:-1, :-1])


def cell_lines(half: tuple[float, float], cells: int) -> tuple[np.ndarray, np.ndarray]:
    """Edges x (n + 1,), y (m + 1,) of nearly square cells over a rectangle, `cells` along its longer side and at least 3, as a
    cubic spline requires."""
    x, y = (corners(max(3, round(cells * r / max(half))), r) for r in half)
    return x, y


def solve(
    source,
    target,
    source_half,
    target_half,
    *,
    start=None,
    smooth=1.5,
    tolerance=5e-3,
    most=10,
    darkest=DARKEST,
    levels=LEVELS,
    times=1,
) -> Transport:
    """The optimal transport map from `source` to `target` for quadratic cost.

    Args:
        source: density on [-a, a] x [-b, b], (n, m) float64, not negative, [i, j] with i along +x; any unit.
        target: density on [-c, c] x [-d, d], (k, l) float64, not negative; zeros stay dark.
        source_half, target_half: (a, b) and (c, d), mm.
        start: potential of a similar problem on the same source cells, (n + 1, m + 1), mm^2, as initial guess, or None.
        smooth: half width of the triangular average of phi, source cells, at least 0.5.
        tolerance: error e at which Newton's method stops.
        most: Newton steps per level.
        darkest: lower bound of the source over its mean; larger values need fewer steps.
        levels: ratios of the number of sites on the finest level to that on each, for a problem without an initial guess.
        times: of `Transport.finer`, for which the masses are compensated; 1 without it.

    Raises:
        InputError: a density that is not 2-D, not finite, negative or black, or a size that is not positive.
    """
    began = time.perf_counter()
    kernels.blocks()  # sets numba's number of threads to torch's
    f, g = _density("source", source), _density("target", target)
    (a, b), (c, d) = _halves("source", source_half), _halves("target", target_half)
    if not 0.5 <= smooth <= 16:
        raise InputError(f"smooth must be 0.5 to 16 source cells, got {smooth!r}")
    n, m = f.shape
    most_sites = _most_sites(_normalised(f, darkest, (a, b)), n * m)
    f, sides = _lit_part(f, a, b)
    f = _normalised(f, darkest, (a, b))
    pyramid = _pyramid(g, (c, d), most_sites)
    psi = sites = None
    steps = 0
    for fewer in levels if start is None else LEVELS[-1:]:
        goal = max(most_sites // fewer, 16)
        raster = [centres(_points(s * fewer**-0.5), h) for s, h in ((n, a), (m, b))]
        light = _light(f, 0.0, raster, a, b, sides)
        last = fewer == levels[-1]
        old, sites = sites, _sites(pyramid, 1.0 / goal, g.shape if last and times > 1 else None)
        linear = 0.5 * ((a / c) * sites.y1**2 + (b / d) * sites.y2**2)  # prices of the map that stretches the rectangle
        if start is not None:
            psi = sites.prices(_resampled(start, (n, m), (a, b), raster), raster, light.inside)[0]
        else:
            psi = linear if old is None else _refined(psi, old, sites, raster, (a, b), sides)
        enough = max(tolerance, MERGED) if last else COARSE_TOLERANCE
        found, error, taken = _newton(psi, sites, raster, light, enough, most)
        steps += taken
        failed = error > 10.0 * enough and (f.size > 1 or len(sides) > 0)  # Newton's method, in dark regions of the source
        if failed and start is not None:  # which were lit where the initial potential comes from
            options = {"smooth": smooth, "tolerance": tolerance, "most": most, "darkest": darkest, "times": times}
            again = solve(source, target, source_half, target_half, **options)
            return replace(again, steps=steps + again.steps, seconds=time.perf_counter() - began)
        if failed:  # continuation from uniform light
            *other, taken, all_taken = _continued(linear, sites, raster, f, (a, b), enough, most, sides)
            steps += all_taken
            found, error = min((found, error), other, key=lambda pair: pair[1])
        psi = found
    if times > 1:
        spots, cell = creases.Spots((sites.y1, sites.y2), sites.mass, g > 0, (c, d)), _cell((n, m), (a, b), times)
        psi, sites, error, taken = _compensated(psi, sites, raster, light, spots, cell, tolerance, FEW)
        steps += taken
    psi, sites, error, taken = _without_empty(psi, sites, error, taken, raster, light, tolerance, most)
    return _map(psi, sites, (n, m), (a, b), smooth, error, steps + taken, began)


def solve_displaced(
    source,
    sites,
    source_half,
    potential,
    shift,
    *,
    smooth=1.5,
    tolerance=5e-3,
    most=SLOWLY,
    darkest=DARKEST,
    start=None,
    fewer=1,
    times=1,
) -> Transport:
    """The same onto scattered point masses, each displaced from its own place by -shift at the point of the source that a similar
    map sends to it.

    Args:
        sites: of `scattered`, where they are in that map.
        potential: its potential on the same source cells, (n + 1, m + 1) mm^2, and shift (2, n + 1, m + 1) mm there.
        source, source_half, smooth, tolerance, most, darkest: as of `solve`.
        start: potential of their map, roughly, there.
        fewer: by what factor the sites are fewer than those of the finest level.
        times: as of `solve`.
    """
    began = time.perf_counter()
    kernels.blocks()
    f, (a, b) = _density("source", source), _halves("source", source_half)
    shape = f.shape
    f, sides = _lit_part(f, a, b)
    f = _normalised(f, darkest, (a, b))
    raster = [centres(max(round(FINE * n * fewer**-0.5), LEAST), h) for n, h in zip(shape, (a, b), strict=True)]
    phi = _resampled(potential, shape, (a, b), raster)
    light = _light(f, 0.0, raster, a, b, sides)
    at = sites.prices(phi, raster, light.inside)[1]
    where = [x[i] for x, i in zip(raster, np.unravel_index(at, [len(x) for x in raster]), strict=True)]
    cells = [(0.5 * x / h + 0.5) * n for x, n, h in zip(where, shape, (a, b), strict=True)]
    moved = sites.displaced(*(-ndimage.map_coordinates(c, cells, order=1, mode="nearest") for c in shift))
    spread = [np.quantile(np.abs(d), COVERED) / h for d, h in zip((moved.y1 - sites.y1, moved.y2 - sites.y2), (a, b), strict=True)]
    if start is None:  # a map that reaches the outermost sites
        wide, high = spread
        phi = phi + 0.5 * (wide * raster[0][:, None] ** 2 + high * raster[1] ** 2)
    else:
        phi = _resampled(start, shape, (a, b), raster)
    psi = moved.prices(phi, raster, light.inside)[0]
    enough = min(tolerance, max(LEAST_ERROR, STRICTER * tolerance))
    psi, error, taken = _newton(psi, moved, raster, light, enough, most)
    if times > 1:
        cell = _cell(shape, (a, b), times)
        psi, moved, error, more = _compensated(psi, moved, raster, light, sites.spots, cell, tolerance)
        taken += more
    return _map(psi, moved, shape, (a, b), smooth, error, taken, began)


def _cell(shape: tuple[int, int], half: tuple[float, float], times: int) -> float:
    """Width of source cells, mm, `times` smaller than these."""
    return 2.0 * float(np.sqrt(half[0] * half[1] / (shape[0] * shape[1]))) / times


def _compensated(
    psi, sites: _Sites, raster: list, light: _Light, spots: creases.Spots, cell: float, tolerance: float, few: float = 1.0
) -> tuple:
    """Prices, sites with masses that make up for what creases smoothed over cells take, error, and steps taken: by Newton's method
    unless the raster misses more than a part `few` of the sites (an error of 1 then).

    spots: what the sites are of the picture; cell: width, mm.
    """
    psi, _, (end, weight, *_) = _cells(psi, sites, raster, light)
    q, p, weight = end[0::2], end[1::2], 0.5 * (weight[0::2] + weight[1::2])
    along = weight * np.hypot(sites.y1[p] - sites.y1[q], sites.y2[p] - sites.y2[q])
    sites = replace(sites, mass=creases.compensated(spots, (p, q), cell * along))
    if few < 1.0 and np.count_nonzero(~_seen(psi, sites, raster, light)) > few * len(psi):
        return psi, sites, 1.0, 1
    psi, error, taken = _newton(psi, sites, raster, light, AGAIN * tolerance, STEPS_AGAIN)
    return psi, sites, error, taken


def _without_empty(psi, sites: _Sites, error: float, taken: int, raster: list, light: _Light, tolerance: float, most: int) -> tuple:
    """Prices, sites, error, and steps taken: Newton's method without the sites whose cells the raster misses, after it has stopped
    with them at `error` after `taken` steps."""
    steps = 0
    for _ in range(ROUNDS):
        if error < tolerance or taken == 0:
            break
        psi, sites = _merged(psi, sites, raster, light)
        psi, error, taken = _newton(psi, sites, raster, light, tolerance, most)
        steps += taken
    return psi, sites, error, steps


def _map(psi, sites: _Sites, shape, half, smooth: float, error: float, steps: int, began: float) -> Transport:
    potential, x, y = _smoothed(psi, sites, shape, half, smooth)
    solved = _Solved(psi, sites, shape, half)
    return Transport(potential - potential.mean(), x, y, error, len(psi), steps, time.perf_counter() - began, solved)


def point_masses(source, picture, half, darkest=DARKEST, fewer=1, times=1) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The point masses of the finest level for a picture (k, l) with half sizes in mm, or about `fewer` times fewer: y1, y2 mm and
    masses, (N,) each; times: as of `solve`."""
    f, half = _density("source", source), _halves("target", half)
    most = _most_sites(_normalised(f, darkest, (1.0, 1.0)), f.size) // fewer
    sites = _sites(_pyramid(_density("target", picture), half, most), 1.0 / max(most, 16), np.shape(picture) if times > 1 else None)
    return sites.y1, sites.y2, sites.mass


def _most_sites(f: np.ndarray, cells: int) -> int:
    """No Laguerre cells below source cells where most light is."""
    return int(cells * f.mean() ** 2 / (f * f).mean())


def _normalised(f: np.ndarray, darkest: float, half: tuple[float, float]) -> np.ndarray:
    """The source with the integral 1 and a lower bound over its mean; a uniform one as a single cell."""
    f = np.maximum(f / f.mean(), darkest)
    f = f[:1, :1] if np.ptp(f) == 0 else f
    return f / (f.mean() * 4.0 * half[0] * half[1])


def _continued(
    psi: np.ndarray, sites: _Sites, raster, f: np.ndarray, half: tuple[float, float], enough: float, most: int, sides: np.ndarray
):
    """Prices by Newton's method in steps from uniform light to that of the source, their error, and the numbers of its steps
    for the source and in all."""
    steps = 0
    for even in EVENER:
        tolerance = COARSE_TOLERANCE if even else enough
        psi, error, taken = _newton(psi, sites, raster, _light(f, even, raster, *half, sides), tolerance, most)
        steps += taken
    return psi, error, taken, steps


def _refined(
    psi: np.ndarray, coarser: _Sites, sites: _Sites, raster: list, half: tuple[float, float], sides: np.ndarray
) -> np.ndarray:
    """Prices of the sites of a level, from those of the coarser one."""
    coarse = [centres(int(ROUGH * len(x)), h) for x, h in zip(raster, half, strict=True)]
    return sites.prices(_rounded(psi, coarser, coarse, half), coarse, _inside(coarse, sides))[0]


def _points(cells: float) -> int:
    """Raster points along an axis with this number of source cells."""
    return max(int(FINE * cells), min(int(SEEN * cells), MANY), LEAST)


def _light(f: np.ndarray, even: float, raster: list, a: float, b: float, sides: np.ndarray = WHOLE) -> _Light:
    """The source mixed with a fraction `even` of uniform light."""
    lit = (1.0 - even) * f + even * f.mean()
    return _Light(lit, laguerre.sampled(lit, *raster, a, b), a, b, sides, _inside(raster, sides))


def _inside(raster: list, sides: np.ndarray) -> np.ndarray | None:
    """Points of a raster within these sides, or None without any."""
    if not len(sides):
        return None
    x1, x2 = raster[0][:, None], raster[1][None, :]
    within = np.ones((len(raster[0]), len(raster[1])), bool)
    for p, q, c in sides:
        within &= p * x1 + q * x2 <= c
    return within


def _lit_part(f: np.ndarray, a: float, b: float) -> tuple[np.ndarray, np.ndarray]:
    """A source (n, m) that is dark outside a convex region, continued evenly beyond it, and the region's sides, as of
    `laguerre.cells`: a polygon through the cells that are half covered, widened to the area of their light.  Of any other no sides,
    and the source as it is."""
    lines = [_to_edges(centres(n, h), h) for n, h in zip(f.shape, (a, b), strict=True)]
    places = np.stack(np.meshgrid(*lines, indexing="ij"), -1)
    hull = None if f.all() else _hull(places[f > 0])
    outside = np.zeros(f.shape, bool) if hull is None else (f <= 0) & ~_inside(lines, hull.equations * OUTWARD)
    if not outside.any():
        return f, WHOLE
    edge = ndimage.binary_dilation(outside, np.ones((3, 3), bool))
    nearest = ndimage.distance_transform_edt(edge, return_distances=False, return_indices=True)
    even = f[tuple(nearest)]
    hull = None if edge.all() or not even.min() > 0 else _hull(places[(f > 0) & (f >= 0.5 * even)])
    if hull is None:
        return f, WHOLE
    area = 4.0 * a * b / f.size * float(np.where(edge, f / even, 1.0).sum())
    ends = hull.points[hull.simplices]
    fixed = ((ends == (a, b)).all(1) | (ends == (-a, -b)).all(1)).any(1)  # along the edges of the rectangle
    sides, lengths = (hull.equations * OUTWARD)[~fixed], np.hypot(*(ends[:, 0] - ends[:, 1]).T)[~fixed]
    sides[:, 2] += (area - hull.volume) / lengths.sum()
    return even, sides


def _hull(points: np.ndarray) -> Any:
    """Convex hull of points (k, 2), None of points on a line."""
    try:
        return spatial.ConvexHull(points)
    except spatial.QhullError:
        return None


def _to_edges(c: np.ndarray, half: float) -> np.ndarray:
    """Centres of cells, the outermost moved to the edges of all."""
    return np.concatenate([[-half], c[1:-1], [half]]) if len(c) > 1 else c


def _density(name: str, value) -> np.ndarray:
    v = np.asarray(value, dtype=np.float64)
    if v.ndim != 2 or min(v.shape) < 1 or max(v.shape) > 2 * MAX_CELLS:
        raise InputError(f"the {name} density must be a 2-D array of at most {2 * MAX_CELLS} values a side, got shape {v.shape}")
    if not np.isfinite(v).all() or (v < 0).any():
        raise InputError(f"the {name} density must be finite and not negative")
    if not v.max() > 0:
        raise InputError(f"the {name} density is black all over; some light is needed")
    return v / v.max()


def _halves(name: str, value) -> tuple[float, float]:
    try:
        half = tuple(float(v) for v in value)
    except (TypeError, ValueError):
        half = ()
    if len(half) != 2 or not all(0 < v < np.inf for v in half):
        raise InputError(f"the {name} half size must be two positive lengths in mm, got {value!r}")
    return half


def _halve(v: np.ndarray) -> np.ndarray:
    """Sums over 2 x 2 blocks of the last two axes."""
    v = np.pad(v, [(0, 0)] * (v.ndim - 2) + [(0, s % 2) for s in v.shape[-2:]])
    return v[..., 0::2, 0::2] + v[..., 1::2, 0::2] + v[..., 0::2, 1::2] + v[..., 1::2, 1::2]


def _pyramid(g: np.ndarray, half: tuple[float, float], goal: int) -> list:
    """[(mass and its first moments (3, k, l), low edge, pixel)], from fine to coarse; pixels are subdivided to reach `goal`
    sites."""
    split = 1
    while max(g.shape) * split * 2 <= MAX_LATTICE and np.count_nonzero(g) * (2 * split) ** 2 <= 1.6 * goal:
        split *= 2
    g = np.repeat(np.repeat(g, split, 0), split, 1) / (g.sum() * split * split)
    pixel = tuple(2.0 * h / s for h, s in zip(half, g.shape, strict=True))
    v = np.stack([g, g * centres(g.shape[0], half[0])[:, None], g * centres(g.shape[1], half[1])])
    out = []
    while True:
        if max(v.shape) <= MAX_LATTICE:
            out.append((v, (-half[0], -half[1]), pixel))
        if max(v.shape[1:]) == 1:
            return out
        v, pixel = _halve(v), (2.0 * pixel[0], 2.0 * pixel[1])


def _parents(owner: np.ndarray) -> np.ndarray:
    """Largest value in blocks of 2 x 2, (k, l) to half of that."""
    owner = np.pad(owner, [(0, s % 2) for s in owner.shape], constant_values=-1)
    return np.maximum(np.maximum(owner[0::2, 0::2], owner[1::2, 0::2]), np.maximum(owner[0::2, 1::2], owner[1::2, 1::2]))


def _sites(pyramid: list, least: float, faint: tuple[int, int] | None = None) -> _Sites:
    """Blocks of pixels, each of at least a mass `least`, as points at their centroids.

    From fine to coarse: a lighter block joins a site of its parent block of 2 x 2, or is left to the next level.  Where the
    picture has `faint` pixels, blocks of these of at least FAINT of that join no site beside them.
    """
    level = 0
    while level + 1 < len(pyramid) and pyramid[level][0][0].size > 32 / least:
        level += 1
    _, low, pixel = pyramid[level]
    loose = pyramid[level][0].copy()
    owner, sites = np.full(loose.shape[1:], -1), np.zeros((3, 0))
    while True:
        new = loose[0] >= least
        if faint and owner.shape[0] <= faint[0]:
            beside = np.repeat(np.repeat(_parents(np.where(new, 0, owner)), 2, 0), 2, 1)[: len(owner), : owner.shape[1]]
            new |= (beside >= 0) & (owner < 0) & (loose[0] >= FAINT * least)
        if owner.size == 1 and not sites.size:
            new[:] = True
        joins = ~new & (owner >= 0) & (loose[0] > 0)
        for k in range(3):
            sites[k] += np.bincount(owner[joins], loose[k][joins], sites.shape[1])
        count = sites.shape[1]
        sites = np.concatenate([sites, loose[:, new]], 1)
        owner[new] = np.arange(count, sites.shape[1])
        loose[:, new | joins] = 0.0
        if owner.size == 1:
            break
        loose = _halve(loose)
        owner = _parents(owner)
    mass, pitch = sites[0], 0.5 * pixel[0]
    row, y2 = np.rint((sites[1] / mass - low[0]) / pitch).astype(np.int64), sites[2] / mass
    order = np.lexsort((y2, row))
    row, y2, mass = row[order], y2[order], mass[order]
    same = np.append((np.diff(row) == 0) & (np.diff(y2) < 0.1 * pixel[1]), False)
    if same.any():  # merge coincident sites
        last = np.flatnonzero(~same)
        mass, row, y2 = np.diff(np.cumsum(mass)[last], prepend=0.0), row[last], y2[last]
    rows, first = np.unique(row, return_index=True)
    at = rows * pitch + low[0]
    return _Sites(at, np.append(first, len(row)), np.repeat(at, np.diff(np.append(first, len(row)))), y2, mass / mass.sum())


def _resampled(potential, shape: tuple[int, int], half: tuple[float, float], raster: list) -> np.ndarray:
    """The initial potential, interpolated on the raster; InputError if it is invalid."""
    v = np.asarray(potential, dtype=np.float64)
    if v.shape != (shape[0] + 1, shape[1] + 1) or not np.isfinite(v).all():
        raise InputError(f"the start potential must be {shape[0] + 1} x {shape[1] + 1} finite values, one a corner of a cell")
    at = [corners(s, h) for s, h in zip(shape, half, strict=True)]
    return GridSpline(*at, v)(*raster)


def _rounded(psi: np.ndarray, sites: _Sites, raster: list, half: tuple[float, float]) -> np.ndarray:
    """phi of a coarser level on a finer raster, smoothed over about a cell, so that new sites get cells between the old ones."""
    shape = tuple(len(x) for x in raster)
    width = [WIDE * s / len(psi) ** 0.5 for s in shape]
    pad = [int(np.ceil(3.0 * w)) for w in width]
    wide = [centres(s, h, p) for s, h, p in zip(shape, half, pad, strict=True)]
    phi, _ = sites.envelope(psi).on(*wide)
    phi = ndimage.gaussian_filter(phi, width, mode="nearest", truncate=3.0)
    return phi[pad[0] : -pad[0], pad[1] : -pad[1]]


def _seen(psi: np.ndarray, sites: _Sites, raster: list, light: _Light) -> np.ndarray:
    """Sites whose cells contain a raster point, (N,) bool."""
    site = light.seen(sites.envelope(psi).on(*raster)[1])
    seen = np.zeros(len(psi), bool)
    seen[site[site >= 0]] = True
    return seen


def _merged(psi: np.ndarray, sites: _Sites, raster: list, light: _Light) -> tuple[np.ndarray, _Sites]:
    """Prices and sites without those whose cells contain no raster point; their mass is added to the nearest ones."""
    seen = _seen(psi, sites, raster, light)
    at = np.column_stack([sites.y1, sites.y2])
    nearest = spatial.cKDTree(at[seen]).query(at[~seen])[1]
    mass = sites.mass[seen] + np.bincount(nearest, sites.mass[~seen], np.count_nonzero(seen))
    return psi[seen], sites.without(seen, mass)


def _cells(psi: np.ndarray, sites: _Sites, raster: list, light: _Light) -> tuple:
    """Prices (those of empty cells lowered until they touch phi), masses of the cells, and the sparse Jacobian as a graph."""
    envelope = sites.envelope(psi)
    phi, site = envelope.on(*raster)
    seen = light.seen(site)
    net = envelope.borders(seen)
    mass, weight = laguerre.cells(psi, sites.y1, sites.y2, site, seen, *net, *light[:-1])
    if light.inside is not None and (total := mass.sum()):
        mass, weight = mass / total, weight / total
    empty = mass == 0.0
    empty[seen[seen >= 0]] = False
    missing, touched, bond = np.flatnonzero(empty), np.zeros(0, np.int64), np.zeros(0)
    if len(missing):
        psi = psi.copy()
        psi[missing], touched = envelope.touched(missing, phi, site, raster, light.inside)
        distance = np.hypot(sites.y1[missing] - sites.y1[touched], sites.y2[missing] - sites.y2[touched])
        bond = BOND * np.sqrt(sites.mass[missing] * light.cells.mean()) / distance
    return psi, mass, (net[2], weight, mass, sites.mass, missing, touched, bond)


def _newton(psi, sites: _Sites, raster: list, light: _Light, tolerance: float, most: int) -> tuple[np.ndarray, float, int]:
    """Damped Newton iteration: prices, transport error, and the number of steps taken."""
    psi, mass, graph = _cells(psi, sites, raster, light)
    excess = mass - sites.mass
    error = 0.5 * float(np.abs(excess).sum())
    for step in range(most):
        if error < tolerance or len(psi) == 1:
            return psi, error, step
        change, _ = multigrid.Multigrid(multigrid.matrix(*graph)).solve(excess - excess.mean(), LINEAR_TOLERANCE)
        change -= change.mean()
        length, best = 1.0, None
        while length > 0.05:
            new = _cells(psi + length * change, sites, raster, light)
            left = new[1] - sites.mass
            size = 0.5 * float(np.abs(left).sum())
            if best is None or size < best[1]:
                best = (new, size, left)
            if size < (1.0 - 0.1 * length) * error:
                break
            length *= 0.5
        if best[1] >= error:
            return psi, error, step
        (psi, mass, graph), error, excess = best
    return psi, error, most


def _smoothed(psi, sites: _Sites, shape, half, smooth: float) -> np.ndarray:
    """phi and its gradient at the corners of cells, averaged with a triangle of half width `smooth` cells: (3, n + 1, m + 1)."""
    box = np.ones(max(round(FINE * smooth), 1))
    kernel = np.convolve(np.convolve(box, box), (1.0, 1.0))  # of even length: centred between two raster points, as corners are
    kernel /= kernel.sum()
    pad = FINE * int(np.ceil(len(kernel) / (2 * FINE)))
    x1, x2 = (centres(FINE * s, h, pad) for s, h in zip(shape, half, strict=True))
    m, low, out = shape[1], pad - len(kernel) // 2, np.empty((3, shape[0] + 1, shape[1] + 1))
    envelope = sites.envelope(psi)
    for j in range(0, m + 1, STRIP):
        count = min(STRIP, m + 1 - j)
        at = low + FINE * j
        phi, site = envelope.on(x1, x2[at : at + FINE * (count - 1) + len(kernel)])
        laguerre.averages(laguerre.ALL, phi, site, sites.y1, sites.y2, kernel, FINE, low, out[:, :, j : j + count])
    return out
