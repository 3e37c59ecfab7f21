"""Optimal transport of light from a rectangle onto a picture: the map T = grad phi, phi convex (Brenier 1991).

Notation
    f, g         source density on [-a, a] x [-b, b], constant or bilinear between cell centres; picture g, constant per pixel
    y_p, m_p     sites: point masses that stand for g, one or a few pixels each; black pixels have none
    psi_p        their prices (dual variables);  phi(x) = max_p (x . y_p - psi_p)
    A_p          light in the Laguerre cell of p, where p attains that maximum;  dA_p / dpsi_q = w_pq, borders of cells
    e            light in the wrong cell, sum |A_p - m_p| / 2, as a part of the whole

Semi-discrete transport by Newton's method (Kitagawa, Merigot & Thibert, J. Eur. Math. Soc. 21, 2019) from coarse sites to
fine ones (Merigot, Comput. Graph. Forum 30, 2011).  Where g vanishes there is nothing to solve, so true zeros need no floor:
phi has a kink there and the map a jump.  Two departures make full Newton steps safe from a rough start:

    a cell lighter than its mass grows like the square of its price, so its borders count by the secant
    (1 + sqrt(m / A)) / 2 instead of the tangent;
    a site without a cell is given the price at which its plane touches phi, and a border with the site it touches as
    long as that of a round cell of its mass.

The last phi is averaged over a few source cells.  That keeps it convex, and the map stays exactly its gradient.

Between islands of light phi has a kink, which that average rounds off: what light crosses it there falls into the black.  So kinks
have to be known far more finely than masses: `Transport.finer` takes the average of the same phi over cells as much smaller.  No
equation is solved for that; its time is linear in cells, and so is its memory, which holds a strip of the raster at a time.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, replace

import numpy as np
from scipy import ndimage
from scipy.interpolate import RectBivariateSpline
from scipy.spatial import cKDTree

from caustic_cli.errors import InputError
from caustic_cli.optics.kernels import blocks, laguerre
from caustic_cli.optics.kernels.multigrid import Multigrid, matrix

FINE = 4  # raster points a source cell, along each axis, over which phi is averaged
#: The same where Newton's method sees its cells: those of sites along a line are long and narrow, and a cell that falls between the
#: points of the raster counts as missing.  With 4 a picture of lines kept 3 % of its light in wrong cells, however many steps;
#: with 8 steps converge quadratically, and text, lines and photographs take a half to a fifth of the time.
SEEN, MANY = 8, 4096  # FINE at least; beyond that, so many points along an axis at most
#: Light in the wrong cell at which sites that the raster still misses are merged with others, so that steps converge; how often.
MERGED, ROUNDS = 5e-3, 4
LEAST = 128  # raster points along an axis
LEVELS = (64, 16, 4, 1)  # of how many times fewer sites
ROUGH, WIDE = 0.5, 0.4  # a coarse phi is rounded on a raster so much coarser than the next level's, over such a part of a cell
MAX_LATTICE = 2048  # the picture is halved until it has at most so many pixels along an axis
BOND = 4.0  # border of a missing cell
COARSE_TOLERANCE, LINEAR_TOLERANCE = 1e-2, 3e-2
EVENER = (1.0, 0.7, 0.4, 0.2, 0.1, 0.03, 0.0)  # parts of uniform light, if a level fails on the source itself
DARKEST = 1e-3  # the source is lifted to at least this part of its mean: a cell without light has no derivative
MAX_CELLS = 4096
#: Width of the average over phi on finer cells, in these: those of Laguerre are wider, so that it keeps no kink but theirs.
SHARP = 0.75
STRIP = 128  # columns of corners averaged together, which bounds the memory


@dataclass(frozen=True, eq=False)
class Transport:
    """A map and what it was made of: `finer` evaluates it on smaller cells.

    Attributes:
        potential: phi at the corners of the source's cells, edges included, (n + 1, m + 1) float64, mm^2; its mean is 0.
        x, y: the map there, mm; the exact gradient of phi.
        error: light in the wrong cell, part of the whole (before phi is smoothed).
        sites, steps: point masses of the finest level, and Newton steps of all levels.
        seconds: wall time.
        solved: prices and sites that it follows from, and the source's cells.
    """

    potential: np.ndarray
    x: np.ndarray
    y: np.ndarray
    error: float
    sites: int
    steps: int
    seconds: float
    solved: _Solved

    def finer(self, times: int) -> Transport:
        """The same map at the corners of cells so many times smaller along each axis, its kinks sharper by more than that."""
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


@dataclass(frozen=True, eq=False)
class _Solved:
    """What a map follows from: prices psi (N,) of the sites, shape and half sizes of the source's cells."""

    psi: np.ndarray
    sites: _Sites
    shape: tuple[int, int]
    half: tuple[float, float]


