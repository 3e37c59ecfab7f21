"""The first surfaces of a lens with two free-form sides: where its light lands, and which way it goes on from there.

Notation
    u       a point of the entrance plane;  e of the exit;  p of the screen, where the picture is
    q       where the light of p lands on a second screen, or where it would, behind the picture, on its way to a focus
    d, t    unit directions of light inside the glass and behind the lens

A picture on a second screen pairs p with q: rays of one wavefront go from p to q by the gradient of a convex function, to first
order in their angles, and only one such map carries the one picture to the other (Brenier 1991).  Light that leaves the picture
parallel or towards a focus is paired by that.  Either way the ray of p comes from e(p), on the straight line through p and q.  The
picture's light put there is what the entrance has to send to the exit, by transport, as if the exit were a screen in the glass; and
the exit turns each ray from d to t.  Its slopes are integrated in the least-squares sense, dark places counting little.

The entrance turns light into the glass, the exit out of it: by Snell's law both are the one formula of `surface_from_map`, with
the indices 1 / n and n.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from scipy.fft import dctn, idctn
from scipy.interpolate import LinearNDInterpolator, NearestNDInterpolator, RectBivariateSpline
from scipy.ndimage import gaussian_filter
from scipy.sparse.linalg import LinearOperator, cg
from torch import Tensor

from caustic_cli.errors import InputError
from caustic_cli.inverse.incidence import on_entrance
from caustic_cli.inverse.initial_surface import net_of
from caustic_cli.inverse.surface_from_map import integrate, slopes_to, surface
from caustic_cli.inverse.transport import corners, solve
from caustic_cli.optics.surfaces.heightfield import HeightField
from caustic_cli.scene import Scene

#: Points a cell of the exit, along each axis, that stand for the picture's light there; most to a pixel; cells over which it is
#: smoothed.
PARTS, MOST_PARTS, SMOOTH = 6, 32, 0.7
#: How often both surfaces are solved for, each time with the exit of the time before; and its heights within each.
REPEATS, HEIGHTS = 2, 6
#: What slopes count where no light goes, against where some does; below which part of the mean light that is.
DARK, LIT = 1e-2, 1e-3
#: Light to which a black picture is lifted where it is paired with another, in parts of its mean.
DARKEST = 0.02
#: Cells along each axis on which two pictures are paired, and into how many a pixel is cut at most.
PAIRED, CUT = 256, 2
#: Cells along the lens' longer side, to a pixel, and at least and most.
A_PIXEL, CELLS = 2, (96, 256)
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
class Sides:
    """Heights of both surfaces at the corners of cells over the aperture, (n + 1, m + 1) mm, the entrance's from its plane."""

    entrance: np.ndarray
    exit: np.ndarray


def first_sides(
    scene: Scene, target: np.ndarray, second: np.ndarray | None, field: HeightField, cells: int | None = None
) -> Tensor:
    """Control heights (2, n, m) mm of entrance and exit, which send the light of the source's centre to the picture and on.

    Args:
        scene: with a `second`; target, second: irradiance on its screen, and on that of its `second` if it has one.
        field: spline spaces of both sides; cells: along the lens' longer side, None for as many as the picture needs.

    Raises:
        InputError: as of `sides`; or a picture out of reach of refraction.
    """
    lens, behind = scene.lens, scene.second
    assert behind is not None
    half, (least, most) = lens.half_size, CELLS
    cells = cells or min(most, max(least, A_PIXEL * max(target.shape)))
    shape = tuple(max(3, round(cells * r / max(half))) for r in half)
    x, y = (corners(n, h) for n, h in zip(shape, half, strict=True))
    near = Picture(target, scene.screen.half_size, scene.screen.z, scene.screen.shift)
    if second is not None and behind.screen is not None:
        slopes = slopes_behind(near, Picture(second, behind.screen.half_size, behind.screen.z))
    else:
        slopes = slopes_towards(near, behind.focus)
    light, directions = on_entrance(scene, x, y)
    found = sides(light, directions, half, lens.index, lens.z_in, lens.offset.thickness, near, slopes)
    return torch.stack([net_of(x, y, z, field) for z in (found.entrance, found.exit)])


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
    qx, qy = _spread(np.stack([c[lit] for c in at], -1), np.stack([c[lit] for c in lands], -1), x, y)
    far_off = far.z - near.z
    return (qx - x) / far_off, (qy - y) / far_off


def slopes_towards(near: Picture, focus: tuple[float, float, float] | None) -> tuple[np.ndarray, np.ndarray]:
    """The same of light that leaves the picture along z, or towards a focus behind it."""
    x, y = near.corners
    if focus is None:
        return np.zeros_like(x), np.zeros_like(y)
    return (focus[0] - x) / (focus[2] - near.z), (focus[1] - y) / (focus[2] - near.z)


