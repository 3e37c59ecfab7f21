"""From an optimal transport map to a refracting or reflecting surface: heights whose rays land at the images of the map.

Notation
    p = (x, y, z)    a point of the exit surface;  d its ray inside the glass, a unit vector
    T                its target point on the plane z_screen;  t = (T - p) / |T - p|, the direction required behind the surface
    N                normal (-z_x, -z_y, 1), parallel to n d - t by Snell's law in vector form (thesis eq. 2.1.10), so

                     z_x = (t_x - n d_x) / (n d_z - t_z),    z_y likewise

T = grad phi, so to first order in all angles z = (phi - |(x, y)|^2 / 2) / ((n - 1) D), D = z_screen - z.  That part is taken
analytically; only the remaining slopes are integrated, in the least-squares sense (a Poisson equation by the cosine transform,
Strang, SIAM Review 41, 1999).  Since t depends on z, this is a fixed-point iteration at constant mean height.

The required slopes are not exactly integrable.  The residual displaces the landing points by e(x, y), a smooth field that grows
with the angles.  It is corrected by an outer iteration: each point mass of the picture is moved by -e at the point that illuminates
it, the transport is solved again (`scattered`), and rays are aimed at T + e.

For a tilted or curved screen T and e are points of the plane z_screen in central projection (`projection`); rays are aimed at the
point of the screen that projects to T, and landing points are projected back.
"""

from __future__ import annotations

import math
import time
from dataclasses import dataclass, replace

import numpy as np
import torch
from scipy.fft import dctn, idctn
from scipy.ndimage import gaussian_filter

from caustic_cli.errors import InputError
from caustic_cli.inverse.projection import CrossedProjection, ScreenProjection
from caustic_cli.inverse.relay import RelayedScreen
from caustic_cli.inverse.scattered import Pixels
from caustic_cli.inverse.transport import LEVELS, Transport, corners, solve, solve_displaced
from caustic_cli.optics.backends.reference import Torch
from caustic_cli.optics.bspline import GridSpline
from caustic_cli.optics.frames import IDENTITY
from caustic_cli.optics.strips import each_strip

Projection = ScreenProjection | RelayedScreen | CrossedProjection  # of a screen that is not the plane z_screen
#: Largest difference of the length of a direction from 1, and one that is none.
LONGEST, UNIT = 0.5, 1e-6
#: Cells over which e is smoothed, each with its share where there is light: wide averages count where there is none nearby.
SMOOTHING = {2.0: 1.0, 8.0: 1e-3, 32.0: 1e-6}
DISTINCT = 1e-9  # least usual stretch over the greatest, where most light goes to one point
KINK = 3.0  # stretch of the map, in its median, from which e is not that of T: at a kink of phi the spline smooths the slopes
NEGLIGIBLE = 0.05  # RMS of e, pixels, that is not corrected
#: Options of the first map onto pixels in a projection, from which e is known: a quarter of the sites.
ROUGHLY = {"tolerance": 1e-2, "most": 10, "levels": LEVELS[:-1], "times": 1}
#: By what factor the point masses are fewer of which the first map with displaced ones is found, and its options.
FEWER, FEW = 4, {"tolerance": 1e-2, "most": 30, "times": 1}
REPEATS = 4  # most fixed-point iterations; each reduces the error by a factor of about angle^2 / throw
SLOPES = (1, 0), (0, 1)  # orders of derivatives
CONVERGED = 1e-10  # largest expected change of a height in the next iteration, mm


class OutOfReach(InputError):
    """The map requires a deflection beyond the limit of refraction; where: at which corners, (n + 1, m + 1) bool."""

    def __init__(self, where: np.ndarray):
        super().__init__("the picture cannot be reached by refraction: a smaller picture or a longer throw is needed")
        self.where = where