def centres(n: int, half: float, pad: int = 0) -> np.ndarray:
    """Centres of n cells on [-half, half], and of `pad` more on either side, (n + 2 pad,)."""
    return (np.arange(-pad, n + pad) + 0.5) * (2.0 * half / n) - half


def corners(n: int, half: float) -> np.ndarray:
    """Edges of n cells on [-half, half], (n + 1,)."""
    return np.linspace(-half, half, n + 1)


def cell_lines(half: tuple[float, float], cells: int) -> tuple[np.ndarray, np.ndarray]:
    """Edges x (n + 1,), y (m + 1,) of nearly square cells over a rectangle, so many along its longer side; 3 at least, since four
    corners carry a cubic."""
    x, y = (corners(max(3, round(cells * r / max(half))), r) for r in half)
    return x, y


def solve(
    source, target, source_half, target_half, *, start=None, smooth=1.5, tolerance=5e-3, most=10, darkest=DARKEST
) -> Transport:
    """The map that carries `source` onto `target` at least quadratic cost.

    Args:
        source: density on [-a, a] x [-b, b], (n, m) float64, not negative, [i, j] with i along +x; any unit.
        target: density on [-c, c] x [-d, d], (k, l) float64, not negative; zeros stay dark.
        source_half, target_half: (a, b) and (c, d), mm.
        start: potential of a similar problem on the same source cells, (n + 1, m + 1), mm^2, or None.
        smooth: width of the average over phi, source cells: a triangle of twice this width; at least 0.5.
        tolerance: light in the wrong cell at which Newton's method stops, a part of the whole.
        most: Newton steps a level.
        darkest: part of its mean to which the source is lifted where it is darker; the more, the fewer steps.

    Raises:
        InputError: a density that is not 2-D, not finite, negative or black, or a size that is not positive.
    """
    began = time.perf_counter()
    blocks()  # torch's threads decide over numba's too
    f, g = _density("source", source), _density("target", target)
    (a, b), (c, d) = _halves("source", source_half), _halves("target", target_half)
    if not 0.5 <= smooth <= 16:
        raise InputError(f"smooth must be 0.5 to 16 source cells, got {smooth!r}")
    n, m = f.shape
    f = np.maximum(f / f.mean(), darkest)
    f = f[:1, :1] if np.ptp(f) == 0 else f
    f = f / (f.mean() * 4.0 * a * b)
    most_sites = int(n * m * f.mean() ** 2 / (f * f).mean())  # so that where most light is, a cell is not below a source cell
    pyramid = _pyramid(g, (c, d), most_sites)
    psi = sites = None
    steps = 0
    for fewer in LEVELS:
        if start is not None and fewer > 1:
            continue
        goal = max(most_sites // fewer, 16)
        raster = [centres(_points(s * fewer**-0.5), h) for s, h in ((n, a), (m, b))]
        old, sites = sites, _sites(pyramid, 1.0 / goal)
        if start is not None:
            psi = _prices(_resampled(start, (n, m), (a, b), raster), sites, raster)
        elif old is None:
            psi = 0.5 * ((a / c) * sites.y1**2 + (b / d) * sites.y2**2)
        else:
            coarse = [centres(int(ROUGH * len(x)), h) for x, h in zip(raster, (a, b), strict=True)]
            psi = _prices(_rounded(psi, old, coarse, (a, b)), sites, coarse)
        enough = max(tolerance, MERGED) if fewer == 1 else COARSE_TOLERANCE
        found, error, taken = _newton(psi, sites, raster, _light(f, 0.0, raster, a, b), enough, most)
        steps += taken
        lost = error > 10.0 * enough and f.size > 1  # in the dark parts of the source
        if lost and start is not None:  # which are others than where the start comes from
            options = {"smooth": smooth, "tolerance": tolerance, "most": most, "darkest": darkest}
            again = solve(source, target, source_half, target_half, **options)
            return replace(again, steps=steps + again.steps, seconds=time.perf_counter() - began)
        if lost:
            psi = 0.5 * ((a / c) * sites.y1**2 + (b / d) * sites.y2**2)
            for even in EVENER:
                light = _light(f, even, raster, a, b)
                psi, left, taken = _newton(psi, sites, raster, light, COARSE_TOLERANCE if even else enough, most)
                steps += taken
            if left < error:
                found, error = psi, left
        psi = found
    for _ in range(ROUNDS):
        if error < tolerance or taken == 0:
            break
        psi, sites = _merged(psi, sites, raster)
        psi, error, taken = _newton(psi, sites, raster, _light(f, 0.0, raster, a, b), tolerance, most)
        steps += taken
    potential, x, y = _smoothed(psi, sites, (n, m), (a, b), smooth)
    solved = _Solved(psi, sites, (n, m), (a, b))
    return Transport(potential - potential.mean(), x, y, error, len(psi), steps, time.perf_counter() - began, solved)


def _points(cells: float) -> int:
    """Raster points along an axis of so many source cells."""
    return max(int(FINE * cells), min(int(SEEN * cells), MANY), LEAST)


def _light(f: np.ndarray, even: float, raster: list, a: float, b: float) -> tuple:
    """What `laguerre.cells` needs of the source, mixed with a part `even` of uniform light."""
    lit = (1.0 - even) * f + even * f.mean()
    return lit, laguerre.sampled(lit, *raster, a, b), a, b


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
    """[(mass and its moments (3, k, l), low edge, pixel)], from fine to coarse; bright pixels are split to reach the goal."""
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


def _sites(pyramid: list, least: float) -> _Sites:
    """Blocks of pixels, each of at least a mass `least`, as points at their centroids.

    From fine to coarse: what is lighter than that joins a site of its own block of 2 x 2, or waits for the next level.
    """
    level = 0
    while level + 1 < len(pyramid) and pyramid[level][0][0].size > 32 / least:
        level += 1
    _, low, pixel = pyramid[level]
    loose = pyramid[level][0].copy()
    owner, sites = np.full(loose.shape[1:], -1), np.zeros((3, 0))
    while True:
        new = loose[0] >= least
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
        owner = np.pad(owner, [(0, s % 2) for s in owner.shape], constant_values=-1)
        owner = np.maximum(np.maximum(owner[0::2, 0::2], owner[1::2, 0::2]), np.maximum(owner[0::2, 1::2], owner[1::2, 1::2]))
    mass, pitch = sites[0], 0.5 * pixel[0]
    row, y2 = np.rint((sites[1] / mass - low[0]) / pitch).astype(np.int64), sites[2] / mass
    order = np.lexsort((y2, row))
    row, y2, mass = row[order], y2[order], mass[order]
    same = np.append((np.diff(row) == 0) & (np.diff(y2) < 0.1 * pixel[1]), False)
    if same.any():  # two in one place are one
        last = np.flatnonzero(~same)
        mass, row, y2 = np.diff(np.cumsum(mass)[last], prepend=0.0), row[last], y2[last]
    rows, first = np.unique(row, return_index=True)
    at = rows * pitch + low[0]
    return _Sites(at, np.append(first, len(row)), np.repeat(at, np.diff(np.append(first, len(row)))), y2, mass / mass.sum())


def _prices(phi: np.ndarray, sites: _Sites, raster: list) -> np.ndarray:
    return laguerre.prices(np.ascontiguousarray(phi), *sites.lines, *raster)[0]


def _resampled(potential, shape: tuple[int, int], half: tuple[float, float], raster: list) -> np.ndarray:
    """A start potential on the raster, or InputError."""
    v = np.asarray(potential, dtype=np.float64)
    if v.shape != (shape[0] + 1, shape[1] + 1) or not np.isfinite(v).all():
        raise InputError(f"the start potential must be {shape[0] + 1} x {shape[1] + 1} finite values, one a corner of a cell")
    at = [corners(s, h) for s, h in zip(shape, half, strict=True)]
    return RectBivariateSpline(*at, v, kx=min(3, shape[0]), ky=min(3, shape[1]))(*raster)


def _rounded(psi: np.ndarray, sites: _Sites, raster: list, half: tuple[float, float]) -> np.ndarray:
    """phi of a coarser level on a finer raster, its kinks rounded over about a cell: new sites then find room between old."""
    shape = tuple(len(x) for x in raster)
    width = [WIDE * s / len(psi) ** 0.5 for s in shape]
    pad = [int(np.ceil(3.0 * w)) for w in width]
    wide = [centres(s, h, p) for s, h, p in zip(shape, half, pad, strict=True)]
    phi, _ = laguerre.envelope(psi, *sites.lines, *wide)
    phi = ndimage.gaussian_filter(phi, width, mode="nearest", truncate=3.0)
    return phi[pad[0] : -pad[0], pad[1] : -pad[1]]


def _merged(psi: np.ndarray, sites: _Sites, raster: list) -> tuple[np.ndarray, _Sites]:
    """Prices and sites without those that no point of the raster sees, whose mass the nearest ones take."""
    _, site = laguerre.envelope(psi, *sites.lines, *raster)
    seen = np.zeros(len(psi), bool)
    seen[site.ravel()] = True
    at = np.column_stack([sites.y1, sites.y2])
    _, nearest = cKDTree(at[seen]).query(at[~seen])
    mass = sites.mass[seen] + np.bincount(nearest, sites.mass[~seen], np.count_nonzero(seen))
    first = np.append(0, np.cumsum(seen))[sites.first]
    kept = np.diff(first) > 0
    return psi[seen], _Sites(sites.rows[kept], np.append(first[:-1][kept], first[-1]), sites.y1[seen], sites.y2[seen], mass)


def _cells(psi: np.ndarray, sites: _Sites, raster: list, light: tuple) -> tuple:
    """Prices (those of missing cells lowered until they touch), masses of the cells, and the derivative's graph."""
    phi, site = laguerre.envelope(psi, *sites.lines, *raster)
    seen = np.zeros(len(psi), bool)
    seen[site.ravel()] = True
    missing, touched, bond = np.flatnonzero(~seen), np.zeros(0, np.int64), np.zeros(0)
    if len(missing):
        back, at = laguerre.prices(phi, *sites.lines, *raster)
        psi = np.where(seen, psi, back)
        touched = site.ravel()[at[missing]].astype(np.int64)
        distance = np.hypot(sites.y1[missing] - sites.y1[touched], sites.y2[missing] - sites.y2[touched])
        bond = BOND * np.sqrt(sites.mass[missing] * light[0].mean()) / distance
    net = laguerre.borders(site, len(psi))
    mass, weight = laguerre.cells(psi, sites.y1, sites.y2, site, *net, *light)
    return psi, mass, (*net[:3], weight, mass, sites.mass, missing, touched, bond)


def _newton(psi, sites: _Sites, raster: list, light: tuple, tolerance: float, most: int) -> tuple[np.ndarray, float, int]:
    """Prices whose cells hold the sites' masses, the light still in a wrong cell, and the steps taken."""
    psi, mass, graph = _cells(psi, sites, raster, light)
    excess = mass - sites.mass
    error = 0.5 * float(np.abs(excess).sum())
    for step in range(most):
        if error < tolerance or len(psi) == 1:
            return psi, error, step
        change, _ = Multigrid(*matrix(*graph)).solve(excess - excess.mean(), LINEAR_TOLERANCE)
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
    """phi and its gradient, averaged with a triangle over 2 `smooth` source cells, at the cells' corners: (3, n + 1, m + 1)."""
    box = np.ones(max(round(FINE * smooth), 1))
    kernel = np.convolve(np.convolve(box, box), (1.0, 1.0))  # of even length: centred between two raster points, as corners are
    kernel /= kernel.sum()
    pad = FINE * int(np.ceil(len(kernel) / (2 * FINE)))
    x1, x2 = (centres(FINE * s, h, pad) for s, h in zip(shape, half, strict=True))
    m, low, out = shape[1], pad - len(kernel) // 2, np.empty((3, shape[0] + 1, shape[1] + 1))
    for j in range(0, m + 1, STRIP):
        count = min(STRIP, m + 1 - j)
        at = low + FINE * j
        phi, site = laguerre.envelope(psi, *sites.lines, x1, x2[at : at + FINE * (count - 1) + len(kernel)])
        laguerre.averages(phi, site, sites.y1, sites.y2, kernel, FINE, low, out[:, :, j : j + count])
    return out
