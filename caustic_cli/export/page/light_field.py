"""The rays of a file as a light field: a radiant intensity through the pupil for each of a number of points.

As many rays as a page holds would leave a grainy picture.  But the light itself is smooth where it meets the lens, which makes the
fine detail: its density in phase space, over two planes as of a light field (Levoy & Hanrahan 1996), that which looks smallest from
the pupil and the pupil.  All rays of the file are grouped by their intercepts with the first plane, until the groups are smaller
than pixels.  Each group becomes a point at its mean, with an intensity that is estimated by a kernel over the pupil.

Notation
    s       intercept of a ray with the first plane, mm;  h   distance of the pupil behind it, negative if light converges
    p       intercept with the pupil, mm;  r, cos(theta)   distance from s to p, and of that way to the z axis
    w       fraction of the source's power;  I(p) = sum w_i K(p - p_i) r_i^2 / cos(theta_i), 1/sr
    sigma   of the Gaussian kernel K, over the widths of the pupil

A pupil of the unit area under N rays of equal power has 4 pi sigma^2 N of them under the kernel, as many as would have its noise.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import cast

import numpy as np
from scipy.ndimage import gaussian_filter
from torch import Tensor

from caustic_cli.optics.emission.measured import effective_count, meeting
from caustic_cli.optics.rays import RayState
from caustic_cli.scene import Pupil, Scene
from caustic_cli.scene.sources.rays import Measured

#: Noise of the intensities that sigma is chosen for, and the largest sigma, by which shadows on the lens are blurred.
NOISE, WIDEST = 0.01, 0.1
#: Root mean square width of the groups, in pixels of the picture; 0.15 added 0.03 to the error of a flame of 96 x 96 pixels.
FINE = 0.1
#: Points at most, and values along each axis of the intensities of one point; several share as many.
MOST, VALUES = 256, 512
#: Bounds of |h|, over the size of the pupil: farther away light is parallel, and its groups are of directions.
NEAREST, FARTHEST = 0.02, 1e5
#: Rays that aberrations are told from.
FEW = 20_000
#: Subdivision of cells by which the part of a pupil around each value is found.
FINER = 4


@dataclass(frozen=True, eq=False)
class FieldPoint:
    """One point of a light field; rays through points of the pupil as of a `coherent.Mode`."""

    pupil: Pupil
    #: mm; behind the pupil for light that converges.
    position: tuple[float, float, float]
    #: Fraction of the source's power that it sends through the pupil.
    part: float
    #: (n, n) 1/sr, of all power `part`, over the pupil's rectangle, borders included.
    intensity: np.ndarray

    def through(self, u: Tensor, v: Tensor, index: float = 1.0) -> RayState:
        """Rays through points (N,) of the pupil, u and v in [0, 1] over its bounding rectangle, with fractions of the source's
        power per mm^2; index: of the medium in front of it."""
        (rx, ry), n = self.pupil.half_size, len(self.intensity)
        x, y = (2.0 * u - 1.0) * rx, (2.0 * v - 1.0) * ry
        (dx, dy, dz), r = _ways(x, y, self.position, self.pupil.z)
        (i, j), table = ((c * (n - 1)).long().clamp(0, n - 2) for c in (u, v)), u.new_tensor(self.intensity)
        f, g = u * (n - 1) - i, v * (n - 1) - j
        low, high = (table[i, k] * (1.0 - f) + table[i + 1, k] * f for k in (j, j + 1))
        return RayState((x, y, self.pupil.z), (dx, dy, dz), (low + g * (high - low)) * dz / (r * r), path=index * r)


@dataclass(frozen=True, eq=False)
class LightField:
    """The light of a ray file."""

    points: list[FieldPoint]
    #: Of the picture, relative, and sigma.
    noise: float
    sigma: float
    #: Number of rays that meet the pupil.
    rays: int
    #: Root mean square displacement of light by groups and kernel, in pixels of the picture.
    blur: float

    @property
    def words(self) -> str:
        """What is held of the file, and with what noise, in a sentence."""
        wide = " × ".join(f"{2.0 * self.sigma * 2.0 * r:.2g}" for r in self.points[0].pupil.half_size)
        points = "1 point with an intensity" if len(self.points) == 1 else f"{len(self.points)} points with an intensity each"
        return (
            f"The light of the ray file is held as {points}, averaged over {wide} mm of the pupil, from the"
            f" {self.rays:,} rays that meet it: about {self.noise:.1%} of noise in the picture, as broad patches; light displaced"
            f" by about {self.blur:.1f} pixels; shadows on the pupil blurred. The screen moves on this page, this light does not."
        )


def light_fields(scene: Scene, most: int = MOST) -> dict[int, LightField]:
    """Those of all ray files among the sources of a scene, by the place of each among them."""
    return {k: light_field(one, most) for k, one in enumerate(scene.by_source) if one.source.rays is not None}


def light_field(scene: Scene, most: int = MOST) -> LightField:
    """The light of a scene's ray file by at most this many points.

    Raises:
        InputError: no ray reaches the pupil.
    """
    source, pupil, screen = cast(Measured, scene.source), scene.pupil, scene.screen
    x, y, met, w = meeting(source, pupil)
    dx, dy, dz = source.turned.directions[met].T
    mx, my = dx / dz, dy / dz
    h = _distance(x, y, mx, my, w * dz**4, 2.0 * max(pupil.half_size))
    s = np.stack([x - h * mx, y - h * my], 1)
    pixel = np.array(screen.pixel) / abs(screen.z - pupil.z * (not screen.far))  # as angles
    seen = s / (abs(h) * pixel)
    groups = grouped(seen, w, most, FINE)
    values = max(9, round(VALUES / math.sqrt(len(groups))))
    count = effective_count(w) * 4.0 / pupil.aperture.filled  # if all of the rectangle were lit
    sigma = min(WIDEST, max(1.0 / (values - 1), 1.0 / (NOISE * math.sqrt(4.0 * math.pi * count))))
    values = min(values, math.ceil(1.0 / sigma) + 1)
    kernel, points = _Kernel(pupil, values, sigma), []
    for of in groups:
        part = float(w[of].sum())
        cx, cy = (w[of] @ s[of]) / part
        position = float(cx), float(cy), pupil.z - h
        points.append(FieldPoint(pupil, position, part, kernel.intensity(x[of], y[of], w[of], position)))
    u, v = x / pupil.half_size[0], y / pupil.half_size[1]
    apart = sum(max(_spread(seen[of], w[of])) for of in groups) / w.sum()
    blur = math.sqrt(apart + (2.0 * sigma * _steepness(u, v, seen, w)) ** 2)
    return LightField(points, 1.0 / math.sqrt(4.0 * math.pi * sigma * sigma * count), sigma, len(w), blur)


def _ways(x, y, position: tuple[float, float, float], z: float):
    """Unit directions of light from a point, or to it where it lies behind the plane z, and its distance r, mm, from x, y there."""
    px, py, pz = position
    sign = math.copysign(1.0, z - pz)
    dx, dy, dz = sign * (x - px), sign * (y - py), abs(z - pz)
    r = (dx * dx + dy * dy + dz * dz) ** 0.5
    return (dx / r, dy / r, dz / r), r


def _distance(x: np.ndarray, y: np.ndarray, mx: np.ndarray, my: np.ndarray, w: np.ndarray, size: float) -> float:
    """h of the plane from whose points the light through x, y with slopes mx, my and weights w comes with the least variance of its
    slopes; never within the lens, where light between entrance and exit has no definite way."""
    common, wide = 0.0, 0.0
    for a, m in ((x, mx), (y, my)):
        a = a - np.average(a, weights=w)
        common, wide = common + float(w @ (a * m)), wide + float(w @ (a * a))
    h = wide / common if wide < FARTHEST * size * abs(common) else FARTHEST * size
    return max(h, NEAREST * size) if h >= 0 else min(h, -size)


def grouped(s: np.ndarray, w: np.ndarray, most: int, fine: float) -> list[np.ndarray]:
    """Indices of points (N, 2) with weights in at most so many groups, whose root mean square distance from their means is at most
    `fine` along each axis if that many are enough: the group with the largest sum of squares is cut at its mean, across."""
    groups, spreads = [np.arange(len(w))], [_spread(s, w)]
    while len(groups) < most and sum(map(max, spreads)) > fine * fine * w.sum():
        k = max(range(len(groups)), key=lambda k: max(spreads[k]))
        of, axis = groups[k], spreads[k].index(max(spreads[k]))
        at = s[of, axis]
        near = at <= np.average(at, weights=w[of])
        if near.all():  # equal but for rounding
            break
        cut = [of[near], of[~near]]
        groups[k : k + 1], spreads[k : k + 1] = cut, [_spread(s[part], w[part]) for part in cut]
    return groups


def _spread(s: np.ndarray, w: np.ndarray) -> list[float]:
    """Weighted sums of squares along each axis about the mean."""
    return [float(c) for c in w @ (s - w @ s / w.sum()) ** 2]


def _steepness(u: np.ndarray, v: np.ndarray, s: np.ndarray, w: np.ndarray) -> float:
    """Root mean square derivative by u and v of the cubic that fits intercepts s (N, 2) best, larger axis: of an aberration, by
    which light that the kernel moves over the pupil comes from another point than it should."""
    few = np.arange(0, len(w), -(-len(w) // FEW))
    u, v, s, w = u[few], v[few], s[few], w[few]
    powers = [(a, b) for a in range(4) for b in range(4 - a)]
    root = np.sqrt(w)[:, None]
    terms = np.stack([u**a * v**b for a, b in powers], 1)
    found = np.linalg.lstsq(root * terms, root * s, rcond=None)[0]
    by_u = np.stack([a * u ** max(a - 1, 0) * v**b for a, b in powers], 1) @ found
    by_v = np.stack([b * u**a * v ** max(b - 1, 0) for a, b in powers], 1) @ found
    return math.sqrt(float(np.max(w @ (by_u**2 + by_v**2)) / w.sum()))


class _Kernel:
    """Estimates intensities on (n, n) values over a pupil's rectangle."""

    def __init__(self, pupil: Pupil, n: int, sigma: float):
        self.pupil, self.n, self.wide = pupil, n, sigma * (n - 1)
        even = (np.arange(FINER * (n - 1)) + 0.5) / (FINER * (n - 1))
        u, v = (c.ravel() for c in np.meshgrid(even, even, indexing="ij"))
        lit = pupil.aperture.covers(2.0 * u - 1.0, 2.0 * v - 1.0) * (4.0 * math.prod(pupil.half_size) / u.size)
        #: mm^2 of the pupil around each value, and the same under the kernel.
        self.areas = self._shared(u, v, lit)
        self.under = gaussian_filter(self.areas, self.wide, mode="constant")

    def _shared(self, u: np.ndarray, v: np.ndarray, w: np.ndarray) -> np.ndarray:
        """Weights of points of [0, 1]^2 shared out linearly among the values around each, (n, n)."""
        n, (i, j) = self.n, ((c * (self.n - 1)).astype(int).clip(0, self.n - 2) for c in (u, v))
        f, g = u * (n - 1) - i, v * (n - 1) - j
        total = np.zeros(n * n)
        for a, fa in ((0, 1.0 - f), (1, f)):
            for b, gb in ((0, 1.0 - g), (1, g)):
                total += np.bincount((i + a) * n + j + b, w * fa * gb, n * n)
        return total.reshape(n, n)

    def intensity(self, x: np.ndarray, y: np.ndarray, w: np.ndarray, position: tuple[float, float, float]) -> np.ndarray:
        """I(p) of rays through x, y from a point, 1/sr, (n, n); their power is that of the rays."""
        (rx, ry), n = self.pupil.half_size, self.n
        (*_, cosine), r = _ways(x, y, position, self.pupil.z)
        sums = gaussian_filter(self._shared(0.5 + 0.5 * x / rx, 0.5 + 0.5 * y / ry, w * r * r / cosine), self.wide, mode="constant")
        found = np.divide(sums, self.under, out=np.zeros_like(sums), where=self.under > 1e-3 * self.under.max())
        at = np.linspace(-1.0, 1.0, n)
        (*_, cosine), r = _ways(rx * at[:, None], ry * at[None, :], position, self.pupil.z)
        return found * (w.sum() / (found * cosine / (r * r) * self.areas).sum())