@dataclass(frozen=True, eq=False)
class MappedSurface:
    """A surface that realises a transport map, and its landing points."""

    #: z at the corners of the source cells, (n + 1, m + 1) float64, mm.
    heights: np.ndarray
    #: Landing points of the rays from there, mm, with the gradient of the bicubic spline through z.
    x: np.ndarray
    y: np.ndarray
    #: RMS distance between landing points and targets, weighted by the source, mm.
    miss: float
    #: e, the total displacement of the picture, (2, n + 1, m + 1) mm.
    shift: np.ndarray
    #: Number of outer iterations.
    corrections: int
    #: The last map.
    transport: Transport
    #: Wall time.
    seconds: float


def surface(
    source,
    target,
    source_half,
    target_half,
    index,
    z_screen,
    thickness,
    directions=None,
    *,
    corrections=2,
    centre=(0.0, 0.0),
    projection: Projection | None = None,
    pixels: Pixels | None = None,
    **options,
) -> MappedSurface:
    """Surface that maps the irradiance `source` onto the picture `target` on a plane.

    Args:
        source: irradiance of the exit surface per area projected along z, (n, m), any unit; where it is 0 the surface is
            extrapolated.
        target: the picture, (k, l), any unit; half sizes in mm as for `transport.solve`.
        index: of the glass, with 1 outside; its inverse for a surface by which light enters the glass; -1 for a mirror.
        z_screen, thickness: the screen's plane and the surface's mean height, mm.
        directions: inside the glass at those corners, of the length of the index there over `index`, three (n + 1, m + 1) arrays,
            or None for (0, 0, 1).
        corrections: most outer iterations.
        centre: of the picture on the plane, mm.
        projection: of a screen that does not lie in that plane; target, centre and landing points are then projected.
        pixels: of the picture, where they lie in these coordinates; None where they are those of target.
        options: of `transport.solve`.

    Raises:
        InputError: as `transport.solve`; an index out of range, a screen not behind the surface, or directions that are not unit
            vectors towards it.
        OutOfReach: light cannot be refracted to the picture.
    """
    began = time.perf_counter()
    shape = np.shape(source)
    _check_place(index, z_screen, thickness)
    d = _directions(directions, (shape[0] + 1, shape[1] + 1))
    half = tuple(float(h) for h in source_half)
    rough = projection is not None and corrections > 0
    map_ = solve(source, target, half, target_half, **{**options, **(ROUGHLY if rough else {})})
    options.pop("start", None)
    x, y = corners(shape[0], half[0])[:, None], corners(shape[1], half[1])[None, :]
    light, pixel = _at_corners(source), min(2.0 * h / s for h, s in zip(target_half, np.shape(target), strict=True))
    masses = pixels or Pixels(np.asarray(target), target_half)
    aim, shift = (map_.x + centre[0], map_.y + centre[1]), np.zeros((2, *light.shape))
    for again in range(corrections + 1):
        z = heights(map_, aim, x, y, d, index, z_screen, thickness, light > 0, projection)
        landing = land(z, x, y, d, index, z_screen, projection)
        off = np.nan_to_num(np.stack([w - t for w, t in zip(landing, aim, strict=True)]))
        miss = _rms(off, light)
        off = _smoothed(off, map_)
        settled = not _rms(off, light) > NEGLIGIBLE * pixel
        if not rough and (settled or again == corrections):
            break
        if settled and projection and projection.aligned:
            map_ = solve(source, target, half, target_half, start=map_.potential, **options)
        else:
            known = map_.solved.sites if shift.any() else None
            shift = shift + off
            map_ = _displaced(masses, known, source, half, map_.potential, shift, rough, options)
        rough = False
        aim = map_.x + shift[0] + centre[0], map_.y + shift[1] + centre[1]
    return MappedSurface(z, *landing, miss, shift, again, map_, time.perf_counter() - began)


def _displaced(
    masses: Pixels, known, source, half, potential: np.ndarray, shift: np.ndarray, rough: bool, options: dict
) -> Transport:
    """The map onto the masses of the picture displaced by -shift, where a map of this potential sends them.

    known: their sites, if they have been displaced before; rough: find a map of few of them first.
    """
    start = None
    if known is None and rough:
        some = masses.sites(source, half, FEWER)
        start = solve_displaced(source, some, half, potential, shift, **{**options, **FEW}, fewer=FEWER).potential
    known = masses.sites(source, half, times=options.get("times", 1)) if known is None else replace(known, mass=known.spots.mass)
    return solve_displaced(source, known, half, potential, shift, start=start, **options)


