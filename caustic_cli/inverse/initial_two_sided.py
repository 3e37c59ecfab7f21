"""The first surfaces of a lens with two free-form sides: where its light lands, and which way it goes on from there.

Notation
    u       a point of the entrance plane;  e of the exit;  p of the screen, where the picture is
    q       where the light of p lands on a second screen, or where it would, behind the picture, on its way to a focus
    d, t    unit directions of light inside the glass and behind the lens

A picture on a second screen pairs p with q: rays of one wavefront go from p to q by the gradient of a convex function, to first
order in their angles, and only one such map carries the one picture to the other (Brenier 1991).  Light that leaves the picture
parallel or towards a focus is paired by that.  Either way the ray of p comes from e(p), on the straight line through p and q.  The
picture's light put there is what the entrance has to send to the exit, by transport, as if the exit were a curved screen in the
glass; and the exit turns each ray from d to t: it is fitted to the slopes which that asks for where rays meet it.

The entrance turns light into the glass, the exit out of it: by Snell's law both are the one formula of `surface_from_map`, with
the indices 1 / n and n.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from scipy.ndimage import gaussian_filter, map_coordinates
from torch import Tensor

from caustic_cli.errors import InputError
from caustic_cli.inverse.incidence import on_entrance
from caustic_cli.inverse.initial_surface import net_of
from caustic_cli.inverse.internal_rays import rays_within, spread
from caustic_cli.inverse.projection import View
from caustic_cli.inverse.surface_from_map import slopes_to, surface
from caustic_cli.inverse.surface_from_slopes import fitted
from caustic_cli.inverse.transport import cell_lines, corners, solve
from caustic_cli.optics.surfaces.heightfield import HeightField
from caustic_cli.scene import Scene, Screen
from caustic_cli.scene.screen import Sags

#: Points a cell of the exit, along each axis, that stand for the picture's light there; most to a pixel; cells over which it is
#: smoothed.
PARTS, MOST_PARTS, SMOOTH = 6, 32, 0.7
#: How often both surfaces are solved for, each time with the exit of the time before; steps for where a ray leaves that; and how
#: often the first exit is fitted.
REPEATS, HEIGHTS, FIRST_FITS = 3, 6, 2
#: Rays that the exit is fitted to, for each of its controls.
RAYS_A_CONTROL = 4
#: Light to which a black picture is lifted where it is paired with another, in parts of its mean.
DARKEST = 0.02
#: Cells along each axis on which two pictures are paired, and into how many a pixel is cut at most.
PAIRED, CUT = 256, 2
#: Cells along the lens' longer side, to a pixel, and at least and most.
A_PIXEL, CELLS = 2, (96, 512)
#: Part of the picture's light that may come from beside the exit's aperture.
BESIDE = 0.02


@dataclass(frozen=True, eq=False)
class Picture:
    """A picture on a plane: (k, l) irradiance, half sizes, mm, the plane's z and the picture's middle there, mm."""

    light: np.ndarray
    half: tuple[float, float]
    z: float
    centre: tuple[float, float] = (0.0, 0.0)

    @property
    def corners(self) -> list[np.ndarray]:
        """Coordinates of the corners of its pixels, (k + 1, l + 1) each, mm."""
        lines = (c + corners(n, h) for n, h, c in zip(self.light.shape, self.half, self.centre, strict=True))
        return np.meshgrid(*lines, indexing="ij")

    @property
    def lit(self) -> np.ndarray:
        """Corners of pixels that are not black, (k + 1, l + 1) bool."""
        on = np.pad(self.light > 0, 1)
        return on[1:, 1:] | on[:-1, 1:] | on[1:, :-1] | on[:-1, :-1]


@dataclass(frozen=True, eq=False)
class _Aperture:
    """Lines x (n + 1,), y (m + 1,) between cells over the aperture, mm."""

    x: np.ndarray
    y: np.ndarray

    @classmethod
    def of(cls, half: tuple[float, float], cells: int) -> _Aperture:
        """So many cells along the longer side."""
        return cls(*cell_lines(half, cells))

    @property
    def corners(self) -> list[np.ndarray]:
        """Coordinates of the cells' corners, (n + 1, m + 1) each, mm."""
        return np.meshgrid(self.x, self.y, indexing="ij")

    def at(self, values: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """Values at corners, linear between them and the nearest beyond, at points, mm."""
        places = [(c - line[0]) / (line[1] - line[0]) for c, line in zip((x, y), (self.x, self.y), strict=True)]
        return map_coordinates(values, places, order=1, mode="nearest")

    def heights(self, field: HeightField, net: Tensor) -> np.ndarray:
        """A surface's heights at the corners, (n + 1, m + 1) mm."""
        u, v = (s.matrix(torch.from_numpy(0.5 * (c / c[-1] + 1.0))) for s, c in zip(field.spaces, (self.x, self.y), strict=True))
        return (u @ net @ v.T).numpy()


def first_sides(
    scene: Scene, target: np.ndarray, second: np.ndarray | None, field: HeightField, cells: int | None = None
) -> Tensor:
    """Control heights (2, n, m) mm of entrance and exit, which send the light of the source's centre to the picture and on.

    Args:
        scene: with a `second`; target, second: irradiance on its screen, and on that of its `second` if it has one.
        field: spline spaces of both sides; cells: along the lens' longer side, None for as many as the picture needs.

    Raises:
        InputError: light of the picture comes from beside the exit, or refraction cannot send it there.
    """
    lens, behind, thickness = scene.lens, scene.second, scene.lens.offset.thickness
    assert behind is not None
    least, most = CELLS
    grid = _Aperture.of(lens.half_size, cells or min(most, max(least, A_PIXEL * max(target.shape))))
    near = Picture(target, scene.screen.half_size, scene.screen.z, scene.screen.shift)
    if second is not None and behind.screen is not None:
        slopes = slopes_behind(near, Picture(second, behind.screen.half_size, behind.screen.z, behind.screen.shift))
    else:
        slopes = slopes_towards(near, behind.focus)
    (px, py), lit = near.corners, near.lit
    nets = torch.stack([torch.zeros(field.shape, dtype=torch.float64), torch.full(field.shape, thickness, dtype=torch.float64)])
    light, directions = on_entrance(scene, grid.x, grid.y)
    exit = np.full((len(grid.x), len(grid.y)), thickness)
    for k in range(REPEATS):
        at = np.full(px.shape, thickness)
        for _ in range(HEIGHTS if k else 1):  # a flat exit is met where the first step says
            ex, ey = px - slopes[0] * (near.z - at), py - slopes[1] * (near.z - at)
            at = grid.at(exit, ex, ey)
        on_exit = _on_exit(near.light, ex, ey, grid)
        aim = spread(np.stack([ex[lit], ey[lit]]), np.stack([px[lit], py[lit]]), *grid.corners)
        nets[0] = net_of(grid.x, grid.y, _entrance(scene, light, directions, on_exit, exit if k else None), field)
        for _ in range(1 if k else FIRST_FITS):
            nets[1] = _exit(scene, field, nets, grid, aim)
        exit = grid.heights(field, nets[1])
    return nets


def slopes_behind(near: Picture, far: Picture) -> tuple[np.ndarray, np.ndarray]:
    """Tangents (dx/dz, dy/dz) of the light of each corner of the near picture's pixels that goes on to the far one."""
    small = [_cells(p) for p in (near, far)]
    if np.count_nonzero(small[0].light) * small[1].light.size > np.count_nonzero(small[1].light) * small[0].light.size:
        found = solve(small[0].light, small[1].light, small[0].half, small[1].half, darkest=DARKEST)
        at, lands = small[0].corners, (found.x + small[1].centre[0], found.y + small[1].centre[1])
        lit = small[0].lit
    else:  # from the one with less black, where a transport is quick and sure
        found = solve(small[1].light, small[0].light, small[1].half, small[0].half, darkest=DARKEST)
        at, lands = [found.x + small[0].centre[0], found.y + small[0].centre[1]], small[1].corners
        lit = small[1].lit
    x, y = near.corners
    qx, qy = spread(np.stack([c[lit] for c in at]), np.stack([c[lit] for c in lands]), x, y)
    far_off = far.z - near.z
    return (qx - x) / far_off, (qy - y) / far_off


def slopes_towards(near: Picture, focus: tuple[float, float, float] | None) -> tuple[np.ndarray, np.ndarray]:
    """The same of light that leaves the picture along z, or towards a focus behind it."""
    x, y = near.corners
    if focus is None:
        return np.zeros_like(x), np.zeros_like(y)
    return (focus[0] - x) / (focus[2] - near.z), (focus[1] - y) / (focus[2] - near.z)


def _entrance(
    scene: Scene, light: np.ndarray, directions: tuple | None, on_exit: np.ndarray, exit: np.ndarray | None
) -> np.ndarray:
    """Heights of the entrance at the corners of the aperture's cells, from its plane, which send light to the exit's.

    Args:
        light, directions: on its plane, see `on_entrance`.
        on_exit: light on the cells there, any unit; exit: the exit's heights at their corners, None for a plane.
    """
    lens = scene.lens
    z, half, centre, view = lens.offset.thickness, lens.half_size, (0.0, 0.0), None
    if exit is not None:
        view = View(Screen(lens.size, z, on_exit.shape, sags=Sags(exit - z, lens.size)), lens.z_in)
        on_exit, half, centre = view.picture(on_exit)
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
        view=view,
    )
    return found.heights - lens.z_in


