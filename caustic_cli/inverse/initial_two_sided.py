"""Initial surfaces of a lens with two free-form sides, from prescribed landing points and directions behind the picture.

Notation
    u       a point of the entrance plane;  e of the exit;  p of the screen, where the picture is
    q       the landing point of the light of p on a second screen, parallel to the first, or a common focus
    d, t    unit directions of light inside the glass and behind the lens

Screens may be tilted: p and q are points in space, which pictures pair in their own coordinates.

Two pictures determine the map p -> q: to first order in the angles the rays of one wavefront follow the gradient of a convex
function, and exactly one such map transports one picture to the other (Brenier 1991).  Collimated or focused light determines it
directly.  The ray of p leaves the exit at e(p) on the straight line through p and q, or through their images by other elements
(`lens_space`).  This gives the irradiance required on the
exit, to which the entrance is solved by transport, with the exit as a curved screen inside the glass; the exit deflects each ray
from d to t and is fitted to the slopes required where rays meet it.

Both surfaces obey the same vector form of Snell's law (`surface_from_map`), with index 1 / n for the entrance and n for the exit.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
import torch
from scipy.ndimage import gaussian_filter, map_coordinates
from torch import Tensor

from caustic_cli.errors import InputError
from caustic_cli.inverse.incidence import on_entrance
from caustic_cli.inverse.initial_surface import net_of
from caustic_cli.inverse.internal_rays import internal_rays, interpolate_scattered
from caustic_cli.inverse.lens_space import lines_behind
from caustic_cli.inverse.projection import ScreenProjection
from caustic_cli.inverse.scattered import Pixels
from caustic_cli.inverse.surface_from_map import slopes_to, surface
from caustic_cli.inverse.surface_from_slopes import fitted
from caustic_cli.inverse.transport import cell_lines, corners, solve
from caustic_cli.optics.screen_shape import points_in_space
from caustic_cli.optics.surfaces.heightfield import HeightField
from caustic_cli.scene import Scene, Screen
from caustic_cli.scene.screen import Sags

#: Samples per cell of the exit along each axis for the light of the picture there; most per pixel; smoothing, cells.
PARTS, MOST_PARTS, SMOOTH = 6, 32, 0.7
#: Alternating solutions for both surfaces, of which all but the last are on cells and knot spans coarser by a factor; iterations
#: for the intersection of a ray with the exit; fits of the first exit.
REPEATS, COARSER, HEIGHTS, FIRST_FITS = 3, 2, 6, 2
#: Rays per control point for the fit of the exit.
RAYS_A_CONTROL = 4
#: Lower bound of a picture over its mean, for the transport between two pictures.
DARKEST = 0.02
#: Cells along each axis for the transport between two pictures, and most subdivisions of a pixel.
PAIRED, CUT = 256, 2
#: Cells along the lens' longer side: per pixel, at least and at most; as many as knot spans if these are more.
A_PIXEL, CELLS = 2, (96, 1024)
#: Fraction of the light of the picture that may fall outside the aperture of the exit.
BESIDE = 0.02


@dataclass(frozen=True, eq=False)
class PlacedPicture:
    """A picture on a screen: irradiance (k, l), half sizes and centre of it in the screen's own coordinates, mm."""

    light: np.ndarray
    screen: Screen
    half: tuple[float, float]
    centre: tuple[float, float] = (0.0, 0.0)

    @classmethod
    def on(cls, screen: Screen, light: np.ndarray) -> PlacedPicture:
        """One that fills its screen."""
        return cls(light, screen, screen.half_size)

    @property
    def corners(self) -> list[np.ndarray]:
        """Own coordinates of the corners of its pixels, (k + 1, l + 1) each, mm."""
        lines = (c + corners(n, h) for n, h, c in zip(self.light.shape, self.half, self.centre, strict=True))
        return np.meshgrid(*lines, indexing="ij")

    @property
    def points(self) -> np.ndarray:
        """These corners in space, (3, k + 1, l + 1) mm."""
        return np.stack(points_in_space(self.screen, *self.corners))

    @property
    def lit(self) -> np.ndarray:
        """Corners of pixels that are not black, (k + 1, l + 1) bool."""
        on = np.pad(self.light > 0, 1)
        return on[1:, 1:] | on[:-1, 1:] | on[1:, :-1] | on[:-1, :-1]

    def pixels(self, ex: np.ndarray, ey: np.ndarray) -> Pixels:
        """Its pixels, where their light leaves the exit: x and y there of the corners, mm, bilinear in between."""

        def on_exit(x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            at = [n * 0.5 * (c / h + 1.0) for c, n, h in zip((x, y), self.light.shape, self.half, strict=True)]
            found = [map_coordinates(e, at, order=1, mode="nearest") for e in (ex, ey)]
            return found[0], found[1]

        return Pixels(self.light, self.half, on_exit)


@dataclass(frozen=True, eq=False)
class _CellGrid:
    """Grid of cells over the aperture, with corners x (n + 1,), y (m + 1,), mm."""

    x: np.ndarray
    y: np.ndarray

    @classmethod
    def of(cls, half: tuple[float, float], cells: int) -> _CellGrid:
        """A grid with this number of cells along the longer side."""
        return cls(*cell_lines(half, cells))

    @property
    def corners(self) -> list[np.ndarray]:
        """Coordinates of the cells' corners, (n + 1, m + 1) each, mm."""
        return np.meshgrid(self.x, self.y, indexing="ij")

    def at(self, values: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """Values at corners, interpolated linearly at points x, y, mm, and constant beyond the border."""
        places = [(c - line[0]) / (line[1] - line[0]) for c, line in zip((x, y), (self.x, self.y), strict=True)]
        return map_coordinates(values, places, order=1, mode="nearest")

    def heights(self, field: HeightField, net: Tensor) -> np.ndarray:
        """A surface's heights at the corners, (n + 1, m + 1) mm."""
        u, v = (s.matrix(torch.from_numpy(0.5 * (c / c[-1] + 1.0))) for s, c in zip(field.spaces, (self.x, self.y), strict=True))
        return (u @ net @ v.T).numpy()


def first_sides(
    scene: Scene, target: np.ndarray, second: np.ndarray | None, field: HeightField, cells: int | None = None
) -> Tensor:
    """Control heights (2, n, m) mm of entrance and exit, for light of the centre of the source.

    Args:
        scene: with a `second`; target, second: irradiance on its screen, and on that of its `second` if it has one.
        field: spline spaces of both sides; cells: along the lens' longer side, None for as many as the picture needs.

    Raises:
        InputError: light of the picture would come from outside the exit, or cannot be refracted there.
    """
    behind, thickness = scene.second_target, scene.lens.offset.thickness
    assert behind is not None
    least, most = CELLS
    cells = cells or min(
        most, max(least, A_PIXEL * max(target.shape), *(n - p for n, p in zip(field.shape, scene.lens.degree, strict=True)))
    )
    levels = [_level(scene, field, cells, COARSER)] * (REPEATS - 1) + [_level(scene, field, cells, 1)]
    near = PlacedPicture.on(scene.screen, target)
    if second is not None and behind.screen is not None:
        slopes = slopes_behind(near, PlacedPicture.on(behind.screen, second))
    else:
        slopes = slopes_towards(near, behind.focus)
    points, slopes = lines_behind(scene, near.points, slopes)
    scene, lit = replace(scene, elements=scene.in_front), near.lit
    px, py, pz = points
    flat = [torch.full(levels[0].field.shape, z, dtype=torch.float64) for z in (0.0, thickness)]
    level, nets = levels[0], torch.stack(flat)
    for k, now in enumerate(levels):
        grid = now.grid
        front, exit = (grid.heights(level.field, net) for net in nets)
        at = np.full(px.shape, thickness)
        for _ in range(HEIGHTS if k else 1):  # the first step is exact for a flat exit
            ex, ey = px - slopes[0] * (pz - at), py - slopes[1] * (pz - at)
            at = grid.at(exit, ex, ey)
        on_exit = _on_exit(near.light, ex, ey, grid)
        aim = interpolate_scattered(np.stack([ex[lit], ey[lit]]), points[:, lit], *grid.corners)
        pixels = near.pixels(ex, ey) if k else None
        entrance = net_of(grid.x, grid.y, _entrance(scene, grid, front, on_exit, exit, pixels), now.field)
        level, nets = now, torch.stack([entrance, net_of(grid.x, grid.y, exit, now.field)])
        for _ in range(1 if k else FIRST_FITS):
            nets[1] = _exit(scene, level.field, nets, grid, aim)
    return nets


@dataclass(frozen=True, eq=False)
class _Level:
    """Cells and spline spaces of both surfaces at a resolution."""

    grid: _CellGrid
    field: HeightField


def _level(scene: Scene, field: HeightField, cells: int, coarser: int) -> _Level:
    """A level with cells and knot spans coarser by a factor."""
    lens = scene.lens
    if coarser > 1 and lens.knots is None:
        control = [max(p + 1, -(-(n - p) // coarser) + p) for n, p in zip(field.shape, lens.degree, strict=True)]
        field = HeightField.of(replace(lens, control=(control[0], control[1])))
    return _Level(_CellGrid.of(lens.half_size, -(-cells // coarser)), field)


def slopes_behind(near: PlacedPicture, far: PlacedPicture) -> np.ndarray:
    """Slopes (dx/dz, dy/dz) of the rays from the pixel corners of the near picture to the far one, (2, k + 1, l + 1), by optimal
    transport."""
    small = [_resampled(p) for p in (near, far)]
    if np.count_nonzero(small[0].light) * small[1].light.size > np.count_nonzero(small[1].light) * small[0].light.size:
        found = solve(small[0].light, small[1].light, small[0].half, small[1].half, darkest=DARKEST)
        at, lands = small[0].corners, [found.x + small[1].centre[0], found.y + small[1].centre[1]]
        lit = small[0].lit
    else:  # from the picture with fewer black pixels, for which the transport converges faster
        found = solve(small[1].light, small[0].light, small[1].half, small[0].half, darkest=DARKEST)
        at, lands = [found.x + small[0].centre[0], found.y + small[0].centre[1]], small[1].corners
        lit = small[1].lit
    found = interpolate_scattered(np.stack([c[lit] for c in at]), np.stack([c[lit] for c in lands]), *near.corners)
    return _slopes(np.stack(points_in_space(far.screen, *found)) - near.points)


def slopes_towards(near: PlacedPicture, focus: tuple[float, float, float] | None) -> np.ndarray:
    """The same for light that leaves the picture along the normal of its screen, or towards a focus behind it, mm."""
    points = near.points
    if focus is None:
        return _slopes(np.broadcast_to(np.reshape(near.screen.axes[2], (3, 1, 1)), points.shape))
    return _slopes(np.reshape(focus, (3, 1, 1)) - points)


def _slopes(ahead: np.ndarray) -> np.ndarray:
    """Slopes (2, ...) of directions (3, ...) of any length."""
    return ahead[:2] / ahead[2]


def _entrance(
    scene: Scene, grid: _CellGrid, front: np.ndarray, on_exit: np.ndarray, exit: np.ndarray, pixels: Pixels | None
) -> np.ndarray:
    """Heights of the entrance at the corners of the cells, from its plane, mm, for an irradiance on the exit.

    Args:
        front: approximate ones, where the light of the source meets them, see `on_entrance`.
        on_exit: irradiance on the cells there, any unit; exit: heights of the exit at their corners, mm.
        pixels: of the picture, where their light leaves the exit; None for a flat exit.
    """
    lens = scene.lens
    light, directions = on_entrance(scene, grid.x, grid.y, lens.z_in + front)
    z, half, centre, projection = lens.offset.thickness, lens.half_size, (0.0, 0.0), None
    if pixels is not None and (to := pixels.project):
        projection = seen = ScreenProjection(Screen(lens.size, z, on_exit.shape, sags=Sags(exit - z, lens.size)), lens.z_in)
        on_exit, half, centre = seen.projected_target(on_exit)
        pixels = replace(pixels, project=lambda x, y: seen.project(*to(x, y)), centre=centre)
    found = surface(
        light,
        on_exit,
        lens.half_size,
        half,
        1.0 / lens.index,
        z,
        lens.z_in,
        directions,
        corrections=1,
        centre=centre,
        projection=projection,
        pixels=pixels,
    )
    return found.heights - lens.z_in


def _exit(scene: Scene, field: HeightField, nets: Tensor, grid: _CellGrid, aim: np.ndarray) -> Tensor:
    """The control net (n, m), mm, of an exit that deflects the rays from the entrance towards points on the screen.

    Args:
        nets: of both surfaces, (2, n, m) mm; aim: target points of the rays from the corners of the cells, (3, ...) mm.
    """
    light = internal_rays(scene, field, nets, RAYS_A_CONTROL * nets[1].numel())
    x, y, z = light.exit
    px, py, pz = (grid.at(a, x, y) for a in aim)
    slopes = slopes_to(px - x, py - y, pz - z, light.direction, scene.lens.index)
    at, asked = ((torch.from_numpy(a), torch.from_numpy(b)) for a, b in ((x, y), slopes))
    return fitted(field, at, asked, torch.from_numpy(light.power), nets[1])


def _on_exit(light: np.ndarray, ex: np.ndarray, ey: np.ndarray, grid: _CellGrid) -> np.ndarray:
    """Power of a picture on the cells of the exit, given the exit points (ex, ey) of the corners of its pixels.

    Raises:
        InputError: too much of it falls outside the aperture.
    """
    lines = grid.x, grid.y
    width = [np.median(np.hypot(*(np.diff(c, axis=k) for c in (ex, ey)))) / (a[1] - a[0]) for k, a in enumerate(lines)]
    count = min(MOST_PARTS, max(1, math.ceil(PARTS * max(width))))
    parts = (np.arange(count) + 0.5) / count
    total = np.zeros([len(a) - 1 for a in lines])
    for a in parts:
        for b in parts:
            at = [
                (1 - a) * (1 - b) * c[:-1, :-1] + a * (1 - b) * c[1:, :-1] + (1 - a) * b * c[:-1, 1:] + a * b * c[1:, 1:]
                for c in (ex, ey)
            ]
            total += np.histogram2d(at[0].ravel(), at[1].ravel(), bins=lines, weights=light.ravel())[0]
    beside = 1.0 - total.sum() / (count**2 * light.sum())
    if beside > BESIDE:
        reach = [float(np.abs(c[:-1, :-1][light > 0]).max()) for c in (ex, ey)]
        raise InputError(
            f"{beside:.0%} of the picture's light would have to come from outside the lens, up to {reach[0]:.3g} and {reach[1]:.3g}"
            " mm from its axis: a larger ⟨lens.size⟩, a smaller picture, a screen nearer the lens, or pictures that are more alike"
        )
    return gaussian_filter(total, SMOOTH)


def _resampled(picture: PlacedPicture) -> PlacedPicture:
    """The picture resampled to about PAIRED cells along each axis: pixels subdivided or binned, zero-padded at the high edges."""
    light = picture.light
    cut = [min(CUT, max(1, round(PAIRED / n))) for n in light.shape]
    light = np.repeat(np.repeat(light, cut[0], 0), cut[1], 1)
    by = [max(1, round(n / PAIRED)) for n in light.shape]
    light = np.pad(light, [(0, -n % b) for n, b in zip(light.shape, by, strict=True)])
    grown = [n / (m * c) for n, m, c in zip(light.shape, picture.light.shape, cut, strict=True)]
    light = light.reshape(light.shape[0] // by[0], by[0], light.shape[1] // by[1], by[1]).sum((1, 3))
    half = picture.half[0] * grown[0], picture.half[1] * grown[1]
    x, y = (c + g - h for c, g, h in zip(picture.centre, half, picture.half, strict=True))
    return PlacedPicture(light, picture.screen, half, (x, y))