def _at_corners(source) -> np.ndarray:
    """Light at the corners of source cells (n, m), that of the cells around each: (n + 1, m + 1), of sum 1."""
    light = np.pad(np.asarray(source, dtype=np.float64), 1)
    light = light[1:, 1:] + light[:-1, 1:] + light[1:, :-1] + light[:-1, :-1]
    return light / light.sum()


def _rms(off: np.ndarray, light: np.ndarray) -> float:
    """RMS of displacements (2, n + 1, m + 1), weighted by the light."""
    return float(np.sqrt((light * (off**2).sum(0)).sum()))


def _check_place(index: float, z_screen: float, thickness: float) -> None:
    if not (index == -1.0 or 1.0 < index <= 5.0 or 0.2 <= index < 1.0):
        raise InputError(f"index must be more than 1 and at most 5, or its inverse, got {index!r}")
    if not (np.isfinite(z_screen) and np.isfinite(thickness) and math.copysign(1.0, index) * (z_screen - thickness) > 0):
        where = "beyond the lens'" if index > 0 else "before the mirror's"
        raise InputError(f"the screen at {z_screen!r} mm must lie {where} height of {thickness!r} mm")


def finer(
    start: MappedSurface,
    times: int,
    source_half,
    index: float,
    z_screen: float,
    directions=None,
    *,
    centre=(0.0, 0.0),
    projection: Projection | None = None,
) -> np.ndarray:
    """Heights of the same surface on cells `times` smaller along each axis, with creases sharper by the same factor.

    Args:
        directions: as of `surface`, at the finer corners; the others as they were there.

    Where light cannot be refracted, the paraxial slope of the map is used.
    """
    map_ = start.transport.finer(times)
    coarse, fine = ([corners(k * n, h) for n, h in zip(start.transport.solved.shape, source_half, strict=True)] for k in (1, times))
    shift = [GridSpline(*coarse, e)(*fine) for e in start.shift] if start.shift.any() else (0.0, 0.0)
    x, y = fine[0][:, None], fine[1][None, :]
    aim = tuple(t + e + c for t, e, c in zip((map_.x, map_.y), shift, centre, strict=True))
    d, dark = _directions(directions, map_.potential.shape), np.zeros(map_.potential.shape, bool)
    return heights(map_, aim, x, y, d, index, z_screen, float(start.heights.mean()), dark, projection)


def _smoothed(off: np.ndarray, map_: Transport) -> np.ndarray:
    """Displacements (2, n + 1, m + 1), mm, smoothed over cells, without those where the map stretches the light far more than on
    average: there the spline smooths a kink, and theirs are those around."""
    stretch = sum(np.gradient(c, axis=axis) ** 2 for c in (map_.x, map_.y) for axis in (0, 1))
    usual = max(float(np.median(stretch)), DISTINCT * float(stretch.max())) or 1.0
    weight = 1.0 / (1.0 + (stretch / (KINK**2 * usual)) ** 2)
    total, part = np.zeros_like(off), np.zeros_like(weight)
    for width, share in SMOOTHING.items():
        part += share * gaussian_filter(weight, width)
        total += share * np.stack([gaussian_filter(weight * c, width) for c in off])
    return total / part


def _directions(directions, shape) -> tuple:
    if directions is None:
        return 0.0, 0.0, 1.0
    d = tuple(np.asarray(v, dtype=np.float64) for v in directions)
    if len(d) != 3 or any(v.shape != tuple(shape) for v in d):
        raise InputError(f"directions must be three arrays of shape {tuple(shape)}, a corner of a source cell each")
    if not (np.abs(_length(d) - 1.0) < LONGEST).all() or (d[2] <= 0).any():  # NaN is not
        raise InputError("directions must be finite vectors of a length near 1 with a positive z component")
    return d