def sides(
    light: np.ndarray,
    directions,
    half: tuple[float, float],
    index: float,
    z_in: float,
    thickness: float,
    near: Picture,
    slopes: tuple[np.ndarray, np.ndarray],
) -> Sides:
    """Both surfaces of a lens.

    Args:
        light: irradiance of the entrance plane, (n, m), any unit.
        directions: unit ones there, at the cells' corners, None for along z.
        half: of the aperture, mm; index: of the glass; z_in, thickness: of the entrance plane and the exit's mean height, mm.
        near: the picture; slopes: of the light behind it, `slopes_behind` or `slopes_towards`.

    Raises:
        InputError: light of the picture comes from beside the exit, or the entrance cannot send it there.
    """
    x, y = (corners(n, h) for n, h in zip(light.shape, half, strict=True))
    u, v = np.meshgrid(x, y, indexing="ij")
    step = float(x[1] - x[0]), float(y[1] - y[0])
    z = np.full(u.shape, thickness)
    px, py = near.corners
    lit = near.lit
    for _ in range(REPEATS):
        spline = RectBivariateSpline(x, y, z)

        def height(a, b, spline=spline):
            return spline(np.clip(a, -half[0], half[0]), np.clip(b, -half[1], half[1]), grid=False)

        at = np.full(px.shape, thickness)
        for _ in range(HEIGHTS):
            ex, ey = px - slopes[0] * (near.z - at), py - slopes[1] * (near.z - at)
            at = height(ex, ey)
        on_exit = _on_exit(near.light, ex, ey, x, y)
        front = surface(light, on_exit, half, half, 1.0 / index, thickness, z_in, directions, corrections=1)
        dx, dy, dz = front.x - u, front.y - v, thickness - front.heights
        rise = height(front.x, front.y) - thickness
        length = np.sqrt(dx * dx + dy * dy + dz * dz)
        comes = np.stack([front.x + dx / dz * rise, front.y + dy / dz * rise], -1), np.stack([dx, dy, dz], -1) / length[..., None]
        passes = np.isfinite(comes[0]).all(-1)
        d = _spread(comes[0][passes], comes[1][passes], u, v)
        d = d / np.sqrt((d * d).sum(0))
        aim = _spread(np.stack([ex[lit], ey[lit]], -1), np.stack([px[lit], py[lit]], -1), u, v)
        on = np.pad(on_exit > LIT * on_exit.mean(), 1)
        weight = np.where(on[1:, 1:] | on[:-1, 1:] | on[1:, :-1] | on[:-1, :-1], 1.0, DARK)
        for _ in range(HEIGHTS):
            z = thickness + _weighed(*slopes_to(aim[0] - u, aim[1] - v, near.z - z, d, index), step, weight)
    return Sides(front.heights - z_in, z)


def _on_exit(light: np.ndarray, ex: np.ndarray, ey: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Light of a picture whose pixels' corners come from points of the exit, on cells between lines x and y there.

    Raises:
        InputError: too much of it comes from beside them.
    """
    width = [np.median(np.hypot(*(np.diff(c, axis=k) for c in (ex, ey)))) / (a[1] - a[0]) for k, a in enumerate((x, y))]
    count = min(MOST_PARTS, max(1, math.ceil(PARTS * max(width))))
    parts = (np.arange(count) + 0.5) / count
    total = np.zeros((len(x) - 1, len(y) - 1))
    for a in parts:
        for b in parts:
            at = [
                (1 - a) * (1 - b) * c[:-1, :-1] + a * (1 - b) * c[1:, :-1] + (1 - a) * b * c[:-1, 1:] + a * b * c[1:, 1:]
                for c in (ex, ey)
            ]
            total += np.histogram2d(at[0].ravel(), at[1].ravel(), bins=(x, y), weights=light.ravel())[0]
    beside = 1.0 - total.sum() / (count**2 * light.sum())
    if beside > BESIDE:
        reach = [float(np.abs(c[:-1, :-1][light > 0]).max()) for c in (ex, ey)]
        raise InputError(
            f"{beside:.0%} of the picture's light would have to come from beside the lens, up to {reach[0]:.3g} and {reach[1]:.3g}"
            " mm from its axis: a larger ⟨lens.size⟩, a smaller picture, a screen nearer the lens, or pictures that are more alike"
        )
    return gaussian_filter(total, SMOOTH)


def _spread(points: np.ndarray, values: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Values (N, k) at scattered points (N, 2), linear between them and the nearest beyond, at x, y: (k, *x.shape)."""
    at = np.stack([x.ravel(), y.ravel()], -1)
    found = LinearNDInterpolator(points, values)(at)
    beyond = np.isnan(found).any(-1)
    if beyond.any():
        found[beyond] = NearestNDInterpolator(points, values)(at[beyond])
    return found.T.reshape(values.shape[1], *x.shape)


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


def _weighed(sx: np.ndarray, sy: np.ndarray, step: tuple[float, float], weight: np.ndarray) -> np.ndarray:
    """The surface of mean 0 whose differences are nearest to the slopes, each squared miss times a weight: conjugate gradients with
    the unweighted problem's solution as preconditioner."""
    n, m = sx.shape
    wx, wy = np.minimum(weight[1:], weight[:-1]) / step[0] ** 2, np.minimum(weight[:, 1:], weight[:, :-1]) / step[1] ** 2

    def divergence(gx: np.ndarray, gy: np.ndarray) -> np.ndarray:
        return -(np.diff(gx, axis=0, prepend=0.0, append=0.0) + np.diff(gy, axis=1, prepend=0.0, append=0.0)).ravel()

    def laplacian(z: np.ndarray) -> np.ndarray:
        z = z.reshape(n, m)
        return divergence(wx * np.diff(z, axis=0), wy * np.diff(z, axis=1))

    modes = [(2.0 * np.sin(0.5 * np.pi * np.arange(k) / k) / h) ** 2 for k, h in zip((n, m), step, strict=True)]
    spectrum = modes[0][:, None] + modes[1]
    spectrum[0, 0] = np.inf

    def inverse(r: np.ndarray) -> np.ndarray:
        return idctn(dctn(r.reshape(n, m), norm="ortho") / spectrum, norm="ortho").ravel()

    right = divergence(wx * 0.5 * (sx[1:] + sx[:-1]) * step[0], wy * 0.5 * (sy[:, 1:] + sy[:, :-1]) * step[1])
    shape = (n * m, n * m)
    z, _ = cg(
        LinearOperator(shape, matvec=laplacian),
        right,
        x0=integrate(sx, sy, step).ravel(),
        M=LinearOperator(shape, matvec=inverse),
        rtol=1e-6,
        maxiter=200,
    )
    return z.reshape(n, m) - z.mean()