def _exit(scene: Scene, field: HeightField, nets: Tensor, grid: _Aperture, aim: np.ndarray) -> Tensor:
    """The net (n, m) of an exit that turns light which comes through the entrance towards its places on the screen.

    Args:
        nets: of both sides, (2, n, m) mm; aim: places for light of the exit's points at the corners of cells, (2, ...) mm.
    """
    light = rays_within(scene, field, nets, RAYS_A_CONTROL * nets[1].numel())
    x, y, z = light.exit
    px, py = (grid.at(a, x, y) for a in aim)
    slopes = slopes_to(px - x, py - y, scene.screen.z - z, light.direction, scene.lens.index)
    at, asked = ((torch.from_numpy(a), torch.from_numpy(b)) for a, b in ((x, y), slopes))
    return fitted(field, at, asked, torch.from_numpy(light.power), nets[1])


def _on_exit(light: np.ndarray, ex: np.ndarray, ey: np.ndarray, grid: _Aperture) -> np.ndarray:
    """Light of a picture whose pixels' corners come from points of the exit, on cells over the aperture.

    Raises:
        InputError: too much of it comes from beside them.
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
            f"{beside:.0%} of the picture's light would have to come from beside the lens, up to {reach[0]:.3g} and {reach[1]:.3g}"
            " mm from its axis: a larger ⟨lens.size⟩, a smaller picture, a screen nearer the lens, or pictures that are more alike"
        )
    return gaussian_filter(total, SMOOTH)


def _cells(picture: Picture) -> Picture:
    """The same light on about PAIRED cells along an axis, or fewer: pixels cut, or added up; black beyond the high edges."""
    light = picture.light
    cut = [min(CUT, max(1, round(PAIRED / n))) for n in light.shape]
    light = np.repeat(np.repeat(light, cut[0], 0), cut[1], 1)
    by = [max(1, round(n / PAIRED)) for n in light.shape]
    light = np.pad(light, [(0, -n % b) for n, b in zip(light.shape, by, strict=True)])
    grown = [n / (m * c) for n, m, c in zip(light.shape, picture.light.shape, cut, strict=True)]
    light = light.reshape(light.shape[0] // by[0], by[0], light.shape[1] // by[1], by[1]).sum((1, 3))
    half = picture.half[0] * grown[0], picture.half[1] * grown[1]
    x, y = (c + g - h for c, g, h in zip(picture.centre, half, picture.half, strict=True))
    return Picture(light, half, picture.z, (x, y))