def _length(d: tuple) -> np.ndarray:
    """Lengths of vectors."""
    return np.sqrt(d[0] ** 2 + d[1] ** 2 + d[2] ** 2)


def heights(
    map_: Transport, aim, x, y, d, index: float, z_screen: float, mean: float, lit: np.ndarray, projection: Projection | None = None
) -> np.ndarray:
    """Heights at the corners x (n + 1, 1), y (1, m + 1), mm, whose rays land at `aim`, in the least-squares sense.

    Args:
        map_: a map close to `aim` (two arrays, mm): its potential is taken analytically, and only the remainder integrated.
        d, index, z_screen, mean: ray directions in the glass, its index, the screen's plane and the heights' mean, mm.
        lit: (n + 1, m + 1) bool, corners with light; others that are out of reach take the paraxial slope of the map.
        projection: as of `surface`.

    The normal of a mirror is parallel to d - t, as for index 1, and t points backwards.

    Raises:
        OutOfReach: light of a lit corner cannot be refracted to its target point.
    """
    step = float(x[1, 0] - x[0, 0]), float(y[0, 1] - y[0, 0])
    scale = 1.0 / ((index - 1.0) * (z_screen - mean) if projection is None else projection.gain(index))
    sign, (cx, cy) = (1.0, (1.0, 1.0)) if projection is None else (projection.sign, projection.axial_scale)
    main = (scale * sign) * map_.potential
    main -= (0.5 * scale) * (cx * x * x + cy * y * y)
    z = main - main.mean() + mean
    towards = None if projection is None else projection.directions_to(*aim)
    within, rest = np.empty(z.shape, bool), np.empty((2, *z.shape))

    def remainder(rows: slice) -> None:
        """The slopes there beyond those of `main`."""
        to = tuple(c[rows] for c in ahead) if ahead else (aim[0][rows] - x[rows], aim[1][rows] - y, z_screen - z[rows])
        light = tuple(v[rows] if isinstance(v, np.ndarray) else v for v in d)
        within[rows] = turned = refracted(*to, light, index)
        slope = scale * (sign * map_.x[rows] - cx * x[rows]), scale * (sign * map_.y[rows] - cy * y)
        for w, s, out in zip(slopes_to(*to, light, index), slope, rest, strict=True):
            out[rows] = np.where(turned, w - s, 0.0)

    moved = 0.0
    for _ in range(REPEATS):
        ahead = towards(x, y, z) if towards else None
        each_strip(len(z), remainder)
        if not within[lit].all():
            raise OutOfReach(lit & ~within)
        before, z = z, main + integrate(*rest, step)
        z += mean - z.mean()
        before, moved = moved, float(np.abs(z - before).max())
        if moved * moved <= CONVERGED * before or moved == 0.0:  # linear convergence
            break
    return z


def refracted(tx, ty, tz, d, index: float) -> np.ndarray:
    """Where a surface can deflect rays d towards (tx, ty, tz): from glass of that index into air, into glass of 1 / index, or by
    reflection (-1)."""
    forward = math.copysign(1.0, index)
    turns = max(index, 1.0 / index) if index > 0 else index
    length = np.sqrt(tx * tx + ty * ty + tz * tz)
    return (turns * (d[0] * tx + d[1] * ty + d[2] * tz) > forward * length) & (forward * tz > 0)  # t . N > 0


def slopes_to(tx, ty, tz, d, index: float) -> tuple[np.ndarray, np.ndarray]:
    """Slopes of the surface that deflects rays d towards (tx, ty, tz), see above; meaningless where none can (`refracted`)."""
    n = abs(index)
    length = np.sqrt(tx * tx + ty * ty + tz * tz)
    lean = n * d[2] - tz / length  # N_z, up to a factor
    lean = np.where(lean == 0.0, 1.0, lean)
    return (tx / length - n * d[0]) / lean, (ty / length - n * d[1]) / lean


def integrate(sx: np.ndarray, sy: np.ndarray, step: tuple[float, float]) -> np.ndarray:
    """Least-squares integration of slopes: the surface (n, m) of mean 0 whose differences are closest to the slopes at its
    points."""
    right = np.empty_like(sx)
    each_strip(len(sx), lambda rows: _divergence(sx, sy, step, rows, right))
    wave = [(2.0 / h * np.sin(0.5 * np.pi * np.arange(n) / (n - 1))) ** 2 for n, h in zip(sx.shape, step, strict=True)]
    workers = torch.get_num_threads()
    spectrum = dctn(right, type=1, workers=workers, overwrite_x=True)
    total = wave[0][:, None] + wave[1]
    total[0, 0] = math.inf
    spectrum /= -total
    z = idctn(spectrum, type=1, workers=workers, overwrite_x=True)
    z -= z.mean()
    return z


def _divergence(sx: np.ndarray, sy: np.ndarray, step: tuple[float, float], rows: slice, out: np.ndarray) -> None:
    """Divergence of slopes (n, m) in these rows, with natural (Neumann) boundary conditions: border points have half a cell."""
    first, last, n = rows.start, rows.stop, len(sx)
    ahead, back = (np.arange(first, last) + k for k in (1, -1))
    out[rows] = (0.5 / step[0]) * (sx[np.minimum(ahead, n - 1)] - sx[np.maximum(back, 0)])
    if first == 0:
        out[0] = (sx[0] + sx[1]) / step[0]
    if last == n:
        out[-1] = -(sx[-1] + sx[-2]) / step[0]
    along, here = sy[rows], out[rows]
    here[:, 1:-1] += (0.5 / step[1]) * (along[:, 2:] - along[:, :-2])
    here[:, 0] += (along[:, 0] + along[:, 1]) / step[1]
    here[:, -1] -= (along[:, -1] + along[:, -2]) / step[1]


def land(
    z: np.ndarray, x, y, d, index: float, z_screen: float, projection: Projection | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Landing points (n, m), mm, of the rays d through the bicubic spline of z, NaN where totally reflected: on the plane z_screen,
    or projected by `projection`."""
    slopes = GridSpline(x[:, 0], y[0], z).derivatives(x[:, 0], y[0], SLOPES)
    return refract_to_screen(x, y, z, *slopes, d, index, z_screen, projection=projection)[:2]


def refract_to_screen(
    x, y, z, zx, zy, d, index: float, z_screen: float, fresnel: str = "none", projection: Projection | None = None
) -> tuple[np.ndarray, ...]:
    """Landing points u, v of rays d (see `surface`) that leave the glass at (x, y, z) with slopes zx, zy, NaN where totally
    reflected, and their transmittance.  projection: as of `surface`; NaN where they miss its screen."""
    shape, backend = z.shape, Torch()  # too few rays to be worth compiling

    def flat(value):
        return value if isinstance(value, float) else torch.from_numpy(np.broadcast_to(value, shape).flatten())

    origin, slopes, eta, long = [flat(c) for c in (x, y, z)], (flat(zx), flat(zy)), abs(index), _length(d)
    if (np.abs(long - 1.0) > UNIT).any():  # the index varies
        d, eta = tuple(c / long for c in d), flat(eta * long)
    out = backend.interact(
        tuple(map(flat, d)),
        slopes,
        torch.ones(z.size, dtype=torch.float64),
        eta=eta,
        reflects=index < 0,
        fresnel=fresnel,
    )
    if projection is None:
        landing = backend.land(tuple(origin), out.direction, (0.0, 0.0, z_screen), IDENTITY, math.copysign(1.0, index))[:2]
        passes = out.passes
    else:
        landing = map(torch.from_numpy, projection.intersections(*(tuple(map(_array, v)) for v in (origin, out.direction))))
        passes = out.passes
    return *(torch.where(passes, c, torch.nan).view(shape).numpy() for c in landing), out.power.view(shape).numpy()


def _array(value):
    return value if isinstance(value, float) else value.numpy()
